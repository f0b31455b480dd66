"""The instrument's config: read, checked as a whole, and kept in a form that needs no other file."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

import namod_ctl
from namod_ctl.app.config.actuator_schema import ActuatorsSection
from namod_ctl.app.config.calibration_schema import CameraRole
from namod_ctl.app.config.calibrations import calibration_problems, with_calibrations_read
from namod_ctl.app.config.camera_problems import with_whole_folder
from namod_ctl.app.config.contradictions import contradictions
from namod_ctl.app.config.extends import read_extended
from namod_ctl.app.config.problems import describe_problems
from namod_ctl.app.config.schema import (
    FacetSection,
    InstrumentSections,
    LayoutSection,
    PolygonSection,
    ReflectorMapSection,
    ReflectorSection,
)
from namod_ctl.app.config.section import Section
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_deg
from namod_ctl.devices.drive_maps import read_drive_map
from namod_ctl.optics.layouts import Dish, Layout, generate_reflector
from namod_ctl.optics.reflector import Facet, FacetShape
from namod_ctl.store.facet_lists import read_mars, read_sim_telarray
from namod_ctl.store.facet_tables import read_facet_table, read_polygon_table

CAMERA_SECTIONS: tuple[CameraRole, ...] = ("star_camera", "reflector_camera")
"""Of the cameras that records come from."""
ALL_CAMERA_SECTIONS: tuple[CameraRole, ...] = (*CAMERA_SECTIONS, "psf_camera")
MAX_REPORTED_PROBLEMS = 40  # a wrong unit in a list of 1000 facets needs no 1000 lines
SAME_ANGLE_DECIMALS = 12  # of a degree: takes the rounding of deg -> rad -> deg away


class InstrumentConfig(InstrumentSections):
    """A checked config; the facets and their outlines are always written out in it."""

    @property
    def facets(self) -> tuple[FacetSection, ...]:
        """All facets, in their order."""
        if self.reflector.facets is None:
            raise TypeError("an InstrumentConfig comes from load_config or from_json, which write the facets out")
        return self.reflector.facets

    @property
    def polygons(self) -> tuple[PolygonSection, ...]:
        """The outlines of the facets in the reflector camera's image; empty without a map."""
        return (self.reflector_map.polygons or ()) if self.reflector_map is not None else ()

    def to_json(self) -> str:
        """The config as JSON text that needs no other file; `from_json` restores exactly the same instrument."""
        return json.dumps(self.model_dump(exclude_none=True), indent=1)

    @classmethod
    def from_json(cls, text: str, source: str) -> InstrumentConfig:
        """The config that `to_json` wrote; `source` names it in errors. Raises ConfigError."""
        try:
            raw = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{source}: the stored config is no JSON: {error}") from None
        try:
            config = cls.model_validate(raw)
        except ValidationError as error:
            raise _together(describe_problems(error, cls, source)) from None
        if config.reflector.facets is None:
            raise ConfigError(f"{source}: reflector: the stored config must hold its facets written out")
        if config.reflector_map is not None and config.reflector_map.polygons is None:
            raise ConfigError(f"{source}: reflector_map: the stored config must hold its polygons written out")
        buses = config.actuators.buses if config.actuators is not None else ()
        if any(isinstance(bus.drive_map, str) for bus in buses):
            raise ConfigError(f"{source}: actuators: the stored config must hold its register maps written out")
        for name in ALL_CAMERA_SECTIONS:
            if any(isinstance(named, str) for named in getattr(getattr(config, name), "calibrations", None) or ()):
                raise ConfigError(f"{source}: {name}: the stored config must hold its calibrations written out")
        _raise_together(contradictions(config, cls.model_fields.keys(), source))
        return config


def builtin_folder() -> Path:
    """Folder of the configs that come with the program: inside the installed package, or beside it in a checkout."""
    package = Path(namod_ctl.__file__).parent
    inside = package / "config"
    return inside if inside.is_dir() else package.parent / "config"


def builtin_names() -> list[str]:
    """Names of the configs that come with the program, such as `fact`."""
    return sorted(path.stem for path in builtin_folder().glob("*.toml"))


def find_config(name_or_path: str | Path) -> Path:
    """The file of a built-in name or a path. Raises ConfigError that lists the built-in names."""
    path = Path(name_or_path)
    if path.is_file():
        return path
    if str(name_or_path) in builtin_names():
        return builtin_folder() / f"{name_or_path}.toml"
    what = "is a folder, not a config file" if path.is_dir() else "there is no such config file"
    raise ConfigError(
        f"{name_or_path}: {what}; give the path of a TOML file or a built-in name: {', '.join(builtin_names())}"
    )


def load_config(name_or_path: str | Path, *, has_map: bool = True, now: datetime | None = None) -> InstrumentConfig:
    """The config of a built-in name or a TOML file, with the files it names read and everything checked.

    Without `has_map` the map of facets is left out, as if the config had none: for those who are about to make it.
    Calibrations must be valid at `now`, by default that of the computer's clock.

    Raises
    ------
    ConfigError
        All problems that can be found together, each with file, key, value, rule and remedy.
    """
    path = find_config(name_or_path)
    raw, source = read_extended(path, find_config)
    if not has_map:
        raw.pop("reflector_map", None)
    problems: list[str] = []
    config, known = _sound_sections(raw, source, problems)
    readers: dict[str, Callable[[], Section | None]] = {
        "reflector": lambda: ReflectorSection(facets=_facets_of(config, path)),
        "reflector_map": lambda: _written_out_map(config.reflector_map, path.parent),
        "actuators": lambda: _with_drive_maps(config.actuators, path.parent, source),
    }
    if "telescope" not in known and "reflector" in known and _needs_focal_length(config.reflector):
        known.discard("reflector")
    written_out: dict[str, Section | None] = {}
    for name in [name for name in readers if name in known]:
        try:
            written_out[name] = readers[name]()
        except ConfigError as problem:
            problems.append(str(problem))
            known.discard(name)
    for name in ALL_CAMERA_SECTIONS:
        if name in known and getattr(config, name) is not None:
            camera = with_whole_folder(getattr(config, name), path.parent)
            try:
                camera = with_calibrations_read(camera, path.parent)
            except ConfigError as problem:
                problems.append(f"{source}: {name}.calibrations: {problem}")
            written_out[name] = camera
    config = config.model_copy(update=written_out)
    problems += contradictions(config, known, source)
    moment = now or SystemClock().now()
    problems += [
        f"{source}: {name}.calibrations: {problem}"
        for name in ALL_CAMERA_SECTIONS
        if name in known and getattr(config, name) is not None
        for problem in calibration_problems(getattr(config, name), name, moment)
    ]
    _raise_together(problems)
    return config


def _sound_sections(raw: dict[str, Any], source: str, problems: list[str]) -> tuple[InstrumentConfig, set[str]]:
    """The config without the sections that are wrong in themselves, and the names of all others; what is wrong is told.

    A section that is wrong is absent from the config, not None.
    """
    try:
        return InstrumentConfig.model_validate(raw), set(InstrumentConfig.model_fields)
    except ValidationError as error:
        problems += describe_problems(error, InstrumentConfig, source)
        known = InstrumentConfig.model_fields.keys() - {detail["loc"][0] for detail in error.errors() if detail["loc"]}
    types = get_type_hints(InstrumentConfig, include_extras=True)
    sections = {name: TypeAdapter(types[name]).validate_python(raw[name]) for name in known & raw.keys()}
    return InstrumentConfig.model_construct(**sections), known


def _together(problems: list[str]) -> ConfigError:
    """One error of all problems."""
    n_more = len(problems) - MAX_REPORTED_PROBLEMS
    more = [f"... and {n_more} more"] if n_more > 0 else []
    return ConfigError("\n".join(problems[:MAX_REPORTED_PROBLEMS] + more))


def _raise_together(problems: list[str]) -> None:
    if problems:
        raise _together(problems)


def _needs_focal_length(section: ReflectorSection) -> bool:
    """Does the telescope's focal length decide where the facets are?"""
    return section.layout is not None or section.format == "sim_telarray"


def _facets_of(config: InstrumentConfig, path: Path) -> tuple[FacetSection, ...]:
    """The facets written out, whichever way the config at `path` gives them."""
    section = config.reflector
    if section.facets is not None:
        return section.facets
    if section.layout is not None:
        try:
            reflector = generate_reflector(_layout(section.layout, config.telescope.focal_length_m))
        except ConfigError as problem:
            raise ConfigError(f"{path}: reflector.layout: {problem}") from None
        return tuple(_facet_section(facet, path) for facet in reflector.facets)
    facets_path = path.parent / str(section.facets_file)
    if section.format == "namod":
        facets = read_facet_table(facets_path)
    elif section.format == "mars":
        facets = read_mars(facets_path, section.facet_ids).facets
    else:
        dish = Dish(
            config.telescope.focal_length_m,
            section.dish.parabola_share if section.dish is not None else 0.0,
            section.dish.sphere_radius_m if section.dish is not None else None,
        )
        facets = read_sim_telarray(facets_path, dish, section.facet_ids).facets
    return tuple(_facet_section(facet, facets_path) for facet in facets)


def _layout(section: LayoutSection, focal_length_m: float) -> Layout:
    return Layout(
        dish=Dish(focal_length_m, section.parabola_share, section.sphere_radius_m),
        shape=FacetShape(section.shape),
        width_m=section.width_m,
        spacing_m=section.spacing_m,
        inner_radius_m=section.inner_radius_m,
        outer_radius_m=section.outer_radius_m,
        centre=section.lattice_centre,
        facet_focal_length_m=section.facet_focal_length_m,
    )


def _facet_section(facet: Facet, path: Path) -> FacetSection:
    x_m, y_m, z_m = (float(value_m) for value_m in facet.position_m)
    try:
        return FacetSection(
            id=facet.id,
            position_m=(x_m, y_m, z_m),
            focal_length_m=facet.focal_length_m,
            shape=facet.shape.value,
            width_m=facet.width_m,
            rotation_deg=round(rad_to_deg(facet.rotation_rad), SAME_ANGLE_DECIMALS),
        )
    except ValidationError as error:
        raise ConfigError("\n".join(describe_problems(error, FacetSection, f"{path}: facet {facet.id}"))) from None


def _written_out_map(section: ReflectorMapSection | None, folder: Path) -> ReflectorMapSection | None:
    if section is None or section.polygons_file is None:
        return section
    path = folder / section.polygons_file
    if not path.is_file():
        raise ConfigError(
            f"{path}: there is no such file, but reflector_map.polygons_file = {section.polygons_file!r} names it; "
            "make it with 'namod-ctl facets edit', or take [reflector_map] out (then no images can be measured)"
        )
    polygons = []
    for facet_id, corners_px in read_polygon_table(path).items():
        corners = tuple((float(x_px), float(y_px)) for x_px, y_px in corners_px)
        try:
            polygons.append(PolygonSection(facet_id=facet_id, corners_px=corners))
        except ValidationError as error:
            where = f"{path}: facet {facet_id}"
            raise ConfigError("\n".join(describe_problems(error, PolygonSection, where))) from None
    return ReflectorMapSection(polygons=tuple(polygons))


def _with_drive_maps(actuators: ActuatorsSection | None, folder: Path, source: str) -> ActuatorsSection | None:
    """The section with its register maps written out. Raises ConfigError with all that cannot be read."""
    if actuators is None:
        return None
    buses, problems = [], []
    for number, bus in enumerate(actuators.buses, start=1):
        if isinstance(bus.drive_map, str):
            try:
                table = read_drive_map(bus.drive_map, folder, builtin_folder() / "drives")
            except ConfigError as problem:
                problems.append(f"{source}: actuators.buses[{number}].drive_map: {problem}")
            else:
                bus = bus.model_copy(update={"drive_map": table})
        buses.append(bus)
    _raise_together(problems)
    return actuators.model_copy(update={"buses": tuple(buses)})

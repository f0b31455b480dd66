"""The instrument's config: read, checked as a whole, and kept in a form that needs no other file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

import namod_ctl
from namod_ctl.app.actuator_problems import actuator_problems
from namod_ctl.app.actuator_schema import ActuatorsSection
from namod_ctl.app.config_extends import read_extended
from namod_ctl.app.config_problems import describe_problems
from namod_ctl.app.config_schema import (
    FacetSection,
    InstrumentSections,
    LayoutSection,
    PolygonSection,
    ReflectorMapSection,
    ReflectorSection,
)
from namod_ctl.app.parts import mount_of, reflector_of
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_deg
from namod_ctl.devices.drive_maps import read_drive_map
from namod_ctl.optics.layouts import Dish, Layout, generate_reflector, overlapping_facets
from namod_ctl.optics.polygons import polygon_fault
from namod_ctl.optics.reflector import Facet, FacetShape
from namod_ctl.store.facet_lists import read_mars, read_sim_telarray
from namod_ctl.store.facet_tables import read_facet_table, read_polygon_table

MAX_RADIUS_SHARE = 1.5  # of the focal length: no Cherenkov telescope is faster than F/D = 0.33
MIN_HEIGHT_SHARE = -0.02  # of the focal length: measured dishes scatter around the vertex, not below
FACET_FOCAL_SHARES = (0.5, 3.0)  # of the telescope's focal length
MAX_REPORTED_PROBLEMS = 40  # a wrong unit in a list of 1000 facets needs no 1000 lines
MAX_OVERLAP_SHARE = 0.02  # of a facet's area: measured positions are good to some mm
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
        config = _validate(raw, source)
        if config.reflector.facets is None:
            raise ConfigError(f"{source}: reflector: the stored config must hold its facets written out")
        if config.reflector_map is not None and config.reflector_map.polygons is None:
            raise ConfigError(f"{source}: reflector_map: the stored config must hold its polygons written out")
        buses = config.actuators.buses if config.actuators is not None else ()
        if any(isinstance(bus.drive_map, str) for bus in buses):
            raise ConfigError(f"{source}: actuators: the stored config must hold its register maps written out")
        _raise_together(_contradictions(config, source))
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


def load_config(name_or_path: str | Path) -> InstrumentConfig:
    """The config of a built-in name or a TOML file, with the files it names read and everything checked.

    Raises
    ------
    ConfigError
        All problems together, each with file, key, value, rule and remedy.
    """
    path = find_config(name_or_path)
    raw, source = read_extended(path, find_config)
    config = _validate(raw, source)
    problems: list[str] = []
    reflector = config.reflector
    reflector_map = config.reflector_map
    try:
        reflector = ReflectorSection(facets=_facets_of(config, path))
    except ConfigError as problem:
        problems.append(str(problem))
    if reflector_map is not None and reflector_map.polygons_file is not None:
        try:
            reflector_map = _read_map(path.parent / reflector_map.polygons_file)
        except ConfigError as problem:
            problems.append(str(problem))
    actuators = config.actuators
    if actuators is not None:
        actuators = _with_drive_maps(actuators, path.parent, source, problems)
    _raise_together(problems)
    config = config.model_copy(update={"reflector": reflector, "reflector_map": reflector_map, "actuators": actuators})
    _raise_together(_contradictions(config, source))
    return config


def _validate(raw: Any, source: str) -> InstrumentConfig:
    try:
        return InstrumentConfig.model_validate(raw)
    except ValidationError as error:
        raise _together(describe_problems(error, InstrumentConfig, source)) from None


def _together(problems: list[str]) -> ConfigError:
    """One error of all problems."""
    n_more = len(problems) - MAX_REPORTED_PROBLEMS
    more = [f"... and {n_more} more"] if n_more > 0 else []
    return ConfigError("\n".join(problems[:MAX_REPORTED_PROBLEMS] + more))


def _raise_together(problems: list[str]) -> None:
    if problems:
        raise _together(problems)


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


def _read_map(path: Path) -> ReflectorMapSection:
    polygons = []
    for facet_id, corners_px in read_polygon_table(path).items():
        corners = tuple((float(x_px), float(y_px)) for x_px, y_px in corners_px)
        try:
            polygons.append(PolygonSection(facet_id=facet_id, corners_px=corners))
        except ValidationError as error:
            where = f"{path}: facet {facet_id}"
            raise ConfigError("\n".join(describe_problems(error, PolygonSection, where))) from None
    return ReflectorMapSection(polygons=tuple(polygons))


def _with_drive_maps(actuators: ActuatorsSection, folder: Path, source: str, problems: list[str]) -> ActuatorsSection:
    """The section with its register maps written out; those that cannot be read go into `problems`."""
    buses = []
    for number, bus in enumerate(actuators.buses, start=1):
        if isinstance(bus.drive_map, str):
            try:
                table = read_drive_map(bus.drive_map, folder, builtin_folder() / "drives")
            except ConfigError as problem:
                problems.append(f"{source}: actuators.buses[{number}].drive_map: {problem}")
            else:
                bus = bus.model_copy(update={"drive_map": table})
        buses.append(bus)
    return actuators.model_copy(update={"buses": tuple(buses)})


def _contradictions(config: InstrumentConfig, source: str) -> list[str]:
    """What is wrong between values that are plausible one by one; one text per problem."""
    ids = [facet.id for facet in config.facets]
    problems = [
        f"{source}: reflector: facet id {facet_id} occurs {ids.count(facet_id)} times; every facet needs its own"
        for facet_id in sorted(set(ids))
        if ids.count(facet_id) > 1
    ]
    problems += _misplaced_facets(config, source)
    try:
        mount_of(config.mount, config.mount.orientation_deg).check_geometry(f"{source}: mount")
    except ConfigError as problem:
        problems.append(str(problem))
    if not problems:
        problems += _overlaps(config, source)
    for key in config.mount.facet_orientation_deg:
        if key not in set(map(str, ids)):
            problems.append(f"{source}: mount.facet_orientation_deg.{key}: there is no facet of this id")
    if config.actuators is not None:
        problems += actuator_problems(config.actuators, config.mount, ids, source)
    return problems + _bad_polygons(config, set(ids), source) + _bad_target(config, source)


def _misplaced_facets(config: InstrumentConfig, source: str) -> list[str]:
    focal_length_m = config.telescope.focal_length_m
    problems = []
    for facet in config.facets:
        x_m, y_m, z_m = facet.position_m
        radius_m = float(np.hypot(x_m, y_m))
        share = facet.focal_length_m / focal_length_m
        if radius_m > MAX_RADIUS_SHARE * focal_length_m:
            problems.append(
                f"{source}: reflector: facet {facet.id} stands {radius_m:g} m from the axis, more than "
                f"{MAX_RADIUS_SHARE:g} focal lengths of {focal_length_m:g} m: check the unit of positions"
            )
        if not MIN_HEIGHT_SHARE * focal_length_m <= z_m < focal_length_m:
            problems.append(
                f"{source}: reflector: facet {facet.id} has z = {z_m:g} m, must lie from {MIN_HEIGHT_SHARE:g} "
                f"to 1 focal length of {focal_length_m:g} m over the dish vertex: check sign and unit"
            )
        if not FACET_FOCAL_SHARES[0] <= share <= FACET_FOCAL_SHARES[1]:
            problems.append(
                f"{source}: reflector: facet {facet.id} has focal_length_m = {facet.focal_length_m:g}, must be "
                f"{FACET_FOCAL_SHARES[0]:g} to {FACET_FOCAL_SHARES[1]:g} of the telescope's {focal_length_m:g} m: "
                "check the unit, and that it is no radius of curvature"
            )
    return problems


def _overlaps(config: InstrumentConfig, source: str) -> list[str]:
    """Facets that stand in each other's place: a position, width or id list is wrong."""
    pairs = overlapping_facets(reflector_of(config.telescope.focal_length_m, config.facets))
    return [
        f"{source}: reflector: facets {first} and {second} overlap by {share:.0%} of a facet, at most "
        f"{MAX_OVERLAP_SHARE:.0%} pass as error of measurement: check positions, width_m and rotation_deg"
        for first, second, share in pairs
        if share > MAX_OVERLAP_SHARE
    ]


def _bad_polygons(config: InstrumentConfig, ids: set[int], source: str) -> list[str]:
    camera = config.reflector_camera
    problems = []
    seen: set[int] = set()
    for polygon in config.polygons:
        where = f"{source}: reflector_map: the polygon of facet {polygon.facet_id}"
        if polygon.facet_id not in ids:
            problems.append(f"{where}: the reflector has no facet of this id; its ids are {_ranges(ids)}")
        if polygon.facet_id in seen:
            problems.append(f"{where} occurs twice; every facet has one outline")
        seen.add(polygon.facet_id)
        corners_px = np.array(polygon.corners_px, dtype=np.float64).reshape(-1, 2)
        fault = polygon_fault(corners_px, camera.columns, camera.rows)
        if fault is not None:
            problems.append(f"{where}: {fault}")
    return problems


def _bad_target(config: InstrumentConfig, source: str) -> list[str]:
    if config.recording is None:
        return []
    share = config.recording.brightest_pixel_share
    cameras = (("star_camera", config.star_camera), ("reflector_camera", config.reflector_camera))
    return [
        f"{source}: recording.brightest_pixel_share = {share:g} must be less than {name}.saturation_share = "
        f"{camera.saturation_share:g}: every frame would be saturated"
        for name, camera in cameras
        if share >= camera.saturation_share
    ]


def _ranges(ids: set[int]) -> str:
    shown = sorted(ids)
    return ", ".join(map(str, shown)) if len(shown) <= 40 else f"{shown[0]} to {shown[-1]}"

"""The twin of the telescope that a config describes."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin_limits import Origins, as_written, beyond_limits, in_radians
from namod_ctl.app.config.camera_schema import DeviceCameraSection
from namod_ctl.app.config.instrument import CAMERA_SECTIONS, InstrumentConfig
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.reflector import Reflector
from namod_ctl.store.table_text import read_text
from namod_ctl.twin.drive_wiring import BusWiring
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.settings import REFLECTOR_CAMERA, STAR_CAMERA, TwinSettings
from namod_ctl.twin.surface_map import projected_outlines
from namod_ctl.twin.twin import Twin

IMAGE_MARGIN_SHARE = 0.02
"""Of the image's width: a lens is chosen so that the dish leaves that much free."""


def load_twin_settings(path: str | Path) -> TwinSettings:
    """Settings from a TOML file with the keys of `TwinSettings`; what is not given keeps its default.

    Angles may be given in other units than rad: `misalignment_arcmin = 4.0`, `speed_arcmin_per_s = 1.0`. Faults are
    `[[faults]]` with `name`, `start_s`, `duration_s` and `params`.

    Raises
    ------
    ConfigError
        All wrong keys and values together.
    """
    try:
        raw = tomllib.loads(read_text(Path(path)))
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    problems: list[str] = []
    origins: Origins = {}
    raw = in_radians(raw, origins, problems)
    problems += beyond_limits(raw, origins)
    for camera, default in (("star_camera", STAR_CAMERA), ("reflector_camera", REFLECTOR_CAMERA)):
        if isinstance(raw.get(camera), dict):  # these two have defaults of their own
            own = {"exposure_at_mag0_s": default.exposure_at_mag0_s, "background_share": default.background_share}
            raw[camera] = own | raw[camera]
    settings = TwinSettings()
    try:
        settings = TypeAdapter(TwinSettings).validate_python(raw)
    except ValidationError as error:
        problems += [
            f"{as_written(detail['loc'], origins)} = {detail['input']!r}: {detail['msg']}" for detail in error.errors()
        ]
    for camera, used in (("star_camera", settings.star_camera), ("reflector_camera", settings.reflector_camera)):
        shortest_s, longest_s = used.exposure_range_s
        if not shortest_s < longest_s:
            problems.append(f"{camera}.exposure_range_s = {[shortest_s, longest_s]}: the first must be the shorter")
    problems += _fault_problems(settings) if not problems else []
    if problems:
        raise ConfigError("\n".join(f"{path}: {problem}" for problem in problems))
    return settings


def _fault_problems(settings: TwinSettings) -> Iterator[str]:
    plan = FaultPlan()
    for number, fault in enumerate(settings.faults):
        try:
            plan.inject(fault)
        except ConfigError as problem:
            yield f"faults.{number}: {problem}"


def build_twin(config: InstrumentConfig, settings: TwinSettings, seed: int, wiring: Sequence[BusWiring] = ()) -> Twin:
    """The twin of that config; `twin.instrument` has a map of facets even where the config has none.

    Its cameras are those of the config without calibrations: what a calibration tells of a camera does not change it.
    The program sees `instrument_on_twin`. With `wiring` (`build_twin_actuators.twin_wiring`) its facets have drives.

    Raises
    ------
    ConfigError
        For a star, a fault or a parameter in the settings that does not exist.
    """
    return Twin(with_facet_map(build_instrument(_uncalibrated(config))), settings, seed, wiring)


def instrument_on_twin(config: InstrumentConfig) -> Instrument:
    """The instrument as the program knows it, on a twin of that config: by the cameras' calibrations, if it has any."""
    instrument = build_instrument(config)
    if instrument.facet_polygons_px:
        return instrument
    polygons_px = with_facet_map(build_instrument(_uncalibrated(config))).facet_polygons_px
    return replace(instrument, facet_polygons_px=polygons_px)


def _uncalibrated(config: InstrumentConfig) -> InstrumentConfig:
    cameras: dict[str, DeviceCameraSection | None] = {role: getattr(config, role) for role in CAMERA_SECTIONS}
    bare = {
        role: camera.model_copy(update={"calibrations": None}) for role, camera in cameras.items() if camera is not None
    }
    return config.model_copy(update=bare)


def with_facet_map(instrument: Instrument) -> Instrument:
    """The instrument itself if it has a map of facets, else one with the map that `project_polygons` makes."""
    if instrument.facet_polygons_px:
        return instrument
    polygons_px = project_polygons(instrument.reflector, instrument.reflector_camera)
    return replace(instrument, facet_polygons_px=polygons_px)


def project_polygons(reflector: Reflector, camera: CameraModel) -> dict[int, NDArray[np.float64]]:
    """Outlines of all facets, by id, shape (n_corners, 2), as a pinhole camera in the focal point sees them.

    Where the dish does not fit into the image, the camera is taken to have a lens of shorter focal length that shows
    all of it: nothing that is measured depends on the reflector camera's plate scale.
    """
    outlines = projected_outlines(reflector, camera)
    offsets = np.concatenate(outlines) - camera.axis_pixel
    room = np.array([camera.n_columns, camera.n_rows]) / 2.0 - IMAGE_MARGIN_SHARE * camera.n_columns
    shrink = min(1.0, float(np.min(room / np.abs(offsets).max(axis=0))))
    return {
        facet.id: camera.axis_pixel + shrink * (outline - camera.axis_pixel)
        for facet, outline in zip(reflector.facets, outlines, strict=True)
    }

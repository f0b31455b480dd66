"""From a folder of frames to the responses of a lamp series, as `cycle.lamp_recording` gives them of a live camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from namod_ctl.app.build.stored_lamp_frames import (
    ExposureUnit,
    StoredFrame,
    check_kind,
    dark_frames_of_folder,
    frames_of_folder,
    numbered_placements,
    read_stored,
)
from namod_ctl.app.config.schema import ReflectorCameraSection, StarCameraSection
from namod_ctl.calibration.lamp.dark_frames import DarkFrame, refuse_light
from namod_ctl.calibration.lamp.lamp_series import (
    Patch,
    Response,
    lit_patch,
    measure_response,
    middle_of,
    patch_dark,
    refuse_wandering,
    unknown_dark,
    without_hot,
)
from namod_ctl.calibration.lamp.radiometric_checks import check_exposure_range
from namod_ctl.core.errors import DataQualityError
from namod_ctl.cycle.lamp_recording import LampSeries, brightness_adu
from namod_ctl.optics.camera_model import CameraModel

MAX_DARKS = 60
OPEN_SHARE = 0.93
"""Of full scale: the brightest pixels of a frame that shows where the lamp is."""


@dataclass(frozen=True, slots=True)
class _Glance:
    """What the first look at a file tells."""

    exposure_s: float
    start_s: float
    brightness_adu: float
    median_adu: float
    kind: str


def read_stored_darks(
    folder: Path,
    camera: StarCameraSection | ReflectorCameraSection,
    unit: ExposureUnit,
    exposure_range_s: tuple[float, float],
) -> list[DarkFrame]:
    """The dark frames of a folder.

    Raises
    ------
    ConfigError, DataQualityError
        There are none, or some cannot be used.
    """
    darks = _darks(dark_frames_of_folder(folder), camera, unit)
    check_exposure_range([dark.exposure_s for dark in darks], [math.nan] * len(darks), exposure_range_s)
    return darks


def _darks(
    frames: Sequence[StoredFrame], camera: StarCameraSection | ReflectorCameraSection, unit: ExposureUnit
) -> list[DarkFrame]:
    if len(frames) > MAX_DARKS:
        raise DataQualityError(f"{len(frames)} dark frames are more than {MAX_DARKS}: leave some out")
    darks = []
    for frame in frames:
        read = read_stored(frame, unit)
        check_kind(frame, read.image, camera.columns, camera.rows, camera.full_scale_adu)
        darks.append(DarkFrame(frame.path.name, read.image, read.exposure_s))
    return darks


def read_stored_series(
    folder: Path,
    camera: StarCameraSection | ReflectorCameraSection,
    model: CameraModel,
    unit: ExposureUnit,
    exposure_range_s: tuple[float, float],
    say: Callable[[str], None],
) -> LampSeries:
    """The responses of the frames that `series.csv` of the folder names.

    Raises
    ------
    ConfigError, DataQualityError
        The files, or what they show, make no series.
    """
    frames = frames_of_folder(folder)
    lit = [frame for frame in frames if frame.placement is not None]
    if not lit:
        raise DataQualityError(f"{folder}: no frame of the lamp is named, only dark ones")
    darks = _darks([frame for frame in frames if frame.placement is None], camera, unit)
    refuse_light(darks, camera.full_scale_adu)
    say(f"{len(lit)} frames of the lamp and {len(darks)} dark frames")
    glances = []
    for frame in lit:
        read = read_stored(frame, unit)
        check_kind(frame, read.image, camera.columns, camera.rows, camera.full_scale_adu)
        median = float(np.median(read.image))
        kind = f"{8 * read.image.itemsize} bit, {'grey' if read.image.ndim == 2 else 'colour'}"
        glances.append(_Glance(read.exposure_s, read.start_s, brightness_adu(read.image), median, kind))
    _refuse_unlike(lit, glances)
    exposures = [glance.exposure_s for glance in glances] + [dark.exposure_s for dark in darks]
    starts = [glance.start_s for glance in glances] + [math.nan] * len(darks)
    check_exposure_range(
        exposures if not darks else exposures[: len(glances)], starts[: len(glances)], exposure_range_s
    )
    if all(math.isfinite(glance.start_s) for glance in glances):
        order = sorted(range(len(lit)), key=lambda i: glances[i].start_s)
        lit, glances = [lit[i] for i in order], [glances[i] for i in order]
    series = LampSeries()
    series.placements, numbers = numbered_placements(lit)
    if darks:
        dark_adu = float(np.median(darks[0].image))
    elif model.dark is not None:
        dark_adu = model.dark.bias_adu
    else:
        dark_adu = min(glance.median_adu for glance in glances)
    series.patch = patch = without_hot(
        middle_of(_patch(lit, glances, numbers, series, unit, dark_adu, camera.full_scale_adu)), darks
    )
    n_channels = 1
    for frame, glance, number in zip(lit, glances, numbers, strict=True):
        response = _response(frame, glance, number, patch, unit, camera.full_scale_adu)
        n_channels = len(response.mean_adu)
        series.responses.append(response)
    if darks:
        series.dark = patch_dark(darks, patch)
    else:
        series.dark = unknown_dark(model.dark, camera.full_scale_adu, n_channels)
    return series


def _refuse_unlike(lit: Sequence[StoredFrame], glances: Sequence[_Glance]) -> None:
    """Raise DataQualityError for frames of several cameras or modes; one of each kind is named."""
    kinds = {glance.kind: frame.path.name for frame, glance in zip(lit, glances, strict=True)}
    if len(kinds) > 1:
        told = "; ".join(f"{name}: {kind}" for kind, name in kinds.items())
        raise DataQualityError(f"the frames are of several cameras or modes ({told}); give those of one")


def _response(
    frame: StoredFrame, glance: _Glance, number: int, patch: Patch, unit: ExposureUnit, full_scale_adu: float
) -> Response:
    image = read_stored(frame, unit).image
    middle_s = glance.start_s + glance.exposure_s / 2.0
    return measure_response(image, patch, full_scale_adu, frame.path.name, number, glance.exposure_s, middle_s)


def _patch(
    lit: Sequence[StoredFrame],
    glances: Sequence[_Glance],
    numbers: Sequence[int],
    series: LampSeries,
    unit: ExposureUnit,
    dark_adu: float,
    full_scale_adu: float,
) -> Patch:
    """Where the lamp lights the frames, by the brightest of each stand that is not saturated; the same at all
    stands."""
    patch: Patch | None = None
    is_any_open = False
    for number, placement in enumerate(series.placements):
        own = [i for i in range(len(lit)) if numbers[i] == number]
        is_open = [i for i in own if glances[i].brightness_adu < OPEN_SHARE * full_scale_adu]
        is_any_open |= bool(is_open)
        if not is_open:
            continue
        best = max(is_open, key=lambda i: glances[i].brightness_adu)
        try:
            here = lit_patch(read_stored(lit[best], unit).image, dark_adu, full_scale_adu, lit[best].path.name)
        except DataQualityError:
            if patch is None and number == len(series.placements) - 1:
                raise
            continue  # too faint to tell where; the frames may still be used
        if patch is not None:
            refuse_wandering(patch, here, placement)
        else:
            patch = here
    if patch is None:
        why = "too dark" if is_any_open else "saturated; expose shorter, or move the lamp away or dim it"
        raise DataQualityError(f"all frames of the lamp are {why}")
    return patch

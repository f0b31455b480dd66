"""From frames of a lamp to responses: where the lamp lights the image, and what each frame shows there.

A response is the mean of many pixels, so that their noise spreads it over the steps of the digitizer. Under a power law
the mean of any fixed set of pixels follows the same law as one pixel does, however unevenly they are lit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.dark_frames import MIN_HOT_ADU, DarkFrame
from namod_ctl.calibration.lamp.dark_level import ROUNDING_FLOOR_ADU, DarkLevel, dark_level
from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.camera_model import DarkModel

Array = NDArray[np.float64]
Image = NDArray[np.unsignedinteger[Any]]

SMOOTH_SHARE = 0.02
"""Of the image's height: the width over which light is averaged to find the lit patch."""

PATCH_SHARE = 0.6
"""The patch is where the smoothed light has at least this share of its largest."""

MIN_PATCH_PX = 400
MAX_SIDE_PX = 500
MIN_PATCH_LIGHT_SHARE = 0.05
"""Of full scale: less light does not tell where the lamp is."""

MIN_OVERLAP = 0.8
"""So much of the patch must be lit as well at every placement of the lamp."""

UNKNOWN_DARK_SHARE = 0.004
MODEL_DARK_ERROR_ADU = 0.1
"""How well the dark level is known without dark frames: 1 adu of 255, and by an earlier dark calibration."""

ODD_SIGMAS = 8.0
COSMIC_SIGMAS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The pixels that are measured: shape (rows, columns), bool, and the box around them."""

    is_inside: NDArray[np.bool_]
    box: tuple[slice, slice]

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns) of the frames."""
        return self.is_inside.shape

    @property
    def n_pixels(self) -> int:
        """Pixels of the patch."""
        return int(self.is_inside.sum())


@dataclass(frozen=True, slots=True)
class Placement:
    """One stand of the lamp.

    Attributes
    ----------
    level
        Its relative intensity, as far as the person knows.
    words
        For people: "1.4 m", "level 0.25".
    distance_m
        From which the level was reckoned; None where it was given as such.
    """

    level: float
    words: str
    distance_m: float | None = None


def at_distance(distance_m: float) -> Placement:
    """The lamp so far from the diffuser; its light is 1 at 1 m and falls with the square of the distance."""
    return Placement(distance_m**-2.0, f"{distance_m:g} m", distance_m)


def at_level(level: float) -> Placement:
    """The lamp with that share of its light."""
    return Placement(level, f"level {level:g}")


@dataclass(frozen=True, slots=True)
class Response:
    """What one frame shows in the patch; per channel.

    Attributes
    ----------
    time_s
        Middle of the exposure on any clock; NaN where nobody knows.
    mean_adu, noise_adu
        Mean of the pixels, and the standard deviation of one from its neighbour's light.
    clipped_share, empty_share
        Of the patch's pixels: at the largest response a pixel can have, and at zero; the worst channel's.
    """

    name: str
    placement: int
    exposure_s: float
    time_s: float
    mean_adu: tuple[float, ...]
    noise_adu: tuple[float, ...]
    clipped_share: float
    empty_share: float


def lit_patch(image: Image, dark_adu: float, full_scale_adu: float, name: str) -> Patch:
    """Where the lamp lights a frame that is not saturated; single odd pixels are left out.

    Raises
    ------
    DataQualityError
        Nothing bright or large enough is lit.
    """
    grey = image.max(axis=2) if image.ndim == 3 else image
    width = max(int(SMOOTH_SHARE * grey.shape[0]) | 1, 5)
    smooth = cv2.blur(grey.astype(np.float32), (width, width)) - np.float32(dark_adu)
    brightest = float(np.percentile(smooth, 99.5))
    if brightest < MIN_PATCH_LIGHT_SHARE * full_scale_adu:
        raise DataQualityError(
            f"{name}: the lamp is hardly to be seen: {max(brightest, 0.0):.3g} adu above the dark, "
            f"{MIN_PATCH_LIGHT_SHARE:.0%} of full scale are needed; is the cap off and the lamp on?"
        )
    is_lit = (smooth >= PATCH_SHARE * brightest).astype(np.uint8)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(is_lit, connectivity=4)
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    is_inside = cv2.erode((labels == largest).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    away = grey.astype(np.float32) - cv2.medianBlur(grey, 5).astype(np.float32)
    spread = 1.4826 * float(np.median(np.abs(away[is_inside]))) if is_inside.any() else 0.0
    is_inside &= np.abs(away) <= ODD_SIGMAS * max(spread, 1.0)
    if int(is_inside.sum()) < MIN_PATCH_PX:
        raise DataQualityError(
            f"{name}: the lamp lights only {int(is_inside.sum())} pixels evenly (limit {MIN_PATCH_PX}): a point of "
            "light cannot be used; put a diffuser (white paper) before the lens and let the lamp light it"
        )
    return _boxed(is_inside)


def _boxed(is_inside: NDArray[np.bool_]) -> Patch:
    rows, columns = np.flatnonzero(is_inside.any(axis=1)), np.flatnonzero(is_inside.any(axis=0))
    return Patch(is_inside, (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)))


def middle_of(patch: Patch) -> Patch:
    """The patch, or of a large one the square about its middle: more pixels tell nothing more."""
    middle = [int(axis.mean()) for axis in np.nonzero(patch.is_inside)]
    half = MAX_SIDE_PX // 2
    square = tuple(slice(max(at - half, 0), at + half) for at in middle)
    inner = np.zeros_like(patch.is_inside)
    inner[square] = patch.is_inside[square]
    return _boxed(inner) if int(inner.sum()) >= MIN_PATCH_PX else patch  # a ring has a hole in its middle


def without_hot(patch: Patch, darks: Sequence[DarkFrame]) -> Patch:
    """The patch without pixels that shine in the dark: in every one of the dark frames of the longest exposure."""
    if not darks:
        return patch
    longest_s = max(dark.exposure_s for dark in darks)
    images = [dark.image for dark in darks if dark.exposure_s == longest_s and dark.image.shape[:2] == patch.shape]
    if not images:
        return patch
    least = np.min(images, axis=0)
    least = least.max(axis=2) if least.ndim == 3 else least
    level = dark_level(least)
    is_hot = least > level.level_adu + max(ODD_SIGMAS * level.noise_adu, MIN_HOT_ADU)
    return Patch(patch.is_inside & ~is_hot, patch.box)


def refuse_wandering(patch: Patch, here: Patch, placement: Placement) -> None:
    """Raise DataQualityError when the light no longer covers the patch, as it does at this placement `here`."""
    overlap = float((patch.is_inside & here.is_inside).sum()) / patch.n_pixels
    if overlap < MIN_OVERLAP:
        raise DataQualityError(
            f"{placement.words}: the lamp lights only {overlap:.0%} of the pixels it lit at first (limit "
            f"{MIN_OVERLAP:.0%}): its image moved or shrank, and a lamp that is seen as a disc does not get fainter "
            "with distance; put a diffuser (white paper) before the lens, and move lamp or camera along one line"
        )


def measure_response(
    image: Image, patch: Patch, full_scale_adu: float, name: str, placement: int, exposure_s: float, time_s: float
) -> Response:
    """What a frame (rows, columns) or (rows, columns, 3) shows in the patch.

    Raises
    ------
    DataQualityError
        The frame is of another size.
    """
    if image.shape[:2] != patch.is_inside.shape:
        raise DataQualityError(
            f"{name}: {image.shape[1]} x {image.shape[0]} pixel, others {patch.is_inside.shape[1]} x "
            f"{patch.is_inside.shape[0]}: frames of several cameras or modes; give those of one"
        )
    inside = patch.is_inside[patch.box]
    boxed = image[patch.box]
    channels = [boxed] if boxed.ndim == 2 else [boxed[:, :, i] for i in range(boxed.shape[2])]
    mean, noise, clipped, empty = [], [], [], []
    for channel in channels:
        is_even, sigma = _even_pixels(np.ascontiguousarray(channel), inside)
        pixels = channel[is_even]
        mean.append(float(pixels.mean(dtype=np.float64)))
        noise.append(sigma)
        clipped.append(float((pixels >= full_scale_adu).mean()))
        empty.append(float((pixels == 0).mean()))
    return Response(name, placement, exposure_s, time_s, tuple(mean), tuple(noise), max(clipped), max(empty))


def _even_pixels(channel: Image, inside: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
    """The pixels inside that no cosmic ray hit, and the noise of one from its neighbours' light."""
    step = np.diff(channel.astype(np.float32), axis=1)[inside[:, 1:] & inside[:, :-1]]
    largest = np.percentile(np.abs(step), 99.0)
    sigma = float(np.sqrt(np.mean(step[np.abs(step) <= largest + 1.0] ** 2, dtype=np.float64) / 2.0))
    away = cv2.absdiff(channel, cv2.medianBlur(channel, 5))
    return inside & (away <= COSMIC_SIGMAS * max(sigma, 1.0)), sigma


@dataclass(frozen=True, slots=True, eq=False)
class PatchDark:
    """What the patch shows without light, per channel: level = bias + rate T; known within `uncertainty_adu`."""

    bias_adu: Array
    rate_adu_per_s: Array
    uncertainty_adu: float
    is_measured: bool

    def level_adu(self, exposure_s: float) -> Array:
        """Shape (n_channels,)."""
        return self.bias_adu + self.rate_adu_per_s * exposure_s


def patch_dark(darks: Sequence[DarkFrame], patch: Patch) -> PatchDark:
    """What the patch shows without light, by dark frames."""
    by_exposure: dict[float, list[DarkFrame]] = {}
    for frame in darks:
        if frame.image.shape[:2] != patch.is_inside.shape:
            raise DataQualityError(
                f"{frame.name}: a dark frame of {frame.image.shape[1]} x {frame.image.shape[0]} pixel, the frames of "
                "the lamp have others; give dark frames of the same camera and mode"
            )
        by_exposure.setdefault(round(frame.exposure_s, 9), []).append(frame)
    exposures = np.array(sorted(by_exposure))
    levels, errors = [], []
    for exposure_s in exposures:
        each = [_channel_levels(frame.image, patch) for frame in by_exposure[float(exposure_s)]]
        values = np.array([[level.level_adu for level in channels] for channels in each])
        levels.append(values.mean(axis=0))
        scatter = float(values.std(axis=0, ddof=1).max()) / len(each) ** 0.5 if len(each) > 1 else 0.0
        own = max(level.uncertainty_adu for channels in each for level in channels) / len(each) ** 0.5
        errors.append(math.hypot(scatter, own, ROUNDING_FLOOR_ADU))
    level = np.array(levels)
    if len(exposures) < 2 or exposures[-1] < 3.0 * exposures[0]:
        return PatchDark(level.mean(axis=0), np.zeros(level.shape[1]), max(errors), True)
    weight = 1.0 / np.array(errors)
    slope, bias = np.polyfit(exposures, level, 1, w=weight)
    scatter = float(np.abs(level - (bias + slope * exposures[:, None])).max())
    return PatchDark(bias, slope, math.hypot(min(errors), scatter / len(exposures) ** 0.5), True)


def unknown_dark(model: DarkModel | None, full_scale_adu: float, n_channels: int) -> PatchDark:
    """What stands for dark frames where there are none: the camera's dark model, else nothing, known badly."""
    if model is None:
        level, rate, error = 0.0, 0.0, UNKNOWN_DARK_SHARE * full_scale_adu
    else:
        level, rate, error = model.bias_adu, model.rate_adu_per_s, MODEL_DARK_ERROR_ADU
    return PatchDark(np.full(n_channels, level), np.full(n_channels, rate), error, model is not None)


def _channel_levels(image: Image, patch: Patch) -> list[DarkLevel]:
    inside, boxed = patch.is_inside[patch.box], image[patch.box]
    return [dark_level(boxed[inside] if boxed.ndim == 2 else boxed[inside][:, i]) for i in range(_n_channels(image))]


def _n_channels(image: Image) -> int:
    return 1 if image.ndim == 2 else int(image.shape[2])

"""Dark frames and hot pixels: what a camera shows without light, and how it is taken out of a frame.

Dark frames belong to an exposure; a camera's dark model, from its calibration, holds for every exposure. Nothing here
changes its input.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.radiometry import Frame
from namod_ctl.optics.camera_model import DarkModel

HOT_SIGMAS = 8.0
"""A pixel is hot when it stands so many standard deviations above its neighbourhood: one in 1e15 by chance."""

HOT_NOISE_RATIO = 5.0
"""A pixel is also hot when it flickers so many times more than the middle pixel does."""

MIN_DARKS_FOR_FLICKER = 5
"""Fewer dark frames say too little about one pixel's noise."""

ISOLATED_NEIGHBOUR_SHARE = 0.4
"""A pixel is isolated when its brightest neighbour has less than this share of its light above background.

The sharpest star that is accepted, 1.75 pixel full width at half maximum and centred on a pixel, gives its
neighbours exp(-4 ln2 / 1.75**2) = 0.4 of its own."""

QUANTISATION_NOISE_ADU = 12.0**-0.5
"""Standard deviation of rounding to whole numbers: no noise of a digital frame is taken to be smaller."""

NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Dark:
    """What a camera shows without light at one exposure.

    Attributes
    ----------
    level
        Mean dark frame, rounded, of the frames' own shape and type.
    is_hot
        Same shape, bool: pixels whose response means nothing.
    """

    level: Frame
    is_hot: NDArray[np.bool_]


def dark_of_frames(frames: Frame) -> Dark:
    """The dark of a stack of dark frames, shape (n_frames, rows, columns) or (n_frames, rows, columns, 3).

    Hot are pixels that stand `HOT_SIGMAS` above their neighbourhood in the mean of the stack, or flicker
    `HOT_NOISE_RATIO` times more than others.

    Raises
    ------
    ConfigError
        When the stack is empty or no stack of frames.
    """
    if frames.ndim not in (3, 4) or frames.shape[0] == 0 or frames.dtype not in (np.uint8, np.uint16):
        raise ConfigError(
            f"dark frames of shape {frames.shape} and type {frames.dtype}: "
            "give at least one frame, stacked as (frame, row, column), of 8 or 16 bit"
        )
    mean = frames.mean(axis=0, dtype=np.float32)
    excess = mean - cv2.medianBlur(mean, 5)
    noise = max(1.4826 * float(np.median(np.abs(excess))), QUANTISATION_NOISE_ADU / frames.shape[0] ** 0.5)
    is_hot = excess > HOT_SIGMAS * noise
    if frames.shape[0] >= MIN_DARKS_FOR_FLICKER:
        flicker = frames.std(axis=0, dtype=np.float32)
        is_hot |= flicker > HOT_NOISE_RATIO * max(float(np.median(flicker)), QUANTISATION_NOISE_ADU)
    return Dark(np.rint(mean).astype(frames.dtype), is_hot)


def subtract_dark(frame: Frame, dark: Dark, saturation_adu: float) -> Frame:
    """The frame without its dark level and with its hot pixels repaired; same shape and type.

    Responses below the dark level become 0. Saturated responses stay as they are: less a dark level they would look
    as if they could be trusted. Hot pixels are repaired last, so a saturated hot pixel does not count.

    Raises
    ------
    ConfigError
        When the dark is not one of this kind of frame.
    """
    if frame.shape != dark.level.shape or frame.dtype != dark.level.dtype:
        raise ConfigError(
            f"a dark frame of shape {dark.level.shape} and type {dark.level.dtype} does not belong to a frame of shape "
            f"{frame.shape} and type {frame.dtype}: give the dark frames of the same camera and mode"
        )
    subtracted: Frame = cv2.subtract(frame, dark.level)
    np.copyto(subtracted, frame, where=frame >= saturation_adu)
    return repair_pixels(subtracted, dark.is_hot)


def subtract_dark_model(frame: Frame, dark: DarkModel, exposure_s: float, saturation_adu: float) -> Frame:
    """What `subtract_dark` makes of a frame, by the camera's dark model instead of dark frames.

    Whole numbers are taken off, as frames are of such; `dark_rest_adu` is what remains for the intensities. Hot pixels
    are of the whole image, in all channels.
    """
    level = max(math.floor(dark.level_adu(exposure_s)), 0)
    if level > 0:
        subtracted: Frame = cv2.subtract(frame, np.full_like(frame, level))
        np.copyto(subtracted, frame, where=frame >= saturation_adu)
        frame = subtracted
    if not len(dark.hot_pixels):
        return frame
    is_hot, positions = _hot_in_frame(dark, frame.shape)
    return _repaired(frame, is_hot, positions)


def dark_rest_adu(dark: DarkModel, exposure_s: float) -> float:
    """What a frame that `subtract_dark_model` left still shows without light, for `radiometry.response_table`.

    0 to 1 adu, so that the responses that became 0 are just those at or below the dark level; below 0 where the camera
    itself cuts responses off that are near its dark level.
    """
    level = dark.level_adu(exposure_s)
    return level - max(math.floor(level), 0)


@lru_cache(maxsize=8)
def _hot_in_frame(dark: DarkModel, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], tuple[NDArray[np.intp], ...]]:
    """The model's hot pixels as a mask of a frame's shape, and where it is true."""
    is_hot = np.zeros(shape, dtype=bool)
    is_hot[dark.hot_pixels[:, 1], dark.hot_pixels[:, 0]] = True
    return is_hot, np.nonzero(is_hot)


def repair_pixels(frame: Frame, is_bad: NDArray[np.bool_]) -> Frame:
    """A copy of the frame whose bad pixels have the median of their good neighbours (of 3 x 3, else 5 x 5 pixels).

    `is_bad` has the frame's shape; channels of a colour frame are repaired apart. A bad pixel without any good
    neighbour gets the frame's median.
    """
    return _repaired(frame, is_bad, np.nonzero(is_bad))


def _repaired(frame: Frame, is_bad: NDArray[np.bool_], bad: tuple[NDArray[np.intp], ...]) -> Frame:
    repaired = frame.copy()
    if bad[0].size == 0:
        return repaired
    pending = np.ones(bad[0].size, dtype=bool)
    for radius in (1, 2):
        positions = tuple(axis[pending] for axis in bad)
        values, n_good = _sorted_good_neighbours(frame, is_bad, positions, radius)
        found = n_good > 0
        middle = np.take_along_axis(values, np.maximum((n_good - 1) // 2, 0)[:, None], axis=1)[:, 0]
        repaired[tuple(axis[found] for axis in positions)] = middle[found].astype(frame.dtype)
        pending[np.flatnonzero(pending)[found]] = False
        if not pending.any():
            return repaired
    repaired[tuple(axis[pending] for axis in bad)] = np.median(frame).astype(frame.dtype)
    return repaired


def _sorted_good_neighbours(
    frame: Frame, is_bad: NDArray[np.bool_], positions: tuple[NDArray[np.intp], ...], radius: int
) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Values of the good neighbours of each position, ascending (n, n_neighbours), and how many of them are good."""
    step = np.arange(-radius, radius + 1)
    d_row, d_column = (grid.ravel() for grid in np.meshgrid(step, step, indexing="ij"))
    row, column = positions[0][:, None] + d_row, positions[1][:, None] + d_column
    is_inside = (row >= 0) & (row < frame.shape[0]) & (column >= 0) & (column < frame.shape[1])
    at = (np.clip(row, 0, frame.shape[0] - 1), np.clip(column, 0, frame.shape[1] - 1))
    at_full = at if len(positions) == 2 else (*at, np.broadcast_to(positions[2][:, None], row.shape))
    is_good = is_inside & ~is_bad[at_full]
    values = np.where(is_good, frame[at_full].astype(np.int64), np.iinfo(np.int64).max)
    return np.sort(values, axis=1), is_good.sum(axis=1)


def isolated_pixels(frame: Frame, background_adu: float, noise_adu: float) -> NDArray[np.bool_]:
    """True where one pixel of a frame (rows, columns) shines alone, as no star can: shape of the frame.

    For cameras without dark frames: a pixel `HOT_SIGMAS` above `background_adu` whose brightest neighbour has less than
    `ISOLATED_NEIGHBOUR_SHARE` of its light.
    """
    neighbour = cv2.dilate(frame, NEIGHBOURS)
    limit_adu = background_adu + HOT_SIGMAS * noise_adu
    is_bright: NDArray[np.bool_] = frame > limit_adu
    if not is_bright.any():
        return is_bright
    own = frame - np.float32(background_adu)
    return is_bright & (neighbour - np.float32(background_adu) < np.float32(ISOLATED_NEIGHBOUR_SHARE) * own)

"""A cut-out of a frame around its brightest place: there the star is, also when it is too bright to be measured."""

from __future__ import annotations

import math

import cv2
import numpy as np

from namod_ctl.imaging.radiometry import Frame
from namod_ctl.store.live_pictures import picture_of

SMALLEST_PX = 64
FIRST_PX = 256
STARS_ACROSS = 5.0
"""The cut-out is at least so many times as wide as the star, and less than twice that."""
LARGEST_PICTURE_PX = 320
"""More a phone does not need; and the message with the picture stays far below what a socket takes at once."""
SEARCHED_COLUMNS = 320
LEAST_SPAN_SHARE = 0.05
"""Of full scale: fainter light is not brightened any further, else noise looks like stars."""


def cutout_side_px(diameter_px: float, side_px: int = FIRST_PX) -> int:
    """Width of the cut-out for a star of that diameter, in steps of two; of NaN the one before, `side_px`."""
    if not math.isfinite(diameter_px):
        return side_px
    return max(SMALLEST_PX, int(2 ** math.ceil(math.log2(STARS_ACROSS * diameter_px))))


def cutout(frame: Frame, side_px: int, full_scale_adu: float) -> tuple[bytes, int]:
    """The brightest place of a frame as JPEG, brightened, and how many pixels of the frame it is wide.

    Of shape (rows, columns) or (rows, columns, 3). Less than `side_px` wide where the frame is smaller.
    """
    n_rows, n_columns = frame.shape[:2]
    side = min(side_px, n_rows, n_columns)
    x, y = _brightest_px(frame)
    left, top = (min(max(middle - side // 2, 0), n - side) for middle, n in ((x, n_columns), (y, n_rows)))
    cut = frame[top : top + side, left : left + side].astype(np.float32)
    if cut.ndim == 3:
        cut = cut.mean(axis=2)
    if side > LARGEST_PICTURE_PX:
        cut = np.asarray(cv2.resize(cut, (LARGEST_PICTURE_PX, LARGEST_PICTURE_PX), interpolation=cv2.INTER_AREA))
    dark_adu = float(np.median(cut))
    span_adu = max(float(cut.max()) - dark_adu, LEAST_SPAN_SHARE * full_scale_adu)
    return picture_of(np.clip((cut - dark_adu) * (255.0 / span_adu), 0.0, 255.0).astype(np.uint8)), side


def _brightest_px(frame: Frame) -> tuple[int, int]:
    """(column, row) of the brightest place; a single hot pixel drowns in the mean of its neighbours."""
    n_rows, n_columns = frame.shape[:2]
    step = max(1, n_columns // SEARCHED_COLUMNS)
    size = (max(1, n_columns // step), max(1, n_rows // step))
    small = np.asarray(cv2.resize(np.asarray(frame), size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    if small.ndim == 3:
        small = small.mean(axis=2)
    smooth = np.asarray(cv2.GaussianBlur(small, (5, 5), 0.0))
    row, column = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    return round((float(column) + 0.5) * n_columns / size[0]), round((float(row) + 0.5) * n_rows / size[1])

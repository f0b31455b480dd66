"""Where in a frame something shines: the fast first look of the star finder, on a shrunk frame.

The frame is halved by 2 x 2 means until a star is 2 to 4 pixels wide. What stands above a coarse map of the
background there is a spot. Single shining pixels are taken out of the spots before these are judged. The first look
costs about two readings of the frame (`benchmarks/bench_imaging.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.imaging.dark import HOT_SIGMAS, ISOLATED_NEIGHBOUR_SHARE, QUANTISATION_NOISE_ADU
from namod_ctl.imaging.radiometry import Frame

Array = NDArray[np.float64]

STAR_WIDTH_IN_BLOCKS = 2.0
"""The frame is halved as long as a star stays at least this wide, in pixels of the shrunk frame."""

CELL_HALVINGS = 4
"""Of the shrunk frame, to the cells of the background map: these are 4 to 8 stars wide."""

FILLED_CELL_SHARE = 0.25
"""Of full scale: a cell of the background map so much brighter than those around it shows no background."""

SPOT_SIGMAS = 5.0
"""A spot stands so many standard deviations of the shrunk frame's noise above the background."""

STRIP_ROWS = 192
"""Rows of the frame that are halved together: half a megabyte."""

MAX_SPOT_SHARE = 1.0 / 16.0
"""With more of the frame above the background than this there is nothing that could be a star among it."""

N_NOISE_ROWS = 48
"""Rows of the shrunk frame that are read for the noise: 30 000 pixels of FACT's star camera give it to 1 %."""

MAX_HOT_PER_BLOCK = 4

# The eight neighbours of a pixel.
_DOWN = np.array([-1, -1, -1, 0, 0, 1, 1, 1])
_RIGHT = np.array([-1, 0, 1, -1, 1, -1, 0, 1])


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """Something that shines, roughly.

    Attributes
    ----------
    x_px, y_px
        Its centre, pixel of the full frame.
    peak_adu
        Brightest block above the background.
    diameter_px
        Of a circle with the area that is brighter than half of that.
    elongation
        Length over width of that area; 1 for a round one.
    length_px
        Of that area along its longest direction, were it a rectangle.
    brightest_adu
        Brightest block, with the background.
    """

    x_px: float
    y_px: float
    peak_adu: float
    diameter_px: float
    elongation: float
    length_px: float
    brightest_adu: float


@dataclass(frozen=True, slots=True, eq=False)
class FirstLook:
    """What the first look at a frame shows.

    Attributes
    ----------
    spots
        Brightest first; none of them much fainter than the share of the brightest that was asked for.
    noise_adu
        Standard deviation of one pixel, of the frame as a whole; rough where it is below 2, for the means of blocks are
        rounded.
    sky_adu
        Median of the background.
    n_isolated
        How many single shining pixels were taken out.
    isolated_px
        One of them, (x, y).
    bright_share
        Share of the frame that stands above the background.
    """

    spots: tuple[Spot, ...]
    noise_adu: float
    sky_adu: float
    n_isolated: int
    isolated_px: tuple[int, int]
    bright_share: float


def _noise_adu(small: Frame) -> float:
    """Standard deviation of one pixel of a frame (rows, columns), from differences of pixels two columns apart.

    Differences beyond 4 standard deviations (stars, hot pixels) do not count. Never below the noise of rounding.
    """
    rows = small[:: max(1, small.shape[0] // N_NOISE_ROWS)]
    difference = cv2.absdiff(rows[:, 2:], rows[:, :-2])
    n_levels = int(np.iinfo(small.dtype).max) + 1
    count = cv2.calcHist([difference], [0], None, [n_levels], [0, n_levels]).ravel().astype(np.float64)
    n_below = np.cumsum(count)
    square_sum = np.cumsum(count * np.arange(n_levels, dtype=np.float64) ** 2)
    last = int(np.searchsorted(n_below, 0.9 * n_below[-1]))
    variance = 0.0
    for _ in range(4):
        variance = float(square_sum[last] / n_below[last])
        last = min(int(4.0 * max(variance, 1.0) ** 0.5), n_levels - 1)
    return max(math.sqrt(variance / 2.0), QUANTISATION_NOISE_ADU)


def first_look(frame: Frame, star_size_px: float, full_scale_adu: float, fainter_share: float) -> FirstLook:
    """The spots of a frame (rows, columns) in which a star is about `star_size_px` wide.

    Spots below `fainter_share` of the brightest one's peak are left out.
    """
    small, n_side = _shrink(frame, star_size_px)
    background = _background_map(small, full_scale_adu)
    sky_adu = float(np.median(background[::8, ::8]))
    small_noise_adu = _noise_adu(small)
    # Every halving rounds to whole numbers; what is left above that comes from n_side**2 pixels.
    rounding = QUANTISATION_NOISE_ADU**2 * (4.0 / 3.0 if n_side > 1 else 0.0)
    noise_adu = max(n_side * max(small_noise_adu**2 - rounding, 0.0) ** 0.5, QUANTISATION_NOISE_ADU)
    limit = math.ceil(SPOT_SIGMAS * small_noise_adu)
    is_above = cv2.subtract(small, background) > limit
    bright_share = np.count_nonzero(is_above) / small.size
    if bright_share == 0.0 or bright_share > MAX_SPOT_SHARE:
        return FirstLook((), noise_adu, sky_adu, 0, (0, 0), bright_share)
    row, column = np.divmod(np.flatnonzero(is_above), small.shape[1])
    level_adu = background[row, column].astype(np.float64)
    above_adu, n_isolated = _means_without_isolated(frame, row, column, n_side, level_adu, noise_adu)
    is_kept = above_adu > max(limit, fainter_share * float(above_adu.max()))
    spots = _spots(row[is_kept], column[is_kept], above_adu[is_kept], level_adu[is_kept], n_side)
    isolated = np.argmin(above_adu - small[row, column])
    isolated_px = (int(column[isolated]) * n_side, int(row[isolated]) * n_side)
    return FirstLook(spots, noise_adu, sky_adu, n_isolated, isolated_px, bright_share)


def _shrink(frame: Frame, star_size_px: float) -> tuple[Frame, int]:
    """The frame of block means, and how many pixels a block is wide (a power of 2).

    Halving again and again takes the fast path of the library: a seventh of the time of one step by 4. It is done strip
    by strip, so that what lies between stays in the processor's cache.
    """
    n_side = 1
    while star_size_px / (2 * n_side) >= STAR_WIDTH_IN_BLOCKS and 4 * n_side <= min(frame.shape):
        n_side *= 2
    # Rows and columns that fill no block lie at the edge, where no star counts.
    n_rows, n_columns = frame.shape[0] // n_side, frame.shape[1] // n_side
    whole = frame[: n_rows * n_side, : n_columns * n_side]
    if n_side == 1:
        return whole, 1
    small = np.empty((n_rows, n_columns), dtype=frame.dtype)
    step = max(1, STRIP_ROWS // n_side)
    for first in range(0, n_rows, step):
        strip = whole[first * n_side : (first + step) * n_side]
        while strip.shape[1] > n_columns:
            half = (strip.shape[1] // 2, strip.shape[0] // 2)
            strip = cv2.resize(strip, half, interpolation=cv2.INTER_AREA)
        small[first : first + step] = strip
    return small, n_side


def _background_map(small: Frame, full_scale_adu: float) -> Frame:
    """The smooth background of the shrunk frame: means of its cells, interpolated; same shape and type.

    A star adds 3 % of its own height to the mean of its cell, and is not taken out: medians over many cells would, but
    lag behind moonlight. Only where light fills a cell do the cells around it speak.
    """
    cells = small
    for _ in range(CELL_HALVINGS):
        half = (max(1, cells.shape[1] // 2), max(1, cells.shape[0] // 2))
        cells = cv2.resize(cells, half, interpolation=cv2.INTER_AREA)
    around = cv2.medianBlur(cells, 5)
    cells = np.where(cv2.subtract(cells, around) > FILLED_CELL_SHARE * full_scale_adu, around, cells)
    return np.asarray(cv2.resize(cells, small.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _means_without_isolated(
    frame: Frame, row: NDArray[np.intp], column: NDArray[np.intp], n_side: int, level_adu: Array, noise_adu: float
) -> tuple[Array, int]:
    """Means above `level_adu` of the blocks at (row, column) without single shining pixels, and how many these were."""
    step = np.arange(-1, n_side + 1)
    rows = np.clip(row[:, None] * n_side + step, 0, frame.shape[0] - 1)
    columns = np.clip(column[:, None] * n_side + step, 0, frame.shape[1] - 1)
    window = frame[rows[:, :, None], columns[:, None, :]] - level_adu[:, None, None]
    # Beyond the edge there is nothing, so that a pixel at the edge is not its own neighbour.
    window[:, 0][row == 0] = 0.0
    window[:, :, 0][column == 0] = 0.0
    window[:, -1][(row + 1) * n_side == frame.shape[0]] = 0.0
    window[:, :, -1][(column + 1) * n_side == frame.shape[1]] = 0.0
    every = np.arange(row.size)
    n_isolated = 0
    for _ in range(MAX_HOT_PER_BLOCK):
        inner = window[:, 1:-1, 1:-1].reshape(row.size, -1)
        brightest = inner.argmax(axis=1)
        y, x = brightest // n_side + 1, brightest % n_side + 1
        own = inner[every, brightest]
        neighbour = window[every[:, None], y[:, None] + _DOWN, x[:, None] + _RIGHT].max(axis=1)
        is_isolated = (own > HOT_SIGMAS * noise_adu) & (neighbour < ISOLATED_NEIGHBOUR_SHARE * own)
        if not is_isolated.any():
            break
        n_isolated += int(is_isolated.sum())
        window[every[is_isolated], y[is_isolated], x[is_isolated]] = np.minimum(neighbour[is_isolated], 0.0)
    means: Array = window[:, 1:-1, 1:-1].mean(axis=(1, 2))
    return means, n_isolated


def _spots(
    row: NDArray[np.intp], column: NDArray[np.intp], above_adu: Array, level_adu: Array, n_side: int
) -> tuple[Spot, ...]:
    """Connected blocks as spots, brightest first."""
    if row.size == 0:
        return ()
    top, left = int(row.min()), int(column.min())
    image = np.zeros((int(row.max()) - top + 1, int(column.max()) - left + 1), dtype=np.uint8)
    image[row - top, column - left] = 1
    _, labels = cv2.connectedComponents(image, connectivity=8)
    label = labels[row - top, column - left]
    spots = []
    for number in range(1, int(label.max()) + 1):
        members = np.flatnonzero(label == number)
        spots.append(_spot(row[members], column[members], above_adu[members], level_adu[members], n_side))
    return tuple(sorted(spots, key=lambda spot: -spot.peak_adu))


def _spot(row: NDArray[np.intp], column: NDArray[np.intp], above_adu: Array, level_adu: Array, n_side: int) -> Spot:
    peak_adu = float(above_adu.max())
    core = above_adu >= 0.5 * peak_adu
    position = np.stack([column[core], row[core]]).astype(np.float64)
    weight = above_adu[core]
    centre = position @ weight / weight.sum()
    # A block is a square of its own: 1/12 is its variance, and keeps a row of blocks from having no width.
    offset = position - position.mean(axis=1, keepdims=True)
    covariance = offset @ offset.T / offset.shape[1] + np.eye(2) / 12.0
    minor, major = np.linalg.eigvalsh(covariance)
    x_px, y_px = (centre + 0.5) * n_side - 0.5
    return Spot(
        x_px=float(x_px),
        y_px=float(y_px),
        peak_adu=peak_adu,
        diameter_px=float((4.0 / np.pi * core.sum()) ** 0.5 * n_side),
        elongation=float((major / minor) ** 0.5),
        length_px=float((12.0 * major) ** 0.5 * n_side),
        brightest_adu=float((above_adu + level_adu).max()),
    )

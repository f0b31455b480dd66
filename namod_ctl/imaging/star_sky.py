"""The sky around a star: the plane its background lies on, and the noise of one pixel of it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from namod_ctl.imaging.dark import QUANTISATION_NOISE_ADU
from namod_ctl.imaging.radiometry import Frame

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RING_WIDTH = 1.0
"""The sky is seen in a ring around the aperture, this share of the aperture's radius wide: wide enough for the slope
of its plane to add less than 1 % to the error of a faint star's centre."""

CLIP_STEPS = 2
CLIP_SIGMAS = 3.0
CLIPPED_SHARE_OF_SPREAD = 0.9866
"""Standard deviation of a normal distribution of unit width cut at 3 sigma."""

MAX_DARK_SHARE = 0.05
"""With more pixels of the sky at 0 than this, the camera's offset is too low to show the noise whole."""

RARE_SHARE = 0.005
"""The largest values of the sky that are not used to tell its noise then: they may be stars."""


@lru_cache(maxsize=32)
def axes(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Row and column numbers of a cut-out, shapes (rows, 1) and (1, columns)."""
    return np.arange(shape[0], dtype=np.float64)[:, None], np.arange(shape[1], dtype=np.float64)[None, :]


def distance2(shape: tuple[int, ...], x: float, y: float) -> Array:
    """Square of every pixel's distance from (x, y), pixel**2."""
    rows, columns = axes(shape)
    squared: Array = (columns - x) ** 2 + (rows - y) ** 2
    return squared


def ring_around(shape: tuple[int, ...], x: float, y: float, aperture_px: float) -> Mask:
    """True in the ring around the aperture at (x, y)."""
    squared = distance2(shape, x, y)
    ring: Mask = (squared > aperture_px**2) & (squared <= ((1.0 + RING_WIDTH) * aperture_px) ** 2)
    return ring


def level_and_spread(values: Frame) -> tuple[float, float]:
    """Median of the values and their standard deviation around it, neither of which feels a few stars.

    The deviation is told by the median of deviations; where a camera's offset is so low that the noise of a dark sky is
    cut at 0, by what is left of it. It is never below that of rounding.
    """
    middle = values.size // 2
    level = float(np.partition(values, middle)[middle])
    spread = 1.4826 * float(np.partition(np.abs(values - level), middle)[middle])
    if np.count_nonzero(values == 0) > MAX_DARK_SHARE * values.size:
        spread = max(spread, _noise_cut_at_zero(values))
    return level, max(spread, QUANTISATION_NOISE_ADU)


def sky_in(cut: Frame, ring: Mask, level_adu: float, spread_adu: float) -> tuple[Mask, Array, float]:
    """Pixels of the ring that show the sky, the plane through them (shape of `cut`), and their noise around it.

    Pixels more than 3 sigma off the plane (other stars, hot pixels) are left out; `level_adu` and `spread_adu` of
    `level_and_spread` are where that starts.
    """
    is_cut_at_zero = np.count_nonzero(cut[ring] == 0) > MAX_DARK_SHARE * np.count_nonzero(ring)
    least_adu = spread_adu if is_cut_at_zero else QUANTISATION_NOISE_ADU
    residual, noise_adu = cut - level_adu, spread_adu
    for _ in range(CLIP_STEPS):
        # A whole step of rounding always belongs to the sky, however dark and quiet it is.
        sky = ring & (np.abs(residual) <= max(CLIP_SIGMAS * noise_adu, 1.0))
        plane = plane_through(cut, sky)
        residual = cut - plane
        noise_adu = max(float(np.std(residual[sky])) / CLIPPED_SHARE_OF_SPREAD, least_adu)
    return sky, plane, noise_adu


def _noise_cut_at_zero(values: Frame) -> float:
    """Standard deviation of a normal distribution that was rounded, and whose negative values were made 0.

    From how many values are 0, and how many are at most some larger one. 0 when too few are above 0 to tell.
    """
    share_up_to = np.cumsum(np.bincount(values)) / values.size
    upper = int(np.searchsorted(share_up_to, 1.0 - RARE_SHARE)) - 1
    if upper < 1:
        return 0.0
    return float(upper / (ndtri(share_up_to[upper]) - ndtri(share_up_to[0])))


def plane_through(values: NDArray[np.floating] | Frame, sky: Mask) -> Array:
    """The plane of least squares through the values at `sky`; shape of `values`."""
    # Coordinates from -1 to 1 keep the three by three system well conditioned.
    down, right = (axis / (size / 2.0) - 1.0 for axis, size in zip(axes(values.shape), values.shape, strict=True))
    y, x = down[:, 0], right[0]
    counted = sky.astype(np.float64)
    by_row, by_column = counted.sum(axis=1), counted.sum(axis=0)
    mixed = y @ counted @ x
    normal = np.array(
        [
            [by_row.sum(), by_row @ y, by_column @ x],
            [by_row @ y, by_row @ (y * y), mixed],
            [by_column @ x, mixed, by_column @ (x * x)],
        ]
    )
    counted = counted * values
    by_row = counted.sum(axis=1)
    level, slope_down, slope_right = np.linalg.lstsq(
        normal, np.array([by_row.sum(), by_row @ y, counted.sum(axis=0) @ x]), rcond=None
    )[0]
    plane: Array = (level + slope_down * down) + slope_right * right
    return plane

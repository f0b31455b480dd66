"""Synthetic frames for the tests: light that falls on pixels, electrons that are counted, numbers that are rounded.

It shares no code with what it tests. A star's light is integrated over each pixel (a gaussian exactly, by its error
function; other profiles by 15 x 15 subsamples), electrons are poissonian, the read-out adds noise and an offset.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]
Profile = Callable[[Array, Array], Array]

ELECTRONS_PER_ADU = 40.0
"""A full well of 10 000 electrons over 8 bit."""

READ_NOISE_ADU = 1.0
OFFSET_ADU = 8.0
SIGMA_PX = 10.26 / 2.3548
"""A star of 0.025 deg full width at half maximum at 2.437 mdeg per pixel."""


def gaussian_light(
    shape: tuple[int, int], x: float, y: float, sigma_px: float, ratio: float = 1.0, turn_rad: float = 0.0
) -> Array:
    """A gaussian's light of unit height; with `ratio` the length over the width along `turn_rad`."""
    if ratio == 1.0:
        along_x = _integral(np.arange(shape[1]), x, sigma_px)
        along_y = _integral(np.arange(shape[0]), y, sigma_px)
        return along_y[:, None] * along_x[None, :] * (2.0 * np.pi * sigma_px**2)

    def profile(dx: Array, dy: Array) -> Array:
        along = dx * np.cos(turn_rad) + dy * np.sin(turn_rad)
        across = dy * np.cos(turn_rad) - dx * np.sin(turn_rad)
        return np.asarray(np.exp(-0.5 * (along**2 / (sigma_px**2 * ratio) + across**2 * ratio / sigma_px**2)))

    return subsampled(shape, x, y, profile)


def moffat_light(shape: tuple[int, int], x: float, y: float, fwhm_px: float, beta: float = 2.5) -> Array:
    """A Moffat profile of unit height."""
    core2 = fwhm_px**2 / 4.0 / (2.0 ** (1.0 / beta) - 1.0)
    return subsampled(shape, x, y, lambda dx, dy: (1.0 + (dx**2 + dy**2) / core2) ** -beta)


def disc_light(shape: tuple[int, int], x: float, y: float, diameter_px: float) -> Array:
    """A uniform disc of unit height: a star out of focus."""
    return subsampled(shape, x, y, lambda dx, dy: (dx**2 + dy**2 <= diameter_px**2 / 4.0).astype(float))


def streak_light(
    shape: tuple[int, int], start: tuple[float, float], end: tuple[float, float], sigma_px: float
) -> Array:
    """A gaussian drawn out from start to end, (x, y), of unit height."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    direction = np.array(end) - np.array(start)
    length = float(np.hypot(*direction))
    along = ((x - start[0]) * direction[0] + (y - start[1]) * direction[1]) / length
    off = np.hypot(
        x - start[0] - np.clip(along, 0, length) * direction[0] / length,
        y - start[1] - np.clip(along, 0, length) * direction[1] / length,
    )
    return np.asarray(np.exp(-0.5 * off**2 / sigma_px**2))


def exposed(
    light_adu: Array,
    rng: np.random.Generator,
    offset_adu: float = OFFSET_ADU,
    read_noise_adu: float = READ_NOISE_ADU,
    electrons_per_adu: float = ELECTRONS_PER_ADU,
    bits: int = 8,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """What a camera gives for that light: shot noise, read noise, offset, rounding, full scale."""
    electrons = rng.poisson(light_adu * electrons_per_adu)
    values = electrons / electrons_per_adu + rng.normal(offset_adu, read_noise_adu, light_adu.shape)
    return np.clip(np.rint(values), 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)


def subsampled(shape: tuple[int, int], x: float, y: float, profile: Profile, reach_px: int = 80, n: int = 15) -> Array:
    """Means over n x n points of every pixel of `profile(dx, dy)`, out to `reach_px` from (x, y)."""
    top, left = max(0, round(y) - reach_px), max(0, round(x) - reach_px)
    bottom, right = min(shape[0], round(y) + reach_px + 1), min(shape[1], round(x) + reach_px + 1)
    rows = np.arange(top, bottom, dtype=float)[:, None] - y
    columns = np.arange(left, right, dtype=float)[None, :] - x
    total = np.zeros((bottom - top, right - left))
    offsets = (np.arange(n) + 0.5) / n - 0.5
    for dy in offsets:
        for dx in offsets:
            total += profile(columns + dx, rows + dy)
    light = np.zeros(shape)
    light[top:bottom, left:right] = total / n**2
    return light


def _integral(pixel: Array, centre: float, sigma_px: float) -> Array:
    edge = np.append(pixel - 0.5, pixel[-1] + 0.5)
    return np.asarray(np.diff(0.5 * (1.0 + erf((edge - centre) / (sigma_px * 2.0**0.5)))))

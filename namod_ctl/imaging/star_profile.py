"""One star, measured exactly: background, place, width, noise and light of a cut-out of a frame.

The centre is found in two steps. First an elliptical gaussian window is matched to the star's own second moments
(adaptive moments: Bernstein & Jarvis 2002, AJ 123, 583). Then the position is the one at which the data, weighted
with that gaussian over each pixel's own variance, balance. For a gaussian star these are the weights of maximum
likelihood; for any other shape that is symmetric to its centre the position is still without bias, and the
uncertainty, taken from the noise that is really in the pixels, still true.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from namod_ctl.imaging.dark import HOT_SIGMAS, NEIGHBOURS, QUANTISATION_NOISE_ADU, isolated_pixels, repair_pixels
from namod_ctl.imaging.radiometry import Frame

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FWHM_PER_SIGMA = float((8.0 * np.log(2.0)) ** 0.5)
RING_WIDTH = 0.5
"""The background is taken from a ring around the aperture, this share of the aperture's radius wide."""

MOMENT_STEPS = 25
MOMENT_TOLERANCE = 0.01
"""Of the window's size: a window that is 1 % off costs 1e-4 of the centre's precision."""

MIN_SIGMA_PX = 0.5
CENTRE_STEPS = 8
CENTRE_TOLERANCE_PX = 1e-4
CLIP_STEPS = 3
CLIP_SIGMAS = 3.0
CLIPPED_SHARE_OF_SPREAD = 0.9866
"""Standard deviation of a normal distribution cut at 3 sigma."""

MAX_DARK_SHARE = 0.05
"""With more pixels of the sky at 0 than this, the camera's offset is too low to show the noise whole."""

RARE_SHARE = 0.005
"""The largest values of the sky that are not used to tell its noise: they may be stars."""

BRIGHT_SHARE = 0.15
"""Pixels with more than this share of the star's peak are looked at for the noise of its light."""

MEDIAN_OF_CHI2 = 0.4549
"""Median of the square of a normal variable of unit width."""

COMPANION_DIP = 0.9
"""Two maxima are two stars when the light between them falls below this share of the fainter one."""

COMPANION_FLOOR = 0.1
"""Maxima below this share of the highest are not looked at."""

COMPANION_SIGMAS = 5.0
"""And so high above the noise of one pixel as any star."""

SPREAD_OF_DIP = 4.0
"""A dip must be so many standard deviations of the smoothed noise deeper than that."""

# Blind to planes and nearly so to anything as wide as a star; white noise keeps its size (Immerkaer 1996).
_ROUGHNESS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float64) / 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """A star, measured.

    Attributes
    ----------
    x_px, y_px
        Centre, pixel of the full frame.
    uncertainty_px
        One standard deviation of each axis of the centre.
    diameter_px
        Full width at half maximum of the gaussian that matches, geometric mean of both axes.
    elongation
        Length over width of that gaussian.
    peak_adu
        Its height above the background.
    noise_adu
        Standard deviation of one pixel of the background around the star.
    intensity_sum
        Sum over the aperture of the pixels' entries in the table of responses, less the background's.
    brightest_adu
        Brightest pixel of the aperture, hot pixels repaired.
    companion_share
        Height of the brightest other maximum of the cut-out as a share of the star's; 0 without one.
    aperture_px
        Radius of the aperture.
    """

    x_px: float
    y_px: float
    uncertainty_px: float
    diameter_px: float
    elongation: float
    peak_adu: float
    noise_adu: float
    intensity_sum: float
    brightest_adu: float
    companion_share: float
    aperture_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A gaussian matched to a cut-out: x, y in its pixels, covariance in pixel**2, and the noise around it."""

    sky: Mask
    signal: Array
    x: float
    y: float
    covariance: Array
    height_adu: float
    shape: Array
    noise_adu: float
    shot_adu: float
    light: Array

    @property
    def variance(self) -> Array:
        """Variance of every pixel: background and the star's own light."""
        return self.noise_adu**2 + self.shot_adu * self.light


def measure_profile(
    frame: Frame, x_px: float, y_px: float, diameter_px: float, aperture_px: float, table: Array
) -> Profile:
    """The profile of the star near (x, y) of a frame (rows, columns).

    Parameters
    ----------
    diameter_px
        First guess of its full width at half maximum.
    aperture_px
        Radius of the circle whose light counts. What lies outside the frame is missing from it.
    table
        `radiometry.response_table` of the camera.
    """
    half = int(np.ceil((1.0 + RING_WIDTH) * aperture_px))
    left, top = max(0, round(x_px) - half), max(0, round(y_px) - half)
    cut = frame[top : round(y_px) + half + 1, left : round(x_px) + half + 1]
    x, y = x_px - left, y_px - top
    ring = _ring(cut.shape, x, y, aperture_px)
    level_adu = float(np.median(cut[ring]))
    spread_adu = max(1.4826 * float(np.median(np.abs(cut[ring] - level_adu))), QUANTISATION_NOISE_ADU)
    is_hot = isolated_pixels(cut, level_adu, spread_adu)
    if is_hot.any():
        cut = repair_pixels(cut, is_hot)
    fit = _fit(cut, ring, x, y, diameter_px)
    is_hot = _standing_out(fit)
    if is_hot.any():
        cut = repair_pixels(cut, is_hot)
        fit = _fit(cut, ring, fit.x, fit.y, diameter_px)
    x, y, uncertainty_px = _balanced_centre(fit)
    minor, major = np.linalg.eigvalsh(fit.covariance)
    sigma_px = float((major * minor) ** 0.25)
    aperture = _distance2(cut.shape, x, y) <= aperture_px**2
    intensity = table.take(cut)
    return Profile(
        x_px=x + left,
        y_px=y + top,
        uncertainty_px=uncertainty_px,
        diameter_px=FWHM_PER_SIGMA * sigma_px,
        elongation=float((major / minor) ** 0.5),
        peak_adu=fit.height_adu,
        noise_adu=fit.noise_adu,
        intensity_sum=float((intensity - _plane(intensity, fit.sky))[aperture].sum()),
        brightest_adu=float(cut[aperture].max(initial=0)),
        companion_share=_companion_share(fit, sigma_px),
        aperture_px=aperture_px,
    )


@lru_cache(maxsize=32)
def _axes(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Row and column numbers of a cut-out, shapes (rows, 1) and (1, columns)."""
    return np.arange(shape[0], dtype=np.float64)[:, None], np.arange(shape[1], dtype=np.float64)[None, :]


def _distance2(shape: tuple[int, ...], x: float, y: float) -> Array:
    rows, columns = _axes(shape)
    distance2: Array = (columns - x) ** 2 + (rows - y) ** 2
    return distance2


def _ring(shape: tuple[int, ...], x: float, y: float, aperture_px: float) -> Mask:
    distance2 = _distance2(shape, x, y)
    ring: Mask = (distance2 > aperture_px**2) & (distance2 <= ((1.0 + RING_WIDTH) * aperture_px) ** 2)
    return ring


def _sky(cut: Frame, ring: Mask) -> tuple[Mask, Array, float]:
    """Pixels of the ring that show the sky, the plane through them (shape of `cut`), and their noise around it.

    Pixels more than 3 sigma off the plane (other stars, hot pixels) are left out.
    """
    values = cut[ring]
    middle = float(np.median(values))
    is_cut = np.count_nonzero(values == 0) > MAX_DARK_SHARE * values.size
    least_adu = max(_noise_cut_at_zero(values) if is_cut else 0.0, QUANTISATION_NOISE_ADU)
    noise_adu = max(1.4826 * float(np.median(np.abs(values - middle))), least_adu)
    residual = cut - middle
    for _ in range(CLIP_STEPS):
        # A whole step of rounding always belongs to the sky, however dark and quiet it is.
        sky = ring & (np.abs(residual) <= max(CLIP_SIGMAS * noise_adu, 1.0))
        plane = _plane(cut, sky)
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


def _plane(values: NDArray[np.number], sky: Mask) -> Array:
    """The plane of least squares through the values at `sky`; shape of `values`."""
    # Coordinates from -1 to 1 keep the three by three system well conditioned.
    down, right = (axis / (size / 2.0) - 1.0 for axis, size in zip(_axes(values.shape), values.shape, strict=True))
    rows, columns = np.nonzero(sky)
    basis = np.stack([np.ones(rows.size), down[rows, 0], right[0, columns]])
    level, slope_down, slope_right = np.linalg.lstsq(basis @ basis.T, basis @ values[sky], rcond=None)[0]
    plane: Array = level + slope_down * down + slope_right * right
    return plane


def _fit(cut: Frame, ring: Mask, x: float, y: float, diameter_px: float) -> _Fit:
    """The gaussian that matches the light of `cut` above the background seen in `ring`."""
    sky, plane, noise_adu = _sky(cut, ring)
    signal = cut - plane
    x, y, covariance = _matched_moments(signal, x, y, diameter_px / FWHM_PER_SIGMA)
    shape = _gaussian(signal.shape, x, y, covariance)
    height_adu = float((shape * signal).sum() / (shape * shape).sum())
    rough = cv2.filter2D(signal - height_adu * shape, cv2.CV_64F, _ROUGHNESS)
    light = np.maximum(cv2.blur(signal, (3, 3)), 0.0)
    shot_adu = _shot_adu(np.asarray(rough, dtype=np.float64), light, noise_adu)
    return _Fit(sky, signal, x, y, covariance, max(height_adu, 0.0), shape, noise_adu, shot_adu, light)


def _shot_adu(rough: Array, light: Array, noise_adu: float) -> float:
    """Variance per light, ADU, that makes the roughness of the star's bright pixels what it is (one over the gain).

    Started from the median and then clipped, so that a sharp edge of the star's image, which is rough without noise,
    hardly counts.
    """
    core = light > BRIGHT_SHARE * light.max()
    rough2, light = rough[core] ** 2, light[core]
    variance = np.full(light.shape, noise_adu**2)
    shot_adu = 0.0
    for share_of_mean in (MEDIAN_OF_CHI2, MEDIAN_OF_CHI2, None, None):
        if share_of_mean is not None:
            scale = float(np.median(rough2 / variance)) / share_of_mean
            shot_adu = max(0.0, float(np.mean(scale * variance - noise_adu**2)) / float(np.mean(light)))
        else:
            kept = rough2 <= CLIP_SIGMAS**2 * variance
            excess = float(np.sum(rough2[kept] / CLIPPED_SHARE_OF_SPREAD**2 - noise_adu**2))
            shot_adu = max(0.0, excess / max(float(light[kept].sum()), QUANTISATION_NOISE_ADU))
        variance = noise_adu**2 + shot_adu * light
    return shot_adu


def _gaussian(shape: tuple[int, ...], x: float, y: float, covariance: Array) -> Array:
    """exp(-d^T C^-1 d / 2) of every pixel's distance d from (x, y)."""
    rows, columns = _axes(shape)
    dx, dy = columns - x, rows - y
    xx, xy, yy = _inverse(covariance)
    gaussian: Array = np.exp((-0.5 * xx * dx**2) + (-0.5 * yy * dy**2) - (xy * dx) * dy)
    return gaussian


def _inverse(covariance: Array) -> tuple[float, float, float]:
    (xx, xy), (_, yy) = covariance
    determinant = xx * yy - xy * xy
    return yy / determinant, -xy / determinant, xx / determinant


def _matched_moments(signal: Array, x: float, y: float, sigma_px: float) -> tuple[float, float, Array]:
    """Centre and covariance of the gaussian window that equals the moments seen through it (adaptive moments)."""
    covariance = np.eye(2) * max(sigma_px, MIN_SIGMA_PX) ** 2
    rows, columns = _axes(signal.shape)
    max_variance = (max(signal.shape) / 4.0) ** 2
    for _ in range(MOMENT_STEPS):
        weighted = _gaussian(signal.shape, x, y, covariance) * signal
        over_rows, over_columns = weighted.sum(axis=0), weighted.sum(axis=1)
        light = over_rows.sum()
        if light <= 0.0:
            break
        dx, dy = columns[0] - x, rows[:, 0] - y
        mean = np.array([over_rows @ dx, over_columns @ dy]) / light
        mixed = dy @ weighted @ dx / light
        moments = np.array([[over_rows @ dx**2 / light, mixed], [mixed, over_columns @ dy**2 / light]])
        # Through a matched window a gaussian shows half its covariance and half its offset.
        shift = 2.0 * mean
        target = _bounded(2.0 * (moments - np.outer(mean, mean)), MIN_SIGMA_PX**2, max_variance)
        change = np.abs(target - covariance).max() / np.trace(target)
        step = np.clip(shift, -2.0, 2.0)
        x = float(np.clip(x + step[0], 0.0, signal.shape[1] - 1.0))
        y = float(np.clip(y + step[1], 0.0, signal.shape[0] - 1.0))
        covariance = target
        if change < MOMENT_TOLERANCE and np.abs(shift).max() < MOMENT_TOLERANCE * sigma_px:
            break
    return x, y, covariance


def _bounded(covariance: Array, low: float, high: float) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    if values[0] >= low and values[1] <= high:
        return covariance
    bounded: Array = vectors @ np.diag(np.clip(values, low, high)) @ vectors.T
    return bounded


def _standing_out(fit: _Fit) -> Mask:
    """True where a pixel stands above the matched gaussian so far beyond its neighbours as only a hot one can."""
    residual = (fit.signal - fit.height_adu * fit.shape).astype(np.float32)
    excess = residual - cv2.dilate(residual, NEIGHBOURS)
    # What the star itself could rise above its neighbours by, were it as steep again as the gaussian.
    minor = float(np.linalg.eigvalsh(fit.covariance)[0])
    own = fit.height_adu * fit.shape * (1.0 - np.exp(-0.5 / minor))
    standing_out: Mask = excess > HOT_SIGMAS * np.sqrt(fit.variance) + own
    return standing_out


def _balanced_centre(fit: _Fit) -> tuple[float, float, float]:
    """Centre (x, y) at which the data balance, and one standard deviation of each axis."""
    xx, xy, yy = _inverse(fit.covariance)
    inverse = np.array([[xx, xy], [xy, yy]])
    rows, columns = _axes(fit.signal.shape)
    background = fit.noise_adu**2
    x, y = fit.x, fit.y
    for _ in range(CENTRE_STEPS):
        shape = _gaussian(fit.signal.shape, x, y, fit.covariance)
        variance = background + fit.shot_adu * fit.height_adu * shape
        weight = shape / variance
        dx, dy = columns[0] - x, rows[:, 0] - y
        weighted = weight * fit.signal
        imbalance = np.array([weighted.sum(axis=0) @ dx, weighted.sum(axis=1) @ dy])
        slope = weighted.sum() * np.eye(2) - _moments(weighted * background / variance, dx, dy) @ inverse
        if np.linalg.det(slope) <= 0.0:
            break
        step = np.clip(np.linalg.solve(slope, imbalance), -1.0, 1.0)
        x, y = x + float(step[0]), y + float(step[1])
        if np.abs(step).max() < CENTRE_TOLERANCE_PX:
            break
    if np.linalg.det(slope) <= 0.0:
        return fit.x, fit.y, float("inf")
    gain = np.linalg.inv(slope)
    covariance = gain @ _moments(weight * weight * fit.variance, dx, dy) @ gain.T
    return x, y, float((np.trace(covariance) / 2.0) ** 0.5)


def _moments(weight: Array, dx: Array, dy: Array) -> Array:
    """Sums of weight * (dx, dy) (dx, dy)^T, shape (2, 2)."""
    mixed = dy @ weight @ dx
    return np.array([[weight.sum(axis=0) @ dx**2, mixed], [mixed, weight.sum(axis=1) @ dy**2]])


def _companion_share(fit: _Fit, sigma_px: float) -> float:
    """Height of the brightest other maximum, parted from the highest by a dip, as a share of the highest."""
    width = 3 if sigma_px < 8.0 else 5
    smooth = cv2.blur(fit.signal.astype(np.float32), (width, width))
    peak = float(smooth.max())
    top = np.array(np.unravel_index(int(smooth.argmax()), smooth.shape))
    is_maximum = (cv2.dilate(smooth, np.ones((3, 3), np.uint8)) == smooth) & (smooth > COMPANION_FLOOR * peak)
    share = 0.0
    steps = np.linspace(0.0, 1.0, 2 * max(smooth.shape))[:, None]
    for other in np.argwhere(is_maximum):
        between = smooth[tuple(np.rint(top + steps * (other - top)).astype(np.intp).T)]
        height = float(smooth[tuple(other)])
        spread = (fit.noise_adu**2 + fit.shot_adu * height) ** 0.5
        is_star = height >= COMPANION_SIGMAS * fit.noise_adu
        if is_star and float(between.min()) < COMPANION_DIP * height - SPREAD_OF_DIP * spread / width:
            share = max(share, height / peak)
    return share

"""One star, measured exactly: background, place, width, noise and light of a cut-out of a frame.

The centre is found in two steps. First an elliptical gaussian window is matched to the star's own second moments
(adaptive moments: Bernstein & Jarvis 2002, AJ 123, 583). Then the position is the one at which the data, weighted
with that gaussian over each pixel's own variance, balance. For a gaussian star these are the weights of maximum
likelihood; for any other shape that is symmetric to its centre the position is still without bias, and the
uncertainty, taken from the noise that is really in the pixels, still true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.imaging.dark import HOT_SIGMAS, NEIGHBOURS, QUANTISATION_NOISE_ADU, isolated_pixels, repair_pixels
from namod_ctl.imaging.radiometry import Frame
from namod_ctl.imaging.star_sky import (
    CLIP_SIGMAS,
    CLIPPED_SHARE_OF_SPREAD,
    RING_WIDTH,
    axes,
    distance2,
    level_and_spread,
    plane_through,
    ring_around,
    sky_in,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FWHM_PER_SIGMA = float((8.0 * np.log(2.0)) ** 0.5)
NEAR = 1.25
"""Of the aperture's radius: how far around the star it is looked at closely."""

MOMENT_STEPS = 25
MOMENT_TOLERANCE = 0.01
"""Of the window's size: a window that is 1 % off costs 1e-4 of the centre's precision."""

MIN_SIGMA_PX = 0.5
WIDTHS = np.array([0.5**0.5, 1.0, 2.0])
"""Of the gaussians whose sum stands for the star, in units of the matched one: core and wings of real optics."""

CENTRE_STEPS = 8
CENTRE_TOLERANCE_PX = 2e-3
"""Of the last step: the steps are Newton's, and the next one would be a thousand times smaller."""
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
    cut, left, top = _cut_out(frame, x_px, y_px, (1.0 + RING_WIDTH) * aperture_px)
    ring = ring_around(cut.shape, x_px - left, y_px - top, aperture_px)
    level_adu, spread_adu = level_and_spread(cut[ring])
    is_hot = isolated_pixels(cut, level_adu, spread_adu)
    if is_hot.any():
        cut = repair_pixels(cut, is_hot)
    sky, plane, noise_adu = sky_in(cut, ring, level_adu, spread_adu)
    intensity = table.take(cut)
    intensity -= plane_through(intensity, sky)
    # The sky is known: from here on only the star itself and what is close to it matter.
    cut, near_left, near_top = _cut_out(cut, x_px - left, y_px - top, NEAR * aperture_px)
    rows = slice(near_top, near_top + cut.shape[0])
    columns = slice(near_left, near_left + cut.shape[1])
    plane, intensity = plane[rows, columns], intensity[rows, columns]
    left, top = left + near_left, top + near_top
    fit = _fit(cut - plane, noise_adu, x_px - left, y_px - top, diameter_px)
    is_hot = _standing_out(fit)
    if is_hot.any():
        cut = repair_pixels(cut, is_hot)
        intensity = np.where(is_hot, table.take(cut) - table.take(np.rint(plane).astype(cut.dtype)), intensity)
        fit = _fit(cut - plane, noise_adu, fit.x, fit.y, diameter_px)
    x, y, uncertainty_px = _balanced_centre(fit)
    minor, major = np.linalg.eigvalsh(fit.covariance)
    sigma_px = float((major * minor) ** 0.25)
    aperture = distance2(cut.shape, x, y) <= aperture_px**2
    return Profile(
        x_px=x + left,
        y_px=y + top,
        uncertainty_px=uncertainty_px,
        diameter_px=FWHM_PER_SIGMA * sigma_px,
        elongation=float((major / minor) ** 0.5),
        peak_adu=fit.height_adu,
        noise_adu=noise_adu,
        intensity_sum=float(intensity[aperture].sum()),
        brightest_adu=float(cut[aperture].max(initial=0)),
        companion_share=_companion_share(fit, sigma_px),
        aperture_px=aperture_px,
    )


def _cut_out(frame: Frame, x: float, y: float, reach_px: float) -> tuple[Frame, int, int]:
    """The square around (x, y) as far as it lies in the frame, and its first column and row there."""
    half = math.ceil(reach_px)
    left, top = max(0, round(x) - half), max(0, round(y) - half)
    return frame[top : round(y) + half + 1, left : round(x) + half + 1], left, top


def _fit(signal: Array, noise_adu: float, x: float, y: float, diameter_px: float) -> _Fit:
    """The gaussian that matches the light of `signal`, a cut-out less its sky."""
    x, y, covariance = _matched_moments(signal, x, y, diameter_px / FWHM_PER_SIGMA)
    shape = _gaussian(signal.shape, x, y, covariance)
    height_adu = float((shape * signal).sum() / (shape * shape).sum())
    rough = cv2.filter2D(signal - height_adu * shape, cv2.CV_64F, _ROUGHNESS)
    light = np.maximum(cv2.blur(signal, (3, 3)), 0.0)
    shot_adu = _shot_adu(np.asarray(rough, dtype=np.float64), light, noise_adu)
    return _Fit(signal, x, y, covariance, max(height_adu, 0.0), shape, noise_adu, shot_adu, light)


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
    rows, columns = axes(shape)
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
    rows, columns = axes(signal.shape)
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
    """Centre (x, y) at which the data balance, and one standard deviation of each axis.

    The balance is d(ln likelihood)/d(centre) = 0 for normal noise of each pixel's own variance and a star that is a sum
    of gaussians of one centre, `WIDTHS` times as wide as the matched one.
    """
    xx, xy, yy = _inverse(fit.covariance)
    inverse = np.array([[xx, xy], [xy, yy]])
    rows, columns = axes(fit.signal.shape)
    sums = _heights(fit) / WIDTHS ** np.array([[0.0], [2.0], [4.0]])
    x, y = fit.x, fit.y
    for _ in range(CENTRE_STEPS):
        parts = _parts(_gaussian(fit.signal.shape, x, y, fit.covariance))
        # The star, and what times (inverse covariance) (distance) is its slope, and the slope of that.
        star, slope, bend = (sums @ parts.reshape(WIDTHS.size, -1)).reshape(-1, *fit.signal.shape)
        variance = fit.noise_adu**2 + fit.shot_adu * np.maximum(star, 0.0)
        weight = slope / variance
        dx, dy = columns[0] - x, rows[:, 0] - y
        weighted = weight * fit.signal
        imbalance = np.array([weighted.sum(axis=0) @ dx, weighted.sum(axis=1) @ dy])
        turned = (bend - fit.shot_adu * slope * weight) / variance * fit.signal
        response = weighted.sum() * np.eye(2) - _moments(turned, dx, dy) @ inverse
        if np.linalg.det(response) <= 0.0:
            return fit.x, fit.y, float("inf")
        step = np.clip(np.linalg.solve(response, imbalance), -1.0, 1.0)
        x, y = x + float(step[0]), y + float(step[1])
        if np.abs(step).max() < CENTRE_TOLERANCE_PX:
            break
    gain = np.linalg.inv(response)
    covariance = gain @ _moments(weight * weight * fit.variance, dx, dy) @ gain.T
    return x, y, float((np.trace(covariance) / 2.0) ** 0.5)


def _parts(shape: Array) -> Array:
    """Gaussians `WIDTHS` times as wide as `shape`, stacked: powers of it."""
    wide = np.sqrt(np.sqrt(shape))
    return np.stack([shape * shape, shape, wide])


def _heights(fit: _Fit) -> Array:
    """Heights of the gaussians of `_parts` that together come closest to the star, least squares over the variance."""
    parts = _parts(fit.shape).reshape(WIDTHS.size, -1)
    weighted = parts / fit.variance.ravel()
    return np.asarray(np.linalg.lstsq(weighted @ parts.T, weighted @ fit.signal.ravel(), rcond=None)[0], np.float64)


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

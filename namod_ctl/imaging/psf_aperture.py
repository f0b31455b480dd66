"""Sums of a spot's light over growing apertures around its centre, and what they are uncertain by.

Apertures are ellipses of one shape; their radius k counts in standard deviations of the light. Outside of an aperture
the light goes on as the spot's wings (`psf_background.Wings`). How each number changes with the light of each pixel
(its influence) is known, so the noise of the pixels, the background's covariance and that of the wings' height are
carried over to every number by the same sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.psf_background import FROM_K, N_TERMS, RING_STEP_K, WINGS, Background, Wings, radius_in_sigmas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CONTAINMENT_SHARES = (0.39, 0.68, 0.80, 0.95)
NUMBERS = ("x", "y", "v_xx", "v_xy", "v_yy", "r39", "r68", "r80", "r95")
_SQUARE_VARIANCE = 1.0 / 12.0
"""Of light spread evenly over a square, along each axis, in its own edges: it is the pixels', not the spot's."""
LEAST_AXIS_RATIO = 0.5
"""Of apertures: those of longer spots are wider than they, so that no light beside the long axis is lost."""

_FINE_PX = 0.05
"""Step in radius of the growth of light."""
_PRIOR = np.array([1.0, 1.0, 0.4])
"""Standard deviations of what is known beforehand of a wing's logarithm, slope and bend."""
_LUMPS = 0.1
"""So far rings of a spot of many pieces may stand off from smooth wings, relative."""
_LEAST_DOUBT = 0.5
"""Of the wings' light, relative: that its shape is none that three numbers can describe."""
_N_RADII, _N_ANGLES, _WING_REACH = 240, 96, 9.0
"""Polar grid on which the wings are summed; its radius in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """How A_sigma grows with the aperture; all of shape (n,).

    Attributes
    ----------
    radius_px
        Of the aperture, along its long axis.
    light_share
        Light within, in units of all light (wings included).
    a_sigma_px2, uncertainty_px2
        pi sqrt(det cov) of the light within and the wings outside, and its uncertainty; NaN where the wings have not
        begun.
    without_wings_px2
        The same of the light within alone.
    """

    radius_px: Array
    light_share: Array
    a_sigma_px2: Array
    uncertainty_px2: Array
    without_wings_px2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Squares:
    """Squares of `size_px` pixels, shape (n,): their middles, light above the background, its variance."""

    x: Array
    y: Array
    signal: Array
    variance: Array
    size_px: int


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Light, centre (x, y) and covariance."""

    light: float
    centre_px: Array
    covariance_px2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """The numbers of one spot and their covariances, as in `psf_image.ImagePsf`."""

    values: Array
    noise_covariance: Array
    common_covariance: Array
    light: float
    wings_share: float


def aperture_shape(covariance_px2: Array) -> Array:
    """The covariance, shape (2, 2), whose ellipses are the apertures of a spot of that covariance."""
    (minor, major), axes = np.linalg.eigh(covariance_px2)
    shape: Array = axes @ np.diag([max(minor, LEAST_AXIS_RATIO**2 * major), major]) @ axes.T
    return shape


class ApertureSums:
    """Sums over all apertures of one spot up to a largest one; `squares` may hold more than that."""

    def __init__(self, squares: Squares, background: Background, wings: Wings, most_k: float) -> None:
        self._wings, self._background, self._size_px = wings, background, squares.size_px
        shape = wings.shape_px2
        k = radius_in_sigmas(squares.x, squares.y, wings.centre_px, shape)
        order = np.argsort(k, kind="stable")
        order = order[: int(np.count_nonzero(k <= most_k))]
        self._k, self._x, self._y = k[order], squares.x[order], squares.y[order]
        self._signal, self._variance = squares.signal[order], squares.variance[order]
        self._long_px = float(np.sqrt(np.linalg.eigvalsh(shape)[1]))
        self._grown = np.cumsum(self._signal[:, None] * self._powers(self._x, self._y), axis=0)
        self._ring_k = np.linspace(0.0, _WING_REACH, _N_RADII)
        angle = np.arange(_N_ANGLES) * 2.0 * np.pi / _N_ANGLES
        circle = np.stack([np.cos(angle), np.sin(angle)])
        places = self._ring_k[:, None, None] * (np.linalg.cholesky(shape) @ circle)
        self._wing_x, self._wing_y = (places[:, axis] + wings.centre_px[axis] for axis in (0, 1))
        patch_px2 = self._ring_k[1] * 2.0 * np.pi / _N_ANGLES * np.sqrt(np.linalg.det(shape))
        light = wings.at(self._ring_k[:, None]) * self._ring_k[:, None] * patch_px2
        self._wing_light = np.repeat(light, _N_ANGLES, axis=1)
        self._pull = self._pull_on_wings()
        self._pull_on_terms = self._pull @ self._terms(self._x, self._y)
        self._height = max(float(background.coefficients[WINGS]), 0.0)

    def _powers(self, x: Array, y: Array) -> Array:
        """1, x, y, x^2, x y, y^2 of the distances from the centre; shape (..., 6)."""
        dx, dy = x - self._wings.centre_px[0], y - self._wings.centre_px[1]
        return np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=-1)

    def _terms(self, x: Array, y: Array) -> Array:
        """The background's terms, summed over squares."""
        return self._size_px**2 * self._background.terms(x, y)

    def _n_within(self, k: float) -> int:
        return max(int(np.searchsorted(self._k, k, side="right")), 1)

    def _light_outside(self, k: float) -> Array:
        """Light of the wings on the polar grid outside an aperture; half of a step at its edge."""
        share = np.clip((self._ring_k - k) / self._ring_k[1] + 0.5, 0.0, 1.0)
        light: Array = share[:, None] * self._wing_light
        return light

    def _sums(self, k: float) -> tuple[Array, Array]:
        """Sums of light times powers: within, and of the wings outside; shape (6,) each."""
        outside = np.einsum("ra,rap->p", self._light_outside(k), self._powers(self._wing_x, self._wing_y))
        return self._grown[self._n_within(k) - 1], outside

    def _ring_numbers(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Squares that lie in rings, the number of the ring of each, and how many squares each ring has."""
        inside = np.flatnonzero(self._k >= FROM_K)
        number = ((self._k[inside] - FROM_K) / RING_STEP_K).astype(np.int64)
        return inside, number, np.bincount(number)

    def _pull_on_wings(self) -> Array:
        """By how much the wings' light rises, relative, with the light of each square, by the rings; shape (n,)."""
        pull = np.zeros(len(self._k))
        inside, number, count = self._ring_numbers()
        rise = np.zeros(len(count))
        told = min(len(rise), len(self._wings.rise_per_level))
        rise[:told] = self._wings.rise_per_level[:told]
        pull[inside] = (rise / (self._size_px**2 * np.maximum(count, 1)))[number]
        return pull

    def _slope(self, by_terms: Array, by_wings: Array | float) -> Array:
        """Change of numbers with the background's coefficients, from the influence of all pixels and of the wings.

        A higher background takes light off all pixels, and by the rings that tell of them off the wings as well.
        """
        change = np.asarray(by_wings)[..., None]
        return np.concatenate([-by_terms - change * self._height * self._pull_on_terms, change], axis=-1)

    def _moments_of(self, sums: Array) -> tuple[float, Array, Array]:
        """Light, centre and covariance from sums of light times powers, the squares' own width taken off."""
        light = float(sums[0])
        if light <= 0.0:
            raise DataQualityError("too faint: no light is left above the background; expose longer")
        mean = sums[1:3] / light
        xx, xy, yy = sums[3:] / light
        covariance = np.array([[xx, xy], [xy, yy]]) - np.outer(mean, mean)
        return light, mean, covariance - self._size_px**2 * _SQUARE_VARIANCE * np.eye(2)

    def moments(self, k: float) -> Moments:
        """Of the light within an aperture and the wings outside. Raises DataQualityError when there is no light."""
        within, outside = self._sums(k)
        light, centre, covariance = self._moments_of(within + self._height * outside)
        return Moments(light, self._wings.centre_px + centre, covariance)

    def growth(self, radii_k: Array) -> Growth:
        """A_sigma for each of the apertures; uncertainties by the influence of pixels at the wings' covariance."""
        inverse = np.linalg.inv(self._wings.covariance_px2)
        # of light on A_sigma, in units of A_sigma / (2 light): d^T V^-1 d - 2
        influence = np.array([-2.0, 0.0, 0.0, inverse[0, 0], 2.0 * inverse[0, 1], inverse[1, 1]])
        of_pixels = self._powers(self._x, self._y) @ influence
        by_noise = np.cumsum(of_pixels**2 * self._variance)
        by_both = np.cumsum(of_pixels * self._pull * self._variance)
        by_pull = float(np.sum(self._pull**2 * self._variance))
        by_terms = np.cumsum(of_pixels[:, None] * self._terms(self._x, self._y), axis=0)
        covariance = self._background.covariance + self._background.misfit_covariance
        rows = []
        for k in radii_k:
            within, outside = self._sums(float(k))
            light, _, square = self._moments_of(within + self._height * outside)
            area = np.pi * np.sqrt(max(float(np.linalg.det(square)), 0.0))
            last = self._n_within(float(k)) - 1
            of_wings = float(influence @ outside)
            slope = self._slope(by_terms[last], of_wings)
            lever = self._height * of_wings
            noise2 = by_noise[last] + 2.0 * lever * by_both[last] + lever**2 * by_pull
            doubt = area / (2.0 * light) * np.sqrt(noise2 + slope @ covariance @ slope)
            plain = float(np.linalg.det(self._moments_of(within)[2]))
            rows.append((within[0] / light, area, doubt, np.pi * np.sqrt(max(plain, 0.0))))
        share, areas, doubts, plains = np.array(rows).T
        areas[radii_k < FROM_K] = doubts[radii_k < FROM_K] = np.nan
        return Growth(radii_k * self._long_px, share, areas, doubts, plains)

    def numbers(self, k: float) -> Numbers:
        """All numbers of the light within an aperture and the wings outside. Raises DataQualityError."""
        n = self._n_within(k)
        found = self.moments(k)
        covariance, light = found.covariance_px2, found.light
        r = np.hypot(self._x[:n] - found.centre_px[0], self._y[:n] - found.centre_px[1])
        wing_r = np.hypot(self._wing_x - found.centre_px[0], self._wing_y - found.centre_px[1])
        outside = self._light_outside(k)
        everywhere = np.append(self._signal[:n], self._height * outside.ravel())
        radii, density = _containment(np.append(r, wing_r.ravel()), everywhere, light, self._size_px)

        def influence(x: Array, y: Array, distance: Array) -> Array:
            """Of light at these places on the numbers, shape (9, n)."""
            dx, dy = x - found.centre_px[0], y - found.centre_px[1]
            contained = [
                (share - np.clip((radius - distance) / self._size_px + 0.5, 0.0, 1.0)) / slope
                for share, radius, slope in zip(CONTAINMENT_SHARES, radii, density, strict=True)
            ]
            squares = [dx * dx - covariance[0, 0], dx * dy - covariance[0, 1], dy * dy - covariance[1, 1]]
            return np.stack([*(value / light for value in (dx, dy, *squares)), *contained])

        of_pixels = influence(self._x[:n], self._y[:n], r)
        of_wings = influence(self._wing_x.ravel(), self._wing_y.ravel(), wing_r.ravel()) @ outside.ravel()
        slope = self._slope(of_pixels @ self._terms(self._x[:n], self._y[:n]), of_wings)
        whole = self._height * of_wings[:, None] * self._pull
        whole[:, :n] += of_pixels
        by_noise = (whole * self._variance) @ whole.T
        known = self._background.covariance
        by_sky = slope[:, :N_TERMS] @ known[:N_TERMS, :N_TERMS] @ slope[:, :N_TERMS].T
        by_all = slope @ (known + self._background.misfit_covariance) @ slope.T
        widened = np.trace(covariance) + 2.0 * self._size_px**2 * _SQUARE_VARIANCE
        shrink = np.sqrt(np.trace(covariance) / widened)
        (v_xx, v_xy), (_, v_yy) = covariance
        return Numbers(
            values=np.array([*found.centre_px, v_xx, v_xy, v_yy, *(shrink * radii)]),
            noise_covariance=by_noise + by_sky,
            common_covariance=by_all - by_sky,
            light=light,
            wings_share=self._height * float(outside.sum()) / light,
        )

    def wings(self, found: Moments) -> Wings:
        """The wings of the spot, as its light from `FROM_K` outwards goes on, for the next turn."""
        inside, number, n = self._ring_numbers()
        area_px = self._size_px**2 * np.maximum(n, 1)
        level = np.bincount(number, self._signal[inside]) / area_px
        doubt = np.sqrt(np.bincount(number, self._variance[inside])) / area_px
        return fitted_wings(level, doubt, n > 0, found)


def gaussian_wings(found: Moments) -> Wings:
    """The wings of a gaussian of these moments, give or take their own height."""
    height = found.light / (2.0 * np.pi * np.sqrt(np.linalg.det(found.covariance_px2)))
    shape = aperture_shape(found.covariance_px2)
    return Wings(
        found.centre_px, found.covariance_px2, shape, float(np.log(height)) - FROM_K**2 / 2.0, FROM_K, 0.5, 1.0
    )


def fitted_wings(level: Array, doubt: Array, is_known: Mask, found: Moments) -> Wings:
    """Wings through the mean light per pixel of rings of `RING_STEP_K`, with the doubt that their noise makes.

    What is known beforehand, and to how much: the fall of a gaussian.
    """
    gaussian = gaussian_wings(found)
    start = np.array([gaussian.log_light, gaussian.slope, gaussian.bend])
    beyond, seen = (np.flatnonzero(is_known) + 0.5) * RING_STEP_K, level[is_known]
    unit = np.hypot(doubt[is_known], _LUMPS * np.maximum(seen, 0.0))

    def residuals(values: Array) -> Array:
        light = np.exp(values[0] - values[1] * beyond - values[2] * beyond**2)
        return np.concatenate([(light - seen) / unit, (values - start) / _PRIOR])

    fit = least_squares(residuals, start, bounds=([-np.inf, 0.0, 0.0], np.inf))
    known = np.linalg.inv(fit.jac.T @ fit.jac)
    far = np.array([1.0, -1.5, -(1.5**2)])  # of the logarithm at FROM_K + 1.5, where the wings' light begins to matter
    rise = np.zeros(len(is_known))
    rise[is_known] = (far @ known @ fit.jac[: len(beyond)].T) / unit
    by_noise2 = float(np.sum((rise[is_known] * doubt[is_known]) ** 2))
    misfit2 = max(2.0 * fit.cost / max(len(beyond) - len(start), 1), 1.0)
    log_light, slope, bend = (float(value) for value in fit.x)
    return replace(
        gaussian,
        log_light=log_light,
        slope=slope,
        bend=bend,
        relative_uncertainty=math.sqrt(max(misfit2 * float(far @ known @ far) - by_noise2, 0.0) + _LEAST_DOUBT**2),
        rise_per_level=tuple(float(value) for value in rise),
    )


def _containment(distance: Array, light: Array, total: float, size_px: int) -> tuple[Array, Array]:
    """Radii that hold `CONTAINMENT_SHARES` of all light, and how much light a pixel of radius adds there."""
    width = round(size_px / _FINE_PX)
    step = (distance / _FINE_PX).astype(np.int64)
    within = np.cumsum(np.bincount(step, light, int(step.max()) + 2 * width))
    # a square at an edge counts by its share within: the mean over half of it inwards and outwards
    padded = np.concatenate([np.zeros(width), within, np.full(width, within[-1])])
    grown = np.convolve(padded, np.full(width, 1.0 / width), mode="same")[width:-width]
    at_px = _FINE_PX * (np.arange(len(grown)) + 1.0)
    radii, density = np.empty(len(CONTAINMENT_SHARES)), np.empty(len(CONTAINMENT_SHARES))
    for index, share in enumerate(CONTAINMENT_SHARES):
        first = max(int(np.argmax(grown >= share * total)), 1)
        radii[index] = np.interp(share * total, grown[first - 1 : first + 1], at_px[first - 1 : first + 1])
        reach = max(int(0.1 * first), width)
        low, high = max(first - reach, 0), min(first + reach, len(grown) - 1)
        density[index] = (grown[high] - grown[low]) / (at_px[high] - at_px[low])
    return radii, np.maximum(density, 1e-3 * total / at_px[-1])

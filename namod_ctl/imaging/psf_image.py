"""The reflector's point spread function from one image of a star in the focal plane: moments and containment radii.

The aperture that counts is the one whose A_sigma has the least uncertainty in all: a larger one has more noise and
more of the background's error, a smaller one more light outside, which is added as wings of the height that the ring
around the aperture allows (`psf_background`). Background, moments and aperture need each other and are found in turns.

Lengths are pixels here; `psf_combine` makes angles of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError
from namod_ctl.imaging.psf_aperture import ApertureSums, Growth, Moments, Squares, gaussian_wings
from namod_ctl.imaging.psf_background import Background, fit_background, radius_in_sigmas
from namod_ctl.imaging.psf_spot import LightImage, OtherLight, SpotPlace, find_spot, light_image, noise_of, roughness
from namod_ctl.imaging.radiometry import Frame
from namod_ctl.optics.camera_model import CameraModel

Array = NDArray[np.float64]

LEAST_RADIUS, MOST_RADIUS = 3.0, 5.5
"""Of apertures, in standard deviations of the light along each axis."""
EXTENT_MARGIN, MOST_EXTENT = 1.1, 1.5
"""The least aperture holds all light that was made out, and some more; the ring lies outside of the largest."""
N_APERTURES = 24
LEAST_SHOWN = 0.5
"""Growth is shown from there on, though no such aperture would do."""
RING_SHARES = (2.2, 1.5)
"""Outer over inner radius of the ring: the wide one where the background is even, else the one that tells more."""
LEAST_RING_SHARE = 1.15
UNEVEN_MISFIT = 2.0
N_ITERATIONS = 8
CONVERGED_SHARE = 1e-4
MIN_SIGMA_PX = 1.2
"""Along the short axis: a sharper spot is not resolved by the pixels."""
MAX_UNCERTAINTY_SHARE = 0.25
UNEVENNESS_SHARE = 0.003
"""Of A_sigma: no screen is so even, and no camera so linear, that it would be known better."""
ZERO_SHARE_WORTH_A_WORD = 0.02
"""Of the sky's pixels: with more of them at 0 the camera's black level is too low."""
LEAST_NOISE_ADU = 0.2
PIXELS_PER_SIGMA = 8.0
"""Finer pixels are taken together: what that adds to the moments is known."""
LIT_SHARE = 0.1
"""Of the brightest light: pixels whose roughness tells how noise grows with light."""
MEDIAN_OF_CHI2 = 0.4549
"""Of one degree of freedom."""


@dataclass(frozen=True, slots=True, eq=False)
class ImagePsf:
    """The point spread function as one image shows it.

    Attributes
    ----------
    numbers
        Shape (9,), in the order of `psf_aperture.NUMBERS`: centre of gravity, covariance, radii about the centre.
    noise_covariance
        Shape (9, 9). What another image of the same sky would not share.
    common_covariance
        Shape (9, 9). What it would: the background's misfit, and the wings.
    light
        Of the whole spot, linear ADU.
    peak_share
        Of full scale, background included.
    aperture_px2, ring_px2
        Shape (2, 2) each: ellipses d^T (..)^-1 d = 1 of the aperture that counts, and of the background's inner and
        outer edge.
    wings_share
        Light outside the aperture, in units of all light.
    growth
        With the aperture.
    background
        Under the spot.
    others
        Light beside the spot that was left out.
    picture, picture_corner_px, picture_step_px
        The image less its background around the spot, the (x, y) of its first pixel, and how many pixels of the frame
        one of its own is wide.
    """

    numbers: Array
    noise_covariance: Array
    common_covariance: Array
    light: float
    peak_share: float
    aperture_px2: Array
    ring_px2: tuple[Array, Array]
    wings_share: float
    growth: Growth
    background: Background
    others: tuple[OtherLight, ...]
    picture: Array
    picture_corner_px: tuple[int, int]
    picture_step_px: int

    @property
    def a_sigma_px2(self) -> float:
        """A_sigma."""
        return area_of(self.numbers)

    @property
    def uncertainty_px2(self) -> float:
        """Of A_sigma, noise and background together."""
        return float(np.sqrt(area_variance(self.numbers, self.noise_covariance + self.common_covariance)))


def measure_psf(frame: Frame, camera: CameraModel, exposure_s: float) -> ImagePsf:
    """The point spread function that a frame of the PSF camera shows.

    Raises
    ------
    ConfigError
        The frame is not of this camera.
    DataQualityError
        There is no spot in it that could be measured; why, and what to do.
    """
    image = light_image(frame, camera, exposure_s)
    place = find_spot(image)
    result = _Spot(image, place, RING_SHARES[0]).measured()
    if result.background.misfit > UNEVEN_MISFIT:
        narrow = _Spot(image, place, RING_SHARES[1]).measured()
        if narrow.uncertainty_px2 / narrow.a_sigma_px2 < result.uncertainty_px2 / result.a_sigma_px2:
            result = narrow
    share = result.uncertainty_px2 / result.a_sigma_px2
    if not share <= MAX_UNCERTAINTY_SHARE:
        remedy = "expose longer, take a brighter star, or darken the screen's surroundings"
        if result.background.zero_share > ZERO_SHARE_WORTH_A_WORD:
            remedy = "the sky's noise is cut off at 0 ADU: raise the camera's black level"
        raise DataQualityError(
            f"too faint for this background: A_sigma would be uncertain by {share:.0%}, at most "
            f"{MAX_UNCERTAINTY_SHARE:.0%} mean anything; {remedy}"
        )
    return result


def area_of(numbers: Array) -> float:
    """A_sigma = pi sqrt(det cov) of numbers in the order of `psf_aperture.NUMBERS`.

    Source: arXiv:1605.06274, section 4.
    """
    return float(np.pi * np.sqrt(max(numbers[2] * numbers[4] - numbers[3] ** 2, 0.0)))


def area_variance(numbers: Array, covariance: Array) -> float:
    """Variance of A_sigma of numbers of that covariance (9, 9)."""
    area = area_of(numbers)
    if area <= 0.0:
        return float("inf")
    slope = np.zeros(len(numbers))
    slope[2:5] = np.array([numbers[4], -2.0 * numbers[3], numbers[2]]) * np.pi**2 / (2.0 * area)
    return max(float(slope @ covariance @ slope), 0.0)


def _of_unevenness(numbers: Array) -> Array:
    """Covariance (9, 9) of numbers that are wrong by one share: areas by `UNEVENNESS_SHARE`, lengths by half of it."""
    scale = UNEVENNESS_SHARE * numbers * np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5])
    return np.outer(scale, scale)


class _Spot:
    """One spot, whose background, moments and aperture are made to fit each other."""

    def __init__(self, image: LightImage, place: SpotPlace, ring_share: float) -> None:
        self._image, self._place, self._ring_share = image, place, ring_share
        self._noise = max(noise_of(image.light), LEAST_NOISE_ADU)
        minor_px = float(np.sqrt(np.linalg.eigvalsh(place.covariance_px2)[0]))
        self._block_px = max(int(minor_px / PIXELS_PER_SIGMA), 1)
        self._wings = gaussian_wings(Moments(place.light, place.centre_px, place.covariance_px2))

    def measured(self) -> ImagePsf:
        """All numbers. Raises DataQualityError."""
        for n in range(N_ITERATIONS):
            radii_k, ring_k = self._radii()
            background = self._fitted(ring_k)
            sums, picture, corner = self._summed(background, float(radii_k[-1]))
            growth = sums.growth(radii_k)
            # chosen by the uncertainties alone, never by the areas themselves
            best = int(np.argmin(growth.uncertainty_px2 / np.maximum(growth.a_sigma_px2, 1e-9)))
            found = sums.moments(float(radii_k[best]))
            minor, major = np.linalg.eigvalsh(found.covariance_px2)
            if not minor >= MIN_SIGMA_PX**2:
                raise DataQualityError(
                    f"the spot is less than {MIN_SIGMA_PX:g} pixels wide (one standard deviation): too sharp, or too "
                    "faint, for this camera; take a finer plate scale, or expose longer"
                )
            shape = self._wings.shape_px2
            change = np.sqrt(minor * major / np.linalg.det(self._wings.covariance_px2)) - 1.0
            if abs(change) < CONVERGED_SHARE and n > 0:
                break
            self._wings = sums.wings(found)
        numbers = sums.numbers(float(radii_k[best]))
        shown_k = np.append(np.linspace(LEAST_SHOWN, radii_k[0], N_APERTURES // 2, endpoint=False), radii_k)
        return ImagePsf(
            numbers=numbers.values,
            noise_covariance=numbers.noise_covariance,
            common_covariance=numbers.common_covariance + _of_unevenness(numbers.values),
            light=numbers.light,
            peak_share=self._image.peak_share,
            aperture_px2=float(radii_k[best]) ** 2 * shape,
            ring_px2=(ring_k[0] ** 2 * shape, ring_k[1] ** 2 * shape),
            wings_share=numbers.wings_share,
            growth=sums.growth(shown_k),
            background=background,
            others=self._place.others,
            picture=picture,
            picture_corner_px=corner,
            picture_step_px=self._block_px,
        )

    def _radii(self) -> tuple[Array, tuple[float, float]]:
        """Radii of apertures, and of the ring around them, as the image has room. Raises DataQualityError."""
        centre, shape = self._wings.centre_px, self._wings.shape_px2
        size = np.array(self._image.light.shape[::-1])
        sigma = np.sqrt(np.diag(shape))
        room_k = float(np.min(np.concatenate([centre, size - 1 - centre]) / np.tile(sigma, 2)))
        extent_k = float(radius_in_sigmas(self._place.spot_px[:, 0], self._place.spot_px[:, 1], centre, shape).max())
        least_k = max(LEAST_RADIUS, EXTENT_MARGIN * extent_k)
        most_k = max(MOST_RADIUS, MOST_EXTENT * extent_k)
        if room_k < least_k:
            raise DataQualityError(
                f"the spot is too close to the edge of the image: it needs {least_k * sigma.max():.0f} pixels around "
                f"its centre at column {centre[0]:.0f}, row {centre[1]:.0f}; bring the star to the middle, or take a "
                "camera with a larger field"
            )
        if self._place.is_other.any():
            y, x = np.nonzero(self._place.is_other)
            free_k = float(radius_in_sigmas(x, y, centre, shape).min())
            if free_k < least_k:
                raise DataQualityError(
                    f"light of another star, or a ghost, is within {free_k:.1f} standard deviations of the spot, which "
                    f"needs {least_k:.1f} for itself; bring a star into the field that stands alone"
                )
            most_k = min(most_k, free_k)
        # the ring may reach over the edges of the image as long as enough of it is left
        far_k = float(np.max(np.concatenate([centre, size - 1 - centre]) / np.tile(sigma, 2)))
        most_k = min(most_k, room_k)
        outer_k = min(self._ring_share * most_k, far_k)
        most_k = max(min(most_k, outer_k / LEAST_RING_SHARE), least_k)
        return np.linspace(least_k, most_k, N_APERTURES), (most_k, outer_k)

    def _fitted(self, ring_k: tuple[float, float]) -> Background:
        return fit_background(
            self._image.light, ~self._place.is_other, self._image.is_zero, self._wings, ring_k, self._noise
        )

    def _summed(self, background: Background, most_k: float) -> tuple[ApertureSums, Array, tuple[int, int]]:
        """Sums over apertures; the light above the background around the spot, and its first pixel (x, y)."""
        reach = most_k * np.sqrt(np.diag(self._wings.shape_px2))
        left, top = (max(int(c), 0) for c in np.floor(self._wings.centre_px - reach))
        right, bottom = (int(c) + 1 for c in np.ceil(self._wings.centre_px + reach))
        size = self._block_px
        light = self._image.light[top:bottom, left:right]
        light = light[: light.shape[0] // size * size, : light.shape[1] // size * size]
        smooth = _summed(np.asarray(cv2.blur(light, (5, 5)), dtype=np.float64), size)
        index = size * np.indices(smooth.shape).astype(np.float64) + (size - 1) / 2.0
        x, y = left + index[1], top + index[0]
        sky = size**2 * background.surface(x, y)
        signal, smooth = _summed(light, size) - sky, np.maximum(smooth - sky, 0.0)
        variance = size**2 * self._noise**2 + self._gain(light, smooth) * smooth
        squares = Squares(x.ravel(), y.ravel(), signal.ravel(), variance.ravel(), size)
        return ApertureSums(squares, background, self._wings, most_k), signal / size**2, (left, top)

    def _gain(self, light: Array, smooth: Array) -> float:
        """Variance per light, from how rough the lit part of the image is; `smooth` in blocks."""
        size = self._block_px
        level = np.repeat(np.repeat(smooth, size, axis=0), size, axis=1)[:-1, :-1] / size**2
        is_lit = level > LIT_SHARE * float(level.max())
        excess = float(np.median(roughness(light)[is_lit] ** 2)) / MEDIAN_OF_CHI2 - self._noise**2
        return max(excess, 0.0) / float(np.median(level[is_lit]))


def _summed(values: Array, size: int) -> Array:
    """Sums over squares of `size` pixels."""
    total: Array = values.reshape(values.shape[0] // size, size, values.shape[1] // size, size).sum(axis=(1, 3))
    return total

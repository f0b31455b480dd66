"""Several images of one point spread function as one: weighted mean, with their scatter as a check of the uncertainty.

Every image is measured about its own centre of gravity, so a star that drifts over the screen between images does no
harm. What it drifts during an exposure makes the spot longer; where the times are known, that is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.imaging.psf_aperture import NUMBERS
from namod_ctl.imaging.psf_image import UNEVENNESS_SHARE, ZERO_SHARE_WORTH_A_WORD, ImagePsf, area_of, area_variance

Array = NDArray[np.float64]

MAX_DRIFT_GAP_S = 5.0
"""Between two images from which the star's speed is told; longer ones say little of the speed during the exposure."""
SMEAR_UNCERTAINTY_SHARE = 0.5
"""Of what is taken off for the star's motion: it may have gone on another way during the exposure."""
LEAST_CHANCE = 0.003
"""Scatter between images that has less chance by their uncertainties is remarked."""
MAX_OTHER_SHARE = 0.01
MISFIT_WORTH_A_WORD = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Exposed:
    """One image and when it was exposed; `mid_s` is None where nobody knows."""

    image: ImagePsf
    exposure_s: float
    mid_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Psf:
    """The point spread function of the reflector, as angles in the focal plane (distance over focal length).

    Attributes
    ----------
    a_sigma_rad2, a_sigma_uncertainty_rad2
        pi sqrt(det cov) of its light.
    common_uncertainty_rad2
        Part of the uncertainty that more images of the same kind do not make smaller.
    axes_rad, axes_uncertainty_rad
        Shape (2,): standard deviations along the long and the short axis of its ellipse.
    angle_rad, angle_uncertainty_rad
        Of the long axis from the right of the image towards its top, in [0, pi).
    radii_rad, radii_uncertainty_rad
        Shape (4,): about the centre of gravity, of `psf_aperture.CONTAINMENT_SHARES` of the light.
    centre_px, centre_uncertainty_px
        Shape (2,): (x, y) of the centre of gravity in the first image, and its uncertainty.
    drift_px
        Shape (2,): from the first image to the last.
    n_images
        That count.
    scatter
        Of A_sigma between images, in units of what their uncertainties explain; NaN for a single one.
    remarks
        For people.
    """

    a_sigma_rad2: float
    a_sigma_uncertainty_rad2: float
    common_uncertainty_rad2: float
    axes_rad: Array
    axes_uncertainty_rad: Array
    angle_rad: float
    angle_uncertainty_rad: float
    radii_rad: Array
    radii_uncertainty_rad: Array
    centre_px: Array
    centre_uncertainty_px: Array
    drift_px: Array
    n_images: int
    scatter: float
    remarks: tuple[str, ...]

    @property
    def covariance_rad2(self) -> Array:
        """Shape (2, 2), of the light along the image's right and top."""
        long = np.array([np.cos(self.angle_rad), np.sin(self.angle_rad)])
        short = np.array([-long[1], long[0]])
        covariance: Array = self.axes_rad[0] ** 2 * np.outer(long, long) + self.axes_rad[1] ** 2 * np.outer(
            short, short
        )
        return covariance


def combine_images(exposed: Sequence[Exposed], plate_scale_rad: float) -> Psf:
    """One point spread function from one image or more."""
    images = [one.image for one in exposed]
    numbers, noise, common = _without_smear(exposed)
    areas = np.array([area_of(values) for values in numbers])
    doubts = np.array([area_variance(v, n) for v, n in zip(numbers, noise, strict=True)])
    # by the relative variance of one typical area: an image whose area came out small is no better for that
    weights = areas**2 / np.maximum(doubts, 1e-12 * areas**2)
    weights = weights / weights.sum()
    mean = weights @ numbers
    noise_of_mean = np.einsum("i,iab->ab", weights**2, noise)
    common_of_mean = np.einsum("i,iab->ab", weights, common)
    scatter = float("nan")
    remarks = _remarks(images, plate_scale_rad)
    if len(images) > 1:
        expected = doubts + (UNEVENNESS_SHARE * areas) ** 2  # a star that drifts meets other parts of the screen
        squares = float(np.sum((areas - weights @ areas) ** 2 / expected))
        scatter = float(np.sqrt(squares / (len(images) - 1)))
        noise_of_mean = noise_of_mean * max(scatter, 1.0) ** 2
        if chi2.sf(squares, len(images) - 1) < LEAST_CHANCE:
            remarks.append(
                f"the images differ {scatter:.1f} times as much as their noise explains: wind, clouds, a star near the "
                "edge, or a screen that is not even; the uncertainty contains it"
            )
    every = noise_of_mean + common_of_mean
    axes_px, angle, of_axes = _ellipse(mean)
    ellipse_doubt = np.sqrt(np.maximum(np.einsum("ka,ab,kb->k", of_axes, every, of_axes), 0.0))
    scale2 = plate_scale_rad**2
    return Psf(
        a_sigma_rad2=area_of(mean) * scale2,
        a_sigma_uncertainty_rad2=float(np.sqrt(area_variance(mean, every))) * scale2,
        common_uncertainty_rad2=float(np.sqrt(area_variance(mean, common_of_mean))) * scale2,
        axes_rad=axes_px * plate_scale_rad,
        axes_uncertainty_rad=ellipse_doubt[:2] * plate_scale_rad,
        angle_rad=angle,
        angle_uncertainty_rad=float(min(ellipse_doubt[2], np.pi / 2.0)),
        radii_rad=mean[5:] * plate_scale_rad,
        radii_uncertainty_rad=np.sqrt(np.maximum(np.diag(every)[5:], 0.0)) * plate_scale_rad,
        centre_px=images[0].numbers[:2],
        centre_uncertainty_px=np.sqrt(
            np.maximum(np.diag(images[0].noise_covariance + images[0].common_covariance)[:2], 0.0)
        ),
        drift_px=images[-1].numbers[:2] - images[0].numbers[:2],
        n_images=len(images),
        scatter=scatter,
        remarks=tuple(remarks),
    )


def _without_smear(exposed: Sequence[Exposed]) -> tuple[Array, Array, Array]:
    """Numbers (n, 9), noise and common covariances (n, 9, 9), less what the star's motion in each exposure adds.

    A star that goes on evenly by d during an exposure adds d d^T / 12 to the covariance.
    """
    numbers = np.array([one.image.numbers for one in exposed])
    noise = np.array([one.image.noise_covariance for one in exposed])
    common = np.array([one.image.common_covariance for one in exposed])
    for index, one in enumerate(exposed):
        speeds = []
        for other in exposed[max(index - 1, 0) : index + 2]:
            if other is one or other.mid_s is None or one.mid_s is None:
                continue
            gap_s = other.mid_s - one.mid_s
            if 0.0 < abs(gap_s) <= MAX_DRIFT_GAP_S:
                speeds.append((other.image.numbers[:2] - one.image.numbers[:2]) / gap_s)
        if speeds:
            way = np.mean(speeds, axis=0) * one.exposure_s
            smear = np.array([way[0] ** 2, way[0] * way[1], way[1] ** 2]) / 12.0
            before = numbers[index, 2] + numbers[index, 4]
            numbers[index, 2:5] -= smear
            numbers[index, 5:] *= np.sqrt((numbers[index, 2] + numbers[index, 4]) / before)
            doubt = np.zeros(len(NUMBERS))
            doubt[2:5] = SMEAR_UNCERTAINTY_SHARE * smear
            common[index] += np.outer(doubt, doubt)
    return numbers, noise, common


def _ellipse(numbers: Array) -> tuple[Array, float, Array]:
    """Long and short axis, angle from the right to the top, and their slopes with the numbers, shape (3, 9)."""
    v_xx, v_xy, v_yy = numbers[2:5]
    half, along = (v_xx + v_yy) / 2.0, (v_xx - v_yy) / 2.0
    apart = max(float(np.hypot(along, v_xy)), 1e-9 * half)
    axes = np.sqrt(np.maximum([half + apart, half - apart], 0.0))
    # rows of an image count downwards
    angle = 0.5 * float(np.arctan2(-v_xy, along)) % np.pi
    slopes = np.zeros((3, len(NUMBERS)))
    of_apart = np.array([along / 2.0, v_xy, -along / 2.0]) / apart
    of_half = np.array([0.5, 0.0, 0.5])
    slopes[0, 2:5] = (of_half + of_apart) / (2.0 * axes[0])
    slopes[1, 2:5] = (of_half - of_apart) / (2.0 * max(axes[1], 1e-9))
    slopes[2, 2:5] = np.array([v_xy / 2.0, -along, -v_xy / 2.0]) / (2.0 * apart**2)
    return axes, angle, slopes


def _remarks(images: Sequence[ImagePsf], plate_scale_rad: float) -> list[str]:
    """What people should know of the images; the same once."""
    remarks = []
    seen = [other for image in images for other in image.others if other.share >= MAX_OTHER_SHARE]
    if seen:
        brightest = max(seen, key=lambda other: other.share)
        image = next(image for image in images if brightest in image.others)
        away = np.array([brightest.x_px, brightest.y_px]) - image.numbers[:2]
        share = brightest.share / (1.0 + brightest.share)
        square = image.numbers[2:5] * (1.0 - share)
        square = square + share * (1.0 - share) * np.array([away[0] ** 2, away[0] * away[1], away[1] ** 2])
        with_it = area_of(np.array([0.0, 0.0, *square])) * plate_scale_rad**2
        remarks.append(
            f"light beside the spot was left out, {brightest.share:.1%} of its own, "
            f"{rad_to_arcmin(float(np.linalg.norm(away)) * plate_scale_rad):.1f} arcmin away: another star or a ghost. "
            f"Should a facet have thrown it there, A_sigma is {rad2_to_arcmin2(with_it):.1f} arcmin2"
        )
    if max(image.background.zero_share for image in images) > ZERO_SHARE_WORTH_A_WORD:
        remarks.append(
            "the sky's noise is cut off at 0 ADU, which makes the background uncertain: raise the camera's black level"
        )
    if max(image.background.misfit for image in images) > MISFIT_WORTH_A_WORD:
        remarks.append(
            "the background around the spot is uneven (a ghost, the screen's edge, stray light); the uncertainty "
            "contains it"
        )
    return remarks

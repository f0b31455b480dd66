"""Where the telescope's optical axis lies in the star camera, and whether it moves with the zenith distance.

Two ways: from the facets' light, whose common centre is where a star must stand for the reflector as a whole to throw
it into the focus; and from a star that is held on the focal plane's centre while the star camera takes frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from namod_ctl.calibration.geometry.serial_noise import variance_factor
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.reconstruction.alignment import FacetAlignment
from namod_ctl.reconstruction.correction import common_centre
from namod_ctl.reconstruction.facet_fit import FacetFit, student_weight
from namod_ctl.reconstruction.facet_psf import BACKGROUND, CENTRE, GRADIENT_Y, LOG_FLUX, evaluate
from namod_ctl.reconstruction.reconstruct import Reconstruction

Array = NDArray[np.float64]

MIN_FACETS = 3
MIN_HELD_FRAMES = 5
CLIP_SIGMAS = 5.0
NORMAL_PER_MAD = 1.4826
MAX_HELD_SCATTER_SHARE = 1.0
"""Of the star's size: a star that wanders further is not held."""
MIN_KEPT_SHARE = 0.6
ROUNDING_PX = 0.01
"""No scatter of a series is believed to be smaller: centres have errors that all frames share."""
SIGNIFICANT_CHANCE = 1e-3
"""An axis that rests would be seen to move so much less often than that."""
_STEP_RAD = 1e-6
_UNSOUND = (
    FacetFlag.NO_SIGNAL
    | FacetFlag.PSF_CUT_BY_SCAN_EDGE
    | FacetFlag.UNRELIABLE
    | FacetFlag.PSF_OUTSIDE_SCAN
    | FacetFlag.RESTS_ON_BAD_RECORD
)
"""Flags of the estimate; those of its correction (no gain, beyond a leg's travel) say nothing against it."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisPosition:
    """The axis in the star camera's image, measured once.

    Attributes
    ----------
    pixel, covariance_px2
        Shapes (2,) and (2, 2).
    n_points
        Facets or frames that it rests on.
    facet_scatter_px
        How far the facets' own centres lie from it, rms per axis; NaN for a held star.
    zenith_rad
        Zenith distance at which it was measured; None when nobody told.
    """

    pixel: Array
    covariance_px2: Array
    n_points: int
    facet_scatter_px: float = math.nan
    zenith_rad: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AxisFit:
    """The axis from all that was measured.

    Attributes
    ----------
    pixel, covariance_px2
        Shapes (2,) and (2, 2). Of an axis that moves: the mean, and how it scatters.
    is_moving
        It moves by more than the measurements' uncertainty allows by chance.
    chance
        Of seeing such a motion when it rests; 1 for one measurement.
    slope_px_per_rad, slope_uncertainty_px_per_rad
        Shape (2,). Against zenith distance; NaN without two different ones.
    largest_way_px
        Between two of the measurements.
    """

    pixel: Array
    covariance_px2: Array
    is_moving: bool
    chance: float
    slope_px_per_rad: Array
    slope_uncertainty_px_per_rad: Array
    largest_way_px: float


def axis_of_facets(result: Reconstruction, camera: CameraModel, zenith_rad: float | None = None) -> AxisPosition:
    """The axis as the light-weighted common centre of the facets' point spread functions shows it.

    Facets that are silent, cut off by the edge of the scan or unreliable have no say. The uncertainty is that of the
    measurement, and of the light of facets without a say; that facets are misaligned is no uncertainty of where their
    light goes now, and is told apart.

    Parameters
    ----------
    camera
        The star camera with which the run was recorded.

    Raises
    ------
    DataQualityError
        Fewer than `MIN_FACETS` facets have a say.
    """
    facets = result.alignment.facets
    sound = [j for j, facet in enumerate(facets) if _is_sound(facet)]
    if len(sound) < MIN_FACETS:
        raise DataQualityError(
            f"{len(sound)} of {len(facets)} facets have a sound point spread function, at least {MIN_FACETS} are "
            "needed for a common centre: record longer, or further out"
        )
    theta = np.array([facets[j].theta_rad for j in sound])
    flux = np.array([facets[j].flux for j in sound])
    centre = common_centre(theta, flux)
    share = flux / flux.sum()
    covariance = sum(
        (
            weight**2 * _covariance_of_pull(facets[j], result.fits[j], off)
            for j, weight, off in zip(sound, share, theta - centre, strict=True)
        ),
        np.zeros((2, 2)),
    )
    pulled = _pulled_by_records(result, sound, share, theta - centre)
    by_records = pulled.T @ pulled
    if np.trace(by_records) > np.trace(covariance):
        covariance = by_records
    # light of facets without a say goes somewhere, too: as far off as that of the others, as far as anybody knows
    n_silent = len(facets) - len(sound)
    spread = np.einsum("j,ja,jb->ab", share, theta - centre, theta - centre)
    covariance = covariance + spread * n_silent / (len(facets) * len(sound))
    steps = np.eye(2) * _STEP_RAD
    pixel = camera.pixel_of_theta(centre)
    per_rad = (camera.pixel_of_theta(centre + steps) - pixel).T / _STEP_RAD
    scatter = camera.pixel_of_theta(theta) - pixel
    return AxisPosition(
        pixel=pixel,
        covariance_px2=per_rad @ covariance @ per_rad.T,
        n_points=len(sound),
        facet_scatter_px=float(np.sqrt(np.average(np.mean(scatter**2, axis=1), weights=flux))),
        zenith_rad=zenith_rad,
    )


def _is_sound(facet: FacetAlignment) -> bool:
    is_known = np.isfinite(facet.theta_rad).all() and np.isfinite(facet.theta_cov_rad2).all()
    return bool(is_known and not facet.flags & _UNSOUND and facet.flux > 0.0)


def _covariance_of_pull(facet: FacetAlignment, fit: FacetFit | None, offset_rad: Array) -> Array:
    """Of what a facet of weight 1 adds to the common centre: its own centre, and its light times how far off it is."""
    if fit is None:
        return facet.theta_cov_rad2
    mixed = np.outer(fit.covariance[CENTRE, LOG_FLUX], offset_rad)
    light = fit.covariance[LOG_FLUX, LOG_FLUX] * np.outer(offset_rad, offset_rad)
    covariance: Array = facet.theta_cov_rad2 + mixed + mixed.T + light
    return covariance


def _pulled_by_records(result: Reconstruction, sound: Sequence[int], share: Array, offset_rad: Array) -> Array:
    """How far each record pulls the common centre, shape (n_records, 2), rad.

    All facets of a record share the star's position and intensity, so their errors add up instead of averaging out.
    The sum of squares of these pulls is the common centre's variance (a sandwich estimate, clustered by record).
    """
    used = result.used
    pulled = np.zeros((used.n_records, 2))
    for j, weight, off in zip(sound, share, offset_rad, strict=True):
        fit = result.fits[j]
        if fit is None:
            continue
        _, jacobian = evaluate(fit.parameters, used.theta_rad[fit.used])
        jacobian[:, BACKGROUND : GRADIENT_Y + 1] *= fit.faintness[:, None]
        residual = student_weight(fit.residual, fit.variance) * fit.residual / (1.0 - fit.leverage)
        step = (residual * fit.slope)[:, None] * (jacobian @ fit.covariance)
        pulled[fit.used] += weight * (step[:, CENTRE] + np.outer(step[:, LOG_FLUX], off))
    return pulled


def axis_of_held_star(
    pixel: Array, uncertainty_px: Array, star_size_px: float, zenith_rad: float | None = None
) -> AxisPosition:
    """The axis as the place of a star that is held on the focal plane's centre.

    Frames that disagree with the others are left out; neighbouring frames that err alike (a drive that hunts slowly)
    count as fewer.

    Parameters
    ----------
    pixel, uncertainty_px
        Shapes (n, 2) and (n,). The star in the frames, in the order of time, and one standard deviation of each axis.

    Raises
    ------
    DataQualityError
        Too few frames, or a star that wanders: it is not held.
    """
    if len(pixel) < MIN_HELD_FRAMES:
        raise DataQualityError(
            f"the star was measured in {len(pixel)} frames, at least {MIN_HELD_FRAMES} are needed: take more"
        )
    middle = np.median(pixel, axis=0)
    scatter_px = np.maximum(NORMAL_PER_MAD * np.median(np.abs(pixel - middle), axis=0), ROUNDING_PX)
    limit = CLIP_SIGMAS * np.hypot(scatter_px, uncertainty_px[:, None])
    is_kept = np.all(np.abs(pixel - middle) < limit, axis=1)
    if float(scatter_px.max()) > MAX_HELD_SCATTER_SHARE * star_size_px or is_kept.mean() < MIN_KEPT_SHARE:
        raise DataQualityError(
            f"the star wanders by {scatter_px.max():.1f} pixel in the star camera (limit "
            f"{MAX_HELD_SCATTER_SHARE * star_size_px:.1f}), so it was not held on the focal plane's centre: let the "
            "drive track, and take frames while its image stands on the PSF camera's centre"
        )
    kept = pixel[is_kept]
    deviation = kept - kept.mean(axis=0)
    n = len(kept)
    covariance = deviation.T @ deviation / (n - 1)
    floor = np.eye(2) * (float(np.median(uncertainty_px)) ** 2 / n + ROUNDING_PX**2)
    return AxisPosition(
        pixel=kept.mean(axis=0),
        covariance_px2=covariance * variance_factor(deviation) / n + floor,
        n_points=n,
        zenith_rad=zenith_rad,
    )


def combine_axis(positions: Sequence[AxisPosition]) -> AxisFit:
    """The axis from one measurement or several, and whether it moves between them.

    An axis that rests is the weighted mean. One that moves is the plain mean, with the scatter of the measurements as
    its uncertainty: that is how far it lies from there at any other zenith distance.
    """
    pixel = np.array([position.pixel for position in positions])
    weights = np.array([np.linalg.inv(position.covariance_px2) for position in positions])
    covariance = np.linalg.inv(weights.sum(axis=0))
    mean: Array = covariance @ np.einsum("kab,kb->a", weights, pixel)
    off = pixel - mean
    n_free = 2 * (len(positions) - 1)
    chance = 1.0
    if n_free:
        chance = float(chi2_distribution.sf(np.einsum("ka,kab,kb->", off, weights, off), n_free))
    is_moving = chance < SIGNIFICANT_CHANCE
    if is_moving:
        mean = pixel.mean(axis=0)
        covariance = np.cov(pixel.T, ddof=1) + covariance
    slope, slope_uncertainty = _slope(positions, pixel, weights)
    ways = np.linalg.norm(pixel[:, None] - pixel[None, :], axis=2)
    return AxisFit(mean, covariance, is_moving, chance, slope, slope_uncertainty, float(ways.max()))


def _slope(positions: Sequence[AxisPosition], pixel: Array, weights: Array) -> tuple[Array, Array]:
    """Motion per zenith distance (2,) and its uncertainty (2,), px / rad; NaN without two zenith distances."""
    told = [position.zenith_rad for position in positions]
    zenith = np.array([math.nan if angle is None else angle for angle in told])
    if np.isnan(zenith).any() or np.ptp(zenith) == 0.0:
        return np.full(2, math.nan), np.full(2, math.nan)
    design = np.stack([np.concatenate([np.eye(2), angle * np.eye(2)], axis=1) for angle in zenith])
    normal = np.einsum("kai,kab,kbj->ij", design, weights, design)
    covariance = np.linalg.inv(normal)
    solution = covariance @ np.einsum("kai,kab,kb->i", design, weights, pixel)
    return solution[2:], np.sqrt(np.diag(covariance)[2:])

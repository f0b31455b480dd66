"""What the place of the star does to its image: off the axis every reflector has coma, however well it is aligned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.imaging.psf_combine import Psf
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.raytrace import combine_moments, facet_moments, trace
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

N_RAYS = 300
"""Per facet: what is wanted is a difference of two traces with the same rays."""
UNCERTAINTY_SHARE = 0.3
"""Of what is taken off: facets that are astray may add to coma, or take from it, and the axis may be elsewhere."""


@dataclass(frozen=True, slots=True)
class OnAxis:
    """A_sigma as it would be with the star on the axis, for which the middle of the image stands.

    Attributes
    ----------
    off_axis_rad
        Where the star was.
    """

    a_sigma_rad2: float
    uncertainty_rad2: float
    off_axis_rad: float


def on_axis(psf: Psf, camera: CameraModel, reflector: Reflector) -> OnAxis:
    """Takes off what a perfectly aligned reflector's image of a star grows by at this distance from the axis."""
    away_px = psf.centre_px + psf.drift_px / 2.0 - camera.axis_pixel
    off_axis_rad = float(np.linalg.norm(away_px)) * camera.plate_scale_rad
    if off_axis_rad == 0.0:
        return OnAxis(psf.a_sigma_rad2, psf.a_sigma_uncertainty_rad2, 0.0)
    along = np.array([away_px[0], -away_px[1]]) / np.linalg.norm(away_px)  # rows count downwards
    turn = np.column_stack([along, [-along[1], along[0]]])
    coma = turn @ (_covariance_rad2(reflector, off_axis_rad) - _covariance_rad2(reflector, 0.0)) @ turn.T
    less = psf.covariance_rad2 - coma
    if np.linalg.eigvalsh(less)[0] <= 0.0:  # the mirror is better than possible: coma cannot be what it shows
        return OnAxis(psf.a_sigma_rad2, psf.a_sigma_uncertainty_rad2, off_axis_rad)
    area_rad2 = math.pi * math.sqrt(np.linalg.det(less))
    doubt_rad2 = UNCERTAINTY_SHARE * abs(psf.a_sigma_rad2 - area_rad2)
    return OnAxis(area_rad2, math.hypot(psf.a_sigma_uncertainty_rad2, doubt_rad2), off_axis_rad)


def _covariance_rad2(reflector: Reflector, off_axis_rad: float) -> Array:
    """Of the aligned reflector's light of a star so far off along the first axis."""
    rays = trace(reflector, N_RAYS, np.array([off_axis_rad, 0.0]))
    covariance: Array = combine_moments(facet_moments(rays)).cov_m2 / reflector.focal_length_m**2
    return covariance

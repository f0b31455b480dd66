"""Spots in the focal plane whose moments and containment are known on paper, and a camera that sees them."""

from __future__ import annotations

import math

import numpy as np
from frames import exposed, gaussian_light
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import i0e

from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation

Array = NDArray[np.float64]

SHAPE = (240, 300)
EVEN = (10.0, 0.0, 0.0, 0.0)
"""Level in ADU, its rise from edge to edge along columns and rows, and what vignetting takes in the corners."""


def psf_camera(shape: tuple[int, int] = SHAPE, full_scale_adu: float = 255.0, **changes: object) -> CameraModel:
    """A linear camera of 1 mdeg per pixel."""
    values = {
        "name": "psf_camera",
        "n_columns": shape[1],
        "n_rows": shape[0],
        "plate_scale_rad": math.radians(1e-3),
        "axis_pixel": np.array([shape[1] / 2.0, shape[0] / 2.0]),
        "axis_is_calibrated": False,
        "orientation": CameraOrientation(),
        "law": RadiometricLaw(1.0, -1.0, 0.0),
        "full_scale_adu": full_scale_adu,
    }
    return CameraModel(**(values | changes))


def background(shape: tuple[int, int], level: float, right: float, down: float, vignetting: float) -> Array:
    """Sky on a screen."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    u, v = x / shape[1] - 0.5, y / shape[0] - 0.5
    return np.asarray((level + right * u + down * v) * (1.0 - 2.0 * vignetting * (u**2 + v**2)))


def elliptic(x: float, y: float, long_px: float, short_px: float, turn_rad: float, shape=SHAPE) -> Array:
    """A gaussian of unit height with these standard deviations."""
    return gaussian_light(shape, x, y, math.sqrt(long_px * short_px), long_px / short_px, turn_rad)


def frame_of(light_adu: Array, rng: np.random.Generator, sky: tuple[float, float, float, float] = EVEN, **camera):
    """What the camera gives for that light and sky."""
    return exposed(light_adu + background(light_adu.shape, *sky), rng, **({"read_noise_adu": 0.8} | camera))


def contained_in_circle(share: float, long_px: float, short_px: float) -> float:
    """Radius of the circle that holds that share of an elliptic gaussian, by quadrature.

    The density of the radius is r / (a b) exp(-r^2 (1/a^2 + 1/b^2) / 4) I0(r^2 (1/b^2 - 1/a^2) / 4) (Hoyt).
    """
    half_sum = (long_px**-2 + short_px**-2) / 4.0
    half_difference = (short_px**-2 - long_px**-2) / 4.0

    def density(r: float) -> float:
        bent = half_difference * r * r
        return r / (long_px * short_px) * math.exp(bent - half_sum * r * r) * float(i0e(bent))

    return float(brentq(lambda radius: quad(density, 0.0, radius)[0] - share, 0.0, 6.0 * long_px))

"""A camera as its calibration describes it: geometry and radiometric law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.coordinates import (
    CameraOrientation,
    angles_of_direction,
    direction_at_angles,
    direction_to_star,
    pixel_to_theta,
    rotation_to_normal,
    theta_of_direction,
    theta_to_pixel,
)

Array = NDArray[np.float64]

_N_NEWTON_STEPS = 6
"""From 10 % of distortion to the last digit."""


@dataclass(frozen=True, slots=True)
class RadiometricLaw:
    """log10(I) = r_resp * log10(C) + r_curve * log10(C)**2 + r_expo * log10(T) + r_const.

    C is the pixel response as a share of full scale in (0, 1], T the exposure in s, I a relative intensity.

    Source: arXiv:1605.06274, section 3, whose law of three parameters is that of `r_curve` = 0. A camera that bends
    away from it has its `r_curve` from its own calibration.
    """

    r_resp: float
    r_expo: float
    r_const: float
    r_curve: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Distortion:
    """How a lens departs from an angle that grows linearly with the distance in the image.

    A pixel at the offset v from `centre_pixel` stands at the angle a (1 + k1 a**2 + k2 a**4) from the lens's axis, on
    the side of v, with a the plate scale times the length of v, rad.

    Attributes
    ----------
    centre_pixel
        Shape (2,), (x, y).
    k1_per_rad2, k2_per_rad4
        A perfect lens without distortion (gnomonic: the tangent of the angle) has k1 = -1/3.
    """

    centre_pixel: Array
    k1_per_rad2: float
    k2_per_rad4: float = 0.0

    def straightened(self, pixel: Array, plate_scale_rad: float) -> Array:
        """Positions (..., 2) in the image of a lens without distortion, of `pixel` (..., 2) in the real one."""
        offset = np.asarray(pixel, dtype=np.float64) - self.centre_pixel
        angle2 = plate_scale_rad**2 * np.sum(offset**2, axis=-1, keepdims=True)
        straight: Array = self.centre_pixel + offset * (1.0 + angle2 * (self.k1_per_rad2 + angle2 * self.k2_per_rad4))
        return straight

    def distorted(self, straight_pixel: Array, plate_scale_rad: float) -> Array:
        """Positions (..., 2) in the real image; the inverse of `straightened`, by Newton's method."""
        offset = np.asarray(straight_pixel, dtype=np.float64) - self.centre_pixel
        target = plate_scale_rad * np.linalg.norm(offset, axis=-1, keepdims=True)
        angle = target.copy()
        for _ in range(_N_NEWTON_STEPS):
            bend = self.k1_per_rad2 * angle**2 + self.k2_per_rad4 * angle**4
            slope = 1.0 + 3.0 * self.k1_per_rad2 * angle**2 + 5.0 * self.k2_per_rad4 * angle**4
            angle = angle - (angle * (1.0 + bend) - target) / slope
        shrink = np.divide(angle, target, out=np.ones_like(target), where=target > 0.0)
        real: Array = self.centre_pixel + offset * shrink
        return real


@dataclass(frozen=True, slots=True, eq=False)
class DarkModel:
    """What a camera shows without light: `bias_adu` + `rate_adu_per_s` times the exposure, but for its hot pixels.

    Attributes
    ----------
    hot_pixels
        Shape (n_hot, 2), int, (x, y): pixels whose response means nothing.
    """

    bias_adu: float
    rate_adu_per_s: float
    hot_pixels: NDArray[np.int64]

    def level_adu(self, exposure_s: float) -> float:
        """Response of an ordinary pixel without light."""
        return self.bias_adu + self.rate_adu_per_s * exposure_s


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Calibration of one camera.

    Attributes
    ----------
    n_columns, n_rows
        Size of its images, pixel.
    plate_scale_rad
        Angle of one pixel at the axis.
    axis_pixel
        Shape (2,), (x, y): where the telescope's optical axis lies in the image. Of the star camera only.
    axis_is_calibrated
        False when `axis_pixel` is merely the nominal centre; corrections then aim at the facets' common centre.
    full_scale_adu
        Response of a saturated pixel.
    saturation_share
        Responses from this share of full scale upwards count as saturated.
    distortion
        None for a lens whose angle grows linearly with the distance in the image.
    dark
        None for a camera that shows nothing without light, or of which nobody knows.
    """

    name: str
    n_columns: int
    n_rows: int
    plate_scale_rad: float
    axis_pixel: Array
    axis_is_calibrated: bool
    orientation: CameraOrientation
    law: RadiometricLaw
    full_scale_adu: float = 255.0
    saturation_share: float = 0.98
    distortion: Distortion | None = None
    dark: DarkModel | None = None

    def theta_of_pixel(self, pixel: Array) -> Array:
        """Direction in the telescope frame, rad, shape (..., 2), of image positions (x, y) of shape (..., 2).

        With a known distortion the lens is round and looks at a sphere; without, angles are counted along x and y, as
        the field's star cameras are calibrated. On the axis the two are the same.
        """
        if self.distortion is None:
            return pixel_to_theta(pixel, self.axis_pixel, self.plate_scale_rad, self.orientation)
        to_telescope = rotation_to_normal(self._direction_in_lens(self.axis_pixel))
        return theta_of_direction(self._direction_in_lens(pixel) @ to_telescope)

    def pixel_of_theta(self, theta_rad: Array) -> Array:
        """Image position (x, y), shape (..., 2), of directions in the telescope frame, rad, shape (..., 2)."""
        bend = self.distortion
        if bend is None:
            return theta_to_pixel(theta_rad, self.axis_pixel, self.plate_scale_rad, self.orientation)
        to_telescope = rotation_to_normal(self._direction_in_lens(self.axis_pixel))
        angles_rad = angles_of_direction(direction_to_star(np.asarray(theta_rad)) @ to_telescope.T)
        straight = theta_to_pixel(angles_rad, bend.centre_pixel, self.plate_scale_rad, self.orientation)
        return bend.distorted(straight, self.plate_scale_rad)

    def _direction_in_lens(self, pixel: Array) -> Array:
        """Unit vectors (..., 3) from the lens, whose axis is z, with the telescope's x and y for side."""
        assert self.distortion is not None
        straight = self.distortion.straightened(pixel, self.plate_scale_rad)
        return direction_at_angles(
            pixel_to_theta(straight, self.distortion.centre_pixel, self.plate_scale_rad, self.orientation)
        )

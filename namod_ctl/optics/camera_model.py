"""A camera as its calibration describes it: geometry and radiometric law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.coordinates import CameraOrientation, pixel_to_theta, theta_to_pixel

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RadiometricLaw:
    """log10(I) = r_resp * log10(C) + r_expo * log10(T) + r_const.

    C is the pixel response as a share of full scale in (0, 1], T the exposure in s, I a relative intensity.

    Source: arXiv:1605.06274, section 3.
    """

    r_resp: float
    r_expo: float
    r_const: float


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

    def theta_of_pixel(self, pixel: Array) -> Array:
        """Direction in the telescope frame, rad, shape (..., 2), of image positions (x, y) of shape (..., 2)."""
        return pixel_to_theta(pixel, self.axis_pixel, self.plate_scale_rad, self.orientation)

    def pixel_of_theta(self, theta_rad: Array) -> Array:
        """Image position (x, y), shape (..., 2), of directions in the telescope frame, rad, shape (..., 2)."""
        return theta_to_pixel(theta_rad, self.axis_pixel, self.plate_scale_rad, self.orientation)

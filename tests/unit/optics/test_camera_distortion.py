"""Distortion of a camera against a lens whose geometry is known in closed form: the tangent of the angle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.optics.camera_model import CameraModel, Distortion, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation

FOCAL_PX = 1000.0
CENTRE = np.array([640.0, 480.0])
TANGENT = Distortion(CENTRE, -1.0 / 3.0, 1.0 / 5.0)  # atan(a) = a (1 - a^2 / 3 + a^4 / 5 - ...)
CAMERA = CameraModel(
    name="lens",
    n_columns=1280,
    n_rows=960,
    plate_scale_rad=1.0 / FOCAL_PX,
    axis_pixel=CENTRE,
    axis_is_calibrated=True,
    orientation=CameraOrientation(math.radians(30.0), is_mirrored=True),
    law=RadiometricLaw(1.0, -1.0, 0.0),
    distortion=TANGENT,
)


def test_a_lens_of_the_tangent_is_seen_as_what_it_is():
    angle_rad = np.linspace(0.0, 0.15, 7)
    pixel = CENTRE + np.stack([FOCAL_PX * np.tan(angle_rad), np.zeros(7)], axis=-1)
    theta_rad = CAMERA.theta_of_pixel(pixel)
    # the next term of the series, a^7 / 7, is what the model leaves out
    assert np.abs(np.hypot(*theta_rad.T) - angle_rad).max() < np.tan(0.15) ** 7 / 7.0


def test_the_axis_is_at_theta_zero_wherever_it_lies():
    axis = np.array([700.0, 300.0])
    camera = replace(CAMERA, axis_pixel=axis)
    assert np.abs(camera.theta_of_pixel(axis)).max() == 0.0
    assert np.allclose(camera.pixel_of_theta(np.zeros(2)), axis, atol=1e-9)


@given(
    st.floats(0.0, 1279.0),
    st.floats(0.0, 959.0),
    st.floats(-0.3, 0.5),  # up to what would fold the image onto itself
    st.floats(-0.15, 1.0),
    st.floats(0.0, 1279.0),
    st.floats(0.0, 959.0),
)
def test_pixels_come_back_from_the_sky(x, y, k1, k2, axis_x, axis_y):
    bend = Distortion(CENTRE, k1, k2)
    camera = replace(CAMERA, distortion=bend, axis_pixel=np.array([axis_x, axis_y]))
    pixel = np.array([x, y])
    assert np.allclose(camera.pixel_of_theta(camera.theta_of_pixel(pixel)), pixel, atol=1e-6)

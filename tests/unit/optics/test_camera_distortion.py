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
    """It throws the direction (tan theta_x, tan theta_y, 1) on the point f (tan theta_x, tan theta_y)."""
    theta_rad = np.stack(np.meshgrid(np.linspace(-0.15, 0.15, 7), np.linspace(-0.1, 0.1, 5)), axis=-1)
    in_image = FOCAL_PX * np.tan(theta_rad) @ CAMERA.orientation.image_to_telescope
    found_rad = CAMERA.theta_of_pixel(CENTRE + in_image)
    # the next term of the series, a^7 / 7, is what the model leaves out
    assert np.abs(found_rad - theta_rad).max() < np.tan(0.19) ** 7 / 7.0


def test_a_lens_of_the_tangent_that_looks_beside_the_axis_is_turned_on_the_sphere():
    """The angle between two directions depends on no axis: it is that between the rays of the pinhole."""
    axis = CENTRE + np.array([120.0, -90.0])
    camera = replace(CAMERA, axis_pixel=axis)
    pixel = CENTRE + np.array([[-100.0, 80.0], [60.0, 20.0], [120.0, -30.0]])
    rays = np.concatenate([(pixel - CENTRE) / FOCAL_PX, np.ones((3, 1))], axis=1)
    to_axis = np.array([*(axis - CENTRE) / FOCAL_PX, 1.0])
    cosine = rays @ to_axis / np.linalg.norm(rays, axis=1) / np.linalg.norm(to_axis)
    tangent = np.tan(camera.theta_of_pixel(pixel))
    np.testing.assert_allclose(np.arctan(np.linalg.norm(tangent, axis=1)), np.arccos(cosine), atol=0.15**7)


def test_the_axis_is_at_theta_zero_wherever_it_lies():
    axis = np.array([700.0, 300.0])
    camera = replace(CAMERA, axis_pixel=axis)
    assert np.abs(camera.theta_of_pixel(axis)).max() == 0.0
    assert np.allclose(camera.pixel_of_theta(np.zeros(2)), axis, atol=1e-9)


@given(
    st.floats(0.0, 1279.0),
    st.floats(0.0, 959.0),
    st.floats(-0.3, 0.3),  # from what would fold the image onto itself to what would see behind the camera
    st.floats(-0.15, 0.3),
    st.floats(440.0, 840.0),
    st.floats(380.0, 580.0),
)
def test_pixels_come_back_from_the_sky(x, y, k1, k2, axis_x, axis_y):
    bend = Distortion(CENTRE, k1, k2)
    camera = replace(CAMERA, distortion=bend, axis_pixel=np.array([axis_x, axis_y]))
    pixel = np.array([x, y])
    assert np.allclose(camera.pixel_of_theta(camera.theta_of_pixel(pixel)), pixel, atol=1e-6)

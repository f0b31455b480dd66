"""Frames and signs, checked against geometry worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from namod_ctl.optics.coordinates import (
    CameraOrientation,
    direction_to_star,
    pixel_to_theta,
    rotation_to_normal,
    theta_of_hit,
    theta_to_pixel,
)

SCALE_RAD = 4e-5
AXIS = np.array([100.0, 50.0])
ORIENTATIONS = st.builds(CameraOrientation, st.floats(-7.0, 7.0), st.booleans())
PIXELS = st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)).map(np.array)


def test_a_star_on_the_axis_stands_along_plus_z() -> None:
    np.testing.assert_array_equal(direction_to_star(np.zeros(2)), [0.0, 0.0, 1.0])


def test_theta_is_measured_in_each_axis_own_plane() -> None:
    """At theta = (45, 0) deg a star stands along (1, 0, 1); a second angle adds its tangent, not its sine."""
    np.testing.assert_allclose(direction_to_star(np.radians([45.0, 0.0])), np.array([1, 0, 1]) / np.sqrt(2))
    np.testing.assert_allclose(direction_to_star(np.radians([45.0, 45.0])), np.array([1, 1, 1]) / np.sqrt(3))


@pytest.mark.parametrize(
    ("orientation", "right", "down"),
    [
        (CameraOrientation(), (1, 0), (0, -1)),
        (CameraOrientation(is_mirrored=True), (-1, 0), (0, -1)),
        (CameraOrientation(rotation_rad=np.pi / 2), (0, 1), (1, 0)),
        (CameraOrientation(rotation_rad=np.pi / 2, is_mirrored=True), (0, -1), (1, 0)),
    ],
)
def test_where_columns_and_rows_run(
    orientation: CameraOrientation, right: tuple[int, int], down: tuple[int, int]
) -> None:
    """Worked out with a sheet of paper: mirror left and right first, then turn counter-clockwise."""
    for step, expected in (((1.0, 0.0), right), ((0.0, 1.0), down)):
        theta = pixel_to_theta(AXIS + step, AXIS, SCALE_RAD, orientation)
        np.testing.assert_allclose(theta, SCALE_RAD * np.array(expected), atol=1e-18)


@given(orientation=ORIENTATIONS, pixel=PIXELS)
def test_pixel_and_theta_are_inverse(orientation: CameraOrientation, pixel: np.ndarray) -> None:
    theta = pixel_to_theta(pixel, AXIS, SCALE_RAD, orientation)
    np.testing.assert_allclose(theta_to_pixel(theta, AXIS, SCALE_RAD, orientation), pixel, atol=1e-8)


def test_light_that_arrives_right_of_the_focus_wants_the_star_further_right() -> None:
    """A mirror image moves against the star: 10 mm right at f = 5 m is mended by the star moving 2 mrad to +x."""
    theta = theta_of_hit(np.array([0.010, 0.0]), 5.0, np.array([0.001, -0.003]))
    np.testing.assert_allclose(theta, [0.003, -0.003], rtol=2e-6)


@given(x=st.floats(-0.9, 0.9), y=st.floats(-0.9, 0.9))
def test_the_frame_of_a_facet_is_turned_without_twist(x: float, y: float) -> None:
    """The shortest rotation from z to n has its axis along z x n: what scipy builds from that axis and angle."""
    normal = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
    axis = np.array([-normal[1], normal[0], 0.0])
    sine = np.linalg.norm(axis)
    vector = axis / sine * np.arctan2(sine, normal[2]) if sine > 0 else axis
    np.testing.assert_allclose(rotation_to_normal(normal), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)

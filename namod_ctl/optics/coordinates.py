"""The conventions of frames and signs, defined here once; nothing else ever flips a sign.

Telescope frame: right-handed, origin at the dish vertex, +z along the optical axis to the sky; a person at
the focal point looking down at the reflector sees +x to the right and +y up.

Theta = (theta_x, theta_y): the star stands in direction (tan theta_x, tan theta_y, 1) of the telescope frame.

Facet tilt t = (t_x, t_y): the facet's normal is its aligned normal + (t_x, t_y, 0). The facet is brightest at
Theta = 2 t, so the correction that is added to the normal is Phi = -Theta / 2.

Pixels: (x, y) = (column, row), centre of the first pixel at (0, 0).

Turns of bolts are positive clockwise, as seen by the person who turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def correction_of_theta(theta_rad: Array) -> Array:
    """Phi, to be added to the facet's normal, for a facet that is brightest at `theta_rad`; (..., 2), rad."""
    return -theta_rad / 2.0


def factors_to_view(seen_from: Literal["front", "back"]) -> Array:
    """Shape (2,). Factors of telescope x and y that give right and up as a person on that side of the mirror sees."""
    return np.array([-1.0 if seen_from == "back" else 1.0, 1.0])


def sense_of_turn(turn_deg: float) -> Literal["clockwise", "counterclockwise"]:
    """The way a person turns a bolt by `turn_deg`, which is not 0."""
    return "clockwise" if turn_deg > 0 else "counterclockwise"


def theta_of_hit(hit_m: Array, focal_length_m: float, theta_rad: Array) -> Array:
    """Star direction that would throw light on the focal point, of light that now hits the focal plane at `hit_m`.

    A mirror image moves against the star: the perfect image of a star at Theta lies at -focal_length * tan(Theta).
    Light of a star at `theta_rad` that arrives at `hit_m` therefore arrives at the focal point once the star has
    moved by +arctan(hit / focal_length). So a facet of tilt t, whose light of an on-axis star arrives at
    +2 t * focal_length, is brightest at Theta = 2 t. To first order in the move of the star.

    Parameters
    ----------
    hit_m
        Shape (..., 2). Position in the focal plane, telescope x and y.
    theta_rad
        Shape (2,). Direction of the star whose light it is.

    Returns
    -------
    Shape (..., 2), rad, on the same axes as the response maps.
    """
    theta: Array = np.asarray(theta_rad) + np.arctan(np.asarray(hit_m) / focal_length_m)
    return theta


def rotation_to_normal(normal: Array) -> Array:
    """Matrix of shape (3, 3) that turns +z onto the unit vector `normal` (3,) the shortest way, without twist.

    Its columns are the x, y and z axes of a facet in the telescope frame. `normal` must not be -z.
    """
    x, y, z = normal
    share = 1.0 / (1.0 + z)
    return np.array(
        [
            [1.0 - x * x * share, -x * y * share, x],
            [-x * y * share, 1.0 - y * y * share, y],
            [-x, -y, z],
        ]
    )


def direction_to_star(theta_rad: Array) -> Array:
    """Unit vectors of shape (..., 3) that point at a star of direction `theta_rad` (..., 2), telescope frame."""
    vector = np.concatenate([np.tan(theta_rad), np.ones((*theta_rad.shape[:-1], 1))], axis=-1)
    unit: Array = vector / np.linalg.norm(vector, axis=-1, keepdims=True)
    return unit


def theta_of_direction(direction: Array) -> Array:
    """Theta (..., 2), rad, of vectors (..., 3) of any length in the telescope frame: the inverse of the above."""
    theta: Array = np.arctan2(direction[..., :2], direction[..., 2:])
    return theta


def direction_at_angles(angles_rad: Array) -> Array:
    """Unit vectors (..., 3) that stand at the angle |angles| from +z, on the side of `angles_rad` (..., 2).

    So a round lens sees: the angle from its axis, and the side of the axis. Theta counts along x and y apart.
    """
    angle = np.linalg.norm(angles_rad, axis=-1, keepdims=True)
    return np.concatenate([np.sinc(angle / np.pi) * angles_rad, np.cos(angle)], axis=-1)


def angles_of_direction(direction: Array) -> Array:
    """Angles (..., 2), rad, of vectors (..., 3) of any length: the inverse of `direction_at_angles`."""
    sideways = np.hypot(direction[..., 0], direction[..., 1])
    angle = np.arctan2(sideways, direction[..., 2])
    stretch = np.divide(angle, sideways, out=np.ones_like(angle), where=sideways > 0.0)
    angles: Array = direction[..., :2] * stretch[..., None]
    return angles


@dataclass(frozen=True, slots=True)
class CameraOrientation:
    """How a camera's pixel axes lie in the telescope frame.

    An image that is "upright" has telescope +x along its columns (to the right) and +y against its rows (up).
    `is_mirrored` swaps left and right of that first; then the frame is turned by `rotation_rad`,
    counter-clockwise as seen in the telescope frame (from the focal point down at the reflector).
    """

    rotation_rad: float = 0.0
    is_mirrored: bool = False

    @property
    def image_to_telescope(self) -> Array:
        """Matrix of shape (2, 2) that turns offsets (column, row) into offsets along telescope (x, y)."""
        upright = np.array([[-1.0 if self.is_mirrored else 1.0, 0.0], [0.0, -1.0]])
        cosine, sine = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        matrix: Array = np.array([[cosine, -sine], [sine, cosine]]) @ upright
        return matrix


def pixel_to_theta(pixel: Array, axis_pixel: Array, plate_scale_rad: float, orientation: CameraOrientation) -> Array:
    """Theta in rad, shape (..., 2), of image positions `pixel` (x, y) of shape (..., 2).

    `axis_pixel` is where the telescope's axis lies in the image, `plate_scale_rad` the angle of one pixel
    at the axis. The scale is linear in the angle, as the field's star cameras are calibrated
    (arXiv:1605.06274, section 3: 2.437 mdeg per pixel).
    """
    offset = np.asarray(pixel, dtype=np.float64) - axis_pixel
    theta: Array = plate_scale_rad * offset @ orientation.image_to_telescope.T
    return theta


def theta_to_pixel(
    theta_rad: Array, axis_pixel: Array, plate_scale_rad: float, orientation: CameraOrientation
) -> Array:
    """Image position (x, y) of shape (..., 2) of star directions `theta_rad`: the inverse of `pixel_to_theta`."""
    pixel: Array = np.asarray(theta_rad) / plate_scale_rad @ orientation.image_to_telescope + axis_pixel
    return pixel

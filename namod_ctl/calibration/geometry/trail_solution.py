"""The fit of a trail: the camera's three angles, its plate scale and one term of distortion, to the path of a star."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from namod_ctl.calibration.geometry.serial_noise import variance_factor
from namod_ctl.calibration.sky.star_path import EARTH_RATE_RAD_PER_S, StarPath
from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.optics.coordinates import CameraOrientation, direction_to_star, theta_of_direction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 8
TIME_OF_DAY_UNCERTAINTY_S = 1.0
"""Computers' clocks, and up to 0.9 s between UTC and the Earth's true turn."""
K1_SIGMA, KNOWN_K1_SIGMA = 3.0, 0.3
"""1/rad^2: what is taken for possible before the trail is looked at; 3 is 1 % at the edge of FACT's star camera."""
CLIP_SIGMAS = 5.0
MIN_KEPT_SHARE = 0.6
LOG_SCALE, TURN, K1, DECLINATION = 0, slice(1, 4), 4, 5
NORMAL_PER_MAD = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class Trail:
    """A star in a series of frames, in the order of time.

    Attributes
    ----------
    time_s
        Shape (n,). Middle of every exposure.
    pixel, uncertainty_px
        Shapes (n, 2) and (n,). Centre (x, y) and one standard deviation of each axis.
    """

    time_s: Array
    pixel: Array
    uncertainty_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A fit: `turn` times the exponential of the parameters' turn takes the ground's directions to the telescope's."""

    camera: CameraModel
    start: Rotation
    parameters: Array
    covariance: Array
    residual_px: Array
    sigma_px: Array
    is_used: Mask
    noise_factor: float

    def chi2_of(self, residual_px: Array) -> float:
        """chi^2 of residuals (n, 2), of this fit or of another, by this fit's noise."""
        return float(np.sum((residual_px / self.sigma_px)[self.is_used] ** 2)) / self.noise_factor

    @property
    def turn(self) -> Rotation:
        return Rotation.from_rotvec(self.parameters[TURN]) * self.start

    @property
    def fitted(self) -> CameraModel:
        return _camera_of(self.camera, self.parameters)


def _camera_of(camera: CameraModel, parameters: Array) -> CameraModel:
    known = camera.distortion
    centre = np.array([camera.n_columns - 1, camera.n_rows - 1]) / 2.0 if known is None else known.centre_pixel
    return replace(
        camera,
        plate_scale_rad=camera.plate_scale_rad * math.exp(parameters[LOG_SCALE]),
        distortion=Distortion(centre, float(parameters[K1]), 0.0 if known is None else known.k2_per_rad4),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fitting:
    """A trail, a path and a first guess, which parameters are relative to."""

    trail: Trail
    path: StarPath
    camera: CameraModel
    start: Rotation

    def expected(self, parameters: Array) -> Array:
        """Theta (n, 2) of the star by these parameters."""
        path = self.path
        direction = path.direction
        if len(parameters) > DECLINATION:
            direction = path.moved_towards_pole(float(parameters[DECLINATION]))
        return theta_of_direction((Rotation.from_rotvec(parameters[TURN]) * self.start).apply(direction))

    def axes(self, parameters: Array) -> Array:
        """Unit vectors along the motion and across it, shape (n, 2, 2): [frame, which, telescope axis]."""
        along = np.gradient(self.expected(parameters), self.trail.time_s, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], axis=1)

    def residuals(self, parameters: Array, axes: Array) -> Array:
        """Shape (n, 2), pixel: what is left along the motion and across it."""
        model = _camera_of(self.camera, parameters)
        miss = (model.theta_of_pixel(self.trail.pixel) - self.expected(parameters)) / model.plate_scale_rad
        left: Array = np.einsum("nka,na->nk", axes, miss)
        return left


def solve_trail(trail: Trail, path: StarPath, camera: CameraModel, *, has_free_declination: bool = False) -> Solution:
    """The best fit; frames that disagree with all others are left out, and the noise is as large as they show it.

    Raises
    ------
    DataQualityError
        Too few positions lie on one path.
    """
    known = camera.distortion
    k1, k1_sigma = (0.0, K1_SIGMA) if known is None else (known.k1_per_rad2, KNOWN_K1_SIGMA)
    parameters = np.zeros(6 if has_free_declination else 5)
    parameters[K1] = k1
    pointed = direction_to_star(_camera_of(camera, parameters).theta_of_pixel(trail.pixel))
    fitting = _Fitting(trail, path, camera, Rotation.align_vectors(pointed, path.direction)[0])
    is_used = np.ones(len(trail.time_s), dtype=bool)
    sigma_px = np.repeat(trail.uncertainty_px[:, None], 2, axis=1)
    typical_px = float(np.median(trail.uncertainty_px))
    axes = fitting.axes(parameters)

    def pulls(values: Array) -> Array:
        own = (fitting.residuals(values, axes) / sigma_px)[is_used]
        return np.append(own.ravel(), (values[K1] - k1) / k1_sigma)

    for loss in ("soft_l1", "linear"):
        parameters = least_squares(pulls, parameters, x_scale="jac", loss=loss).x
        axes = fitting.axes(parameters)
        residual_px = fitting.residuals(parameters, axes)
        scatter_px = NORMAL_PER_MAD * np.median(np.abs(residual_px[is_used]), axis=0)
        extra2 = np.maximum(scatter_px**2 - typical_px**2, 0.0)
        sigma_px = np.sqrt(trail.uncertainty_px[:, None] ** 2 + extra2)
        is_used = np.all(np.abs(residual_px) < CLIP_SIGMAS * sigma_px, axis=1)
        if np.count_nonzero(is_used) < max(MIN_POINTS, MIN_KEPT_SHARE * len(is_used)):
            raise DataQualityError(
                f"only {np.count_nonzero(is_used)} of {len(is_used)} positions of the star lie on one path: the drive "
                "moves, times are wrong, or there are several stars; stop the drive and record a lone bright star"
            )
    found = least_squares(pulls, parameters, x_scale="jac")
    parameters, jacobian = found.x, found.jac
    residual_px = fitting.residuals(parameters, axes)
    n_free = max(2 * int(np.count_nonzero(is_used)) - len(parameters), 1)
    factor = max(2.0 * float(found.cost) / n_free, 1.0)
    factor *= variance_factor(residual_px[is_used] / sigma_px[is_used])
    covariance = np.linalg.inv(jacobian.T @ jacobian) * factor
    return Solution(camera, fitting.start, parameters, covariance, residual_px, sigma_px, is_used, factor)


def turned_camera(solution: Solution) -> CameraModel:
    """The solution's camera with the rotation that it has in the telescope's frame."""
    orientation = solution.camera.orientation
    rotation_rad = orientation.rotation_rad - _roll_rad(solution.turn)
    wrapped = math.remainder(rotation_rad, math.tau)
    return replace(solution.camera, orientation=CameraOrientation(wrapped, orientation.is_mirrored))


def _roll_rad(turn: Rotation) -> float:
    """How far the frame that `turn` leads to is turned about its z against one whose y points to larger altitude."""
    matrix = turn.as_matrix()
    axis, up = matrix[2], np.array([0.0, 0.0, 1.0])
    y = up - axis * axis[2]
    y /= np.linalg.norm(y)
    x = np.cross(y, axis)
    return math.atan2(float(matrix[1] @ x), float(matrix[0] @ x))


def roll_uncertainty_rad(solution: Solution, path: StarPath) -> float:
    """Of the fit, and of a time of day that is wrong by a second."""
    step = 1e-6
    roll = _roll_rad(solution.turn)
    gradient = np.zeros(len(solution.parameters))
    for axis in range(TURN.start, TURN.stop):
        moved = solution.parameters.copy()
        moved[axis] += step
        turn = Rotation.from_rotvec(moved[TURN]) * solution.start
        gradient[axis] = math.remainder(_roll_rad(turn) - roll, math.tau) / step
    late = Rotation.from_rotvec(path.pole * EARTH_RATE_RAD_PER_S * TIME_OF_DAY_UNCERTAINTY_S)
    by_time = math.remainder(_roll_rad(solution.turn * late) - roll, math.tau)
    return math.hypot(math.sqrt(float(gradient @ solution.covariance @ gradient)), by_time)

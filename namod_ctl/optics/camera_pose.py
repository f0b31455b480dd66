"""Where the reflector camera stands and looks, from a few facets whose places in its image are known.

The camera is a pinhole with one term of radial distortion. Its pose is the most probable one given the marks (of
`MARK_SIGMA_PX`) and what every instrument of this kind has in common: the camera sits near the focal point, and its
focal length is roughly the config's plate scale. So 4 marks suffice, and distance and lens of a flat dish stay apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.coordinates import CameraOrientation, rotation_to_normal, theta_to_pixel
from namod_ctl.optics.layouts import facet_outline_m
from namod_ctl.optics.polygons import clip_to_image
from namod_ctl.optics.reflector import Facet, Reflector

Array = NDArray[np.float64]

MARK_SIGMA_PX = 1.0
"""How well a person marks a corner or a centre, per axis."""
PLACE_SIGMA_SHARE = 0.05
"""Of the focal length: the camera sits in front of the focal plane, or beside another camera."""
FOCAL_SIGMA = 0.2
"""Of the natural logarithm of the focal length: lenses are exchanged and configs keep the nominal one."""
DISTORTION_SIGMA = 0.3
"""Of the radial term. FACT's reflector camera has about -0.4: 20 deg off its axis things appear 5 % too near to it."""
MIN_FACETS_FOR_DISTORTION = 6
"""With 6 marks there are 12 numbers for 8; on FACT's real picture a pose without distortion is 10 px wrong."""
MAX_STEPS = 60
"""Right marks are fitted in less than 10; wrong ones wander."""
NOMINAL_AXES = np.diag([1.0, -1.0, -1.0])
"""Right, down and forward of an upright camera in the focal point that looks down, in the telescope frame."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """A camera that sees the reflector.

    Attributes
    ----------
    axes
        Shape (3, 3). Its right, down and forward directions (rows), telescope frame, of the image before mirroring.
    place_m
        Shape (3,). Its pinhole, telescope frame.
    focal_px
        Focal length, pixel.
    distortion
        A ray at tangent r from the camera's axis appears at r (1 + distortion r^2).
    principal_px
        Shape (2,). Where the camera's axis lies in the image.
    """

    axes: Array
    place_m: Array
    focal_px: float
    distortion: float
    principal_px: Array
    is_mirrored: bool

    @property
    def rotation_rad(self) -> float:
        """How far the image is turned in the telescope frame, as `CameraOrientation.rotation_rad`."""
        return math.atan2(float(self.axes[0, 1]), float(self.axes[0, 0]))

    def project(self, points_m: Array) -> Array:
        """Pixel (x, y), shape (..., 2), of points (..., 3) of the telescope frame; NaN behind the camera."""
        right, down, forward = np.moveaxis((points_m - self.place_m) @ self.axes.T, -1, 0)
        forward = np.where(forward > 0.0, forward, np.nan)
        upright = np.stack([right / forward, -down / forward], axis=-1)
        upright *= 1.0 + self.distortion * np.sum(upright**2, axis=-1, keepdims=True)
        return theta_to_pixel(upright, self.principal_px, 1.0 / self.focal_px, CameraOrientation(0.0, self.is_mirrored))


def nominal_pose(reflector: Reflector, camera: CameraModel) -> CameraPose:
    """The pose that the config describes: in the focal point, looking at the dish vertex."""
    cosine, sine = math.cos(camera.orientation.rotation_rad), math.sin(camera.orientation.rotation_rad)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    place_m = np.array([0.0, 0.0, reflector.focal_length_m])
    return CameraPose(
        axes=NOMINAL_AXES @ turn.T,
        place_m=place_m,
        focal_px=1.0 / camera.plate_scale_rad,
        distortion=0.0,
        principal_px=camera.axis_pixel,
        is_mirrored=camera.orientation.is_mirrored,
    )


def facet_corners_m(reflector: Reflector) -> dict[int, Array]:
    """Corners of every facet's outline by id, shape (n_corners, 3), telescope frame.

    The outline stands in the facet's own x and y as `raytrace.sample_surface` fills it.
    """
    return {
        facet.id: facet.position_m + _flat(facet) @ rotation_to_normal(normal).T
        for facet, normal in zip(reflector.facets, reflector.aligned_normals(), strict=True)
    }


def _flat(facet: Facet) -> Array:
    outline_m = facet_outline_m(replace(facet, position_m=np.zeros(3)), np.array([0.0, 0.0, 1.0]))
    return np.column_stack([outline_m, np.zeros(len(outline_m))])


def project_facets(pose: CameraPose, reflector: Reflector) -> dict[int, Array]:
    """Outline of every facet by id, shape (n_corners, 2), (x, y) pixel; may reach out of the image."""
    return {facet_id: pose.project(corners_m) for facet_id, corners_m in facet_corners_m(reflector).items()}


def outlines_in_image(outlines_px: Mapping[int, Array], n_columns: int, n_rows: int) -> dict[int, Array]:
    """The parts of the outlines that lie in the image; a facet that is not in it at all is left out."""
    clipped = {i: clip_to_image(outline, n_columns, n_rows) for i, outline in outlines_px.items()}
    return {i: outline for i, outline in clipped.items() if len(outline) >= 3}


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Points of the reflector and where they are in the image.

    Attributes
    ----------
    facet_ids
        Of each point.
    points_m
        Shape (n, 3), telescope frame.
    pixels
        Shape (n, 2).
    """

    facet_ids: tuple[int, ...]
    points_m: Array
    pixels: Array


class PoseFamily:
    """Camera poses about a start, by the 7 or 8 numbers that a fit varies; at all zeros the start.

    The numbers: turns about the camera's three axes (rad), moves along x, y, z (in focal lengths of the telescope), the
    logarithm of the change of the camera's focal length, and its distortion.
    """

    def __init__(self, start: CameraPose, reflector: Reflector, camera: CameraModel, has_distortion: bool) -> None:
        self._start = start
        self._length_m = reflector.focal_length_m
        self._nominal = nominal_pose(reflector, camera)
        self._has_distortion = has_distortion
        self.n_numbers = 8 if has_distortion else 7

    def pose(self, numbers: Array) -> CameraPose:
        """The pose of these numbers, shape (n_numbers,)."""
        turn = cv2.Rodrigues(np.asarray(numbers[:3], dtype=np.float64))[0]
        return replace(
            self._start,
            axes=turn @ self._start.axes,
            place_m=self._start.place_m + self._length_m * numbers[3:6],
            focal_px=self._start.focal_px * math.exp(float(numbers[6])),
            distortion=self._start.distortion + (float(numbers[7]) if self._has_distortion else 0.0),
        )

    def prior(self, pose: CameraPose) -> Array:
        """How far the pose is from what is expected, in standard deviations, shape (5,)."""
        away = (pose.place_m - self._nominal.place_m) / self._length_m / PLACE_SIGMA_SHARE
        focal = math.log(pose.focal_px / self._nominal.focal_px) / FOCAL_SIGMA
        return np.array([*away, focal, pose.distortion / DISTORTION_SIGMA])


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose fitted to points.

    Attributes
    ----------
    residual_px
        Shape (n, 2). Where the points are, minus where the pose puts them.
    cov
        Shape (n_numbers, n_numbers). Covariance of the family's numbers.
    cost
        Half the sum of squares, in standard deviations, marks and expectations together.
    """

    pose: CameraPose
    family: PoseFamily
    residual_px: Array
    cov: Array
    cost: float

    def uncertainty_px(self, points_m: Array) -> Array:
        """Expected error (one standard deviation, both axes together), shape (...), of projected points (..., 3)."""
        step = 1e-6
        zeros = np.zeros(self.family.n_numbers)
        here = self.family.pose(zeros).project(points_m)
        slopes = []
        for k in range(len(zeros)):
            numbers = zeros.copy()
            numbers[k] = step
            slopes.append((self.family.pose(numbers).project(points_m) - here) / step)
        slope = np.stack(slopes, axis=-1)
        variance: Array = np.einsum("...ak,kl,...al->...", slope, self.cov, slope)
        return np.sqrt(np.maximum(variance, 0.0))


def fit_pose(
    pairs: PointPairs,
    starts: Sequence[CameraPose],
    reflector: Reflector,
    camera: CameraModel,
    sigma_px: float = MARK_SIGMA_PX,
    robust: bool = False,
    max_steps: int = MAX_STEPS,
) -> PoseFit:
    """The most probable pose for at least 4 points that are not on one line.

    Distortion is fitted where points of `MIN_FACETS_FOR_DISTORTION` facets are given. `robust` lets points that do not
    fit pull no harder than those 2 standard deviations away.
    """
    has_distortion = len(set(pairs.facet_ids)) >= MIN_FACETS_FOR_DISTORTION
    best: PoseFit | None = None
    for start in starts:
        fit = _fit_from(pairs, start, reflector, camera, has_distortion, sigma_px, robust, max_steps)
        if best is None or fit.cost < best.cost:
            best = fit
    if best is None:
        raise ValueError("a fit needs a start")
    return best


def _fit_from(
    pairs: PointPairs,
    start: CameraPose,
    reflector: Reflector,
    camera: CameraModel,
    has_distortion: bool,
    sigma_px: float,
    robust: bool,
    max_steps: int,
) -> PoseFit:
    family = PoseFamily(start, reflector, camera, has_distortion)
    behind = 10.0 * (camera.n_columns + camera.n_rows)  # as far off as makes any step that goes there a bad one

    def misfit(numbers: Array) -> Array:
        pose = family.pose(numbers)
        off = np.nan_to_num(pairs.pixels - pose.project(pairs.points_m), nan=behind) / sigma_px
        return np.concatenate([off.ravel(), family.prior(pose)])

    solved = least_squares(
        misfit,
        np.zeros(family.n_numbers),
        loss="soft_l1" if robust else "linear",
        f_scale=2.0,
        x_scale="jac",
        max_nfev=max_steps,
    )
    pose = family.pose(solved.x)
    final = PoseFamily(pose, reflector, camera, has_distortion)
    cov = np.linalg.pinv(solved.jac.T @ solved.jac)
    return PoseFit(pose, final, pairs.pixels - pose.project(pairs.points_m), cov, float(solved.cost))


def starting_poses(
    pairs: PointPairs, reflector: Reflector, camera: CameraModel, is_mirrored: bool
) -> tuple[CameraPose, ...]:
    """Poses to start a fit from: the closed solution of OpenCV, and the focal point with the marks' turn and scale."""
    nominal = replace(nominal_pose(reflector, camera), is_mirrored=is_mirrored)
    to_upright = CameraOrientation(0.0, is_mirrored).image_to_telescope
    upright = (pairs.pixels - nominal.principal_px) @ to_upright.T
    # Turn and scale as a complex factor: the images of all points as multiples of their telescope x + iy.
    across, seen = (xy - xy.mean(axis=0) for xy in (pairs.points_m[:, :2], upright))
    factor = np.vdot(_complex(across), _complex(seen)) / np.vdot(_complex(across), _complex(across)).real
    turn_rad = -float(np.angle(factor))
    depth_m = reflector.focal_length_m - float(pairs.points_m[:, 2].mean())
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    simple = replace(nominal, axes=NOMINAL_AXES @ turn.T)
    scale = float(np.clip(abs(factor) * depth_m / nominal.focal_px, 0.3, 3.0))
    simple = replace(simple, focal_px=scale * nominal.focal_px)
    matrix = np.array([[simple.focal_px, 0.0, 0.0], [0.0, simple.focal_px, 0.0], [0.0, 0.0, 1.0]])
    try:
        is_solved, turn_vector, shift_m = cv2.solvePnP(
            pairs.points_m, upright * (1.0, -1.0), matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # points it cannot use: on one line, or in one place
        return (simple,)
    if not is_solved or not np.isfinite(turn_vector).all() or not np.isfinite(shift_m).all():
        return (simple,)
    axes = np.asarray(cv2.Rodrigues(turn_vector)[0], dtype=np.float64)
    return replace(simple, axes=axes, place_m=-axes.T @ shift_m.ravel()), simple


def _complex(points: Array) -> NDArray[np.complex128]:
    return np.asarray(points[:, 0] + 1j * points[:, 1], dtype=np.complex128)

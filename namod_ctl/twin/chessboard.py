"""Pictures of a chessboard as a camera sees it: every pixel's rays are followed to the board."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.twin.randomness import generator

Array = NDArray[np.float64]
Rays = Callable[[Array], Array]
"""From pixels (n, 2) to tangents (n, 2) of the angles from the camera's axis: to the right and down in the image."""

RAYS_PER_SIDE, COARSE_PX = 3, 8
DARK, BRIGHT, ROOM = 0.08, 0.75, 0.35
"""Brightness of the squares and of what is behind the board, shares of full scale."""
MARGIN_SQUARES = 1.0
"""White rim around the squares."""


@dataclass(frozen=True, slots=True)
class Board:
    """So many inner corners (columns, rows), and the side of a square."""

    corners: tuple[int, int]
    square_m: float


@dataclass(frozen=True, slots=True)
class BoardPose:
    """How a board stands before the camera.

    Attributes
    ----------
    middle_m
        Of the board: to the right, down and ahead of the camera.
    tilt_rad
        About the image's x and y axes, and turned in its own plane.
    """

    middle_m: tuple[float, float, float]
    tilt_rad: tuple[float, float, float]


def lens_of(camera: CameraModel) -> Rays:
    """The rays of a round lens with the camera's plate scale and distortion: the radius alone says the ray's angle.

    The house's Theta bends along the telescope's axes instead, which is the same within 0.6 pixel in FACT's star camera
    but not in a wide one: no real lens knows of the telescope's axes.
    """
    bend = camera.distortion
    centre = camera.axis_pixel if bend is None else bend.centre_pixel
    k1, k2 = (0.0, 0.0) if bend is None else (bend.k1_per_rad2, bend.k2_per_rad4)

    def rays(pixel: Array) -> Array:
        offset = pixel - centre
        radius = camera.plate_scale_rad * np.hypot(offset[:, 0], offset[:, 1])
        angle = radius * (1.0 + k1 * radius**2 + k2 * radius**4)
        per_pixel = np.divide(np.tan(angle), radius, out=np.ones_like(radius), where=radius > 0.0)
        tangents: Array = offset * (camera.plate_scale_rad * per_pixel)[:, None]
        return tangents

    return rays


def wrong_by(camera: CameraModel, seed: int) -> CameraModel:
    """The camera as it truly is, a little different from what its config says."""
    rng = generator(seed, "true lens of a camera")
    middle = np.array([camera.n_columns - 1, camera.n_rows - 1]) / 2.0
    # up to 1 % of distortion in the corners, either way
    corner_rad = camera.plate_scale_rad * float(np.linalg.norm(middle))
    k1 = float(rng.uniform(-0.01, 0.01)) / corner_rad**2
    return replace(
        camera,
        plate_scale_rad=camera.plate_scale_rad * (1.0 + float(rng.normal(0.0, 0.005))),
        distortion=Distortion(middle + rng.normal(0.0, 0.003 * camera.n_columns, 2), k1),
    )


def draw_poses(board: Board, camera: CameraModel, n_views: int, seed: int) -> list[BoardPose]:
    """Poses such as a careful person takes: tilted to all sides, near and far, all over the image."""
    rng = generator(seed, "poses of a chessboard")
    field_rad = camera.plate_scale_rad * np.array([camera.n_columns, camera.n_rows])
    size_m = board.square_m * (np.array(board.corners) + 1.0)
    poses = []
    for number in range(n_views):
        share = rng.uniform(0.45, 0.7)
        distance_m = float(np.max(size_m / (2.0 * np.tan(share * field_rad / 2.0))))
        angle = math.tau * number / n_views
        tilt = rng.uniform(0.45, 0.8)
        free = (1.0 - share) / 2.0 * field_rad
        side = np.array([number % 3 - 1, number // 3 % 3 - 1])  # nine places all over the image
        x, y = np.tan((side + rng.uniform(-0.2, 0.2, 2)) / 1.2 * free) * distance_m
        turn = (tilt * math.sin(angle), tilt * math.cos(angle), float(rng.uniform(-0.3, 0.3)))
        poses.append(BoardPose((float(x), float(y), distance_m), turn))
    return poses


def render_board(
    board: Board,
    pose: BoardPose,
    rays: Rays,
    size: tuple[int, int],
    rng: np.random.Generator,
    blur_px: float = 0.6,
    noise_adu: float = 1.5,
) -> NDArray[np.uint8]:
    """The picture of a board, 8 bit, (rows, columns).

    `size` is (columns, rows), `blur_px` the standard deviation of the lens' blur.
    """
    columns, rows = size
    light = np.full((rows, columns), ROOM)
    shares = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE - 0.5
    left, right, top, bottom = _reach(board, pose, rays, size)
    x = np.arange(left, right, dtype=np.float64)
    for row in range(top, bottom):
        pixel = np.stack(np.broadcast_arrays(x[:, None, None] + shares[:, None], row + shares), axis=-1)
        seen = _brightness(board, pose, rays(pixel.reshape(-1, 2)))
        light[row, left:right] = seen.reshape(len(x), -1).mean(axis=1)
    if blur_px > 0.0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), blur_px), dtype=np.float64)
    adu = 255.0 * light + noise_adu * rng.standard_normal(light.shape)
    return np.clip(np.rint(adu), 0, 255).astype(np.uint8)


def _reach(board: Board, pose: BoardPose, rays: Rays, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Columns and rows (first, behind the last; both) that may show the board, from a coarse look."""
    x, y = np.meshgrid(*(np.arange(0, n + COARSE_PX, COARSE_PX, dtype=np.float64) for n in size))
    seen = _brightness(board, pose, rays(np.column_stack([x.ravel(), y.ravel()])))
    on_board = np.flatnonzero(seen != ROOM)
    if on_board.size == 0:
        return 0, size[0], 0, size[1]
    reach = []
    for places, n in ((x.ravel()[on_board], size[0]), (y.ravel()[on_board], size[1])):
        reach += [max(int(places.min()) - COARSE_PX, 0), min(int(places.max()) + COARSE_PX, n)]
    return reach[0], reach[1], reach[2], reach[3]


def _brightness(board: Board, pose: BoardPose, tangent: Array) -> Array:
    """Brightness (n,) where rays (n, 2) end."""
    about_x, about_y, about_z = pose.tilt_rad
    across, along = (
        _turned((1.0, 0.0, 0.0), about_x, about_y, about_z),
        _turned((0.0, 1.0, 0.0), about_x, about_y, about_z),
    )
    normal = np.cross(across, along)
    middle = np.array(pose.middle_m)
    ray = np.column_stack([tangent, np.ones(len(tangent))])
    facing = ray @ normal
    reach = (normal @ middle) / np.where(np.abs(facing) > 1e-9, facing, np.nan)
    hit = ray * reach[:, None] - middle
    u, v = hit @ across / board.square_m, hit @ along / board.square_m
    half_u, half_v = (board.corners[0] + 1) / 2.0, (board.corners[1] + 1) / 2.0
    on_squares = (np.abs(u) < half_u) & (np.abs(v) < half_v)
    on_board = (np.abs(u) < half_u + MARGIN_SQUARES) & (np.abs(v) < half_v + MARGIN_SQUARES) & (reach > 0.0)
    with np.errstate(invalid="ignore"):
        is_dark = (np.floor(np.nan_to_num(u + half_u)) + np.floor(np.nan_to_num(v + half_v))) % 2 == 0
    brightness: Array = np.where(on_board, np.where(on_squares & is_dark, DARK, BRIGHT), ROOM)
    return brightness


def _turned(vector: tuple[float, float, float], about_x: float, about_y: float, about_z: float) -> Array:
    """The vector turned about z, then y, then x."""
    x, y, z = vector
    x, y = x * math.cos(about_z) - y * math.sin(about_z), x * math.sin(about_z) + y * math.cos(about_z)
    x, z = x * math.cos(about_y) + z * math.sin(about_y), -x * math.sin(about_y) + z * math.cos(about_y)
    y, z = y * math.cos(about_x) - z * math.sin(about_x), y * math.sin(about_x) + z * math.cos(about_x)
    return np.array([x, y, z])

"""Plate scale and distortion of a camera from pictures of a chessboard in many poses, by OpenCV's calibration.

OpenCV takes a lens for a pinhole: tangents of angles, bent by a radial polynomial. The program's cameras are linear in
the angle. The plate scale at the centre is one over OpenCV's focal length in pixel, exactly; the two coefficients of
distortion are those that bring the directions of the whole image closest to OpenCV's, and what they leave is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.imaging.radiometry import Frame
from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.optics.coordinates import angles_of_direction

Array = NDArray[np.float64]

MIN_VIEWS = 6
SAME_VIEW_SHARE = 0.01
"""Of the image's width: two views whose corners lie closer than that on average count as one."""
MIN_TILT_SPREAD_RAD = deg_to_rad(15.0)
"""Between the boards' normals: boards that all face the camera do not tell the focal length from the distance."""
MAX_RISE_OF_SQUARE = 0.4
"""Width of the squares' edges (10 % to 90 %) as a share of a square: wider ones are out of focus."""
MAX_RESIDUAL_PX = 2.0
MAX_RELATIVE_UNCERTAINTY = 0.02
MAX_CENTRE_UNCERTAINTY_SHARE = 0.05
"""Of the image's width: a centre of distortion that is known worse is taken to be the image's centre."""
GRID = 41
FOCAL_X, FOCAL_Y, CENTRE_X, CENTRE_Y = range(4)
_FLAGS = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_UNBEND = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
_SEARCH = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A chessboard in one frame.

    Attributes
    ----------
    corners_px
        Shape (n_corners, 2). Inner corners (x, y), row by row.
    rise_of_square
        Width of the edges of its squares as a share of a square.
    """

    corners_px: Array
    rise_of_square: float


@dataclass(frozen=True, slots=True, eq=False)
class ChessboardFit:
    """The camera as chessboards show it.

    Attributes
    ----------
    camera
        With the plate scale and the distortion.
    focal_px
        OpenCV's focal length.
    k1_uncertainty_per_rad2
        One standard deviation, from leaving out every view in turn.
    residual_rms_px
        Between corners and their places by the fit.
    corner_residual_px
        Shape (n_views, n_corners, 2).
    conversion_rms_px
        What the program's two coefficients leave of OpenCV's lens, over the whole image.
    tilt_rad, distance_m
        Shapes (n_views,). Of the boards against the image plane; and how far they are.
    is_centre_fitted
        False when the centre of distortion was taken to be the image's.
    covered_share
        Of the image's area that lies within reach of the corners.
    views
        The views that count.
    """

    camera: CameraModel
    plate_scale_uncertainty_rad: float
    focal_px: float
    k1_uncertainty_per_rad2: float
    residual_rms_px: float
    corner_residual_px: Array
    conversion_rms_px: float
    tilt_rad: Array
    distance_m: Array
    is_centre_fitted: bool
    covered_share: float
    views: tuple[BoardView, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """OpenCV's result: matrix (3, 3), coefficients (5,), and what it says of itself."""

    matrix: Array
    coefficients: Array
    uncertainty: Array
    turns: list[Array]
    shifts: list[Array]
    rms_px: float


def find_board(frame: Frame, corners: tuple[int, int]) -> BoardView | None:
    """The chessboard with so many inner corners (columns, rows) in a frame; None when none is found."""
    grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if grey.dtype != np.uint8:
        grey = cv2.normalize(grey, np.empty_like(grey), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    is_found, found = cv2.findChessboardCornersSB(grey, corners, flags=_SEARCH)
    if not is_found:
        return None
    # The mean width of the edges, pixel; OpenCV looks at those along the board's rows.
    mean: Any = cv2.estimateChessboardSharpness(grey, corners, found)[0]
    corners_px = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    grid = corners_px.reshape(corners[1], corners[0], 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).mean() for axis in (0, 1)]
    return BoardView(corners_px, float(mean[0]) / float(min(sides)))


def calibrate_with_boards(
    views: Sequence[BoardView], corners: tuple[int, int], square_m: float, camera: CameraModel
) -> ChessboardFit:
    """Plate scale and distortion of `camera` from views of one board with squares of `square_m`.

    Raises
    ------
    DataQualityError
        Too few sharp and different views, boards that all stand alike, or a fit that does not hold.
    """
    kept = _sharp_and_different(views, camera)
    board = np.zeros((corners[0] * corners[1], 3), dtype=np.float32)
    board[:, :2] = square_m * np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2)
    lens = _calibrate(kept, board, camera, fixes_centre=False)
    is_centre_fitted = bool(
        max(lens.uncertainty[CENTRE_X], lens.uncertainty[CENTRE_Y]) < MAX_CENTRE_UNCERTAINTY_SHARE * camera.n_columns
    )
    if not is_centre_fitted:
        lens = _calibrate(kept, board, camera, fixes_centre=True)
    tilt_rad = _check_tilts(lens)
    if lens.rms_px > MAX_RESIDUAL_PX:
        raise DataQualityError(
            f"the corners miss their places by {lens.rms_px:.1f} pixel (limit {MAX_RESIDUAL_PX:g}): the board is not "
            "flat, --corners is wrong, or frames are of several cameras"
        )
    fitted, conversion_rms_px = _converted(lens, camera)
    others = []
    for left_out in range(len(kept)):
        rest = [*kept[:left_out], *kept[left_out + 1 :]]
        other, _ = _converted(_calibrate(rest, board, camera, fixes_centre=not is_centre_fitted, like=lens), camera)
        assert other.distortion is not None
        others.append((math.log(other.plate_scale_rad), other.distortion.k1_per_rad2))
    jackknife = np.std(others, axis=0) * math.sqrt(len(kept) - 1.0)
    own = float(max(lens.uncertainty[FOCAL_X], lens.uncertainty[FOCAL_Y]) / lens.matrix[0, 0])
    relative = max(own, float(jackknife[0]))
    if not relative < MAX_RELATIVE_UNCERTAINTY:
        raise DataQualityError(
            f"the plate scale is uncertain by {relative:.1%} (limit {MAX_RELATIVE_UNCERTAINTY:.0%}): the views are too "
            "similar; tilt the board by 30 to 45 deg to all sides, bring it closer, into all corners of the image"
        )
    predicted = [
        cv2.projectPoints(board, turn, shift, lens.matrix, lens.coefficients)[0].reshape(-1, 2)
        for turn, shift in zip(lens.turns, lens.shifts, strict=True)
    ]
    residual = np.array([view.corners_px for view in kept]) - np.array(predicted)
    return ChessboardFit(
        camera=fitted,
        plate_scale_uncertainty_rad=fitted.plate_scale_rad * relative,
        focal_px=float(lens.matrix[0, 0]),
        k1_uncertainty_per_rad2=float(jackknife[1]),
        residual_rms_px=lens.rms_px,
        corner_residual_px=residual,
        conversion_rms_px=conversion_rms_px,
        tilt_rad=tilt_rad,
        distance_m=np.array([float(np.linalg.norm(shift)) for shift in lens.shifts]),
        is_centre_fitted=is_centre_fitted,
        covered_share=_covered_share(kept, camera),
        views=tuple(kept),
    )


def _sharp_and_different(views: Sequence[BoardView], camera: CameraModel) -> list[BoardView]:
    """Views that are in focus, of near duplicates the first."""
    sharp = [view for view in views if view.rise_of_square <= MAX_RISE_OF_SQUARE]
    kept: list[BoardView] = []
    for view in sharp:
        way_px = [np.linalg.norm(view.corners_px - other.corners_px, axis=1).mean() for other in kept]
        if not way_px or min(way_px) > SAME_VIEW_SHARE * camera.n_columns:
            kept.append(view)
    if len(kept) < MIN_VIEWS:
        blurred, alike = len(views) - len(sharp), len(sharp) - len(kept)
        raise DataQualityError(
            f"{len(kept)} views of the board count, at least {MIN_VIEWS} are needed ({len(views)} show it, {blurred} "
            f"of them out of focus, {alike} like another view): take about 15, focused, the board tilted to all sides"
        )
    return kept


def _calibrate(
    views: Sequence[BoardView], board: NDArray[np.float32], camera: CameraModel, *, fixes_centre: bool,
    like: _Lens | None = None,
) -> _Lens:  # fmt: skip
    size = (camera.n_columns, camera.n_rows)
    flags = _FLAGS | (cv2.CALIB_FIX_PRINCIPAL_POINT if fixes_centre else 0)
    matrix, coefficients = np.eye(3), np.zeros(5)
    if like is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, coefficients = like.matrix.copy(), like.coefficients.copy()
    points: Any = [view.corners_px.astype(np.float32).reshape(-1, 1, 2) for view in views]
    try:
        found: Any = cv2.calibrateCameraExtended([board] * len(views), points, size, matrix, coefficients, flags=flags)
    except cv2.error as error:
        raise DataQualityError(
            f"OpenCV finds no lens that fits these views ({error.err}): take more, with the board tilted to all sides"
        ) from None
    rms_px, matrix, coefficients, turns, shifts, uncertainty = found[:6]
    if not (np.isfinite(matrix).all() and np.isfinite(uncertainty).all()):
        raise DataQualityError("OpenCV's calibration did not converge: take views with the board tilted to all sides")
    return _Lens(matrix, coefficients.ravel(), uncertainty.ravel(), list(turns), list(shifts), float(rms_px))


def _check_tilts(lens: _Lens) -> Array:
    """Tilts of the boards against the image plane, rad. Raises DataQualityError when all stand alike."""
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in lens.turns])
    normals *= np.sign(normals[:, 2:])
    spread_rad = float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max())
    if spread_rad < MIN_TILT_SPREAD_RAD:
        raise DataQualityError(
            f"the boards' tilts differ by {rad_to_deg(spread_rad):.0f} deg at most (at least "
            f"{rad_to_deg(MIN_TILT_SPREAD_RAD):.0f} are needed): tilt the board by 30 to 45 deg to all sides"
        )
    tilt: Array = np.arccos(np.clip(normals[:, 2], -1.0, 1.0))
    return tilt


def _converted(lens: _Lens, camera: CameraModel) -> tuple[CameraModel, float]:
    """`camera` with the lens that OpenCV found, and how well it stands for it over the image (rms, pixel)."""
    scale_rad = 1.0 / float(lens.matrix[0, 0])
    centre = np.array([lens.matrix[0, 2], lens.matrix[1, 2]])
    x, y = np.meshgrid(np.linspace(0.0, camera.n_columns - 1, GRID), np.linspace(0.0, camera.n_rows - 1, GRID))
    pixel = np.column_stack([x.ravel(), y.ravel()])
    tangent = cv2.undistortPoints(pixel.reshape(-1, 1, 2), lens.matrix, lens.coefficients, criteria=_UNBEND)
    tangent = np.asarray(tangent, dtype=np.float64).reshape(-1, 2)
    ahead = np.concatenate([tangent, np.ones((len(tangent), 1))], axis=1)
    wanted = angles_of_direction(ahead) / scale_rad  # straight offsets, pixel
    offset = pixel - centre
    angle2 = scale_rad**2 * np.sum(offset**2, axis=1, keepdims=True)
    terms = np.stack([offset * angle2, offset * angle2**2], axis=-1).reshape(-1, 2)
    size = np.linalg.norm(terms, axis=0)
    (k1, k2), *_ = np.linalg.lstsq(terms / size, (wanted - offset).ravel(), rcond=None)
    bend = Distortion(centre, float(k1 / size[0]), float(k2 / size[1]))
    left = offset + (terms @ (bend.k1_per_rad2, bend.k2_per_rad4)).reshape(-1, 2) - wanted
    rms_px = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    return replace(camera, plate_scale_rad=scale_rad, distortion=bend), rms_px


def _covered_share(views: Sequence[BoardView], camera: CameraModel) -> float:
    """Share of an 8 x 6 raster of the image that has a corner in it."""
    points = np.concatenate([view.corners_px for view in views])
    counts, _, _ = np.histogram2d(
        points[:, 0], points[:, 1], bins=(8, 6), range=((0, camera.n_columns), (0, camera.n_rows))
    )
    return float(np.mean(counts > 0))

"""Lenses from pictures of a chessboard: of a camera whose rays we know, and converted from OpenCV's model."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from trail_maker import DEG

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.geometry.chessboard import BoardView, calibrate_with_boards, find_board
from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.camera_model import Distortion
from namod_ctl.twin.chessboard import Board, BoardPose, draw_poses, lens_of, render_board

BOARD = Board((9, 6), 0.03)
CAMERA = replace(
    build_instrument(load_config("fact")).reflector_camera,
    n_columns=480,
    n_rows=360,
    axis_pixel=np.array([240.0, 180.0]),
    plate_scale_rad=0.03 * DEG,
)
SIZE = (CAMERA.n_columns, CAMERA.n_rows)


def projected(pose, focal_px, centre, kappa, noise_px=0.0, seed=0):
    """Corners of a board as an ideal pinhole with OpenCV's radial term shows them, by plain geometry."""
    about_x, about_y, about_z = pose.tilt_rad
    turn = cv2.Rodrigues(np.array([about_x, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.array([0.0, about_y, 0.0]))[0]
    turn = turn @ cv2.Rodrigues(np.array([0.0, 0.0, about_z]))[0]
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(6) - 2.5)
    points = BOARD.square_m * np.column_stack([x.ravel(), y.ravel(), np.zeros(54)]) @ turn.T + pose.middle_m
    tangent = points[:, :2] / points[:, 2:]
    tangent = tangent * (1.0 + kappa * np.sum(tangent**2, axis=1, keepdims=True))
    noise = np.random.default_rng(seed).normal(0.0, noise_px, (54, 2))
    return BoardView(centre + focal_px * tangent + noise, 0.1)


@pytest.fixture(scope="module")
def poses():
    return draw_poses(BOARD, CAMERA, 8, 3)


def test_lens_of_rendered_boards(poses):
    truth = replace(
        CAMERA, plate_scale_rad=1.01 * CAMERA.plate_scale_rad, distortion=Distortion(np.array([243.0, 177.0]), 0.6)
    )
    rng = np.random.default_rng(1)
    rays = lens_of(truth)
    views = [view for pose in poses if (view := find_board(render_board(BOARD, pose, rays, SIZE, rng), (9, 6)))]
    assert len(views) >= 7
    fit = calibrate_with_boards(views, (9, 6), BOARD.square_m, CAMERA)
    off = fit.camera.plate_scale_rad - truth.plate_scale_rad
    assert abs(off) < 3.0 * fit.plate_scale_uncertainty_rad
    assert fit.plate_scale_uncertainty_rad < 1e-2 * truth.plate_scale_rad
    # besides the scale: near the image's edges the bend is 0.6 pixel
    along = np.array([[-150.0, 0.0], [150.0, 0.0], [0.0, -130.0], [0.0, 130.0]]) + truth.distortion.centre_pixel
    wanted = np.arctan(rays(along)) - np.arctan(rays(truth.distortion.centre_pixel[None, :]))
    centred = replace(fit.camera, axis_pixel=truth.distortion.centre_pixel)
    found = centred.theta_of_pixel(along) * [1.0, -1.0]
    bend = found * (truth.plate_scale_rad / fit.camera.plate_scale_rad) - wanted
    assert np.abs(bend).max() < 0.3 * CAMERA.plate_scale_rad
    assert fit.residual_rms_px < 0.3


@pytest.mark.parametrize("kappa", [-0.3, 0.0, 0.2])
def test_conversion_of_a_pinholes_tangents(poses, kappa):
    focal_px, centre = 1900.0, np.array([236.0, 182.0])
    views = [projected(pose, focal_px, centre, kappa) for pose in poses]
    fit = calibrate_with_boards(views, (9, 6), BOARD.square_m, CAMERA)
    assert fit.focal_px == pytest.approx(focal_px, rel=1e-4)
    assert fit.camera.plate_scale_rad == pytest.approx(1.0 / focal_px, rel=1e-4)
    # over the whole image the true direction of a pixel, bent back by bisection, is the arctangent of its tangents
    x, y = np.meshgrid(np.linspace(0.0, 479.0, 25), np.linspace(0.0, 359.0, 19))
    pixel = np.column_stack([x.ravel(), y.ravel()])
    offset = (pixel - centre) / focal_px
    radius = np.hypot(*offset.T)
    low, high = np.zeros_like(radius), 2.0 * radius
    for _ in range(60):
        middle = 0.5 * (low + high)
        is_low = middle * (1.0 + kappa * middle**2) < radius
        low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
    wanted = np.arctan(offset * np.divide(low, radius, out=np.ones_like(radius), where=radius > 0)[:, None] * [1, -1])
    miss_px = (replace(fit.camera, axis_pixel=centre).theta_of_pixel(pixel) - wanted) * focal_px
    rms_px = np.sqrt(np.mean(np.sum(miss_px**2, axis=1)))
    # linear angles without any bend would be 2.4 pixel off in the corners for a lens of kappa = 0
    assert rms_px < 0.005
    assert fit.conversion_rms_px < 0.001


def test_uncertainty_is_honest_over_seeds(poses):
    pulls = []
    for seed in range(6):
        views = [
            projected(pose, 1900.0, np.array([240.0, 180.0]), -0.1, 0.1, 100 * seed + k) for k, pose in enumerate(poses)
        ]
        fit = calibrate_with_boards(views, (9, 6), BOARD.square_m, CAMERA)
        pulls.append((fit.camera.plate_scale_rad - 1.0 / 1900.0) / fit.plate_scale_uncertainty_rad)
    # of 6 normal numbers the rms is 0.4 to 1.7 in 98 of 100 cases
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.7


def flat(poses):
    return [replace(pose, tilt_rad=(0.02 * k / len(poses), 0.0, 0.0)) for k, pose in enumerate(poses)]


@pytest.mark.parametrize(
    ("views", "words"),
    [
        (lambda poses: [view_of(pose) for pose in poses[:4]], "at least 6"),
        (lambda poses: [view_of(poses[0], seed=k) for k in range(12)], "11 like another view"),
        (lambda poses: [replace(view_of(pose), rise_of_square=0.6) for pose in poses], "8 of them out of focus"),
        (lambda poses: [view_of(pose) for pose in flat(poses)], "tilt the board|too similar|converge"),
        (lambda poses: [shuffled(view_of(pose), k) for k, pose in enumerate(poses)], "miss their places|finds no|tilt"),
    ],
)
def test_useless_views_are_refused(poses, views, words):
    with pytest.raises(DataQualityError, match=words):
        calibrate_with_boards(views(poses), (9, 6), BOARD.square_m, CAMERA)


def view_of(pose, seed=0):
    return projected(pose, 1900.0, np.array([240.0, 180.0]), -0.1, 0.1, seed)


def shuffled(view, seed):
    return replace(view, corners_px=np.random.default_rng(seed).permutation(view.corners_px))


def test_board_out_of_focus_and_none_at_all():
    rays = lens_of(CAMERA)
    pose = BoardPose((0.0, 0.0, 1.6), (0.4, 0.2, 0.0))
    rng = np.random.default_rng(2)
    sharp, blurred = (find_board(render_board(BOARD, pose, rays, SIZE, rng, blur_px=b), (9, 6)) for b in (0.6, 6.0))
    assert sharp is not None
    assert sharp.rise_of_square < 0.2
    assert blurred is None or blurred.rise_of_square > 0.4
    assert find_board(np.full((360, 480), 90, np.uint8), (9, 6)) is None
    assert find_board(render_board(BOARD, pose, rays, SIZE, rng), (7, 5)) is None

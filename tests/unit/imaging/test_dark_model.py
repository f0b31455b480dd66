"""A camera's dark model: frames with a dark level and hot pixels give the records of frames without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from frames import OFFSET_ADU, SIGMA_PX, exposed, gaussian_light
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, resized

from namod_ctl.imaging.dark import subtract_dark_model
from namod_ctl.imaging.measure import without_dark
from namod_ctl.imaging.radiometry import saturation_adu
from namod_ctl.imaging.star import Star, star_finder
from namod_ctl.optics.camera_model import DarkModel

STAR = resized(STAR_CAMERA, 401, 301)
NO_HOT = np.empty((0, 2), dtype=np.int64)
STAR_SIZE_RAD = np.radians(0.025)


def test_the_level_at_the_frames_exposure_is_taken_off():
    frame = np.full((8, 10), 30, dtype=np.uint8)
    frame[2, 3], frame[4, 5] = 3, 254
    clean = subtract_dark_model(frame, DarkModel(6.0, 2.0, NO_HOT), 2.0, 250.0)
    assert clean[0, 0] == 20  # 30 - 6 - 2 * 2
    assert clean[2, 3] == 0  # less than no light is none
    assert clean[4, 5] == 254  # saturated stays saturated
    assert frame[0, 0] == 30


def test_a_hot_pixel_becomes_as_its_neighbours_in_every_channel():
    frame = np.full((8, 10, 3), 30, dtype=np.uint8)
    frame[2, 3] = (255, 200, 255)
    clean = subtract_dark_model(frame, DarkModel(0.0, 0.0, np.array([[3, 2]])), 1.0, 250.0)
    assert np.all(clean == 30)


def test_hot_pixels_that_look_like_stars_leave_the_star_alone():
    rng = np.random.default_rng(5)
    frame = exposed(120.0 * gaussian_light((301, 401), 250.4, 100.7, SIGMA_PX), rng)
    hot = np.array([[x + i, y + j] for x, y in ((60, 60), (300, 220)) for i in range(8) for j in range(8)])
    spoilt = frame.copy()
    spoilt[hot[:, 1], hot[:, 0]] = 200
    finder = star_finder(STAR, STAR_SIZE_RAD, spoilt.dtype)
    assert not isinstance(finder.find(spoilt), Star)
    camera = replace(STAR, dark=DarkModel(OFFSET_ADU, 0.0, hot))
    found = finder.find(without_dark(spoilt, camera, 0.1))
    assert isinstance(found, Star)
    assert abs(found.x_px - 250.4) < 0.1
    assert abs(found.y_px - 100.7) < 0.1


def test_a_camera_without_a_model_keeps_its_frames():
    frame = np.full((REFLECTOR_CAMERA.n_rows, REFLECTOR_CAMERA.n_columns), 9, dtype=np.uint8)
    assert without_dark(frame, REFLECTOR_CAMERA, 0.1) is frame
    assert saturation_adu(REFLECTOR_CAMERA) > 9

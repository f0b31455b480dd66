"""A camera's dark model: frames with a dark level and hot pixels give the records of frames without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from frames import OFFSET_ADU, SIGMA_PX, exposed, gaussian_light
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, hexagon, instrument, resized

from namod_ctl.imaging.dark import dark_rest_adu, subtract_dark_model
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record, without_dark
from namod_ctl.imaging.radiometry import exposure_factor, saturation_adu
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


@pytest.mark.parametrize("level_adu", [6.0, 6.25, 6.5, 6.9, 0.4])
def test_faint_facets_have_the_light_above_the_exact_level(level_adu: float):
    """By the law itself, of light that noise spreads over the digitizer's steps."""
    light_adu, noise_adu = 6.0, 0.8
    camera = replace(resized(REFLECTOR_CAMERA, 200, 150), dark=DarkModel(level_adu - 0.1, 0.2, NO_HOT))
    polygons = {1: hexagon(100.0, 75.0, 60.0)}
    rng = np.random.default_rng(8)
    adu = light_adu + noise_adu * rng.standard_normal((150, 200))
    frame = np.rint(level_adu + adu).astype(np.uint8)
    photometer = FacetPhotometer(polygons, [1], 200, 150)
    star = np.zeros((STAR.n_rows, STAR.n_columns), dtype=np.uint8)
    record = measure_record(star, frame, 0.1, 0.5, instrument(STAR, camera, polygons), photometer, 0, "")
    truth = np.mean((adu / 255.0) ** camera.law.r_resp) * exposure_factor(camera.law, 0.5)
    assert record.facet_intensity[0] == pytest.approx(truth, rel=0.006)


@pytest.mark.parametrize("level_adu", [6.0, 6.25, 6.5, 6.9])
def test_faint_star_has_the_light_above_the_exact_level(level_adu: float):
    sky_adu, noise_adu, exposure_s = 4.0, 0.8, 0.2
    camera = replace(STAR, dark=DarkModel(level_adu, 0.0, NO_HOT))
    rng = np.random.default_rng(9)
    light = 25.0 * gaussian_light((301, 401), 200.3, 150.6, SIGMA_PX)
    rows, columns = np.mgrid[:301, :401]
    near = (columns - 200.3) ** 2 + (rows - 150.6) ** 2 <= (2.0 * STAR_SIZE_RAD / camera.plate_scale_rad) ** 2
    power = camera.law.r_resp
    truth = float(np.sum(((sky_adu + light[near]) / 255.0) ** power - (sky_adu / 255.0) ** power))
    found = []
    for _ in range(40):
        frame = np.rint(level_adu + sky_adu + light + noise_adu * rng.standard_normal(light.shape)).astype(np.uint8)
        rest_adu = dark_rest_adu(camera.dark, exposure_s)
        star = star_finder(camera, STAR_SIZE_RAD, frame.dtype, rest_adu).find(without_dark(frame, camera, exposure_s))
        assert isinstance(star, Star)
        found.append(star.intensity_sum)
    assert np.mean(found) == pytest.approx(truth, rel=0.006)

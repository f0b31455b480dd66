"""The size of stars in and far out of focus, against gaussians and discs of known width."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from fake_night import STAR
from frames import exposed, gaussian_light
from imaging_instruments import resized

from namod_ctl.cycle.focus import FocusCourse, read_focus
from namod_ctl.optics.camera_model import CameraModel

SIZE_RAD = math.radians(0.025)
FWHM_PER_SIGMA = math.sqrt(8.0 * math.log(2.0))


def star_frame(sigma_px: float, peak_adu: float = 150.0, seed: int = 1) -> np.ndarray:
    light = peak_adu * gaussian_light((480, 640), 300.3, 210.8, sigma_px)
    return np.asarray(exposed(light, np.random.default_rng(seed), offset_adu=3.0), dtype=np.uint8)


def big(camera: CameraModel = STAR) -> CameraModel:
    return resized(camera, 640, 480)


@pytest.mark.parametrize("sigma_px", [1.2, 4.4, 12.0, 30.0])
def test_gaussian_stars_of_any_size(sigma_px: float) -> None:
    reading = read_focus(star_frame(sigma_px), big(), SIZE_RAD)
    assert reading.trouble == ""
    assert reading.diameter_px == pytest.approx(FWHM_PER_SIGMA * sigma_px, rel=0.07)
    assert reading.diameter_rad == pytest.approx(reading.diameter_px * STAR.plate_scale_rad)
    assert reading.peak_share == pytest.approx(150.0 / 255.0, rel=0.1)


def test_the_disc_of_a_star_out_of_focus_shrinks_with_the_disc() -> None:
    sizes = []
    for radius_px in (40, 25, 15, 8, 4):
        light = np.zeros((480, 640))
        cv2.circle(light, (300, 210), radius_px, 120.0, -1)
        light = cv2.GaussianBlur(light, (0, 0), 1.5)
        frame = np.asarray(exposed(light, np.random.default_rng(radius_px), offset_adu=3.0), dtype=np.uint8)
        sizes.append(read_focus(frame, big(), SIZE_RAD).diameter_px)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 4.0 * sizes[-1]


def test_nothing_and_too_much_say_what_is_wrong() -> None:
    nothing = read_focus(star_frame(4.0, 0.0), big(), SIZE_RAD)
    assert math.isnan(nothing.diameter_px)
    assert "nothing stands" in nothing.trouble
    glaring = read_focus(star_frame(4.0, 2000.0), big(), SIZE_RAD)
    assert "saturated" in glaring.trouble


def test_the_course_tells_which_way_to_turn() -> None:
    course = FocusCourse()
    said = [course.add(read_focus(star_frame(sigma_px), big(), SIZE_RAD)) for sigma_px in (8.0, 6.0, 5.0, 7.0, 6.0)]
    assert said == ["best so far", "best so far", "best so far", "worse", "better"]
    assert course.best_px == pytest.approx(5.0 * FWHM_PER_SIGMA, rel=0.05)
    assert course.add(read_focus(star_frame(4.0, 0.0), big(), SIZE_RAD)) == ""

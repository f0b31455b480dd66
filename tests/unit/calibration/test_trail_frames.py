"""The star that trails is found among hot pixels, clouds and other stars; what is no trail is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trail_maker import DEG, MDEG

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.geometry.star_streak import fit_streak
from namod_ctl.calibration.geometry.star_trail import fit_trail
from namod_ctl.calibration.geometry.trail_frames import find_trail, trail_spots
from namod_ctl.calibration.sky.star_path import path_of_declination
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_trail import TrailScene, TrailTwin

FACT = build_instrument(load_config("fact"))
CAMERA = replace(
    FACT.star_camera, n_columns=640, n_rows=480, axis_pixel=np.array([320.0, 240.0]), plate_scale_rad=6.0 * MDEG
)
TRUE = replace(CAMERA, plate_scale_rad=1.004 * CAMERA.plate_scale_rad)
STAR_RAD = 0.04 * DEG
SCENE = TrailScene(28.76 * DEG, 20.0 * DEG, -0.3, (0.002, -0.003), altitude_m=None, magnitude=1.0)
EXPOSURE_S = 0.1


def spots_of(scene, settings=STAR_CAMERA, n=24, half_s=300.0, exposure_s=EXPOSURE_S, seed=1):
    twin = TrailTwin(scene, TRUE, STAR_RAD, settings, seed)
    frames = list(twin.frames(np.linspace(-half_s, half_s, n), exposure_s))
    spots = [trail_spots(frame.exposure.image, CAMERA, STAR_RAD, exposure_s) for frame in frames]
    return np.array([frame.time_s for frame in frames]), spots


def truth_px(scene, time_s):
    return TRUE.pixel_of_theta(scene.theta_rad(time_s))


def test_trail_among_hot_pixels_clouds_and_a_faint_star():
    scene = replace(SCENE, cloud_share=0.25, companion=(0.012, 0.006, 1.6))
    time_s, spots = spots_of(scene, replace(STAR_CAMERA, n_hot_pixels=3000))
    found = find_trail(time_s, spots)
    assert len(found.frames) > 12
    miss_px = found.trail.pixel - truth_px(scene, found.trail.time_s)
    assert np.abs(miss_px).max() < 0.15
    fit = fit_trail(
        found.trail, path_of_declination(found.trail.time_s / (1.0 - 4.5e-4), SCENE.declination_rad), CAMERA
    )
    assert abs(fit.camera.plate_scale_rad - TRUE.plate_scale_rad) < 3.0 * fit.plate_scale_uncertainty_rad


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (replace(SCENE, drive_rate=1.0), "the drive tracks"),
        (replace(SCENE, companion=(0.012, 0.006, 0.3)), "two stars"),
        (replace(SCENE, cloud_share=1.0), "seen in 0 of 24"),
        (replace(SCENE, magnitude=-2.0), "saturated"),
        (replace(SCENE, wind_rad=0.5 * DEG), "no star moves steadily"),
    ],
)
def test_what_is_no_trail_is_refused(scene, words):
    time_s, spots = spots_of(scene)
    with pytest.raises(DataQualityError, match=words):
        find_trail(time_s, spots)


def test_frame_of_another_camera_is_refused():
    with pytest.raises(ConfigError, match="480 rows"):
        trail_spots(np.zeros((100, 200), np.uint8), CAMERA, STAR_RAD, EXPOSURE_S)


def streak(scene=SCENE, exposure_s=240.0, n_hot=0, seed=1):
    settings = replace(STAR_CAMERA, exposure_at_mag0_s=20.0, n_hot_pixels=n_hot)
    (frame,) = TrailTwin(scene, TRUE, STAR_RAD, settings, seed).frames(np.zeros(1), exposure_s)
    return frame.exposure.image


@pytest.mark.parametrize("seed", range(3))
def test_one_long_exposure(seed):
    image = streak(seed=seed, n_hot=10)
    fit = fit_streak(image, CAMERA, STAR_RAD, 240.0, SCENE.declination_rad)
    without_air = fit.plate_scale_rad / (1.0 - 4.5e-4)
    assert abs(without_air - TRUE.plate_scale_rad) < 2.0 * fit.plate_scale_uncertainty_rad
    assert fit.plate_scale_uncertainty_rad < 3e-2 * TRUE.plate_scale_rad
    ends_px = truth_px(SCENE, np.array([-120.0, 120.0]))
    straight = np.abs(fit.ends_px - ends_px).max(), np.abs(fit.ends_px - ends_px[::-1]).max()
    assert min(straight) < 0.5


@pytest.mark.parametrize(
    ("scene", "exposure_s", "words"),
    [
        (SCENE, 5.0, "no streak"),
        (replace(SCENE, drive_rate=1.0), 240.0, "no streak"),
        (replace(SCENE, drive_rate=0.6), 240.0, "the drive moved"),
        (replace(SCENE, companion=(0.012, 0.006, 0.3)), 240.0, "several stars"),
        (replace(SCENE, miss_rad=(0.0, 0.0245)), 240.0, "leaves the frame"),
        (replace(SCENE, magnitude=-1.5), 240.0, "saturated"),
    ],
)
def test_useless_long_exposures_are_refused(scene, exposure_s, words):
    with pytest.raises(DataQualityError, match=words):
        fit_streak(streak(scene, exposure_s), CAMERA, STAR_RAD, exposure_s, SCENE.declination_rad)


def test_streak_that_a_cloud_cuts_is_refused():
    image = streak()
    start, end = truth_px(SCENE, np.array([-30.0, 30.0]))
    low, high = np.floor(np.minimum(start, end)).astype(int), np.ceil(np.maximum(start, end)).astype(int)
    image[low[1] : high[1], low[0] - 20 : high[0] + 20] //= 3
    with pytest.raises(DataQualityError, match="cloud"):
        fit_streak(image, CAMERA, STAR_RAD, 240.0, SCENE.declination_rad)

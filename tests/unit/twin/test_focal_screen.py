"""The twin's focal screen: its light is where the reflector's rays go, and it moves as mirror images do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from twins import STILL, small_twin

from namod_ctl.core.units import arcmin_to_rad, mdeg_to_rad
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.focal_screen import PSF_CAMERA, FocalScreen, Screen, focal_camera
from namod_ctl.twin.settings import PERFECT, ReflectorSettings
from namod_ctl.twin.sky import LightTrack

COLUMNS, ROWS = 480, 360


def camera(scale_mdeg=3.0):
    return CameraModel(
        name="screen",
        n_columns=COLUMNS,
        n_rows=ROWS,
        plate_scale_rad=mdeg_to_rad(scale_mdeg),
        axis_pixel=np.array([COLUMNS / 2.0, ROWS / 2.0]),
        axis_is_calibrated=False,
        orientation=CameraOrientation(),
        law=RadiometricLaw(1.0, -1.0, 0.0),
        full_scale_adu=4095.0,
    )


def light_of(twin, theta_rad=(0.0, 0.0), model=None):
    screen = FocalScreen(twin.instrument.reflector, twin.reflector, model or camera(), Screen(), 1)
    return screen.light_shares([LightTrack(np.array([theta_rad]), np.ones(1), 0.0)])


def moments(light):
    """Sum, centre (x, y) and covariance of the light, pixels' own width taken off."""
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    total = light.sum()
    mean = np.array([(light * x).sum(), (light * y).sum()]) / total
    dx, dy = x - mean[0], y - mean[1]
    cov = np.array([[(light * a * b).sum() for a in (dx, dy)] for b in (dx, dy)]) / total
    return total, mean, cov - np.eye(2) / 12.0


@pytest.mark.parametrize("misalignment_arcmin", [0.0, 3.0])
def test_area_of_the_image_is_that_of_the_rays(misalignment_arcmin):
    twin = small_twin(3, reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(misalignment_arcmin)))
    model = camera(2.0)
    total, _, cov = moments(light_of(twin, model=model))
    assert total == pytest.approx(1.0, abs=1e-9)
    area_rad2 = math.pi * math.sqrt(np.linalg.det(cov)) * model.plate_scale_rad**2
    # rays fall into pixels of a few hundredths of the spot: their sum is that of the moments to some 0.1 %
    assert area_rad2 == pytest.approx(twin.reflector.a_sigma_now_rad2(), rel=0.003)


def test_image_moves_against_the_star_and_is_upright():
    twin = small_twin(1, reflector=PERFECT)
    model = camera()
    theta = np.array([arcmin_to_rad(5.0), arcmin_to_rad(-3.0)])
    _, centre, _ = moments(light_of(twin))
    _, moved, _ = moments(light_of(twin, theta))
    # +y of the telescope is up, rows count downwards
    expected = np.array([-np.tan(theta[0]), np.tan(theta[1])]) / model.plate_scale_rad
    # facets at the rim of a sphere about the focus are as far from it as those in the middle: they throw further
    assert moved - centre == pytest.approx(expected, rel=0.04)


def test_tilted_facet_throws_its_light_twice_the_tilt_away():
    twin = small_twin(1, reflector=PERFECT)
    n = len(twin.instrument.reflector.ids)
    _, before, _ = moments(light_of(twin))
    tilt = np.zeros((n, 2))
    tilt[2] = (arcmin_to_rad(2.0), arcmin_to_rad(1.0))
    twin.apply_correction(tilt)
    twin.update(twin.clock.monotonic_s())
    _, after, _ = moments(light_of(twin))
    share = twin.reflector.light_m2[2] / twin.reflector.light_m2.sum()
    expected = share * 2.0 * np.array([tilt[2, 0], -tilt[2, 1]]) / camera().plate_scale_rad
    assert after - before == pytest.approx(expected, rel=0.05)


def test_frames_have_sky_gradient_noise_and_hot_pixels():
    twin = small_twin(1)
    model = camera()
    screen = Screen(
        camera=replace(PSF_CAMERA, background_share=0.05, n_hot_pixels=40), gradient_share=1.0, gradient_rad=0.0
    )
    psf_camera = focal_camera(twin, model, 1, screen)
    psf_camera.start(0.1)
    exposure = psf_camera.fetch(1.0)
    image = exposure.image.astype(float)
    assert exposure.exposure_s == pytest.approx(0.1)
    assert image.max() > 1000.0  # Vega, well aligned or not
    left, right = image[:40, :40], image[:40, -40:]
    assert np.median(right) > 2.0 * np.median(left)  # from half of the level to one and a half, vignetted
    sigma = 1.4826 * np.median(np.abs(left - np.median(left)))
    assert sigma > 0.8
    psf_camera.start(2.5)
    long = psf_camera.fetch(1.0).image.astype(float)
    far = np.ones(long.shape, dtype=bool)
    far[60:300, 100:380] = False
    level = np.median(long[far])
    assert np.count_nonzero(long[far] > level + 200.0) > 0 or np.count_nonzero(long[far] > level + 40.0) > 5


def test_exposures_repeat_and_differ_with_time():
    frames = []
    for _ in range(2):
        psf_camera = focal_camera(small_twin(1, telescope=STILL), camera(), 1)
        images = []
        for _ in range(2):
            psf_camera.start(0.05)
            images.append(psf_camera.fetch(1.0).image)
        frames.append(images)
    assert np.array_equal(frames[0][0], frames[1][0])
    assert np.array_equal(frames[0][1], frames[1][1])
    assert not np.array_equal(frames[0][0], frames[0][1])


def test_ghost_adds_its_share_of_light():
    twin = small_twin(1, reflector=PERFECT)
    model, rng = camera(), np.random.default_rng(1)
    quiet = replace(PSF_CAMERA, background_share=0.0, read_noise_adu=0.0, electrons_per_adu=1e12, black_level_adu=0.0)
    track = [LightTrack(np.zeros((1, 2)), np.ones(1), 0.0)]

    def frame(share):
        screen = Screen(quiet, vignetting=0.0, ghost_share=share)
        return FocalScreen(twin.instrument.reflector, twin.reflector, model, screen, 1).render(
            track, 1e-3, 0.0, 10.0, rng
        )

    ghostly, clean = frame(0.5).sum(dtype=float), frame(0.0).sum(dtype=float)
    assert clean > 0.0
    assert ghostly / clean == pytest.approx(1.5, abs=0.1)

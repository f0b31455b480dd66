"""Several images of one spot: weighted mean, drift, smear, scatter."""

import math

import numpy as np
import pytest
from frames import gaussian_light, streak_light
from spot_frames import SHAPE, elliptic, frame_of, psf_camera

from namod_ctl.imaging.psf_combine import Exposed, combine_images
from namod_ctl.imaging.psf_image import measure_psf

CAMERA = psf_camera()
SCALE_RAD = CAMERA.plate_scale_rad


def exposed(light, seed, mid_s=None, exposure_s=0.1):
    return Exposed(measure_psf(frame_of(light, np.random.default_rng(seed)), CAMERA, exposure_s), exposure_s, mid_s)


def test_star_that_drifts_between_images():
    places = [(120.0 + 8.0 * number, 130.0 - 4.0 * number) for number in range(4)]
    images = [exposed(30.0 * elliptic(x, y, 9.0, 6.0, 0.4), number) for number, (x, y) in enumerate(places)]
    psf = combine_images(images, SCALE_RAD)
    assert psf.a_sigma_rad2 == pytest.approx(math.pi * 54.0 * SCALE_RAD**2, rel=0.02)
    assert psf.drift_px == pytest.approx((24.0, -12.0), abs=0.3)
    assert psf.axes_rad == pytest.approx(np.array([9.0, 6.0]) * SCALE_RAD, rel=0.02)
    # rows count downwards: along (cos 0.4, sin 0.4) of columns and rows is -0.4 from the right towards the top
    assert psf.angle_rad == pytest.approx(math.pi - 0.4, abs=0.04)
    assert psf.angle_uncertainty_rad < 0.04
    single = combine_images(images[:1], SCALE_RAD)
    assert math.isnan(single.scatter)
    assert psf.a_sigma_uncertainty_rad2 < 0.85 * single.a_sigma_uncertainty_rad2


def test_motion_during_the_exposure_is_taken_off():
    """12 pixels in each exposure make a spot of 6 pixels longer by 12^2 / 12 in variance: 15 % in A_sigma."""
    images, smeared = [], 0.0
    for number in range(3):
        start = np.array([80.0 + 24.0 * number, 120.0])
        steps = np.linspace(0.0, 12.0, 49)
        light = 100.0 * np.mean([gaussian_light(SHAPE, start[0] + step, 120.0, 6.0) for step in steps], axis=0)
        images.append(exposed(light, number, mid_s=0.2 * number, exposure_s=0.1))
        smeared += images[-1].image.a_sigma_px2 / 3
    true_px2 = math.pi * 36.0
    assert smeared == pytest.approx(true_px2 * math.sqrt(1.0 + 12.25**2 / 12.0 / 36.0), rel=0.02)
    psf = combine_images(images, SCALE_RAD)
    assert psf.a_sigma_rad2 == pytest.approx(true_px2 * SCALE_RAD**2, rel=0.02)
    assert psf.radii_rad[1] == pytest.approx(6.0 * math.sqrt(-2.0 * math.log(0.32)) * SCALE_RAD, rel=0.02)
    # nobody knows which way it went in between: that is in the uncertainty
    assert psf.common_uncertainty_rad2 > 0.05 * psf.a_sigma_rad2


def test_images_that_differ_are_told_and_make_it_less_certain():
    sizes = (8.0, 8.7, 7.9, 8.6)
    images = [exposed(120.0 * gaussian_light(SHAPE, 150.0, 120.0, size), n) for n, size in enumerate(sizes)]
    psf = combine_images(images, SCALE_RAD)
    areas = np.array([one.image.a_sigma_px2 for one in images]) * SCALE_RAD**2
    assert psf.scatter > 3.0
    assert any("differ" in remark for remark in psf.remarks)
    assert psf.a_sigma_uncertainty_rad2 > 0.7 * areas.std() / math.sqrt(len(areas))


def test_a_streak_is_long_in_its_own_direction():
    light = 100.0 * streak_light(SHAPE, (130.0, 100.0), (160.0, 130.0), 6.0)
    psf = combine_images([exposed(light, 1)], SCALE_RAD)
    assert psf.angle_rad == pytest.approx(3.0 * math.pi / 4.0, abs=0.03)  # right and down is up and left


def test_light_beside_is_told_with_what_it_would_mean():
    """A tenth of the light 90 pixels away: were it a facet's, it would belong to the spot."""
    light = 120.0 * gaussian_light(SHAPE, 110.0, 120.0, 6.0) + 12.0 * gaussian_light(SHAPE, 200.0, 120.0, 6.0)
    psf = combine_images([exposed(light, 2)], SCALE_RAD)
    (remark,) = [text for text in psf.remarks if "beside" in text]
    assert "5.4 arcmin away" in remark
    # mixture of 10 : 1 along one axis; of the fainter light only what stands out is counted
    with_it = math.pi * math.sqrt((36.0 + 10.0 / 121.0 * 90.0**2) * 36.0) * (1e-3 * 60.0) ** 2
    assert float(remark.split()[-2]) == pytest.approx(with_it, rel=0.1)

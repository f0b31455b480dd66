"""The PSF camera's numbers against spots that are known on paper, and what it refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from frames import disc_light, gaussian_light
from scipy.ndimage import gaussian_filter
from spot_frames import EVEN, SHAPE, contained_in_circle, elliptic, frame_of, psf_camera

from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.imaging.psf_aperture import CONTAINMENT_SHARES
from namod_ctl.imaging.psf_image import measure_psf
from namod_ctl.optics.camera_model import DarkModel, RadiometricLaw

CAMERA = psf_camera()
UNEVEN = (10.0, 6.0, -4.0, 0.2)


def relative(measured, true_px2):
    """Error of A_sigma and its stated uncertainty, relative."""
    return measured.a_sigma_px2 / true_px2 - 1.0, measured.uncertainty_px2 / true_px2


@pytest.mark.parametrize(
    ("height", "long_px", "short_px", "sky", "within"),
    [
        (150.0, 10.0, 10.0, EVEN, 0.02),
        (150.0, 10.0, 10.0, UNEVEN, 0.02),
        (150.0, 14.0, 7.0, UNEVEN, 0.02),
        (150.0, 3.0, 2.5, UNEVEN, 0.04),  # a hundredth of the light in the same noise per pixel
        (15.0, 10.0, 8.0, UNEVEN, 0.08),
    ],
    ids=["round", "uneven sky", "elongated", "sharp", "faint"],
)
def test_elliptic_gaussians(height, long_px, short_px, sky, within):
    errors, doubts, radii = [], [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        turn = rng.uniform(0.0, math.pi)
        x, y = np.array([SHAPE[1], SHAPE[0]]) / 2.0 + rng.uniform(-8.0, 8.0, 2)
        light = height * elliptic(x, y, long_px, short_px, turn)
        measured = measure_psf(frame_of(light, rng, sky), CAMERA, 0.1)
        error, doubt = relative(measured, math.pi * long_px * short_px)
        errors.append(error)
        doubts.append(doubt)
        radii.append(measured.numbers[5:])
        assert np.hypot(*(measured.numbers[:2] - (x, y))) < 0.05 * short_px
    pulls = np.array(errors) / np.array(doubts)
    assert np.max(np.abs(errors)) < within
    # 5 pulls of unit width: rms 2 has a chance of 1 in 1000; stated uncertainties contain wings that gaussians lack
    assert np.sqrt(np.mean(pulls**2)) < 2.0
    true = [contained_in_circle(share, long_px, short_px) for share in CONTAINMENT_SHARES]
    assert np.mean(radii, axis=0) == pytest.approx(true, rel=max(0.75 * within, 0.015))


def test_uniform_disc_out_of_focus():
    """Variance of a disc: diameter^2 / 16 along each axis; its edge blurred by 3 pixels."""
    light = 100.0 * gaussian_filter(disc_light(SHAPE, 148.3, 121.7, 50.0), 3.0, mode="constant")
    measured = measure_psf(frame_of(light, np.random.default_rng(1), UNEVEN), CAMERA, 0.1)
    error, _ = relative(measured, math.pi * (50.0**2 / 16.0 + 9.0))
    assert abs(error) < 0.02
    # a disc holds the share (2 r / D)^2
    assert measured.numbers[6] == pytest.approx(25.0 * math.sqrt(0.68), rel=0.02)


def test_facets_that_are_astray_belong_to_the_spot():
    """Five spots of equal light with gaps of darkness between them: the covariance of a mixture is known."""
    shape, sigma_px = (300, 360), 5.0
    places = np.array([(150.0, 140.0), (185.0, 150.0), (160.0, 175.0), (210.0, 135.0), (190.0, 190.0)])
    light = 120.0 * sum(gaussian_light(shape, x, y, sigma_px) for x, y in places)
    measured = measure_psf(frame_of(light, np.random.default_rng(2)), psf_camera(shape), 0.1)
    true = math.pi * math.sqrt(np.linalg.det(np.cov(places.T, bias=True) + sigma_px**2 * np.eye(2)))
    error, doubt = relative(measured, true)
    assert abs(error) < 0.02
    assert abs(error) < 3.5 * doubt


def test_star_beside_is_left_out_and_told():
    light = 120.0 * gaussian_light(SHAPE, 110.0, 120.0, 6.0) + 15.0 * gaussian_light(SHAPE, 200.0, 150.0, 6.0)
    measured = measure_psf(frame_of(light, np.random.default_rng(3)), CAMERA, 0.1)
    assert abs(relative(measured, math.pi * 36.0)[0]) < 0.02
    (other,) = measured.others
    assert (other.x_px, other.y_px) == pytest.approx((200.0, 150.0), abs=1.0)
    assert other.share == pytest.approx(0.125, rel=0.1)


def test_hot_pixels_do_not_matter():
    rng = np.random.default_rng(4)
    frame = frame_of(150.0 * elliptic(150.0, 120.0, 9.0, 7.0, 0.5), rng)
    frame[rng.integers(0, SHAPE[0], 120), rng.integers(0, SHAPE[1], 120)] = 255
    assert abs(relative(measure_psf(frame, CAMERA, 0.1), math.pi * 63.0)[0]) < 0.02


def test_wide_ghost_is_within_the_uncertainty():
    """5 % of the light in a patch five times as wide beside the spot: nobody can tell it from wings exactly."""
    shape = (300, 360)
    light = 150.0 * gaussian_light(shape, 170.0, 150.0, 9.0)
    ghost = 150.0 * 0.05 / 25.0 * gaussian_light(shape, 230.0, 170.0, 45.0)
    for seed in range(3):
        measured = measure_psf(frame_of(light + ghost, np.random.default_rng(seed)), psf_camera(shape), 0.1)
        error, doubt = relative(measured, math.pi * 81.0)
        assert abs(error) < 3.0 * doubt
        assert abs(error) < 0.05


def test_wings_wider_than_a_gaussian():
    """85 % of the light in a core, 15 % in wings twice as wide: truncation must neither bite nor be overdone."""
    shape = (360, 400)
    errors = []
    for seed in range(3):
        light = 130.0 * gaussian_light(shape, 200.3, 180.6, 8.0)
        light += 130.0 * (0.15 / 0.85) / 4.0 * gaussian_light(shape, 200.3, 180.6, 16.0)
        measured = measure_psf(frame_of(light, np.random.default_rng(seed)), psf_camera(shape), 0.1)
        errors.append(relative(measured, math.pi * (0.85 * 64.0 + 0.15 * 256.0)))
    assert all(abs(error) < 3.0 * doubt for error, doubt in errors)
    # a gaussian's wings would leave 5 % of A_sigma out; each image is uncertain by 2 %
    assert abs(np.mean([error for error, _ in errors])) < 0.03


def test_law_and_dark_of_the_camera_are_applied():
    """A camera whose response goes as light^(1 / 1.2), with 20 ADU in the dark, sees the same spot."""
    law = RadiometricLaw(1.2, -1.2, 0.0)
    rng = np.random.default_rng(5)
    intensity = 0.7 * elliptic(150.0, 120.0, 9.0, 7.0, 0.5) + 0.02
    adu = 20.0 + 235.0 * intensity ** (1.0 / 1.2)
    frame = np.clip(np.rint(adu + rng.normal(0.0, 0.8, adu.shape)), 0, 255).astype(np.uint8)
    dark = DarkModel(15.0, 50.0, np.zeros((0, 2), dtype=np.int64))
    camera = psf_camera(law=law, dark=dark)
    assert abs(relative(measure_psf(frame, camera, 0.1), math.pi * 63.0)[0]) < 0.02
    # taken for a linear camera's the same frame shows a spot that is 20 % too large
    assert relative(measure_psf(frame, CAMERA, 0.1), math.pi * 63.0)[0] > 0.1


def test_sixteen_bit_and_colour():
    light = 9000.0 * elliptic(150.0, 120.0, 9.0, 7.0, 0.5)
    rng = np.random.default_rng(6)
    frame = frame_of(light, rng, (300.0, 0.0, 0.0, 0.0), bits=16, read_noise_adu=20.0, electrons_per_adu=1.0)
    deep = psf_camera(full_scale_adu=16383.0)
    assert abs(relative(measure_psf(frame, deep, 0.1), math.pi * 63.0)[0]) < 0.02
    colours = np.stack([frame_of(light / 80.0, rng) for _ in range(3)], axis=-1)
    assert abs(relative(measure_psf(colours, CAMERA, 0.1), math.pi * 63.0)[0]) < 0.02
    colours[100, 200] = (20, 250, 30)  # a hot pixel, in one colour
    assert abs(relative(measure_psf(colours, CAMERA, 0.1), math.pi * 63.0)[0]) < 0.02


@pytest.mark.parametrize(
    ("light", "words"),
    [
        (np.zeros(SHAPE), "no star in the image"),
        (np.full(SHAPE, 5000.0), "most of the image is saturated"),
        (400.0 * gaussian_light(SHAPE, 150.0, 120.0, 8.0), "saturated"),
        (100.0 * gaussian_light(SHAPE, 10.0, 120.0, 8.0), "edge of the image"),
        (100.0 * gaussian_light(SHAPE, 28.0, 120.0, 8.0), "edge of the image"),
        (
            100.0 * gaussian_light(SHAPE, 80.0, 120.0, 6.0) + 60.0 * gaussian_light(SHAPE, 200.0, 120.0, 6.0),
            "several spots",
        ),
        (1.2 * gaussian_light(SHAPE, 150.0, 120.0, 6.0), "too faint"),
        (100.0 * gaussian_light(SHAPE, 150.2, 120.1, 0.9), "too sharp"),
        (100.0 * gaussian_light(SHAPE, 150.0, 120.0, 46.0), "edge of the image|another star"),
    ],
    ids=[
        "empty",
        "saturated all over",
        "saturated",
        "cut",
        "close to the edge",
        "two stars",
        "faint",
        "sharp",
        "larger than the field",
    ],
)
def test_what_cannot_be_measured_is_refused(light, words):
    with pytest.raises(DataQualityError, match=words):
        measure_psf(frame_of(light, np.random.default_rng(7)), CAMERA, 0.1)


def test_frame_of_another_camera_is_refused():
    with pytest.raises(ConfigError, match="240 rows"):
        measure_psf(np.zeros((100, 100), dtype=np.uint8), CAMERA, 0.1)


def test_noise_cut_off_at_zero_makes_it_less_certain():
    light = 100.0 * gaussian_light(SHAPE, 150.0, 120.0, 8.0)
    dark = measure_psf(frame_of(light, np.random.default_rng(8), (0.2, 0.0, 0.0, 0.0), offset_adu=0.0), CAMERA, 0.1)
    sound = measure_psf(frame_of(light, np.random.default_rng(8)), CAMERA, 0.1)
    assert dark.background.zero_share > 0.3
    assert dark.uncertainty_px2 > 2.0 * sound.uncertainty_px2
    assert abs(dark.a_sigma_px2 - math.pi * 64.0) < 3.0 * dark.uncertainty_px2


def test_hot_pixels_of_the_calibration_are_repaired():
    """Twenty neighbours that shine together look like no hot pixels; the calibration knows them."""
    frame = frame_of(100.0 * gaussian_light(SHAPE, 150.0, 120.0, 8.0), np.random.default_rng(9))
    hot = np.array([(x, y) for x in range(60, 65) for y in range(60, 64)])
    frame[hot[:, 1], hot[:, 0]] = 250
    known = replace(CAMERA, dark=DarkModel(0.0, 0.0, hot))
    assert measure_psf(frame, CAMERA, 0.1).others
    assert not measure_psf(frame, known, 0.1).others

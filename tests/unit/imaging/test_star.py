"""The star finder on frames whose truth is known: reasons, places, uncertainties and light."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from frames import (
    SIGMA_PX,
    disc_light,
    exposed,
    gaussian_light,
    moffat_light,
    streak_light,
)
from imaging_instruments import STAR_CAMERA, STAR_SIZE_RAD

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.imaging.star import DOMINANCE_SHARE, Star, StarRejection, star_finder

SHAPE = (360, 440)
FINDER = star_finder(STAR_CAMERA, STAR_SIZE_RAD, np.dtype(np.uint8))


def star_at(x, y, height=180.0, sigma_px=SIGMA_PX):
    return height * gaussian_light(SHAPE, x, y, sigma_px)


def outcome(light, seed, **camera):
    return FINDER.find(exposed(light, np.random.default_rng(seed), **camera))


def reasons(light, n=4, **camera):
    found = [outcome(light, seed, **camera) for seed in range(n)]
    return {None if isinstance(f, Star) else f.reason for f in found}


Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)


@pytest.mark.parametrize(
    ("light", "reason"),
    [
        (np.zeros(SHAPE), RejectReason.NO_STAR),
        (np.full(SHAPE, 60.0), RejectReason.NO_STAR),
        (star_at(200.3, 150.2, height=3.0), RejectReason.NO_STAR),
        (star_at(200.3, 150.2, height=6.7), RejectReason.STAR_UNDEREXPOSED),
        (star_at(200.3, 150.2, height=400.0), RejectReason.STAR_SATURATED),
        (star_at(200.3, 150.2, height=20_000.0), RejectReason.STAR_SATURATED),
        (np.full(SHAPE, 400.0), RejectReason.STAR_SATURATED),
        (star_at(200.3, 150.2, sigma_px=16.0), RejectReason.STAR_TOO_LARGE),
        (100.0 * np.exp(-((X - 220) ** 2 + (Y - 180) ** 2) / 2 / 40.0**2), RejectReason.STAR_TOO_LARGE),
        (star_at(5.2, 150.2), RejectReason.STAR_AT_EDGE),
        (star_at(-4.0, 150.2), RejectReason.STAR_AT_EDGE),
        (star_at(437.0, 357.0), RejectReason.STAR_AT_EDGE),
        (100.0 * streak_light(SHAPE, (0, 20), (440, 300), 3.0), RejectReason.STAR_STREAK),
        (150.0 * streak_light(SHAPE, (200, 100), (280, 150), 4.4), RejectReason.STAR_STREAK),
        (150.0 * streak_light(SHAPE, (200, 100), (222, 112), 4.4), RejectReason.STAR_STREAK),
        (star_at(100, 300, 150.0) + 80.0 * streak_light(SHAPE, (0, 20), (440, 200), 3.0), RejectReason.STAR_STREAK),
    ],
)
def test_reasons(light, reason):
    assert reasons(light) == {reason}


@pytest.mark.parametrize("distance_px", [12.0, 16.0, 20.0, 35.0, 60.0, 250.0])
def test_two_equal_stars_are_several_from_a_diameter_on(distance_px):
    """The diameter is 10.3 pixels; closer together they look like one somewhat longer star, with any method."""
    light = star_at(90.3, 80.2, 120.0) + star_at(90.3 + 0.8 * distance_px, 80.2 + 0.6 * distance_px, 120.0)
    assert reasons(light) == {RejectReason.SEVERAL_STARS}


@pytest.mark.parametrize("distance_px", [35.0, 60.0, 250.0])
@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.1, None), (0.75 * DOMINANCE_SHARE, None), (1.25 * DOMINANCE_SHARE, RejectReason.SEVERAL_STARS)],
)
def test_a_fainter_star_counts_by_its_share(distance_px, share, expected):
    light = star_at(90.3, 80.2) + star_at(90.3 + 0.8 * distance_px, 80.2 + 0.6 * distance_px, 180.0 * share)
    assert reasons(light) == {expected}


def test_pure_noise_raises_no_false_alarm():
    """5 sigma of one pixel over a star's 100 pixels is 38 sigma: none in 24 full frames of sky, bright or dark."""
    rng = np.random.default_rng(11)
    found = Counter()
    for sky_adu in (0.0, 3.0, 30.0, 120.0):
        for _ in range(6):
            result = FINDER.find(exposed(np.full((1920, 2560), sky_adu), rng, offset_adu=4.0))
            found[result.reason if isinstance(result, StarRejection) else None] += 1
    assert found == {RejectReason.NO_STAR: 24}


def with_hot_pixels(light, rng, n, height=230.0):
    hot = np.zeros(SHAPE)
    hot.flat[rng.choice(hot.size, n, replace=False)] = height
    return light + hot


def test_hot_pixels_neither_make_a_star_nor_hide_one():
    rng = np.random.default_rng(12)
    for _ in range(10):
        empty = FINDER.find(exposed(with_hot_pixels(np.zeros(SHAPE), rng, 60), rng))
        assert isinstance(empty, StarRejection)
        assert empty.reason is RejectReason.STAR_TOO_SMALL
        x, y = rng.uniform(60, 300, 2)
        star = FINDER.find(exposed(with_hot_pixels(star_at(x, y, 60.0), rng, 60), rng))
        assert isinstance(star, Star)
        assert np.hypot(star.x_px - x, star.y_px - y) < 5.0 * star.uncertainty_px


def test_a_hot_pixel_on_the_star_itself_is_seen():
    rng = np.random.default_rng(13)
    for dx, dy in [(3, 4), (-6, 2), (0, 9), (14, -3)]:
        light = star_at(200.3, 150.2, 110.0)
        light[150 + dy, 200 + dx] += 100.0
        star = FINDER.find(exposed(light, rng))
        assert isinstance(star, Star)
        assert np.hypot(star.x_px - 200.3, star.y_px - 150.2) < 4.0 * star.uncertainty_px


def test_a_cosmic_ray_does_not_hide_the_star():
    light = star_at(300.0, 200.0)
    light[100:103, 100:102] += 240.0
    assert reasons(light) == {None}
    assert reasons(light - star_at(300.0, 200.0)) == {RejectReason.STAR_TOO_SMALL}


SKIES = {
    "gradient": 60.0 * X / SHAPE[1] + 20.0 * Y / SHAPE[0],
    "moonlight": 70.0 * np.exp(-((X - 460.0) ** 2 + (Y + 40.0) ** 2) / 2 / 220.0**2),
}


def samples(make_light, n, seed, finder=FINDER, **camera):
    """Errors (n, 2) and uncertainties (n,) in pixels, and intensities (n,), of stars at random places."""
    rng = np.random.default_rng(seed)
    errors, uncertainties, intensities = [], [], []
    for _ in range(n):
        x, y = rng.uniform(100, 250, 2)
        star = finder.find(exposed(make_light(x, y), rng, **camera))
        assert isinstance(star, Star), star
        errors.append((star.x_px - x, star.y_px - y))
        uncertainties.append(star.uncertainty_px)
        intensities.append(star.intensity_sum)
    return np.array(errors), np.array(uncertainties), np.array(intensities)


TWELVE_BIT = star_finder(replace(STAR_CAMERA, full_scale_adu=4095.0), STAR_SIZE_RAD, np.dtype(np.uint16))

PULL_CASES = {
    "bright": (star_at, {}),
    "faint": (lambda x, y: star_at(x, y, 15.0), {}),
    "faint and quantised": (lambda x, y: star_at(x, y, 12.0), {"read_noise_adu": 0.1, "electrons_per_adu": 400.0}),
    "no offset": (star_at, {"offset_adu": 0.0}),
    "few electrons": (star_at, {"electrons_per_adu": 4.0}),
    "noisy camera": (star_at, {"read_noise_adu": 6.0, "offset_adu": 30.0}),
    "sharp": (lambda x, y: star_at(x, y, sigma_px=1.6), {}),
    "out of focus": (lambda x, y: star_at(x, y, sigma_px=10.0), {}),
    "wings": (lambda x, y: 180.0 * moffat_light(SHAPE, x, y, 10.0), {}),
    "elongated": (lambda x, y: 180.0 * gaussian_light(SHAPE, x, y, SIGMA_PX, 1.6, 0.6), {}),
    "gradient": (lambda x, y: star_at(x, y, 130.0) + SKIES["gradient"], {}),
    "moonlight": (lambda x, y: star_at(x, y, 130.0) + SKIES["moonlight"], {}),
    "twelve bit": (
        lambda x, y: star_at(x, y, 3000.0),
        {"finder": TWELVE_BIT, "bits": 16, "read_noise_adu": 10.0, "offset_adu": 150.0, "electrons_per_adu": 2.5},
    ),
}


@pytest.mark.parametrize("name", PULL_CASES)
def test_the_uncertainty_of_the_centre_is_true(name):
    """Pulls have unit width within 25 %; 2 x 60 of them give the width to 6.5 %."""
    make_light, camera = PULL_CASES[name]
    errors, uncertainties, _ = samples(make_light, 60, seed=20, **camera)
    pulls = errors / uncertainties[:, None]
    assert 0.75 < pulls.std() < 1.25
    # No bias either: the mean of 60 pulls is 0 to 0.13.
    assert np.abs(pulls.mean(axis=0)).max() < 0.5


def test_a_sharp_edged_disc_has_no_smaller_uncertainty_than_it_should():
    """A star far out of focus: its edge looks rough; the uncertainty may be too large, never too small."""
    errors, uncertainties, _ = samples(lambda x, y: 180.0 * disc_light(SHAPE, x, y, 20.0), 25, seed=21)
    assert (errors / uncertainties[:, None]).std() < 1.25


def test_the_centre_is_as_good_as_theory_allows():
    """Cramer-Rao: the information of every pixel of a gaussian star about its place, summed."""
    height, electrons_per_adu, read_noise_adu = 180.0, 40.0, 1.0
    light = star_at(200.0, 150.0, height)
    slope = light * (X - 200.0) / SIGMA_PX**2
    variance = read_noise_adu**2 + 1.0 / 12.0 + light / electrons_per_adu
    best_px = (slope**2 / variance).sum() ** -0.5
    errors, uncertainties, _ = samples(star_at, 150, seed=22)
    # 300 errors give their rms to 4 %.
    assert errors.std() < 1.12 * best_px
    assert uncertainties.mean() == pytest.approx(best_px, rel=0.08)


def test_the_intensity_is_the_sum_of_the_law_over_the_stars_pixels():
    """Without noise and sky the sum of C**1.2 is that of the light itself; with both it scatters around it."""
    light = star_at(200.3, 150.2)
    expected = ((light / 255.0) ** 1.2).sum()
    _, _, dark_sky = samples(star_at, 40, seed=23, offset_adu=0.0, read_noise_adu=0.3)
    assert dark_sky.mean() == pytest.approx(expected, rel=0.02)


def test_the_intensity_of_a_linear_camera_does_not_know_the_sky():
    linear = replace(STAR_CAMERA, law=replace(STAR_CAMERA.law, r_resp=1.0))
    finder = star_finder(linear, STAR_SIZE_RAD, np.dtype(np.uint8))
    expected = (star_at(200.3, 150.2, 130.0) / 255.0).sum()
    for sky, tolerance in ((np.zeros(SHAPE), 0.004), (SKIES["gradient"], 0.004), (SKIES["moonlight"], 0.01)):
        _, _, intensity = samples(lambda x, y, sky=sky: star_at(x, y, 130.0) + sky, 30, seed=24, finder=finder)
        # 1300 pixels of 1 to 2 ADU noise on 15 400 ADU: 0.4 %, of 30 stars 0.1 %. Moonlight half a degree wide is
        # curved: a plane around the star is up to 0.1 ADU off.
        assert intensity.mean() == pytest.approx(expected, rel=tolerance)


def test_diameters_are_full_widths_at_half_maximum():
    for fwhm_px in (5.0, 10.0, 22.0):
        star = outcome(star_at(200.3, 150.2, sigma_px=fwhm_px / 2.3548), 1)
        assert isinstance(star, Star)
        assert star.diameter_px == pytest.approx(fwhm_px, abs=0.3)


@pytest.mark.parametrize("star_size_px", [3.0, 6.0, 20.0, 45.0])
def test_cameras_of_other_plate_scales(star_size_px):
    """Everything follows the star's size in pixels."""
    camera = replace(STAR_CAMERA, plate_scale_rad=STAR_SIZE_RAD / star_size_px)
    finder = star_finder(camera, STAR_SIZE_RAD, np.dtype(np.uint8))
    rng = np.random.default_rng(30)
    shape = (600, 700)
    for _ in range(5):
        x, y = rng.uniform(230, 370, 2)
        star = finder.find(exposed(180.0 * gaussian_light(shape, x, y, star_size_px / 2.3548), rng))
        assert isinstance(star, Star), star
        assert np.hypot(star.x_px - x, star.y_px - y) < 4.5 * star.uncertainty_px
    assert isinstance(finder.find(exposed(np.zeros(shape), rng)), StarRejection)


def test_every_rejection_says_where_or_how_much():
    for light in (np.zeros(SHAPE), star_at(5.0, 150.0), star_at(200.0, 150.0, 400.0)):
        rejection = outcome(light, 1)
        assert isinstance(rejection, StarRejection)
        assert any(character.isdigit() for character in rejection.detail)


def test_a_frame_without_room_for_a_star_is_refused():
    with pytest.raises(ConfigError, match="60 x 50 pixel is too small"):
        FINDER.find(np.zeros((50, 60), np.uint8))

"""The twin as a whole: what its images show, that they repeat, and that every fault shows in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from twins import CALM, STILL, aligned_twin, pair, quiet, small_twin

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Camera
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.twin.faults import CATALOGUE, DRIVE_CATALOGUE
from namod_ctl.twin.settings import (
    REFLECTOR_CAMERA,
    STAR_CAMERA,
    FaultSpec,
    ReflectorSettings,
    SkySettings,
    TwinSettings,
)

BRIGHT = 0.8 * 255


def light_of_facets(twin, image, exposure_s):
    """Mean light over each facet's polygon, by the law in closed form."""
    law = twin.instrument.reflector_camera.law
    light = (image / 255.0) ** law.r_resp * exposure_s**law.r_expo * 10.0**law.r_const
    flat = light.reshape(-1, 3).mean(axis=1)
    return np.array([flat[p.index].mean() for p in twin._reflector_frames._pixels])


def test_a_star_of_magnitude_0_is_as_bright_as_the_settings_say() -> None:
    clear = SkySettings(reference_star="Vega", extinction_mag=0.0, scintillation=0.0)
    star, reflector = pair(aligned_twin(sky=clear), STAR_CAMERA.exposure_at_mag0_s, REFLECTOR_CAMERA.exposure_at_mag0_s)
    vega = 10.0 ** (-0.4 * 0.03)
    assert star.max() == pytest.approx(BRIGHT * vega ** (1 / 1.2), abs=3)
    grey = reflector.astype(float).mean(axis=2)
    lit = grey[grey > 0.5 * grey.max()]  # a point of a facet is lit or not
    assert np.median(lit) == pytest.approx(BRIGHT * vega ** (1 / 1.03), rel=0.05)


def test_the_star_stands_where_the_telescope_frame_says() -> None:
    twin = aligned_twin(telescope=replace(STILL, centre_rad=(deg_to_rad(0.1234), deg_to_rad(-0.2))))
    star, _ = pair(twin)
    y, x = np.indices(star.shape)
    weight = star.astype(float) ** twin.instrument.star_camera.law.r_resp
    centre = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
    theta = twin.instrument.star_camera.theta_of_pixel(centre)
    np.testing.assert_allclose(theta, deg_to_rad(np.array([0.1234, -0.2])), atol=0.05 * 4.25e-5)  # 0.05 pixel


def test_light_on_a_facet_is_proportional_to_the_star() -> None:
    """Stars 6.3 times apart, at other exposures: the recovered light of every facet is 6.3 times apart."""
    dark = replace(quiet(REFLECTOR_CAMERA), background_share=0.0)
    recovered = {}
    for name, exposure_s in (("Vega", 0.2), ("Polaris", 0.9)):
        twin = aligned_twin(
            sky=replace(CALM, reference_star=name, extinction_mag=0.0),
            reflector=ReflectorSettings(misalignment_rad=arcmin_to_rad(1.0), sag_rad=0.0),  # the stars' heights differ
            reflector_camera=dark,
        )
        _, image = pair(twin, 0.02, exposure_s)
        assert image.max() < 255
        recovered[name] = light_of_facets(twin, image, exposure_s)
    is_bright = recovered["Vega"] > 0.2 * recovered["Vega"].max()
    assert is_bright.sum() > 10
    ratio = (recovered["Polaris"] / recovered["Vega"])[is_bright]
    assert ratio == pytest.approx(10 ** (-0.4 * (2.02 - 0.03)), rel=0.01)


def test_a_facet_is_bright_in_true_theta_and_dark_elsewhere() -> None:
    stiff = replace(ReflectorSettings(), sag_rad=0.0, drift_rad_per_kelvin=0.0)
    truth = small_twin(reflector=stiff).true_theta_rad
    for facet in (0, 7):
        light = []
        for away_rad in (0.0, arcmin_to_rad(20.0)):
            x_rad, y_rad = truth[facet] + (away_rad, 0.0)
            twin = small_twin(reflector=stiff, telescope=replace(STILL, centre_rad=(float(x_rad), float(y_rad))))
            light.append(light_of_facets(twin, pair(twin, 0.02, 0.2)[1], 0.2)[facet])
        assert light[0] > 20.0 * light[1]


def test_a_moving_star_is_drawn_out() -> None:
    fast = replace(STILL, radius_rad=deg_to_rad(0.3), spacing_rad=deg_to_rad(0.3), speed_rad_per_s=deg_to_rad(0.2))
    widths = []
    for twin in (aligned_twin(), aligned_twin(telescope=fast)):
        twin.update(60.0)
        star, _ = pair(twin, star_s=1.0)
        widths.append(np.count_nonzero(star > 20))
    assert widths[1] > 1.5 * widths[0]


@pytest.mark.parametrize("other", [{"seed": 2}, {"faults": (FaultSpec("hot_pixels"),)}])
def test_one_seed_makes_one_run(other: dict) -> None:
    def images(**changes) -> list[np.ndarray]:
        twin = small_twin(**changes)
        return [image for _ in range(3) for image in pair(twin)]

    first, again, different = images(), images(), images(**other)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(first, different, strict=True))


def test_frames_do_not_depend_on_the_order_of_fetching() -> None:
    """Two threads fetch from two cameras: which is first is chance, also when facets sag meanwhile."""
    sagging = ReflectorSettings(sag_rad=deg_to_rad(1.0), drift_rad_per_kelvin=deg_to_rad(10.0))
    one, other = small_twin(reflector=sagging), small_twin(reflector=sagging)
    for twin in (one, other):
        twin.update(0.98)
    star, reflector = pair(one)
    other.star_camera.start(0.02)
    other.reflector_camera.start(0.05)
    np.testing.assert_array_equal(reflector, other.reflector_camera.fetch(1.0).image)
    np.testing.assert_array_equal(star, other.star_camera.fetch(1.0).image)


VISIBLE = {
    # What a fault does to the star frame and to the reflector frame; "other": they differ.
    "clouds": ({"factor": 30.0, "period_s": 5.0}, "darker", "darker"),
    "clouds_total": ({}, "darker", "darker"),
    "second_star": ({"offset_x_rad": 2e-3, "offset_y_rad": 1e-3}, "brighter", "other"),
    "satellite": ({"miss_rad": 2e-3}, "brighter", "other"),
    "aircraft": ({"miss_rad": 1e-3}, "brighter", "other"),
    "moonlight": ({}, "brighter", "brighter"),
    "twilight": ({"level_share": 0.01}, "brighter", "brighter"),
    "dew": ({"camera": "both", "decay_s": 1.0}, "darker", "darker"),
    "dropped_frame": ({}, CommunicationError, CommunicationError),
    "torn_frame": ({}, CommunicationError, CommunicationError),
    "hot_pixels": ({"count": 3000.0, "adu_per_s": 4000.0}, "brighter", "brighter"),
    "telescope_jump": ({"x_rad": 3e-3, "y_rad": 1e-3}, "other", "other"),
    "camera_lost": ({"camera": "both"}, DeviceFaultError, DeviceFaultError),
}


def begun_and_fetched(camera: Camera) -> np.ndarray:
    camera.start(0.05)
    return camera.fetch(1.0).image


@pytest.mark.parametrize("name", sorted(set(CATALOGUE) - set(DRIVE_CATALOGUE) - {"clock_set_back"}))
def test_every_fault_shows_in_the_frames(name: str) -> None:
    params, *expected = VISIBLE[name]
    misaligned = ReflectorSettings()  # some facet is lit wherever a light stands
    healthy, faulty = aligned_twin(reflector=misaligned), aligned_twin(reflector=misaligned)
    faulty.inject(name, start_s=0.0, duration_s=60.0, **params)
    for role, effect in zip(("star_camera", "reflector_camera"), expected, strict=True):
        for twin in (healthy, faulty):
            twin.update(2.0)
        sums, images = [], []
        for twin in (healthy, faulty):
            camera = getattr(twin, role)
            if isinstance(effect, type) and twin is faulty:
                with pytest.raises(effect):  # when it is begun or when it is fetched
                    begun_and_fetched(camera)
                return
            images.append(begun_and_fetched(camera).astype(int))
            sums.append(images[-1].sum())
        assert not np.array_equal(*images)
        if effect == "brighter":
            assert sums[1] > 1.02 * sums[0]
        if effect == "darker":
            assert sums[1] < 0.8 * sums[0]


def test_a_fault_ends() -> None:
    twin, healthy = aligned_twin(), aligned_twin()
    twin.inject("clouds_total", start_s=0.0, duration_s=1.0)
    assert pair(twin)[0].max() < 20
    for each in (twin, healthy):
        each.update(1.0)
    assert np.abs(pair(twin)[0].astype(int) - pair(healthy)[0]).max() <= 1


def test_the_wall_clock_is_set_back_and_the_cameras_clock_is_not() -> None:
    twin = small_twin()
    before, monotonic = twin.wall_clock.now(), twin.clock.monotonic_s()
    twin.inject("clock_set_back", start_s=1.0, by_s=3600.0)
    twin.update(2.0)
    assert (twin.wall_clock.now() - before).total_seconds() == pytest.approx(2.0 - 3600.0)
    assert twin.clock.monotonic_s() == monotonic + 2.0


@pytest.mark.parametrize(
    ("name", "params", "told"),
    [
        ("cloud", {}, "clouds_total"),
        ("clouds", {"thickness": 2.0}, "factor"),
        ("dew", {"camera": "left"}, "reflector"),
        ("clouds", {"factor": float("nan")}, "finite"),
        ("clouds", {"factor": "thirty"}, "finite"),
    ],
)
def test_a_fault_that_is_none_is_refused_and_the_message_helps(name: str, params: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        small_twin().inject(name, **params)


def test_a_fault_needs_a_sound_time() -> None:
    for spec in (FaultSpec("clouds", -1.0), FaultSpec("clouds", 0.0, 0.0), FaultSpec("clouds", float("nan"))):
        with pytest.raises(ConfigError, match="start_s"):
            small_twin(faults=(spec,))


def test_a_saturated_star_blooms() -> None:
    twin = aligned_twin(star_camera=replace(quiet(STAR_CAMERA), blooming_share=0.2))
    star, _ = pair(twin, star_s=3.0)
    height = np.flatnonzero((star == 255).any(axis=1)).size
    width = np.flatnonzero((star == 255).any(axis=0)).size
    assert height > 1.3 * width


@pytest.mark.parametrize("preset", ["fact", "mini_fact", "mst_like", "lst_like"])
def test_every_preset_makes_a_twin_whose_aligned_facets_all_light_up(preset: str) -> None:
    twin = build_twin(load_config(preset), TwinSettings(sky=CALM, telescope=STILL), seed=4)
    twin.apply_correction(-twin.true_theta_rad / 2.0)
    twin.apply_correction(-twin.true_theta_rad / 2.0)  # the first one leaves a few percent, by obliquity
    twin.reflector_camera.start(0.05)
    light = light_of_facets(twin, twin.reflector_camera.fetch(1.0).image, 0.05)
    assert light.min() > 0.03 * light.max()  # the scene alone makes 0.0002
    assert twin.star_camera.exposure_range_s[1] == 3.0


def test_a_moonlit_sky_slopes_as_the_law_says() -> None:
    """Level and slope 0.006 from edge to edge, of a pixel of 80 % of full scale at 50 ms, towards 45.8 deg."""
    twin = aligned_twin(star_camera=replace(quiet(STAR_CAMERA), read_noise_adu=0.6, background_share=0.0))
    twin.inject("moonlight")
    star, _ = pair(twin, STAR_CAMERA.exposure_at_mag0_s)
    rows, columns = star.shape
    for x, y in ((-0.4, -0.3), (0.4, -0.3), (0.4, 0.3)):  # shares of the width; the image's y runs down
        row, column = int(rows / 2 + y * columns), int(columns / 2 + x * columns)
        seen = star[row - 20 : row + 20, column - 20 : column + 20].astype(float).mean()
        share = 0.006 + 0.006 * (x * np.cos(0.8) - y * np.sin(0.8))
        assert seen == pytest.approx(BRIGHT * share ** (1.0 / 1.2), abs=0.25)

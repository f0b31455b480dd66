"""The exposure law against light that follows the published radiometric laws, solved here for the response."""

from __future__ import annotations

import math

import numpy as np
import pytest
from frames import exposed, gaussian_light
from hypothesis import given, settings
from hypothesis import strategies as st
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, resized
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.exposure import (
    ExposureVerdict,
    exposure_rule,
    frame_statistics,
    judge_exposure,
    next_exposure_s,
)
from namod_ctl.optics.camera_model import CameraModel

STAR = resized(STAR_CAMERA, 160, 120)
REFLECTOR = resized(REFLECTOR_CAMERA, 160, 120)
SHORTEST_S, LONGEST_S = 1e-3, 3.0
MAX_RETAKES = 3


def response_adu(camera: CameraModel, needed_s: float, exposure_s: float) -> float:
    """Response, without a limit, of light that makes 80 % of full scale in `needed_s`.

    log10(I) is r_resp log10(C) + r_expo log10(T) + r_const; equal I at both exposures gives C.
    """
    law = camera.law
    log_intensity = law.r_resp * math.log10(0.8) + law.r_expo * math.log10(needed_s) + law.r_const
    log_share = (log_intensity - law.r_expo * math.log10(exposure_s) - law.r_const) / law.r_resp
    return 255.0 * 10.0**log_share


def star_frame(needed_s: float, exposure_s: float, seed: int, offset_adu: float = 2.0) -> NDArray[np.uint8]:
    height = response_adu(STAR, needed_s, exposure_s)
    light = np.minimum(height * gaussian_light((120, 160), 80.3, 60.4, 4.36), 1e4)
    return exposed(light, np.random.default_rng(seed), offset_adu)


def facets_frame(needed_s: float, exposure_s: float, seed: int, offset_adu: float = 2.0) -> NDArray[np.uint8]:
    """Four facets whose light differs by up to three times, in colour."""
    height = response_adu(REFLECTOR, needed_s, exposure_s)
    light = np.zeros((120, 160))
    for n, share in enumerate((1.0, 0.7, 0.5, 0.33)):
        light[30 + 40 * (n // 2) : 60 + 40 * (n // 2), 30 + 60 * (n % 2) : 70 + 60 * (n % 2)] = share * height
    frame = exposed(np.minimum(light, 1e4), np.random.default_rng(seed), offset_adu)
    return np.repeat(frame[:, :, None], 3, axis=2)


CAMERAS = {"star": (STAR, star_frame), "facets": (REFLECTOR, facets_frame)}


@pytest.mark.parametrize("kind", CAMERAS)
@given(
    log_start=st.floats(math.log(SHORTEST_S), math.log(LONGEST_S)),
    log_needed=st.floats(math.log(SHORTEST_S), math.log(LONGEST_S)),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=150, deadline=None)
def test_it_recovers_from_any_start(kind: str, log_start: float, log_needed: float, seed: int) -> None:
    camera, scene = CAMERAS[kind]
    rule = exposure_rule(camera, SHORTEST_S, LONGEST_S)
    exposure_s, needed_s = math.exp(log_start), math.exp(log_needed)
    n_retakes = 0
    while True:
        statistics = frame_statistics(scene(needed_s, exposure_s, seed + n_retakes), camera)
        verdict = judge_exposure(statistics, exposure_s, rule)
        exposure_s = next_exposure_s(statistics, exposure_s, rule)
        if verdict is ExposureVerdict.GOOD:
            break
        n_retakes += 1
        assert n_retakes <= MAX_RETAKES
    # and what it then asks for is near the target: 80 % of full scale, or an end of the range
    for n in range(2):
        statistics = frame_statistics(scene(needed_s, exposure_s, seed + 10 + n), camera)
        exposure_s = next_exposure_s(statistics, exposure_s, rule)
    assert exposure_s == pytest.approx(min(max(needed_s, SHORTEST_S), LONGEST_S), rel=0.12)


@pytest.mark.parametrize("target", [0.5, 0.8, 0.9])
def test_the_brightest_pixel_is_kept_where_the_user_wants_it(target: float) -> None:
    rule = exposure_rule(STAR, SHORTEST_S, LONGEST_S, target_share=target)
    exposure_s = 0.05
    for seed in range(4):
        exposure_s = next_exposure_s(frame_statistics(star_frame(0.2, exposure_s, seed), STAR), exposure_s, rule)
    assert response_adu(STAR, 0.2, exposure_s) == pytest.approx(255.0 * target, rel=0.06)


def test_a_facet_that_is_not_lit_gets_the_longest_exposure_and_counts() -> None:
    rule = exposure_rule(REFLECTOR, SHORTEST_S, LONGEST_S)
    exposure_s = SHORTEST_S
    for seed in range(MAX_RETAKES + 1):
        frame = exposed(np.zeros((120, 160)), np.random.default_rng(seed), offset_adu=2.0)
        statistics = frame_statistics(frame, REFLECTOR)
        if judge_exposure(statistics, exposure_s, rule) is ExposureVerdict.GOOD:
            break
        exposure_s = next_exposure_s(statistics, exposure_s, rule)
    else:
        pytest.fail("a dark reflector was never accepted")
    assert exposure_s == LONGEST_S
    assert next_exposure_s(statistics, exposure_s, rule) == LONGEST_S


def test_a_bright_sky_is_not_mistaken_for_a_dark_frame() -> None:
    """Moonlight at 60 of 255 and no star: 30 times the exposure would saturate the sky."""
    rule = exposure_rule(STAR, SHORTEST_S, LONGEST_S)
    statistics = frame_statistics(exposed(np.full((120, 160), 58.0), np.random.default_rng(1), 2.0), STAR)
    assert next_exposure_s(statistics, 0.1, rule) <= 0.1 * 255.0 / 60.0


def test_a_star_out_of_a_cloud() -> None:
    """Behind the cloud nothing is seen at 3 s; then the star needs 20 ms."""
    rule = exposure_rule(STAR, SHORTEST_S, LONGEST_S)
    exposure_s, n_frames = LONGEST_S, 0
    while True:
        statistics = frame_statistics(star_frame(0.02, exposure_s, n_frames), STAR)
        if judge_exposure(statistics, exposure_s, rule) is ExposureVerdict.GOOD:
            break
        exposure_s = next_exposure_s(statistics, exposure_s, rule)
        n_frames += 1
    assert n_frames <= MAX_RETAKES


@pytest.mark.parametrize(
    "cluster", [[(20, 30)], [(20, 30), (20, 31)], [(20, 30), (21, 30)], [(20, 30), (90, 7), (0, 0)]]
)
def test_hot_pixels_do_not_count(cluster: list[tuple[int, int]]) -> None:
    frame = star_frame(0.2, 0.1, 3)
    clean = frame_statistics(frame, STAR)
    for row, column in cluster:
        frame[row, column] = 255
    assert frame_statistics(frame, STAR) == clean


@pytest.mark.parametrize("needed_s", [0.05, 0.1, 0.2])
def test_hot_pixels_on_a_lit_facet_do_not_count(needed_s: float) -> None:
    """One pixel in 250, as at 3000 hot pixels in a small camera: wherever the brightest place is, one is near."""
    frame = facets_frame(needed_s, 0.05, 3)
    clean = frame_statistics(frame, REFLECTOR).brightest_adu
    frame.reshape(-1, 3)[np.random.default_rng(2).choice(120 * 160, 77, replace=False)] = 255
    assert frame_statistics(frame, REFLECTOR).brightest_adu == pytest.approx(clean, rel=0.06)


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5])
def test_the_sharpest_star_counts_in_full(shift: float) -> None:
    light = 180.0 * gaussian_light((120, 160), 80.0 + shift, 60.0 + shift, 1.75 / 2.3548)
    frame = exposed(light, np.random.default_rng(1), offset_adu=2.0)
    assert frame_statistics(frame, STAR).brightest_adu == frame.max()


def test_only_the_region_counts() -> None:
    frame = facets_frame(0.2, 0.1, 3)
    region = np.full((120, 160), 255, dtype=np.uint8)
    region[:20] = 0
    clean = frame_statistics(frame, REFLECTOR, region)
    frame[5:12, 40:60] = 255  # a lamp beside the dish
    assert frame_statistics(frame, REFLECTOR, region).brightest_adu == clean.brightest_adu
    assert frame_statistics(frame, REFLECTOR).brightest_adu == 255.0


def test_the_brightest_channel_of_a_colour_frame_counts() -> None:
    frame = np.zeros((120, 160, 3), np.uint8)
    frame[40:60, 40:60] = (30, 90, 200)
    assert frame_statistics(frame, REFLECTOR).brightest_adu == 200.0


def test_what_cannot_be_exposed_shorter_is_left_to_the_measurement() -> None:
    rule = exposure_rule(STAR, SHORTEST_S, LONGEST_S)
    statistics = frame_statistics(star_frame(1e-5, SHORTEST_S, 1), STAR)
    assert judge_exposure(statistics, SHORTEST_S, rule) is ExposureVerdict.GOOD
    assert judge_exposure(statistics, 2.0 * SHORTEST_S, rule) is ExposureVerdict.SATURATED


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"target_share": 0.99}, "saturation"), ({"target_share": 0.1}, "0.2"), ({"longest_s": 0.0}, "range")],
)
def test_wishes_that_cannot_be_met(changes: dict[str, float], named: str) -> None:
    arguments = {"shortest_s": SHORTEST_S, "longest_s": LONGEST_S} | changes
    with pytest.raises(ConfigError, match=named):
        exposure_rule(STAR, **arguments)

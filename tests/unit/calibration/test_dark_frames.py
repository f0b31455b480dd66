"""Dark frames: bias, rate, noise and hot pixels against what the frames were made of, and light that is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from namod_ctl.calibration.lamp.dark_frames import DarkFrame, measure_dark_frames
from namod_ctl.calibration.lamp.dark_level import dark_level
from namod_ctl.core.errors import DataQualityError

ROWS, COLUMNS = 96, 128
EXPOSURES_S = (0.001, 0.1, 1.0, 3.0)
HOT = {(10, 20): (0.0, 60.0), (50, 64): (40.0, 0.0), (90, 5): (5.0, 12.0), (0, 127): (0.0, 200.0)}
"""(row, column): offset in adu, rate in adu per s. The last one saturates at 3 s."""


def dark_frames(
    bias_adu: float = 8.0,
    rate_adu_per_s: float = 1.5,
    noise_adu: float = 1.2,
    n_frames: int = 5,
    n_cosmic: int = 6,
    channels: tuple[int, ...] = (),
) -> list[DarkFrame]:
    rng = np.random.default_rng(11)
    pattern = 0.5 * rng.standard_normal((ROWS, COLUMNS, *channels))
    frames = []
    for exposure_s in EXPOSURES_S:
        for number in range(n_frames):
            adu = bias_adu + rate_adu_per_s * exposure_s + pattern
            for (row, column), (offset, rate) in HOT.items():
                adu[row, column] += offset + rate * exposure_s
            adu = adu + noise_adu * rng.standard_normal(adu.shape)
            for _ in range(n_cosmic):
                adu[rng.integers(20, 80), rng.integers(COLUMNS)] += 120.0
            image = np.clip(np.rint(adu), 0, 255).astype(np.uint8)
            frames.append(DarkFrame(f"dark_{exposure_s:g}_{number}.png", image, exposure_s))
    return frames


def test_levels_noise_and_hot_pixels_are_recovered() -> None:
    found = measure_dark_frames(dark_frames(), 255.0)
    assert found.bias_adu == pytest.approx(8.0, abs=0.05)
    assert found.rate_adu_per_s == pytest.approx(1.5, abs=0.03)
    assert abs(found.bias_adu - 8.0) < 4.0 * found.bias_uncertainty_adu
    assert found.read_noise_adu == pytest.approx(1.2, rel=0.05)
    assert found.fixed_pattern_adu == pytest.approx(0.5, rel=0.15)
    at = {(int(y), int(x)): i for i, (x, y) in enumerate(found.hot_xy)}
    assert at.keys() == HOT.keys()
    for place, (offset, rate) in HOT.items():
        assert found.hot_offset_adu[at[place]] == pytest.approx(offset, abs=2.5)
        assert found.hot_rate_adu_per_s[at[place]] == pytest.approx(rate, abs=1.5)
    assert found.n_cosmic_rays == pytest.approx(6 * 20, abs=6)


def test_colour_frames_have_the_same_hot_pixels() -> None:
    found = measure_dark_frames(dark_frames(channels=(3,)), 255.0)
    assert {(int(y), int(x)) for x, y in found.hot_xy} == HOT.keys()
    assert found.bias_adu == pytest.approx(8.0, abs=0.05)


def test_cosmic_rays_in_one_frame_of_few_pixels_are_no_light() -> None:
    frames = dark_frames(n_cosmic=0)
    hit = frames[-2].image.copy()
    rng = np.random.default_rng(12)
    hit[rng.integers(20, 80, 60), rng.integers(0, COLUMNS, 60)] = 220
    frames[-2] = replace(frames[-2], image=hit)
    found = measure_dark_frames(frames, 255.0)
    assert found.bias_adu == pytest.approx(8.0, abs=0.05)
    assert found.n_cosmic_rays == pytest.approx(60, abs=4)
    assert len(found.hot_xy) == len(HOT)


@pytest.mark.parametrize("level", [-0.4, 0.0, 0.3, 0.8, 2.0])
def test_level_is_found_behind_the_floor_at_zero(level: float) -> None:
    rng = np.random.default_rng(3)
    cut = np.clip(np.rint(level + 0.7 * rng.standard_normal(40_000)), 0, 255).astype(np.uint8)
    found = dark_level(cut)
    assert found.level_adu == pytest.approx(level, abs=0.04)
    assert abs(found.level_adu - level) < 4.0 * found.uncertainty_adu
    assert found.noise_adu == pytest.approx(0.7, abs=0.03)


def test_camera_that_shows_nothing_in_the_dark() -> None:
    frames = [replace(frame, image=np.zeros_like(frame.image)) for frame in dark_frames()]
    found = measure_dark_frames(frames, 255.0)
    assert found.is_lost
    assert found.bias_adu == 0.0
    assert len(found.hot_xy) == 0


def test_one_exposure_tells_no_rate() -> None:
    found = measure_dark_frames([frame for frame in dark_frames() if frame.exposure_s == 1.0], 255.0)
    assert not found.has_rate
    assert found.rate_adu_per_s == 0.0
    assert found.bias_adu == pytest.approx(9.5, abs=0.05)


def _with_light(frames: list[DarkFrame], light: np.ndarray, which: slice) -> list[DarkFrame]:
    lit = []
    for number, frame in enumerate(frames):
        is_lit = number in range(len(frames))[which]
        adu = frame.image + (light * frame.exposure_s if is_lit else 0.0 * light)
        lit.append(replace(frame, image=np.clip(np.rint(adu), 0, 255).astype(np.uint8)))
    return lit


def test_light_is_refused() -> None:
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    everywhere = np.ones((ROWS, COLUMNS))
    corner = 8.0 * np.exp(-(rows**2 + columns**2) / 30.0**2)
    star = 60.0 * np.exp(-((rows - 40) ** 2 + (columns - 90) ** 2) / 2.0 / 2.5**2)
    cases = {
        "grow by": _with_light(dark_frames(), 20.0 * everywhere, slice(None)),
        "other than the other frames": _with_light(dark_frames(), 5.0 * everywhere, slice(17, 18)),
        "light falls on part of the sensor": _with_light(dark_frames(), corner, slice(None)),
        "bright spots": _with_light(dark_frames(), star, slice(None)),
        "no dark frames": _with_light(dark_frames(), 200.0 * everywhere, slice(18, 20)),
    }
    for match, frames in cases.items():
        with pytest.raises(DataQualityError, match=match):
            measure_dark_frames(frames, 255.0)


def test_frames_of_two_cameras_and_too_few() -> None:
    frames = dark_frames()
    with pytest.raises(DataQualityError, match="several cameras"):
        measure_dark_frames([*frames, replace(frames[0], image=frames[0].image[:50])], 255.0)
    with pytest.raises(DataQualityError, match="2 dark frames are too few"):
        measure_dark_frames(frames[:2], 255.0)

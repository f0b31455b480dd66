"""Dark frames and hot pixels, against frames whose defects are known."""

import numpy as np
import pytest
from frames import exposed

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.dark import dark_of_frames, isolated_pixels, repair_pixels, subtract_dark

SHAPE = (120, 160)


def dark_light(rng):
    """A dark current that grows across the sensor, and thirty pixels with a large one."""
    light = np.broadcast_to(np.linspace(2.0, 12.0, SHAPE[1]), SHAPE).copy()
    hot = rng.choice(light.size, 30, replace=False)
    light.flat[hot] += rng.uniform(25.0, 300.0, 30)
    return light, hot


def test_the_hot_pixels_of_a_stack_are_found_and_no_others():
    rng = np.random.default_rng(5)
    light, hot = dark_light(rng)
    dark = dark_of_frames(np.stack([exposed(light, rng) for _ in range(10)]))
    np.testing.assert_array_equal(np.flatnonzero(dark.is_hot), np.sort(hot))


def test_a_flickering_pixel_is_hot_even_when_its_mean_is_not():
    rng = np.random.default_rng(6)
    frames = np.stack([exposed(np.full(SHAPE, 5.0), rng, offset_adu=40.0) for _ in range(16)])
    frames[::2, 50, 60], frames[1::2, 50, 60] = 20, 68
    assert dark_of_frames(frames).is_hot[50, 60]


def test_subtraction_leaves_the_light():
    """Mean light of 80 ADU on 19 200 pixels of 1.8 ADU noise is known to 0.02 ADU; a rounded dark adds at most 0.05."""
    rng = np.random.default_rng(7)
    light, _ = dark_light(rng)
    dark = dark_of_frames(np.stack([exposed(light, rng) for _ in range(25)]))
    frame = exposed(light + 80.0, rng)
    corrected = subtract_dark(frame, dark, 250.0)
    assert corrected.dtype == frame.dtype
    assert corrected.mean() == pytest.approx(80.0, abs=0.1)
    assert np.abs(corrected.astype(float) - 80.0).max() < 12.0


def test_saturated_pixels_stay_saturated_unless_they_are_hot():
    rng = np.random.default_rng(8)
    light, hot = dark_light(rng)
    dark = dark_of_frames(np.stack([exposed(light, rng) for _ in range(5)]))
    frame = exposed(light + 60.0, rng)
    frame[40:44, 50:54] = 255
    corrected = subtract_dark(frame, dark, 250.0)
    saturated = np.zeros(SHAPE, bool)
    saturated[40:44, 50:54] = True
    saturated.flat[hot] = False
    np.testing.assert_array_equal(corrected >= 250, saturated)


def test_repair_uses_good_neighbours_only_and_colours_apart():
    frame = np.zeros((9, 9, 3), np.uint8)
    frame[..., 0], frame[..., 1], frame[..., 2] = 10, 20, 30
    is_bad = np.zeros(frame.shape, bool)
    is_bad[4, 4], is_bad[4, 5], is_bad[0, 0, 1] = True, True, True
    frame[is_bad] = 255
    repaired = repair_pixels(frame, is_bad)
    np.testing.assert_array_equal(repaired, np.broadcast_to(np.array([10, 20, 30], np.uint8), frame.shape))


def test_repair_of_a_hole_larger_than_a_pixel():
    frame = np.tile(np.arange(40, dtype=np.uint16) * 10, (40, 1))
    is_bad = np.zeros(frame.shape, bool)
    is_bad[10:13, 20:23] = True
    broken = frame.copy()
    broken[is_bad] = 4000
    assert np.abs(repair_pixels(broken, is_bad).astype(int) - frame).max() <= 20


def test_repair_changes_nothing_else():
    frame = np.random.default_rng(9).integers(0, 255, SHAPE).astype(np.uint8)
    before = frame.copy()
    np.testing.assert_array_equal(repair_pixels(frame, np.zeros(SHAPE, bool)), before)
    is_bad = np.zeros(SHAPE, bool)
    is_bad[3, 4] = True
    changed = repair_pixels(frame, is_bad) != frame
    assert not changed[~is_bad].any()
    np.testing.assert_array_equal(frame, before)


def test_isolated_pixels_at_edge_and_inside_but_no_pair():
    frame = exposed(np.zeros(SHAPE), np.random.default_rng(10))
    frame[0, 0], frame[60, 70], frame[100, 20:22] = 60, 200, 200
    np.testing.assert_array_equal(np.argwhere(isolated_pixels(frame, 8.0, 1.0)), [[0, 0], [60, 70]])


def test_a_dark_of_another_mode_is_refused():
    dark = dark_of_frames(np.zeros((3, *SHAPE), np.uint8))
    with pytest.raises(ConfigError, match="uint16"):
        subtract_dark(np.zeros(SHAPE, np.uint16), dark, 250.0)


def test_no_dark_frames_are_refused():
    with pytest.raises(ConfigError, match="at least one"):
        dark_of_frames(np.zeros((0, *SHAPE), np.uint8))

"""The twin's cameras as the recorder meets them, and the faults that cameras have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from twins import pair, small_twin

from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.twin.settings import STAR_CAMERA


def test_the_twin_stands_behind_the_interfaces() -> None:
    twin = small_twin()
    camera: Camera = twin.star_camera
    clock: MonotonicClock = twin.clock
    assert "star" in camera.name
    assert camera.exposure_range_s == (1e-3, 3.0)
    clock.wait_s(2.0)
    assert clock.monotonic_s() == 2.0


def test_both_cameras_expose_at_the_same_time() -> None:
    twin = small_twin()
    twin.update(5.0)
    twin.star_camera.start(0.02)
    twin.reflector_camera.start(0.2)
    star, reflector = twin.star_camera.fetch(1.0), twin.reflector_camera.fetch(1.0)
    assert star.mid_exposure_s == pytest.approx(5.01)
    assert reflector.mid_exposure_s == pytest.approx(5.1)
    assert twin.clock.monotonic_s() == pytest.approx(5.2 + 0.015)  # the later end, and its latency
    assert star.image.shape == (320, 400)
    assert reflector.image.shape == (192, 256, 3)
    assert star.image.dtype == reflector.image.dtype == np.uint8


def test_exposures_come_in_the_cameras_steps_and_limits() -> None:
    twin = small_twin(star_camera=replace(STAR_CAMERA, exposure_step_s=1e-3))
    twin.star_camera.start(0.01234)
    assert twin.star_camera.fetch(1.0).exposure_s == pytest.approx(0.012)
    for exposure_s in (0.5e-3, 3.1, float("nan")):
        with pytest.raises(LimitError, match="exposure"):
            twin.star_camera.start(exposure_s)


def test_frames_are_counted_and_nothing_comes_without_a_start() -> None:
    twin = small_twin()
    frames = []
    for _ in range(2):
        twin.star_camera.start(0.01)
        frames.append(twin.star_camera.fetch(1.0).frame_id)
    assert frames == [1, 2]
    with pytest.raises(CommunicationError, match="begun"):
        twin.star_camera.fetch(1.0)
    twin.star_camera.start(0.01)
    twin.star_camera.close()
    twin.star_camera.close()
    with pytest.raises(CommunicationError):
        twin.star_camera.fetch(1.0)


def test_a_dropped_frame_costs_its_timeout_and_leaves_a_gap() -> None:
    twin = small_twin()
    twin.inject("dropped_frame", duration_s=0.1, camera="star")
    twin.star_camera.start(0.01)
    with pytest.raises(CommunicationError, match="no frame"):
        twin.star_camera.fetch(0.5)
    assert twin.clock.monotonic_s() == pytest.approx(0.51)
    twin.star_camera.start(0.01)
    assert twin.star_camera.fetch(0.5).frame_id == 2


def test_a_torn_frame_is_reported_or_shows() -> None:
    twin = small_twin()
    twin.inject("torn_frame", duration_s=1.0, camera="reflector")
    twin.reflector_camera.start(0.02)
    with pytest.raises(CommunicationError, match="incomplete"):
        twin.reflector_camera.fetch(1.0)
    twin.star_camera.start(0.02)
    assert twin.star_camera.fetch(1.0).image.any()
    silent = small_twin()
    silent.inject("torn_frame", is_reported=0.0)
    silent.reflector_camera.start(3.0)
    image = silent.reflector_camera.fetch(1.0).image
    dark_rows = np.flatnonzero(~image.any(axis=(1, 2)))
    assert 0.1 * 192 - 1 <= len(dark_rows) <= 0.8 * 192 + 1
    assert dark_rows[-1] == 191


def test_a_share_of_frames_gets_lost() -> None:
    twin = small_twin()
    twin.inject("dropped_frame", share=0.3)
    n_lost = 0
    for _ in range(100):
        twin.star_camera.start(0.001)
        try:
            twin.star_camera.fetch(0.02)
        except CommunicationError:
            n_lost += 1
    assert 15 <= n_lost <= 45  # 30 +- 4.6


def test_a_lost_camera_fails_until_it_is_back() -> None:
    twin = small_twin()
    twin.reflector_camera.start(0.5)
    twin.inject("camera_lost", start_s=0.2, duration_s=1.0, camera="reflector")
    with pytest.raises(DeviceFaultError, match="reflector camera"):
        twin.reflector_camera.fetch(1.0)
    with pytest.raises(DeviceFaultError):
        twin.reflector_camera.start(0.1)
    twin.star_camera.start(0.01)
    twin.star_camera.fetch(1.0)
    twin.update(1.3)
    assert pair(twin)[1].any()


def test_another_session_does_not_repeat_the_noise_of_the_first() -> None:
    """Frames are counted from 1 again in each session, and the star stands still."""
    first, again, later = small_twin(), small_twin(), small_twin()
    later.update(500.0)
    frames = [pair(twin) for twin in (first, again, later)]
    for n in (0, 1):
        assert np.array_equal(frames[0][n], frames[1][n])
        same = np.mean(frames[0][n] == frames[2][n])
        different = np.mean(frames[0][n] == pair(first)[n])
        assert same == pytest.approx(different, abs=0.05)

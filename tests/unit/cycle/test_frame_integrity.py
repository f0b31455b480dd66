"""Frames that are copies, pieces or leftovers, and such that only look like it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import TELESCOPE, Night, new_run
from frames import gaussian_light
from hypothesis import given, settings
from hypothesis import strategies as st

from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle.frame_integrity import LATE_S, SAMPLE_STEP, FrameFault, FrameGuard
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.record import Recorder, RecordSettings, StopRule

SHAPE = (240, 320)


def noisy(seed: int, sigma_adu: float = 1.0, level_adu: float = 5.0, dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(rng.normal(level_adu, sigma_adu, SHAPE)), 0, np.iinfo(dtype).max).astype(dtype)


def exposure(image: np.ndarray, frame_id: int, start_s: float = 0.0) -> Exposure:
    return Exposure(image, 0.1, start_s + 0.05, frame_id)


def faults(images: list[np.ndarray]) -> list[FrameFault | None]:
    guard = FrameGuard()
    found = [guard.fault(exposure(image, n, float(n)), float(n)) for n, image in enumerate(images)]
    return [None if fault is None else fault[0] for fault in found]


def test_live_frames_are_let_pass() -> None:
    assert faults([noisy(n) for n in range(20)]) == [None] * 20
    assert faults([noisy(n, dtype=np.uint16) for n in range(5)]) == [None] * 5
    assert faults([np.repeat(noisy(n)[:, :, None], 3, axis=2) for n in range(5)]) == [None] * 5


@pytest.mark.parametrize("back", [1, 2, 5])
def test_a_driver_that_shows_an_old_buffer_again(back: int) -> None:
    images = [noisy(n) for n in range(8)]
    images.append(images[-back].copy())
    assert faults(images) == [None] * 8 + [FrameFault.REPEATED]


@given(sigma_adu=st.floats(0.35, 5.0), level_adu=st.floats(1.0, 60.0), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_noise_of_any_sensor_tells_a_copy(sigma_adu: float, level_adu: float, seed: int) -> None:
    """Down to a third of a step of the camera, around whatever offset."""
    one, other = noisy(seed, sigma_adu, level_adu), noisy(seed + 1, sigma_adu, level_adu)
    assert faults([one, other]) == [None, None]
    if len(np.unique(one)) > 1 and np.mean(one == np.bincount(one.ravel()).argmax()) < 0.95:
        assert faults([one, other, one]) == [None, None, FrameFault.REPEATED]


def noiseless_star() -> np.ndarray:
    light = 3.0 + 200.0 * gaussian_light(SHAPE, 100.3, 70.1, 4.0)
    return np.asarray(np.rint(light), dtype=np.uint8)


def slope() -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    return ((0.3 * columns + 0.7 * rows) % 256).astype(np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros(SHAPE, np.uint8),
        np.full(SHAPE, 255, np.uint8),
        np.full((*SHAPE, 3), 4, np.uint8),
        noiseless_star(),
        slope(),
    ],
    ids=["black", "white", "even", "drawn star", "test picture"],
)
def test_pictures_without_noise_may_be_alike(image: np.ndarray) -> None:
    """Cap on, glare, and the pictures of simulators: that they are the same proves nothing."""
    assert faults([image.copy() for _ in range(5)]) == [None] * 5


@given(n_arrived=st.integers(SAMPLE_STEP, SHAPE[0] - SAMPLE_STEP), seed=st.integers(0, 2**32 - 4))
@settings(max_examples=30, deadline=None)
def test_the_end_of_a_buffer_that_was_not_overwritten(n_arrived: int, seed: int) -> None:
    """Wherever the transfer broke off, and as often as it does so."""
    before = noisy(seed)
    guard = FrameGuard()
    assert guard.fault(exposure(noisy(seed + 3), 0)) is None
    assert guard.fault(exposure(before, 1)) is None
    for n in (2, 3):
        torn = noisy(seed + n - 1)
        torn[n_arrived:] = before[n_arrived:]
        found = guard.fault(exposure(torn, n))
        assert found is not None
        assert found[0] is FrameFault.INCOMPLETE
        said_rows = int(found[1].split(" last ")[1].split()[0])
        assert abs(said_rows - (SHAPE[0] - n_arrived)) <= SAMPLE_STEP
    assert guard.fault(exposure(noisy(seed + 4), 4)) is None


def test_rows_that_never_change_are_let_pass() -> None:
    """Some cameras write what they know of a frame into its last rows, pixels like noise."""
    images = [noisy(n) for n in range(5)]
    for image in images:
        image[-20:] = noisy(99)[-20:]
    assert faults(images) == [None] * 5


def test_zeros_where_the_end_is_missing() -> None:
    torn = noisy(1)
    torn[100:] = 0
    assert faults([noisy(2), torn, noisy(3)]) == [None, FrameFault.INCOMPLETE, None]


def test_a_frame_of_an_exposure_that_was_given_up() -> None:
    guard = FrameGuard()
    late = guard.fault(exposure(noisy(1), 1, start_s=10.0), 13.0)
    assert late is not None
    assert late[0] is FrameFault.LATE
    assert "2.9 s" in late[1]
    # a clock of the camera that is off by a few ms is no reason
    assert guard.fault(exposure(noisy(2), 2, start_s=13.0 - 0.1 - 0.9 * LATE_S), 13.0) is None


def test_numbers_tell_copies_and_gaps() -> None:
    guard = FrameGuard()
    for frame_id, expected in ((5, None), (6, None), (6, FrameFault.REPEATED), (9, None), (1, None), (2, None)):
        found = guard.fault(exposure(noisy(np.random.default_rng().integers(2**31)), frame_id))
        assert (None if found is None else found[0]) == expected
    assert guard.n_missed == 2  # 7 and 8; a camera that begins to count anew has missed nothing


SETTINGS = RecordSettings(region_radius_rad=0.002)


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_the_recorder_drops_and_counts_them_by_cause_and_stores_none(tmp_path: Path, role: str) -> None:
    night = Night()
    camera = getattr(night, role)
    kept: list[Exposure] = []

    def edit(fresh: Exposure) -> Exposure:
        kept.append(fresh)
        if fresh.frame_id == 6:  # an old buffer under a new number
            return replace(fresh, image=kept[-2].image)
        if fresh.frame_id == 10:  # what came late is delivered for the next exposure
            return replace(fresh, mid_exposure_s=kept[-2].mid_exposure_s - 5.0)
        if fresh.frame_id == 14:
            torn = fresh.image.copy()
            torn[len(torn) // 2 :] = kept[-2].image[len(torn) // 2 :]
            return replace(fresh, image=torn)
        return fresh

    camera.edit = edit
    with new_run(tmp_path / "RUN", night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)
        recorder.record(StopRule(n_records=20))
        dropped = recorder.progress().source.dropped
        records = store.records()
    assert dropped[DropCause.STALE_FRAME] == 1
    assert dropped[DropCause.LATE_FRAME] == 1
    assert dropped[DropCause.NO_FRAME] == 1
    assert all(record.reject_reason is None for record in records)
    assert all(abs(record.mid_exposure_difference_s) < 1e-9 for record in records)


def test_a_camera_that_hangs_on_one_frame_is_told(tmp_path: Path) -> None:
    night = Night()
    frozen: list[np.ndarray] = []

    def edit(fresh: Exposure) -> Exposure:
        if fresh.mid_exposure_s > 3.0:
            frozen.append(fresh.image)
            return replace(fresh, image=frozen[0])
        return fresh

    night.star.edit = edit
    seen = []
    with new_run(tmp_path / "RUN", night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)
        recorder.record(StopRule(duration_s=60.0), seen.append)
    assert "the same frame twice" in seen[-1].warning
    assert "same noise in every pixel" in seen[-1].source.trouble

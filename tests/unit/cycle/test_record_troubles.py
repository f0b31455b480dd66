"""What the recorder survives: clouds, lost cameras, bad frames, clocks; and what the crew is told meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import Night, with_frame_id
from recorded_night import SETTINGS, accepted, record_night

from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle.pairs import DropCause


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def test_a_star_behind_a_cloud_and_out_again(path: Path) -> None:
    """No light from 5 to 50 s: the warning says what is wrong, and the recording goes on by itself."""
    night = Night(star_of=lambda time_s: 1e-9 if 5.0 < time_s < 50.0 else 1.0)
    records, _, seen = record_night(path, night, 60)
    assert len(accepted(records)) == 60
    reasons = {record.reject_reason for record in records} - {None}
    assert RejectReason.NO_STAR in reasons
    warnings = [progress.warning for progress in seen if progress.warning]
    assert "cloud" in warnings[-1]
    assert seen[-1].warning == ""
    assert (
        50.0
        < min(record.star_mid_exposure_s for record in accepted(records) if record.star_mid_exposure_s > 5.0)
        < 60.0
    )


def test_a_camera_is_lost_and_found(path: Path) -> None:
    night = Night()
    lost = DeviceFaultError("fake reflector camera: does not answer")
    night.reflector.fault = lambda time_s: lost if 3.0 < time_s < 45.0 else None
    records, _, seen = record_night(path, night, 60)
    assert len(accepted(records)) == 60
    assert seen[-1].source.dropped[DropCause.CAMERA_LOST] >= 10
    assert seen[-1].source.trouble == ""


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_frames_that_are_torn_stale_or_late_are_taken_again(path: Path, role: str) -> None:
    night = Night()
    camera = night.star if role == "star" else night.reflector

    def edit(exposure: Exposure) -> Exposure:
        if exposure.frame_id == 7:
            raise CommunicationError("late")
        if exposure.frame_id == 11:
            return with_frame_id(exposure, 10)
        if exposure.frame_id == 15:
            torn = exposure.image.copy()
            torn[len(torn) // 2 :] = 0
            return replace(exposure, image=torn)
        return exposure if exposure.frame_id < 20 else with_frame_id(exposure, exposure.frame_id + 4)

    camera.edit = edit
    records, _, seen = record_night(path, night, 30)
    assert len(accepted(records)) == len(records) == 30
    assert seen[-1].source.dropped[DropCause.NO_FRAME] == 2
    assert seen[-1].source.dropped[DropCause.STALE_FRAME] == 1
    assert seen[-1].source.n_frames_missed == 4 + 1 + 1  # four skipped, one that came late, one that came twice


NO_STAR_AT_ALL, TEN_THOUSAND_SUNS = 1e-9, 1e4


def lost(role: str) -> Callable[[Night], None]:
    def lose(night: Night) -> None:
        error = DeviceFaultError(f"fake {role} camera: does not answer")
        getattr(night, role).fault = lambda time_s: error if time_s > 5.0 else None

    return lose


def dark(night: Night) -> None:
    night.star_of = lambda time_s: NO_STAR_AT_ALL if time_s > 5.0 else 1.0


def glaring(night: Night) -> None:
    night.star_of = lambda time_s: TEN_THOUSAND_SUNS if time_s > 5.0 else 1.0


def racing(night: Night) -> None:
    def theta_of(time_s: float) -> np.ndarray:
        turn = 0.1 * min(time_s, 5.0) + 2.0 * max(time_s - 5.0, 0.0)
        return math.radians(0.1) * np.array([math.cos(turn), math.sin(turn)])

    night.theta_of = theta_of


@pytest.mark.parametrize(
    ("trouble", "minutes", "what", "remedy"),
    [
        (lost("star"), 2.0, "camera lost", "cable and power"),
        (lost("reflector"), 2.0, "camera lost", "cable and power"),
        (dark, 0.8, "star", "cloud"),
        (glaring, 0.8, "saturated", "fainter star"),
        (racing, 0.8, "moved", "more slowly"),
    ],
    ids=["star camera lost", "reflector camera lost", "star lost", "saturated", "too fast"],
)
def test_after_half_a_minute_of_trouble_the_crew_is_told_what_to_do(
    path: Path, trouble: Callable[[Night], None], minutes: float, what: str, remedy: str
) -> None:
    night = Night()
    trouble(night)
    _, _, seen = record_night(path, night, None, replace(SETTINGS, first_exposure_s=0.3, pace_s=0.4), minutes)
    warned = [progress for progress in seen if progress.warning]
    assert warned, "no warning"
    assert what in warned[-1].warning
    assert remedy in warned[-1].warning
    assert warned[0].elapsed_s > 34.0  # all was well for five seconds


def test_a_clock_that_is_set_back(path: Path) -> None:
    night = Night()
    night.clock.setbacks = [(3.0, 3600.0)]
    records, recorder, _ = record_night(path, night, 30)
    assert ["set back" in event for event in recorder.events] == [True]
    times = [record.star_mid_exposure_s for record in records]
    assert times == sorted(times)
    assert len({record.label for record in records}) == len(records)

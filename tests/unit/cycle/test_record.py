"""The recorder on a fake night: what it stores, how it goes on, and that a replay gives the same bits."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import FACET_THETA_RAD, FACETS, PSF_RAD, TELESCOPE, Night, new_run
from recorded_night import SETTINGS, accepted, bits, record_night

from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.records import Record
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.record import Equipment, Recorder, StopRule
from namod_ctl.cycle.replay import CAMERAS, ReplayCamera, ReplayClock, replayable_records
from namod_ctl.store.run import RunStore


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def test_records_tell_the_truth_about_the_night(path: Path) -> None:
    night = Night()
    records, recorder, seen = record_night(path, night, 40)
    assert len(accepted(records)) == 40
    assert [record.index for record in records] == list(range(len(records)))
    for record in records:
        true_theta = night.theta_of(record.star_mid_exposure_s)
        assert record.theta_rad == pytest.approx(true_theta, abs=5.0 * record.theta_uncertainty_rad)
        # the cameras expose around the same moment, whatever the lengths of their exposures
        assert abs(record.mid_exposure_difference_s) < 1e-9
        assert record.star_exposure_s == pytest.approx(0.04, rel=0.15)
    # the response of a facet over that of another is what their distances from the star make it
    first, second, _ = FACETS
    ratios = np.array([record.facet_intensity[0] / record.facet_intensity[1] for record in records])
    expected = np.array(
        [
            math.exp(
                -0.5
                * sum(
                    sign * float(np.sum((record.theta_rad - FACET_THETA_RAD[facet]) ** 2))
                    for sign, facet in ((1.0, first), (-1.0, second))
                )
                / PSF_RAD**2
            )
            for record in records
        ]
    )
    bright = [
        n for n, record in enumerate(records) if min(record.facet_intensity[:2]) > 0.3 * max(record.facet_intensity)
    ]
    assert len(bright) > 3
    assert ratios[bright] == pytest.approx(expected[bright], rel=0.15)  # 3 adu of the camera's offset count as light
    assert seen[-1].n_accepted == 40
    assert recorder.events == []


def test_a_night_can_be_repeated(tmp_path: Path) -> None:
    """Threads or not, the same cameras make the same records."""
    first, _, _ = record_night(tmp_path / "a", Night(), 25)
    second, _, _ = record_night(tmp_path / "b", Night(), 25)
    assert [bits(record) for record in first] == [bits(record) for record in second]


def test_a_dark_reflector_counts_as_no_response(path: Path) -> None:
    night = Night(lambda time_s: np.array([math.radians(0.24), 0.0]) + 1e-6 * time_s)
    records, _, seen = record_night(path, night, 5)
    assert len(accepted(records)) == 5
    assert all(record.reflector_exposure_s == pytest.approx(3.0, rel=0.01) for record in records[1:])
    assert seen[-1].source.dropped[DropCause.REFLECTOR_STARVED] <= 3


def test_appending_goes_on_with_numbers_and_times(path: Path) -> None:
    first, _, _ = record_night(path, Night(), 10)
    night = Night()  # of another day: its clock begins at 0 again
    with RunStore.open(path, read_only=False) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)
        recorder.record(StopRule(n_records=25))
        records = store.records()
    assert [bits(record) for record in records[: len(first)]] == [bits(record) for record in first]
    assert len(accepted(records)) == 25
    assert [record.index for record in records] == list(range(len(records)))
    times = [record.star_mid_exposure_s for record in records]
    assert times == sorted(times)


def replayed(path: Path, out: Path) -> list[Record]:
    with RunStore.open(path) as old:
        found = replayable_records(old)
        star, reflector = (ReplayCamera(old, found, camera) for camera in CAMERAS)
    clock = Night().clock
    with new_run(out, clock) as store:
        identities = iter(found)
        recorder = Recorder(
            Equipment(star, reflector, ReplayClock(), clock), TELESCOPE, store, SETTINGS, replayed=identities
        )
        assert recorder.record(StopRule()) == "all frames are replayed"
        return store.records()


def test_a_replay_gives_the_same_numbers_to_the_last_bit(tmp_path: Path) -> None:
    """Through retakes, a cloud, moved telescopes and a second session."""
    keeping = replace(SETTINGS, keep_frames=True)
    path = tmp_path / "RUN"

    def jumping(time_s: float) -> np.ndarray:
        offset = 0.05 if time_s % 8.0 > 7.0 else 0.0
        return np.array([math.radians(0.02 * (time_s % 4.0) + offset), 0.0])

    night = Night(jumping, lambda time_s: 1e-9 if 2.0 < time_s < 12.0 else 1.0)
    record_night(path, night, 40, keeping)
    with RunStore.open(path, read_only=False) as store:
        Recorder(Night().equipment, TELESCOPE, store, keeping).record(StopRule(n_records=50))
        records = store.records()
    assert {None, RejectReason.NO_STAR, RejectReason.TELESCOPE_MOVED} <= {record.reject_reason for record in records}
    again = replayed(path, tmp_path / "AGAIN")
    assert [bits(record) for record in again] == [bits(record) for record in records]


def test_a_run_without_frames_cannot_be_replayed(path: Path) -> None:
    record_night(path, Night(), 3)
    with RunStore.open(path) as run, pytest.raises(ConfigError, match="keep-frames all"):
        replayable_records(run)


def test_retaken_pairs_are_those_of_the_records(tmp_path: Path) -> None:
    """The cameras are ahead: all frames from the 30th on are torn, and nobody asks for those."""
    night = Night()

    def late(exposure: Exposure) -> Exposure:
        if exposure.frame_id > 30:
            raise CommunicationError("late")
        return exposure

    night.star.edit = late
    with new_run(tmp_path / "RUN", night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)
        recorder.record(StopRule(n_records=20), lambda progress: time.sleep(0.02))
        assert DropCause.NO_FRAME not in recorder.progress().source.dropped

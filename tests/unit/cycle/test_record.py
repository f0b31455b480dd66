"""The recorder on a fake night: what it stores, what it survives, and that a replay gives the same bits."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import FACET_THETA_RAD, FACETS, PSF_RAD, TELESCOPE, Night, new_run, with_frame_id

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError, StoreError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.records import Record
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.cycle.replay import CAMERAS, ReplayCamera, ReplayClock, replayable_records
from namod_ctl.store.run import RunStore

SETTINGS = RecordSettings(region_radius_rad=math.radians(0.12), store_retry_s=0.0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def record_night(
    path: Path, night: Night, n_records: int | None, settings: RecordSettings = SETTINGS, minutes: float = 1e9
) -> tuple[list[Record], Recorder, list[Progress]]:
    seen: list[Progress] = []
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, settings)
        recorder.record(StopRule(n_records=n_records, duration_s=60.0 * minutes), seen.append)
        return store.records(), recorder, seen


def accepted(records: Iterable[Record]) -> list[Record]:
    return [record for record in records if record.reject_reason is None]


def bits(record: Record) -> list[object]:
    values = (getattr(record, name) for name in Record.__slots__)
    return [np.asarray(v).tobytes() if isinstance(v, np.ndarray | float) else v for v in values]


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


def test_the_exposure_stays_within_what_the_motion_allows(path: Path) -> None:
    """A dark reflector would ask for 3 s; at 0.02 deg/s the star moves by half of its image in 0.6 s."""

    def to_and_fro(time_s: float) -> np.ndarray:
        return np.array([math.radians(0.2 + 0.02 * abs(time_s % 16.0 - 8.0)), 0.0])

    records, _, _ = record_night(path, Night(to_and_fro), 20)
    assert max(record.reflector_exposure_s for record in records[8:]) < 1.0
    assert len(accepted(records[8:])) >= len(records[8:]) - 2  # it turns once: there the speed is underestimated


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


def test_a_telescope_that_moves_too_fast_is_told_so(path: Path) -> None:
    """0.1 deg/s: in the shortest exposures of 0.3 s that it gets, it still moves by more than half a star."""

    def fast(time_s: float) -> np.ndarray:
        return math.radians(0.1) * np.array([math.cos(time_s), math.sin(time_s)])

    records, _, seen = record_night(path, Night(fast), None, replace(SETTINGS, first_exposure_s=0.3), minutes=0.6)
    assert sum(record.reject_reason is RejectReason.TELESCOPE_MOVED for record in records) > 0.8 * len(records)
    assert "limit" in next(r.detail for r in records if r.reject_reason is RejectReason.TELESCOPE_MOVED)
    assert "slowly" in seen[-1].warning


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


def test_far_apart_records_are_judged_by_a_second_look(path: Path) -> None:
    """15 s from one record to the next, 0.1 deg/s: in 0.3 s the star moves by 0.03 deg, more than half of its image."""

    def fast(time_s: float) -> np.ndarray:
        return math.radians(0.1) * np.array([math.cos(time_s), math.sin(time_s)])

    settings = replace(SETTINGS, first_exposure_s=0.3, pace_s=15.0)
    records, _, seen = record_night(path, Night(fast), None, settings, minutes=3.0)
    longer_s = [max(record.star_exposure_s, record.reflector_exposure_s) for record in records]
    limit_s = 0.5 * TELESCOPE.star_size_rad / math.radians(0.1)
    has_moved = [record.reject_reason is RejectReason.TELESCOPE_MOVED for record in records]
    assert [exposure_s > limit_s for exposure_s in longer_s] == has_moved
    assert sum(has_moved) >= 4
    assert "slowly" in seen[-1].warning


def test_far_apart_records_of_a_slow_telescope_are_exposed_as_long_as_it_allows(path: Path) -> None:
    """0.02 deg/s, where a dark reflector would ask for 3 s: only the records begun before the first was seen moved."""

    def slow(time_s: float) -> np.ndarray:
        return np.array([math.radians(0.19 + 0.02 * abs(time_s % 16.0 - 8.0)), 0.0])

    records, recorder, _ = record_night(path, Night(slow), 12, replace(SETTINGS, pace_s=11.3))
    speed = math.radians(0.02)
    for record in accepted(records):
        assert speed * max(record.star_exposure_s, record.reflector_exposure_s) < 0.55 * TELESCOPE.star_size_rad
    assert len(records) - len(accepted(records)) <= 5  # four, and one at a turn
    assert recorder.progress().rejected.keys() <= {RejectReason.TELESCOPE_MOVED}


def test_a_record_whose_motion_nobody_saw_says_so(path: Path) -> None:
    """The first after a cloud: the pair before it was not far away in time, but showed no star."""
    night = Night(star_of=lambda time_s: 1e-9 if 5.0 < time_s < 30.0 else 1.0)
    records, _, _ = record_night(path, night, 25)
    unknown = [record for record in accepted(records) if record.detail]
    assert len(unknown) == 1
    assert "not known" in unknown[0].detail
    assert unknown[0].star_mid_exposure_s > 30.0


class FullDisk:
    """A run on a disk that is full for some of the attempts to store a record."""

    def __init__(self, store: RunStore, error: StoreError, n_refusals: int) -> None:
        self._store, self._error, self.n_refusals = store, error, n_refusals

    def __getattr__(self, name: str) -> object:
        return getattr(self._store, name)

    def append(self, records: list[Record]) -> None:
        if records[0].index == 5 and self.n_refusals > 0:
            self.n_refusals -= 1
            raise self._error
        self._store.append(records)


def store_error(cause: Exception) -> StoreError:
    try:
        raise StoreError("run.sqlite: no") from cause
    except StoreError as error:
        return error


def test_a_full_disk_is_waited_for(path: Path) -> None:
    night = Night()
    seen: list[Progress] = []
    with new_run(path, night.clock) as store:
        disk = FullDisk(store, store_error(OSError(errno.ENOSPC, "No space left on device")), 3)
        recorder = Recorder(night.equipment, TELESCOPE, disk, SETTINGS)  # type: ignore[arg-type]
        recorder.record(StopRule(n_records=12), seen.append)
        records = store.records()
    assert disk.n_refusals == 0
    assert [record.index for record in records] == list(range(len(records)))
    assert len(accepted(records)) == 12
    assert any("trying again" in progress.trouble for progress in seen)
    assert ["had to wait" in event for event in recorder.events] == [True]


def test_a_damaged_run_ends_the_recording(path: Path) -> None:
    night = Night()
    with new_run(path, night.clock) as store:
        disk = FullDisk(store, store_error(ValueError("damaged")), 10**9)
        recorder = Recorder(night.equipment, TELESCOPE, disk, SETTINGS)  # type: ignore[arg-type]
        with pytest.raises(StoreError):
            recorder.record(StopRule(n_records=12))
        assert len(store.records()) == 5


def test_a_clock_that_is_set_back(path: Path) -> None:
    night = Night()
    night.clock.setbacks = [(3.0, 3600.0)]
    records, recorder, _ = record_night(path, night, 30)
    assert ["set back" in event for event in recorder.events] == [True]
    times = [record.star_mid_exposure_s for record in records]
    assert times == sorted(times)
    assert len({record.label for record in records}) == len(records)


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


def test_stopping_by_hand_is_at_a_record_boundary(path: Path) -> None:
    night = Night()
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)

        def stop_after_7(progress: Progress) -> None:
            if progress.n_accepted == 7:
                recorder.ask_to_stop()

        assert "by hand" in recorder.record(StopRule(n_records=100), stop_after_7)
        assert len(accepted(store.records())) == 7


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


def some_progress(make: Callable[[Progress], Progress], tmp_path: Path) -> Progress:
    _, _, seen = record_night(tmp_path / "some", Night(), 2)
    return make(seen[-1])


def test_the_rule_of_uncertainty_waits_for_coverage(tmp_path: Path) -> None:
    rule = StopRule(uncertainty_rad=1e-4)
    good = LiveEstimate(n_records=500, worst_uncertainty_rad=0.9e-4, worst_facet_id=1, unseen_facet_ids=())
    progress = some_progress(lambda p: replace(p, estimate=good), tmp_path)
    assert rule.reason_to_stop(progress) == ""
    covered = replace(progress, coverage=replace(progress.coverage, counts=np.ones_like(progress.coverage.counts)))
    assert rule.reason_to_stop(covered) != ""
    assert rule.reason_to_stop(replace(covered, estimate=replace(good, worst_uncertainty_rad=1.1e-4))) == ""
    assert rule.reason_to_stop(replace(covered, estimate=None)) == ""


def test_facets_that_were_not_seen_hold_the_rule_up_until_the_region_is_covered(tmp_path: Path) -> None:
    """Nothing is known of them, so they are no reason to stop; once the star was everywhere, nothing will be."""
    rule = StopRule(uncertainty_rad=1e-4)
    estimate = LiveEstimate(n_records=500, worst_uncertainty_rad=0.9e-4, worst_facet_id=1, unseen_facet_ids=(2, 5))
    progress = some_progress(lambda p: replace(p, estimate=estimate), tmp_path)

    def covered_to(share: float) -> Progress:
        counts = np.ones_like(progress.coverage.counts)
        cells = np.argwhere(progress.coverage.is_inside)
        counts[tuple(cells[: round((1.0 - share) * len(cells))].T)] = 0
        return replace(progress, coverage=replace(progress.coverage, counts=counts))

    assert rule.reason_to_stop(covered_to(0.85)) == ""
    assert "never seen: 2, 5" in rule.reason_to_stop(covered_to(1.0))
    none_seen = replace(estimate, worst_uncertainty_rad=math.inf, unseen_facet_ids=(1, 2, 5))
    assert rule.reason_to_stop(replace(covered_to(1.0), estimate=none_seen)) == ""


def test_minutes_are_those_of_the_cameras_and_repeat(tmp_path: Path) -> None:
    """However slowly the records are reduced; and pairs that nobody took leave no trace in the counts."""

    def recorded(name: str, delay_s: float) -> tuple[list[list[object]], dict[DropCause, int], str]:
        night = Night(star_of=lambda time_s: 0.02 if time_s % 6.0 > 3.0 else 1.0)
        with new_run(tmp_path / name, night.clock) as store:
            recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)
            reason = recorder.record(StopRule(duration_s=15.0), lambda progress: time.sleep(delay_s))
            records = store.records()
        assert all(r.star_mid_exposure_s - r.star_exposure_s / 2 < 15.0 for r in records)
        assert records[-1].star_mid_exposure_s > 13.0
        return [bits(record) for record in records], recorder.progress().source.dropped, reason

    slow, fast = recorded("slow", 0.03), recorded("fast", 0.0)
    assert slow == fast
    assert "0.25 minutes" in slow[2]
    assert slow[1]


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


def test_a_run_that_has_all_records_gets_no_more(path: Path) -> None:
    record_night(path, Night(), 5)
    night = Night()
    with RunStore.open(path, read_only=False) as store:
        n_before = len(store.records())
        assert "are there" in Recorder(night.equipment, TELESCOPE, store, SETTINGS).record(StopRule(n_records=5))
        assert len(store.records()) == n_before
    assert night.star.started == []


def test_a_run_that_is_taken_away_is_told_at_once_and_gone_on_with_when_it_is_back(path: Path) -> None:
    night, told = Night(), []
    away = path.with_name("AWAY")
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)

        def watch(progress: Progress) -> None:
            if progress.is_halted:
                told.append(progress.warning)
                away.rename(path)
            elif progress.n_accepted == 6 and not told:
                path.rename(away)

        recorder.record(StopRule(n_records=12), watch)
    assert len(told) == 1
    assert "THE RUN IS GONE" in told[0]
    with RunStore.open(path) as run:
        assert len(accepted(run.records())) == 12


DUE_AT = 20


class SlowEstimator:
    """Says after three looks at it that all is known well enough."""

    def __init__(self) -> None:
        self.n_looks = 0
        self.is_asked = False

    def update(self, n_accepted: int) -> LiveEstimate | None:
        self.is_asked |= n_accepted >= DUE_AT
        return LiveEstimate(DUE_AT, 1e-5, 1, ()) if self.n_looks >= 3 else None

    def is_ready(self, timeout_s: float) -> bool:
        self.n_looks += self.is_asked
        return not self.is_asked or self.n_looks >= 3


def test_the_rule_of_uncertainty_stops_where_the_estimate_was_due(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("namod_ctl.cycle.record.MIN_RECORDS_FOR_UNCERTAINTY", DUE_AT)
    monkeypatch.setattr("namod_ctl.cycle.record.MIN_COVERAGE_FOR_UNCERTAINTY", 0.0)
    night = Night()
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS, SlowEstimator())  # type: ignore[arg-type]
        reason = recorder.record(StopRule(uncertainty_rad=1e-4, n_records=2 * DUE_AT))
    assert "known well enough" in reason
    assert recorder.progress().n_accepted == DUE_AT

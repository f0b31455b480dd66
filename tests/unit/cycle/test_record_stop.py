"""When a recording ends."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import TELESCOPE, Night, new_run
from recorded_night import SETTINGS, accepted, bits, record_night

from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.store.run import RunStore


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def test_stopping_by_hand_is_at_a_record_boundary(path: Path) -> None:
    night = Night()
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)

        def stop_after_7(progress: Progress) -> None:
            if progress.n_accepted == 7:
                recorder.ask_to_stop()

        assert "by hand" in recorder.record(StopRule(n_records=100), stop_after_7)
        assert len(accepted(store.records())) == 7


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


def test_a_run_that_has_all_records_gets_no_more(path: Path) -> None:
    record_night(path, Night(), 5)
    night = Night()
    with RunStore.open(path, read_only=False) as store:
        n_before = len(store.records())
        assert "are there" in Recorder(night.equipment, TELESCOPE, store, SETTINGS).record(StopRule(n_records=5))
        assert len(store.records()) == n_before
    assert night.star.started == []


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


def test_a_hole_in_the_region_asks_for_more_records_but_not_for_ever(tmp_path: Path) -> None:
    rule = StopRule(n_records=50, min_coverage=0.8)
    progress = some_progress(lambda p: replace(p, n_accepted=50), tmp_path)
    counts = np.ones_like(progress.coverage.counts)
    covered = replace(progress, coverage=replace(progress.coverage, counts=counts))
    counts = counts.copy()
    counts[5:7, 5:7] = 0  # 4 of 97 cells, where all facets look once they were aligned
    holed = replace(progress, coverage=replace(progress.coverage, counts=counts))
    assert rule.reason_to_stop(covered) != ""
    assert holed.coverage.share > rule.min_coverage
    assert rule.reason_to_stop(holed) == ""
    assert rule.reason_to_stop(replace(holed, n_accepted=149)) == ""
    assert "to cover the region" in rule.reason_to_stop(replace(holed, n_accepted=150))
    assert StopRule(n_records=50).reason_to_stop(holed) == "all records wanted are there"

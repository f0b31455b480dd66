"""What the crew is told: warnings that name the cause, rates, the map and the direction to steer."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from namod_ctl.app.views.recording_view import TerminalView, coverage_lines, plain_line, star_brightness, steering
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.cycle.coverage import N_CELLS, empty_coverage, with_record
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.pairs import DropCause, SourceStatus
from namod_ctl.cycle.progress import Progress, Tracker, magnitude, rate_per_min, warning_text

RADIUS = math.radians(0.35)
ALL_WELL = SourceStatus({}, 0, "")


def record(reason: RejectReason | None = None, theta_deg: tuple[float, float] = (0.1, 0.0)) -> Record:
    theta = np.radians(theta_deg) if reason is None else np.full(2, np.nan)
    nothing = np.zeros(1)
    return Record(0, "", theta, 1e-6, 10.0 if reason is None else math.nan, nothing, nothing, 0.1, 0.2, reason)


def told_at(tracker: Tracker, now_s: float, source: SourceStatus = ALL_WELL) -> Progress:
    return tracker.snapshot(now_s, source, None)


def test_a_warning_comes_after_thirty_seconds_and_goes_with_the_next_record() -> None:
    tracker = Tracker(RADIUS, 100.0)
    tracker.add(record(), 110.0, ALL_WELL)
    for second in range(111, 145):
        tracker.add(record(RejectReason.STAR_AT_EDGE), float(second), ALL_WELL)
    assert told_at(tracker, 139.0).warning == ""
    assert "middle of the star camera's field" in told_at(tracker, 141.0).warning
    tracker.add(record(), 145.0, ALL_WELL)
    assert told_at(tracker, 146.0).warning == ""


def test_only_what_was_dropped_since_the_last_good_record_counts() -> None:
    tracker = Tracker(RADIUS, 0.0)
    tracker.add(record(), 1.0, SourceStatus({DropCause.STAR_SATURATED: 50}, 0, ""))
    source = SourceStatus({DropCause.STAR_SATURATED: 50, DropCause.CAMERA_LOST: 4}, 0, "no answer")
    warning = told_at(tracker, 40.0, source).warning
    assert "cable and power" in warning
    assert "4 times" in warning


@pytest.mark.parametrize("reason", RejectReason)
def test_every_reason_has_its_text(reason: RejectReason) -> None:
    assert "3 records" in warning_text(31.0, Counter({reason: 3}), Counter())


@pytest.mark.parametrize("cause", DropCause)
def test_every_cause_has_its_text(cause: DropCause) -> None:
    assert "3 times" in warning_text(31.0, Counter(), Counter({cause: 3}))


def test_silence_is_named() -> None:
    assert "no frames arrive" in warning_text(31.0, Counter(), Counter())


def test_the_rate_is_that_of_the_last_minute() -> None:
    every_second: deque[tuple[float, RejectReason | None]] = deque((float(second), None) for second in range(301))
    assert rate_per_min(every_second, 0.0, 300.0) == pytest.approx(60.0)
    assert rate_per_min(every_second, 0.0, 330.0) == pytest.approx(30.0)
    assert rate_per_min(deque([(9.0, None)]), 0.0, 10.0) == pytest.approx(6.0)  # younger than a minute
    assert rate_per_min(deque(), 0.0, 0.0) == 0.0


def test_five_magnitudes_are_a_factor_of_a_hundred() -> None:
    assert magnitude(1.0) - magnitude(100.0) == pytest.approx(5.0)
    assert math.isnan(magnitude(math.nan))


def dimmed(progress_record: Record, by_mag: float) -> Record:
    return replace(progress_record, star_intensity=progress_record.star_intensity * 10.0 ** (-0.4 * by_mag))


def test_without_a_zero_point_the_magnitude_counts_from_the_brightest_of_the_run() -> None:
    tracker = Tracker(RADIUS, 0.0)
    tracker.add_earlier(record())
    tracker.add(dimmed(record(), 1.2), 1.0, ALL_WELL)
    assert told_at(tracker, 1.0).star_magnitude == pytest.approx(1.2)
    assert star_brightness(told_at(tracker, 1.0)) == "+1.20 mag relative to the brightest of this run"
    tracker.add(record(RejectReason.NO_STAR), 2.0, ALL_WELL)
    assert star_brightness(told_at(tracker, 2.0)) == "not seen"


def test_with_a_zero_point_the_magnitude_is_the_stars() -> None:
    tracker = Tracker(RADIUS, 0.0, star_zero_point_mag=4.0)
    tracker.add(record(), 1.0, ALL_WELL)  # an intensity of 10 is 2.5 mag
    assert star_brightness(told_at(tracker, 1.0)) == "1.50 mag"


def some_progress(theta_deg: tuple[float, float] = (0.1, 0.0)) -> Progress:
    tracker = Tracker(RADIUS, 0.0, n_wanted=10)
    tracker.add(record(theta_deg=theta_deg), 1.0, ALL_WELL)
    return told_at(tracker, 2.0)


def test_the_map_lies_as_the_telescope_frame_does() -> None:
    """+x to the right, +y up: a star at (+0.3, +0.1) deg is on the right, above the middle."""
    coverage = with_record(empty_coverage(RADIUS), np.radians([0.3, 0.1]))
    lines = coverage_lines(coverage, np.radians([0.3, 0.1]), np.radians([-0.3, 0.0]))
    assert {len(line) for line in lines} == {2 * N_CELLS}
    row = next(n for n, line in enumerate(lines) if "★" in line)
    assert row < N_CELLS // 2
    assert lines[row].index("★") > N_CELLS
    assert "█" in lines[row]
    goal = next(n for n, line in enumerate(lines) if "✚" in line)
    assert goal == N_CELLS // 2
    assert lines[goal].index("✚") < N_CELLS


def test_the_crew_is_told_where_to_bring_the_star() -> None:
    progress = replace(some_progress(), theta_rad=np.radians([0.1, 0.0]), next_theta_rad=np.radians([-0.15, 0.2]))
    assert steering(progress) == "bring the star 0.25 deg left, 0.20 deg up"
    assert steering(replace(progress, theta_rad=np.full(2, np.nan))) == "no star at the moment"


def test_a_plain_line_holds_the_numbers_and_the_warning() -> None:
    estimate = LiveEstimate(
        n_records=7, worst_uncertainty_rad=math.radians(0.5 / 60.0), worst_facet_id=12, unseen_facet_ids=(3, 4)
    )
    progress = replace(some_progress(), estimate=estimate, warning="look up")
    line = plain_line(progress)
    assert "1 of 10 records" in line
    assert "+0.00 mag relative" in line
    assert "+-0.50 arcmin (facet 12; 2 facets not seen; 7 records)" in line
    assert line.endswith("look up")


@pytest.mark.parametrize("pace_s", [35.0, 40.0])
def test_a_slow_pace_is_no_trouble_and_neither_is_one_rejected_record(pace_s: float) -> None:
    tracker = Tracker(RADIUS, 0.0, pace_s=pace_s)
    now_s, reasons = 0.0, [None, None, RejectReason.REFLECTOR_SATURATED, None, None]
    for reason in reasons:
        now_s += pace_s
        assert told_at(tracker, now_s - 0.1).warning == ""
        tracker.add(record(reason), now_s, ALL_WELL)
        assert told_at(tracker, now_s).warning == ""
    for _ in range(5):
        now_s += pace_s
        tracker.add(record(RejectReason.STAR_AT_EDGE), now_s, ALL_WELL)
    assert "middle of the star camera's field" in told_at(tracker, now_s).warning


def test_one_is_no_plural() -> None:
    assert "(1 record)" in warning_text(31.0, Counter({RejectReason.NO_STAR: 1}), Counter())
    assert "(once)" in warning_text(31.0, Counter(), Counter({DropCause.NO_FRAME: 1}))


def test_what_stops_the_recording_hides_what_else_is_wrong_and_is_news() -> None:
    """A disk that is full for a minute is no matter of the cameras' cables."""
    tracker = Tracker(RADIUS, 0.0)
    tracker.add(record(), 1.0, ALL_WELL)
    cameras = SourceStatus({DropCause.CAMERA_LOST: 9}, 0, "no answer")
    before, after = tracker.snapshot(90.0, cameras, None), tracker.snapshot(100.0, cameras, None)
    halted = tracker.snapshot(95.0, cameras, None, "the disk is full")
    assert "cable" in plain_line(before)
    assert plain_line(halted).endswith("the disk is full")
    text = StringIO()
    view = TerminalView(Console(file=text, force_terminal=False, width=200), "night")
    for progress in (before, before, halted, halted, after, after):
        view.show(progress)
    assert text.getvalue().count("the disk is full") == 1
    assert text.getvalue().count("cable") == 2
    screen = StringIO()
    with TerminalView(Console(file=screen, force_terminal=True, width=120), "night") as live:
        live.show(halted)
    assert "the disk is full" in screen.getvalue()
    assert "cable" not in screen.getvalue()

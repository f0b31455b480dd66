"""How fast the telescope wanders: exposures that fit it, and records that are spoiled by it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_night import TELESCOPE, Night
from recorded_night import SETTINGS, accepted, record_night

from namod_ctl.core.flags import RejectReason


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def test_the_exposure_stays_within_what_the_motion_allows(path: Path) -> None:
    """A dark reflector would ask for 3 s; at 0.02 deg/s the star moves by half of its image in 0.6 s."""

    def to_and_fro(time_s: float) -> np.ndarray:
        return np.array([math.radians(0.2 + 0.02 * abs(time_s % 16.0 - 8.0)), 0.0])

    records, _, _ = record_night(path, Night(to_and_fro), 20)
    assert max(record.reflector_exposure_s for record in records[8:]) < 1.0
    assert len(accepted(records[8:])) >= len(records[8:]) - 2  # it turns once: there the speed is underestimated


def test_a_telescope_that_moves_too_fast_is_told_so(path: Path) -> None:
    """0.1 deg/s: in the shortest exposures of 0.3 s that it gets, it still moves by more than half a star."""

    def fast(time_s: float) -> np.ndarray:
        return math.radians(0.1) * np.array([math.cos(time_s), math.sin(time_s)])

    records, _, seen = record_night(path, Night(fast), None, replace(SETTINGS, first_exposure_s=0.3), minutes=0.6)
    assert sum(record.reject_reason is RejectReason.TELESCOPE_MOVED for record in records) > 0.8 * len(records)
    assert "limit" in next(r.detail for r in records if r.reject_reason is RejectReason.TELESCOPE_MOVED)
    assert "slowly" in seen[-1].warning


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

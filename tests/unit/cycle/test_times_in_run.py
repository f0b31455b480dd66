"""Times of exposures in the run: new runs keep them, runs of schema version 1 are read and upgraded."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path

import pytest
from fake_night import TELESCOPE, Night, new_run

from namod_ctl.cycle.record import Recorder, RecordSettings, StopRule
from namod_ctl.store.run import RunStore


def run_of_version_1(path: Path) -> None:
    night = Night()
    with new_run(path, night.clock) as store:
        Recorder(night.equipment, TELESCOPE, store, RecordSettings()).record(StopRule(n_records=3))
    connection = sqlite3.connect(path / "run.sqlite", isolation_level=None)
    connection.execute("ALTER TABLE records DROP COLUMN star_mid_exposure_s")
    connection.execute("ALTER TABLE records DROP COLUMN reflector_mid_exposure_s")
    connection.execute("PRAGMA user_version = 1")
    connection.close()


@pytest.mark.parametrize("read_only", [True, False])
def test_an_old_run_has_records_without_times(tmp_path: Path, read_only: bool) -> None:
    run_of_version_1(tmp_path / "RUN")
    with RunStore.open(tmp_path / "RUN", read_only=read_only) as run:
        records = run.records()
    assert len(records) == 3
    assert all(math.isnan(record.star_mid_exposure_s) for record in records)
    assert all(record.star_exposure_s > 0.0 for record in records)


def test_an_old_run_can_be_gone_on_with(tmp_path: Path) -> None:
    run_of_version_1(tmp_path / "RUN")
    night = Night()
    with RunStore.open(tmp_path / "RUN", read_only=False) as run:
        Recorder(night.equipment, TELESCOPE, run, RecordSettings()).record(StopRule(n_records=5))
    with RunStore.open(tmp_path / "RUN") as run:
        times_s = [record.star_mid_exposure_s for record in run.records()]
    assert [math.isnan(time_s) for time_s in times_s] == [True] * 3 + [False] * (len(times_s) - 3)

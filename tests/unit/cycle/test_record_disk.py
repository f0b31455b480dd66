"""A disk that is full, a run that is damaged or taken away."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from pathlib import Path

import pytest
from fake_night import TELESCOPE, Night, new_run
from recorded_night import SETTINGS, accepted

from namod_ctl.core.errors import StoreError
from namod_ctl.core.records import Record
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.store.run import RunStore


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


class FullDisk:
    """A run on a disk that is full for some of the attempts to store a record."""

    def __init__(self, store: RunStore, error: StoreError, n_refusals: int) -> None:
        self._store, self._error, self.n_refusals = store, error, n_refusals

    def __getattr__(self, name: str) -> object:
        return getattr(self._store, name)

    def append(self, records: list[Record], notes: Mapping[str, str] | None = None) -> None:
        if records[0].index == 5 and self.n_refusals > 0:
            self.n_refusals -= 1
            raise self._error
        self._store.append(records, notes)


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

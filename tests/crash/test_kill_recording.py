"""A recording that is killed or interrupted: the run always opens, is whole, and lacks at most the record in flight."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
from fake_night import TELESCOPE, Night, new_run

from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, RecordSettings, StopRule
from namod_ctl.store.folders import is_run
from namod_ctl.store.run import RunStore

N_KILLS = 30
LONGEST_LIFE_S = 0.5
PATIENCE_S = 40.0
SETTINGS = RecordSettings(keep_frames=True)


def record_until_killed(path: Path, told: Connection) -> None:
    """Record, or go on, and tell after every record how many the run has; runs in a process of its own."""
    night = Night()
    told.send(-1)
    store = RunStore.open(path, read_only=False) if is_run(path) else new_run(path, night.clock)

    def tell(progress: Progress) -> None:
        told.send(progress.n_accepted + sum(progress.rejected.values()))

    Recorder(night.equipment, TELESCOPE, store, SETTINGS).record(StopRule(), tell)


def check_whole(path: Path) -> int:
    """The number of records of the run, whose every record is complete."""
    with RunStore.open(path) as run:
        records = run.records()
        assert [record.index for record in records] == list(range(len(records)))
        for camera in ("star_camera", "reflector_camera"):
            files = run.frame_files(camera)
            assert set(range(len(records))) <= set(files) <= set(range(len(records) + 1))
        for record in records[-3:]:
            assert run.frame(record.index, "star_camera").shape == (240, 320)
            assert np.isfinite(record.facet_intensity).all()
    times_s = [record.star_mid_exposure_s for record in records]
    assert times_s == sorted(times_s)
    connection = sqlite3.connect(path / "run.sqlite")
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()
    return len(records)


def test_thirty_kills_at_random_moments(tmp_path: Path) -> None:
    """Every life goes on with the run that the last one left behind."""
    path, rng = tmp_path / "RUN", random.Random(3)
    context = get_context("forkserver")
    context.set_forkserver_preload(["namod_ctl.cycle.record", "pytest"])
    n_records = n_lives_with_records = 0
    for _ in range(N_KILLS):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=record_until_killed, args=(path, theirs), daemon=True)
        process.start()
        theirs.close()
        assert ours.poll(PATIENCE_S)
        time.sleep(LONGEST_LIFE_S * rng.random() ** 2)  # the moment is what is tested, nothing waits for it
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(PATIENCE_S)
        told = []
        try:
            while ours.poll():
                told.append(ours.recv())
        except (EOFError, OSError):  # it was killed in the middle of a word
            pass
        if not is_run(path):
            assert told == [-1]
            continue
        n_now = check_whole(path)
        n_told = max(told) if max(told) >= 0 else 0
        # what it had told was on the disk; with the record it had just stored, or was about to tell
        n_new = n_now - n_records
        assert n_new >= 0
        if n_told:
            n_lives_with_records += 1
            assert n_now >= n_told
            assert n_now <= n_told + 1
        n_records = n_now
    assert n_lives_with_records > N_KILLS // 3


Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts the program in a session of its own, as a terminal does; what still runs at the end is killed."""
    with ExitStack() as processes:

        def start(*arguments: str) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-c", "from namod_ctl.app.cli import main; main()", "record", *arguments],
                start_new_session=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            processes.enter_context(process)
            processes.callback(process.kill)
            return process

        yield start


def n_stored(path: Path) -> int:
    if not is_run(path):
        return 0
    with RunStore.open(path) as run:
        return len(run.labels())


def wait_for_records(path: Path, n_records: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while n_stored(path) < n_records:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_ctrl_c_ends_at_a_record_and_append_goes_on(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "RUN"
    process = start("--twin", "--out", str(path), "--records", "100000", "--every", "0")
    wait_for_records(path, 3, process)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to every process in front
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "stopped by hand" in output
    assert "Traceback" not in errors
    n_before = n_stored(path)

    process = start("--append", str(path), "--records", str(n_before + 5), "--every", "0")
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert n_stored(path) >= n_before + 5
    with RunStore.open(path) as run:
        records = run.records()
    assert [record.index for record in records] == list(range(len(records)))
    times_s = [record.star_mid_exposure_s for record in records]
    assert times_s == sorted(times_s)


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """Frames fill a disk of 1 MB; the recording waits, says so, and goes on when there is room."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if shutil.which("mount") is None:
        pytest.skip("needs the program mount")
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    mounted = subprocess.run(mount, capture_output=True, text=True, check=False)
    if mounted.returncode != 0:
        pytest.skip(f"mounting a small disk needs privileges: {mounted.stderr.strip()}")
    try:
        night, troubles = Night(), []

        def make_room(progress: Progress) -> None:
            if "trying again" in progress.trouble:
                troubles.append(progress.trouble)
                subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)

        with new_run(disk / "RUN", night.clock) as store:
            settings = replace(SETTINGS, store_retry_s=0.0)
            recorder = Recorder(night.equipment, TELESCOPE, store, settings)
            recorder.record(StopRule(n_records=40), make_room)
        assert len(troubles) == 1
        assert "space" in troubles[0]
        assert ["had to wait for the disk" in event for event in recorder.events] == [True]
        assert check_whole(disk / "RUN") >= 40
    finally:
        subprocess.run(["umount", str(disk)], check=True)

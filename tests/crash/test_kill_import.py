"""An import that is killed or interrupted: what is committed is whole, and resuming gives the same run, bit by bit."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from namod_files import write_folder
from typer.testing import CliRunner

from namod_ctl.app.commands.imports import app
from namod_ctl.core.records import Record
from namod_ctl.store.folders import is_run, partial_folder
from namod_ctl.store.run import RunStore

N_RECORDS = 40
N_KILLS = 10
PATIENCE_S = 30.0

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in Linux' /proc")


Start = Callable[..., subprocess.Popen[str]]

# the group of commands by itself starts in half the time of the whole program
COMMANDS = "from namod_ctl.app.commands.imports import app; app(['namod', *sys.argv[1:]])"
WHOLE_PROGRAM = "from namod_ctl.app.cli import main; sys.argv[1:1] = ['import', 'namod']; main()"


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts the command in a session of its own, as a terminal does; what still runs at the end is killed."""
    with ExitStack() as processes:

        def start(folder: Path, out: Path, *options: str, program: str = COMMANDS) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                [sys.executable, "-c", f"import sys; {program}", str(folder), "--out", str(out), *options],
                start_new_session=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            processes.enter_context(process)
            processes.callback(process.kill)
            return process

        yield start


def wait_until(condition: object, process: subprocess.Popen[str]) -> None:
    """Until the condition holds or the process has ended."""
    assert callable(condition)
    deadline = time.monotonic() + PATIENCE_S
    while not condition() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.002)


def n_committed(out: Path) -> int:
    if not is_run(partial_folder(out)):
        return 0
    with RunStore.open(partial_folder(out)) as run:
        return len(run.labels())


def living_in_session(session: int) -> list[int]:
    """Ids of the processes."""
    living = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, _, of_session = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            except OSError:  # it has just ended
                continue
            if int(of_session) == session and state != "Z":
                living.append(int(entry.name))
    return living


def fingerprint(record: Record) -> tuple[object, ...]:
    """Every bit of a record, comparable."""
    values = (getattr(record, name) for name in Record.__slots__)
    return tuple(np.asarray(v).tobytes() if isinstance(v, np.ndarray | float) else v for v in values)


def fingerprints(out: Path) -> list[tuple[object, ...]]:
    with RunStore.open(out) as run:
        return [fingerprint(record) for record in run.records()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("input") / "night"
    truth = write_folder(folder, N_RECORDS)
    (folder / f"{truth[3].prefix}_star.png").unlink()
    return folder


@pytest.fixture(scope="module")
def undisturbed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[object, ...]]:
    out = tmp_path_factory.mktemp("reference") / "run"
    result = CliRunner().invoke(app, ["namod", str(folder), "--out", str(out), "--jobs", "1"])
    assert result.exit_code == 0, result.output
    return fingerprints(out)


def test_sigkill_at_any_moment(
    start: Start, folder: Path, undisturbed: list[tuple[object, ...]], tmp_path: Path
) -> None:
    rng = random.Random(20140520)
    out = tmp_path / "run"
    n_kills, n_inside, n_finished = 0, 0, 0
    while n_kills < N_KILLS:
        options = ["--keep-frames", "all", "--jobs", "2" if n_kills % 5 == 4 else "1"]
        if is_run(partial_folder(out)):
            options.append("--resume")
        before = n_committed(out)
        process = start(folder, out, *options)
        # most of the time goes into starting Python: wait until it writes, then some milliseconds more
        wait_until(lambda before=before: n_committed(out) > before, process)
        time.sleep(rng.uniform(0.0, 0.1))
        os.kill(process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE_S)
        n_kills += 1
        if is_run(partial_folder(out)):
            found = fingerprints(partial_folder(out))
            assert found == undisturbed[: len(found)]
            n_inside += 0 < len(found) < N_RECORDS
        if is_run(out):
            assert fingerprints(out) == undisturbed
            n_finished += 1
            shutil.rmtree(out)
        deadline = time.monotonic() + PATIENCE_S
        while living_in_session(process.pid):  # its workers notice and end, too
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert n_inside >= N_KILLS // 2  # else the kills came too late to test anything

    options = ["--resume"] if is_run(partial_folder(out)) else []
    process = start(folder, out, "--keep-frames", "all", "--jobs", "1", *options)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert fingerprints(out) == undisturbed
    with RunStore.open(out) as run:
        for index in (0, N_RECORDS - 1):
            assert run.frame(index, "star_camera").shape == (240, 320, 3)
    assert [entry.name for entry in tmp_path.iterdir() if not entry.name.startswith(".")] == ["run"]


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_ctrl_c(start: Start, folder: Path, undisturbed: list[tuple[object, ...]], tmp_path: Path, n_jobs: int) -> None:
    out = tmp_path / "run"
    process = start(folder, out, "--jobs", str(n_jobs))
    wait_until(lambda: n_committed(out) > 0, process)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to every process in front
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "--resume" in errors
    assert "Traceback" not in errors
    assert not out.exists()

    process = start(folder, out, "--resume", "--jobs", str(n_jobs))
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert fingerprints(out) == undisturbed
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_a_worker_that_dies(start: Start, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    process = start(folder, out, "--jobs", "2", program=WHOLE_PROGRAM)
    wait_until(lambda: n_committed(out) > 0, process)
    for process_id in living_in_session(process.pid):
        if b"spawn_main" in (Path("/proc") / str(process_id) / "cmdline").read_bytes():
            os.kill(process_id, signal.SIGKILL)  # as the kernel does when memory is short
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, errors
    assert "a worker process died" in errors
    assert "Traceback" not in errors
    assert n_committed(out) > 0

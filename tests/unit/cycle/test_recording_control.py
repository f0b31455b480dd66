"""Ending a plain recording from elsewhere, and knowing whether anybody listens."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import StoreError
from namod_ctl.cycle.control import ControlBox, Request, RequestKind, send
from namod_ctl.cycle.recording_control import RecordingControl, pid_at_work
from namod_ctl.store.campaign_lock import UNKNOWN_PID

STOP = Request(kind=RequestKind.STOP)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "RUN"
    path.mkdir()
    return path


def test_stop_is_obeyed_at_the_next_look_and_answered(run: Path) -> None:
    asked: list[str] = []
    with RecordingControl(run, lambda: asked.append("stop")) as control:
        control.look()
        assert asked == []
        stop, pause = send(run, STOP, SystemClock()), send(run, Request(kind=RequestKind.PAUSE), SystemClock())
        control.look()
        assert asked == ["stop"]
        yes, no = stop.answer(), pause.answer()
    assert yes is not None
    assert yes.is_accepted
    assert no is not None
    assert not no.is_accepted
    assert list(run.iterdir()) == []


def test_request_for_an_earlier_recording_does_not_end_the_next(run: Path) -> None:
    early = send(run, STOP, SystemClock())
    with RecordingControl(run, lambda: pytest.fail("nobody wants this one to stop")) as control:
        control.look()
        answer = early.answer()
    assert answer is not None
    assert not answer.is_accepted


def test_somebody_is_at_work_as_long_as_the_recording_lives_however_it_ends(run: Path) -> None:
    assert pid_at_work(run) is None
    with RecordingControl(run, lambda: None):
        assert pid_at_work(run) == UNKNOWN_PID
    assert pid_at_work(run) is None
    program = (
        "import sys, time; from pathlib import Path\n"
        "from namod_ctl.cycle.recording_control import RecordingControl\n"
        "with RecordingControl(Path(sys.argv[1]), lambda: None):\n"
        "    print('there', flush=True); sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(run)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as recorder:
        assert recorder.stdout is not None
        assert recorder.stdout.readline() == b"there\n"
        assert pid_at_work(run) == UNKNOWN_PID
        os.kill(recorder.pid, signal.SIGKILL)
        recorder.wait(10.0)
    assert pid_at_work(run) is None
    with RecordingControl(run, lambda: None):  # what the killed one left is in nobody's way
        assert pid_at_work(run) == UNKNOWN_PID


def test_trouble_with_the_folder_stops_on_request_and_ends_no_recording(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def refuse(*_: object, **__: object) -> None:
        raise StoreError("no space left on device")

    with RecordingControl(run, lambda: asked.append("stop")) as control:
        send(run, STOP, SystemClock())
        monkeypatch.setattr(ControlBox, "answer", refuse)
        control.look()
        assert asked == ["stop"]
        monkeypatch.setattr(ControlBox, "poll", refuse)
        control.look()

"""The control box of a plain recording: somebody elsewhere can end it in order, as the first Ctrl-C does.

It lies in RUN/control/ and is there while a recording goes on. Who records holds a lock on that folder, which the
operating system lets go of however the program ends.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from namod_ctl.core.errors import StoreError
from namod_ctl.cycle.control import ControlBox, Request, RequestKind
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.store.campaign_folder import CONTROL_FOLDER
from namod_ctl.store.campaign_lock import UNKNOWN_PID, running_pid
from namod_ctl.store.database import store_errors

_STOPPING = "stopping: the recording ends after the record in work, and keeps all before it"


class RecordingControl:
    """Takes requests to stop while the block lasts; a context manager. `look` is for the recorder's progress.

    Parameters
    ----------
    run
        Folder of the run that is recorded.
    ask_to_stop
        Called when somebody asks to stop; as often as somebody does.

    Raises
    ------
    StoreError
        The folder cannot be written, at the beginning. Later such trouble is silent: the records are worth more.
    """

    def __init__(self, run: Path, ask_to_stop: Callable[[], None]) -> None:
        self._folder, self._ask_to_stop = run / CONTROL_FOLDER, ask_to_stop
        with store_errors(self._folder):
            self._folder.mkdir(exist_ok=True)
            self._descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        with suppress(OSError):  # some file systems know no locks: then nobody can be told that somebody listens
            # waits for those who look just now, some microseconds; no other recording can be here (`recording_lock`)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        self._box = ControlBox(run)
        self._refuse_all("this was for an earlier recording: look again")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(StoreError):
            self._refuse_all("the recording has ended already")
        os.close(self._descriptor)
        with suppress(OSError):  # an answer that nobody has fetched yet
            self._folder.rmdir()

    def look(self) -> None:
        """Obey a request to stop, if there is one; some microseconds if there is none."""
        try:
            requests = self._box.poll()
        except StoreError:  # a folder that cannot be read must not end a recording
            return
        for request in requests:
            if request.kind is RequestKind.STOP:
                self._ask_to_stop()
                self._answer(request, _STOPPING, is_accepted=True)
            else:
                self._answer(request, "a plain recording can only be stopped", is_accepted=False)

    def _refuse_all(self, why: str) -> None:
        for request in self._box.poll():
            self._answer(request, why, is_accepted=False)

    def _answer(self, request: Request, text: str, *, is_accepted: bool) -> None:
        with suppress(StoreError):  # a full disk: who asked is told that it was taken
            self._box.answer(request, text, is_accepted=is_accepted)


def pid_at_work(path: Path) -> int | None:
    """Id of the process that takes requests for that campaign or run, `UNKNOWN_PID` where it is not told; None: nobody.

    Raises StoreError when the folder cannot be read.
    """
    if is_campaign(path):
        return running_pid(path)
    folder = path / CONTROL_FOLDER
    with store_errors(folder):
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:  # somebody has it; or there are no locks here, and that the folder is there has to do
            return UNKNOWN_PID
        finally:
            os.close(descriptor)
    return None

"""Requests from another terminal to the process that works on a campaign: one file each in CAMPAIGN/control/.

Files and no socket: they need no port and no rights beyond those on the folder, work over a network file system,
and any shell can look at them. A request appears whole (temporary file, rename) and is taken by removing it; the
one who removes it first decides whether it was taken or withdrawn, so that nothing is carried out that its sender
was told nobody heard.

Cost of looking when nothing is there: one listing of an empty folder, 6 us (`tests/unit/cycle/test_control.py`
bounds it). Modification times would cost as much and miss a file that arrives within their resolution.
"""

from __future__ import annotations

import os
import re
import stat
import uuid
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from namod_ctl.core.clock import Clock
from namod_ctl.store.campaign_folder import CONTROL_FOLDER
from namod_ctl.store.database import store_errors
from namod_ctl.store.frames import write_file_durably

ALL: Final = "all"
_MAX_BYTES = 65536  # 10000 facets are listed in less
_REQUEST, _ANSWER = ".request", ".answer"
_ANSWER_NAME = re.compile(r"[0-9a-f]{32}\.answer")
_FacetId: TypeAlias = Annotated[int, Field(ge=0, lt=2**31)]


class RequestKind(StrEnum):
    """What can be asked of a running campaign."""

    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"
    APPROVE = "approve"
    REFUSE = "refuse"
    RELEASE = "release"
    DONE = "done"
    NOT_DONE = "not_done"


OF_FACETS = frozenset({RequestKind.DONE, RequestKind.NOT_DONE})
_ABOUT_THIS_MOMENT = frozenset({RequestKind.APPROVE, RequestKind.RELEASE})


class Request(BaseModel):
    """One request.

    Attributes
    ----------
    facet_ids
        Of a `done`: the facets whose bolts were turned, or "all"; of a `not_done` those of which that was said by
        mistake. Empty for every other kind.
    id
        Unique; names the file of the answer.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    kind: Annotated[RequestKind, Field(strict=False)]
    facet_ids: Annotated[tuple[_FacetId, ...], Field(strict=False)] | Literal["all"] = ()
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")] = Field(default_factory=lambda: uuid.uuid4().hex)

    @model_validator(mode="after")
    def _check_facets(self) -> Request:
        if (self.kind in OF_FACETS) != bool(self.facet_ids):
            raise ValueError(f"a request to {self.kind} with facets {self.facet_ids!r}")
        return self


class Answer(BaseModel):
    """What came of a request.

    Attributes
    ----------
    is_accepted
        False: nothing was done, because it does not fit what goes on.
    text
        One line for the person who asked.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    is_accepted: bool
    text: str


class SentRequest:
    """A request that lies in the control folder, for its sender to look after."""

    def __init__(self, campaign: Path, file_name: str, request: Request) -> None:
        self.request = request
        self._file = campaign / CONTROL_FOLDER / file_name
        self._answer_file = self._file.with_name(request.id + _ANSWER)

    def is_taken(self) -> bool:
        """Has somebody taken it?"""
        return not self._file.exists()

    def answer(self) -> Answer | None:
        """What was answered, None as long as nothing was; fetching it removes it.

        Raises StoreError when the answer cannot be read.
        """
        with store_errors(self._answer_file):
            try:
                data = self._answer_file.read_bytes()
            except FileNotFoundError:
                return None
            _remove(self._answer_file)
        try:
            return Answer.model_validate_json(data)
        except ValidationError:
            return Answer(is_accepted=True, text="taken; the answer cannot be read")

    def withdraw(self) -> bool:
        """Take it back; False when it was taken before, so that it is or will be carried out."""
        with store_errors(self._file):
            return _remove(self._file)


def send(campaign: Path, request: Request, clock: Clock) -> SentRequest:
    """The request, which is in the control folder when this returns; whether anybody looks there is not known.

    Raises StoreError when the folder cannot be written.
    """
    moment = clock.now().strftime("%Y%m%dT%H%M%S.%f")  # sorts by time
    file_name = f"{moment}-{request.id}{_REQUEST}"
    folder = campaign / CONTROL_FOLDER
    with store_errors(folder):
        folder.mkdir(exist_ok=True)
        write_file_durably(folder / file_name, request.model_dump_json().encode())
    return SentRequest(campaign, file_name, request)


class ControlBox:
    """The control folder of a campaign, as seen by the process that works on it.

    Answers that nobody fetched are removed at the beginning. Requests that were sent before come with the first
    `poll`, but those that let something move are answered with no: they were about what an earlier process, killed
    before it looked, had shown to a person.
    """

    def __init__(self, campaign: Path) -> None:
        self._folder = campaign / CONTROL_FOLDER
        self._complaints: list[str] = []
        self._folders_seen: set[str] = set()
        self._early: list[Request] = []
        with store_errors(self._folder):
            self._folder.mkdir(exist_ok=True)
            for name in os.listdir(self._folder):
                if _ANSWER_NAME.fullmatch(name):
                    _remove(self._folder / name)
        for request in self.poll():
            if request.kind in _ABOUT_THIS_MOMENT:
                self.answer(request, f"too early to {request.kind}: look at the status again", is_accepted=False)
            else:
                self._early.append(request)

    def poll(self) -> list[Request]:
        """Requests that have arrived, in the order in which they were sent; each is returned once.

        What is no request is removed and complained about. Raises StoreError when the folder cannot be read or
        a file in it cannot be removed.
        """
        try:
            names = os.listdir(self._folder)
        except FileNotFoundError:  # somebody deleted it: nobody asks for anything; the next sender makes it anew
            names = []
        except OSError:
            with store_errors(self._folder):
                raise
        early, self._early = self._early, []
        if not names:
            return early
        # temporary files of senders that are writing begin with a dot
        arrived = sorted(name for name in names if not name.startswith(".") and not _ANSWER_NAME.fullmatch(name))
        taken = (self._take(name) for name in arrived)
        return early + [request for request in taken if request is not None]

    def answer(self, request: Request, text: str, *, is_accepted: bool = True) -> None:
        """Tell the sender of a request what came of it, in one line for a person.

        Raises StoreError when the disk refuses.
        """
        file = self._folder / (request.id + _ANSWER)
        with store_errors(file):
            self._folder.mkdir(exist_ok=True)
            answer = Answer(is_accepted=is_accepted, text=text)
            write_file_durably(file, answer.model_dump_json().encode())

    def complaints(self) -> list[str]:
        """What was found in the folder and is no request, one line each, since this was asked last."""
        complaints, self._complaints = self._complaints, []
        return complaints

    def _take(self, name: str) -> Request | None:
        """The request in a file, which is removed; None when it is none, or was withdrawn."""
        file = self._folder / name
        with store_errors(file):
            try:
                status = file.lstat()
                if stat.S_ISDIR(status.st_mode):  # may hold anything: not ours to delete
                    if name not in self._folders_seen:
                        self._folders_seen.add(name)
                        self._complain(name, "is a folder; it is left alone")
                    return None
                data = file.read_bytes() if stat.S_ISREG(status.st_mode) and status.st_size <= _MAX_BYTES else None
            except FileNotFoundError:
                return None
            except PermissionError:
                data = None
            if not _remove(file):
                return None
        if data is None:
            self._complain(name, "is no readable file of a request's size; removed")
            return None
        try:
            return Request.model_validate_json(data)
        except ValidationError as error:
            self._complain(name, f"is no request ({error.errors()[0]['msg']}); removed")
            return None

    def _complain(self, name: str, what: str) -> None:
        self._complaints.append(f"{self._folder}: {name!r} {what}")


def _remove(file: Path) -> bool:
    """Remove the file; False when it was not there any more. Raises OSError."""
    try:
        file.unlink()
    except FileNotFoundError:
        return False
    return True

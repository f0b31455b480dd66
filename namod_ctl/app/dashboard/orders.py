"""Commands from the page: they go the way of `namod-ctl pause` and the others, through the control box on the disk."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from namod_ctl.app.commands.control import LOOK_S, PATIENCE_S
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import StoreError
from namod_ctl.cycle.control import ALL, Answer, Request, RequestKind, SentRequest, send
from namod_ctl.cycle.recording_control import pid_at_work

_ABOUT_WHAT_WAS_SEEN = frozenset({RequestKind.APPROVE, RequestKind.DONE, RequestKind.NOT_DONE})
_STALE = "the page showed something else than what is asked now: look again"


class Order(BaseModel):
    """What a page sends.

    Attributes
    ----------
    facets
        Of `done` and `not_done`: the facets whose bolts were turned, or were not after all; or "all".
    step
        Number of the journal's last step that the page showed: an approval holds for that preview and no other, a
        mark for the sheet of that cycle.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    kind: Literal["stop", "pause", "resume", "approve", "refuse", "done", "not_done"]
    facets: Annotated[list[int], Field(max_length=500)] | Literal["all"] = []
    step: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True, slots=True)
class Reply:
    """HTTP status and one line for the person who asked."""

    status: int
    text: str


def read_order(body: bytes) -> Order | Reply:
    """The order in a request's body, or why it is none."""
    try:
        return Order.model_validate_json(body)
    except ValidationError as error:
        return Reply(422, f"this is no command: {error.errors()[0]['msg']}")


async def carry_out(path: Path, order: Order, step: int) -> Reply:
    """Ask the process that works on the campaign, or records the run, and wait for what it says.

    `step` is the number of the journal's last step at this moment.
    """
    kind = RequestKind(order.kind)
    if kind in _ABOUT_WHAT_WAS_SEEN and order.step != step:
        return Reply(409, _STALE)
    try:
        request = Request(kind=kind, facet_ids=ALL if order.facets == ALL else tuple(order.facets))
    except ValidationError as error:
        return Reply(422, f"this is no command: {error.errors()[0]['msg']}")
    try:
        if await asyncio.to_thread(pid_at_work, path) is None:
            return Reply(409, f"nobody is at work on this, so nobody was asked to {_in_words(kind)}")
        sent = await asyncio.to_thread(send, path, request, SystemClock())
        answer = await _answer(path, sent)
        if answer is not None:
            return Reply(200 if answer.is_accepted else 409, answer.text)
        if sent.is_taken():
            return Reply(200, f"taken: {_in_words(kind)}")
        if kind is RequestKind.STOP:
            return Reply(504, "the program has not looked yet; the request to stop stays until it does")
        is_withdrawn = sent.withdraw()
    except StoreError as error:
        return Reply(503, str(error))
    return (
        Reply(504, "nobody took it: withdrawn, try again") if is_withdrawn else Reply(200, f"taken: {_in_words(kind)}")
    )


def _in_words(kind: RequestKind) -> str:
    return {RequestKind.DONE: "mark facets", RequestKind.NOT_DONE: "take marks back"}.get(kind, kind.value)


async def _answer(path: Path, sent: SentRequest) -> Answer | None:
    """The answer; None when there is none in time, or nobody left to give it."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        pid = pid_at_work(path)  # before the look: one who answers and ends at once has answered
        if (answer := sent.answer()) is not None:
            return answer
        if pid is None:
            return None
        await asyncio.sleep(LOOK_S)  # for another process there is nothing to wait on but its file
    return None

"""Signals that end a program: while drives move, all of them must lead to an orderly stop."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_ENDING = ("SIGTERM", "SIGHUP")


def leave(number: int, frame: FrameType | None) -> None:
    """SystemExit with the exit code of that signal; on the way out whoever moves drives stops them."""
    raise SystemExit(128 + number)


@contextmanager
def ended_in_order(handler: Callable[[int, FrameType | None], object] = leave) -> Iterator[None]:
    """SIGTERM, and SIGHUP of a terminal that is closed or a line that is lost, call `handler` in the block.

    Without one they end the program there and then, while legs go on. A SIGHUP that nohup ignores stays ignored.
    """
    numbers = [signal.Signals[name] for name in _ENDING if name in signal.Signals.__members__]
    heeded = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heeded}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)

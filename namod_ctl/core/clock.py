"""Time as an argument: what tells the time, so that tests and the twin can tell it themselves."""

from __future__ import annotations

import threading
import time
from datetime import UTC, datetime
from typing import Protocol


class Clock(Protocol):
    """Something that knows the time of day."""

    def now(self) -> datetime:
        """The present moment, aware of its time zone (UTC)."""
        ...


class SystemClock:
    """The computer's own clock."""

    def now(self) -> datetime:
        """The present moment in UTC."""
        return datetime.now(UTC)


class SystemMonotonicClock:
    """The computer's seconds since it started; satisfies `core.interfaces.MonotonicClock`."""

    def monotonic_s(self) -> float:
        """Seconds that never go back."""
        return time.monotonic()

    def wait_s(self, duration_s: float) -> None:
        """Return when `duration_s` has passed, or earlier with what a signal's handler raises (Ctrl-C, SIGTERM)."""
        threading.Event().wait(max(duration_s, 0.0))

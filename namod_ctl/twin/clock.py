"""The twin's two clocks: seconds that only the twin moves, and a wall clock that may be wrong."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

FIRST_MOMENT = datetime(2026, 11, 22, 21, 0, 0, tzinfo=UTC)


class ManualClock:
    """Monotonic seconds from 0 that pass only when somebody waits; safe to share between threads."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._lock = threading.Lock()

    def monotonic_s(self) -> float:
        """Seconds since the twin began."""
        return self._now_s

    def wait_s(self, duration_s: float) -> None:
        """Let `duration_s` pass, at once."""
        with self._lock:
            self._now_s += max(duration_s, 0.0)

    def advance_to_s(self, time_s: float) -> None:
        """Let time pass until `time_s`; nothing if that is over."""
        with self._lock:
            self._now_s = max(self._now_s, time_s)


class WallClock:
    """Time of day of the twin: the manual clock's seconds, and an error that faults make."""

    def __init__(self, clock: ManualClock, error_s: Callable[[float], float]) -> None:
        self._clock = clock
        self._error_s = error_s

    def now(self) -> datetime:
        """The present moment in UTC; goes back when the clock is set back."""
        now_s = self._clock.monotonic_s()
        return FIRST_MOMENT + timedelta(seconds=now_s + self._error_s(now_s))

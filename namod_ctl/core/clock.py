"""Time as an argument: what tells the time, so that tests and the twin can tell it themselves."""

from __future__ import annotations

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

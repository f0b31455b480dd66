"""Somebody sets the computer's clock back: noticed, and told."""

from __future__ import annotations

from datetime import datetime, timedelta

CLOCK_STEP = timedelta(seconds=1)


class WallClockWatch:
    """Compares each time of day with the one before."""

    def __init__(self) -> None:
        self._last: datetime | None = None

    def step(self, now: datetime) -> str:
        """What happened to the clock, for a person; empty when nothing did."""
        last, self._last = self._last, now
        if last is None or now >= last - CLOCK_STEP:
            return ""
        return (
            f"the computer's clock was set back by {last - now}: labels go back with it, the records' order and times "
            "do not"
        )

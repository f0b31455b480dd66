"""What drives said last, for whoever shows it: overheard from the questions that are asked anyway."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError, DeviceFaultError

SHOW_EVERY_S = 0.5
"""What was heard is shown no more often, by the computer's clock."""

Heard = DriveState | str
"""A drive's state, or in words why it did not tell any."""


class LegWatch:
    """Collects what drives say, from any thread, and shows it in the thread of `show`'s caller.

    Parameters
    ----------
    show
        Given what is new since it was called last, by leg.
    """

    def __init__(self, show: Callable[[Mapping[Leg, Heard]], None], now_s: Callable[[], float] = time.monotonic):
        self._show, self._now_s = show, now_s
        self._lock = threading.Lock()
        self._news: dict[Leg, Heard] = {}
        self._shown_s = -math.inf

    def hear(self, leg: Leg, said: Heard) -> None:
        """Keep what a drive said, in place of what it said before."""
        with self._lock:
            self._news[leg] = said

    def show(self, *, now: bool = False) -> None:
        """Show what is new, if there is anything and it is time for it, or `now`."""
        if not now and self._now_s() < self._shown_s + SHOW_EVERY_S:
            return
        with self._lock:
            news, self._news = self._news, {}
        if news:
            self._shown_s = self._now_s()
            self._show(news)


class WatchedDrive:
    """A drive whose answers are overheard."""

    def __init__(self, leg: Leg, drive: Drive, watch: LegWatch) -> None:
        self._leg, self._drive, self._watch = leg, drive, watch

    @property
    def name(self) -> str:
        """Its name."""
        return self._drive.name

    @property
    def range_m(self) -> tuple[float, float]:
        """Its soft limits."""
        return self._drive.range_m

    @property
    def resolution_m(self) -> float:
        """Its step."""
        return self._drive.resolution_m

    def identity(self) -> str:
        """What it says it is."""
        return self._drive.identity()

    def state(self) -> DriveState:
        """Its state, or its silence, which the watch hears as well."""
        try:
            state = self._drive.state()
        except (CommunicationError, DeviceFaultError) as error:
            self._watch.hear(self._leg, str(error))
            raise
        self._watch.hear(self._leg, state)
        return state

    def start_move(self, position_m: float) -> None:
        """Begin to move."""
        self._drive.start_move(position_m)

    def start_homing(self) -> None:
        """Begin to seek the reference."""
        self._drive.start_homing()

    def stop(self) -> None:
        """Halt."""
        self._drive.stop()

    def clear_faults(self) -> None:
        """Acknowledge faults."""
        self._drive.clear_faults()

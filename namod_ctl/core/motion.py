"""Words of motion: what a leg is ordered to do, what came of it, and the switch that stops everything."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import StrEnum

from namod_ctl.core.drives import Leg


@dataclass(frozen=True, slots=True)
class MoveOrder:
    """One leg is to be brought to an absolute position.

    Attributes
    ----------
    start_m
        Readback on which the order rests; a drive found elsewhere when the order is to be carried out refuses it.
    target_m
        Absolute, in the drive's frame: carrying it out twice moves nothing twice.
    """

    leg: Leg
    start_m: float
    target_m: float


class MoveOutcome(StrEnum):
    """What came of an order; the value is its name in the journal."""

    ARRIVED = "arrived"
    REFUSED = "refused"  # before it moved: a limit, a changed readback, a drive that is not homed
    STOPPED = "stopped"  # somebody or something stopped all motion
    OFF_TARGET = "off_target"  # it stands still, elsewhere
    FAULT = "fault"  # the drive reports a fault
    LOST = "lost"  # the drive does not answer: where the leg is, nobody knows
    UNKNOWN = "unknown"  # ordered before a crash, no result on record


@dataclass(frozen=True, slots=True)
class MoveResult:
    """What came of an order.

    Attributes
    ----------
    readback_m
        Position the drive says afterwards; NaN when it does not answer.
    detail
        One line for a person; empty when it arrived.
    """

    order: MoveOrder
    outcome: MoveOutcome
    readback_m: float
    detail: str = ""


class StopSwitch:
    """The one switch that every stop path throws; seen by all workers between two exchanges on their bus.

    Once thrown it stays: only a new switch, after a person has released, lets anything move.
    """

    def __init__(self) -> None:
        self._thrown = threading.Event()
        self._lock = threading.Lock()
        self.reason = ""

    def throw(self, reason: str) -> None:
        """Stop everything. The first reason is kept. Safe from any thread and from signal handlers' deferred calls."""
        with self._lock:
            if not self._thrown.is_set():
                self.reason = reason
                self._thrown.set()

    @property
    def is_thrown(self) -> bool:
        """Has anybody thrown it?"""
        return self._thrown.is_set()

"""Drives without a protocol: physics on a manual clock, and whatever can go wrong with them, at will."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.units import mm_to_m, um_to_m

SPEED_M_PER_S = mm_to_m(1.0)
STEP_M = um_to_m(3.0)
HURRIED_S = 0.03
RANGE_M = (mm_to_m(-5.0), mm_to_m(5.0))


class TestClock:
    """Seconds that pass when somebody waits or when a slow drive is asked."""

    __test__ = False

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic_s(self) -> float:
        return self.now_s

    def wait_s(self, duration_s: float) -> None:
        self.now_s += duration_s


@dataclass
class FakeDrive:
    """Moves at one speed; every order and the time at which it stood still are kept."""

    clock: TestClock
    name: str = "fake"
    start_m: float = 0.0
    is_homed: bool = True
    faults: tuple[str, ...] = ()
    silent_s: tuple[float, float] = (math.inf, math.inf)
    never_answers_stop: bool = False
    reset_at_s: float = math.inf
    barrier_m: float = math.inf
    lost_share: float = 0.0
    timeouts_take_s: float = 0.0
    is_hurried: bool = False
    refuses_stops: bool = False
    range_m: tuple[float, float] = RANGE_M
    resolution_m: float = STEP_M
    bug: Exception | None = None
    orders: list[tuple[float, str, float]] = field(default_factory=list)
    on_question: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self._from_m, self._to_m, self._since_s = self.start_m, self.start_m, 0.0
        self._gain = 1.0

    def place(self, position_m: float) -> None:
        """Somebody turned it there by hand."""
        self._from_m = self._to_m = position_m

    def identity(self) -> str:
        self._hear()
        return f"{self.name} v1"

    def true_m(self, time_s: float | None = None) -> float:
        time_s = min(self.clock.now_s if time_s is None else time_s, self.reset_at_s)
        way_m = self._to_m - self._from_m
        gone_m = min(abs(way_m), max(time_s - self._since_s, 0.0) * SPEED_M_PER_S)
        return min(self._from_m + math.copysign(gone_m, way_m) * self._gain, self.barrier_m)

    def moves_at(self, time_s: float) -> bool:
        is_on_way = abs(self._to_m - self._from_m) > (time_s - self._since_s) * SPEED_M_PER_S
        is_free = self.true_m(time_s) < self.barrier_m or self._to_m < self._from_m
        return is_on_way and time_s < self.reset_at_s and is_free

    def _hear(self) -> None:
        self.on_question()
        if self.bug is not None:
            raise self.bug
        if self.silent_s[0] <= self.clock.now_s < self.silent_s[1]:
            self.clock.now_s += min(self.timeouts_take_s, HURRIED_S) if self.is_hurried else self.timeouts_take_s
            raise CommunicationError(f"{self.name}: no answer")

    def state(self) -> DriveState:
        self._hear()
        now_s = self.clock.now_s
        has_hit = self.true_m() >= self.barrier_m
        is_homed = self.is_homed and now_s < self.reset_at_s
        faults = (*self.faults, *(("right limit switch hit",) if has_hit else ()))
        return DriveState(self.true_m() if is_homed else math.nan, self.moves_at(now_s), is_homed, faults)

    def start_move(self, position_m: float) -> None:
        if not self.range_m[0] <= position_m <= self.range_m[1]:
            raise LimitError(f"{self.name}: out of range")
        self._hear()
        self._set_off("move", round(position_m / STEP_M) * STEP_M)
        self._gain = 1.0 - self.lost_share

    def start_homing(self) -> None:
        self._hear()
        self._set_off("home", 0.0)
        self.is_homed = True

    def stop(self) -> None:
        if self.never_answers_stop:
            raise CommunicationError(f"{self.name}: no answer to the stop")
        self._hear()
        if self.refuses_stops:
            raise DeviceFaultError(f"{self.name} refuses to stop")
        self._set_off("stop", self.true_m())

    def clear_faults(self) -> None:
        self._hear()
        self.faults = ()

    def _set_off(self, order: str, to_m: float) -> None:
        here_m = self.true_m()
        self.orders.append((self.clock.now_s, order, to_m))
        self._from_m, self._to_m, self._since_s, self._gain = here_m, to_m, self.clock.now_s, 1.0

    def moves(self) -> list[float]:
        return [to_m for _, order, to_m in self.orders if order == "move"]


@dataclass
class FakeBus:
    name: str
    drives: dict[Leg, Drive]
    max_moving: int = 3

    def hurry(self, is_hurried: bool) -> None:
        for drive in self.drives.values():
            if isinstance(drive, FakeDrive):
                drive.is_hurried = is_hurried

    def scan(self) -> list[str]:
        return []

    def close(self) -> None: ...

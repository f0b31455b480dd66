"""What one leg goes through until its order is carried out or has come to nothing: visit by visit, no waiting."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOrder, MoveOutcome
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import m_to_mm

SLOWNESS = 3.0
"""A motion may take so many times as long as its way at the set speed (ramps, a drive that is set slower), and"""
GRACE_S = 3.0
"""so much longer, before the leg counts as one that does not get there."""
MAX_LOOK_S = 0.5
"""A moving drive is asked when it should be there, and then every `poll_s`; but not more rarely than this."""
N_FAILURES = 3
"""A drive that refuses so often while it is being stopped is left alone."""


def approach_of(start_m: float, target_m: float, approach_m: float) -> tuple[float, ...]:
    """Where a leg goes, one after the other, so that it reaches its target upwards."""
    if target_m < start_m and approach_m > 0.0:
        return (target_m - approach_m, target_m)
    return (target_m,)


def refusal(order: MoveOrder, state: DriveState, drive: Drive, settings: MotionSettings) -> str:
    """Why a leg must not be moved, for a person; empty when it may be."""
    way_m = abs(order.target_m - order.start_m)
    low_m, high_m = drive.range_m
    moved_m = abs(state.position_m - order.start_m)
    lowest_m = min(approach_of(order.start_m, order.target_m, settings.approach_m))
    if not state.is_homed:
        return "it is not homed: namod-ctl actuators home"
    if state.faults:
        return f"it reports: {'; '.join(state.faults)}"
    if state.is_moving:
        return "it moves, by somebody else's order"
    if not moved_m <= settings.arrival_tolerance_m:  # NaN as well
        return (
            f"it stands at {_mm(state.position_m)} mm, not at {_mm(order.start_m)} mm where the order was reckoned "
            "from: something moved it since; reckon anew"
        )
    if not way_m <= settings.max_travel_per_cycle_m:
        return f"{_mm(way_m)} mm is more than the {_mm(settings.max_travel_per_cycle_m)} mm that one cycle allows"
    if not low_m <= order.target_m <= high_m:
        return f"its target {_mm(order.target_m)} mm is outside of its range {_mm(low_m)} to {_mm(high_m)} mm"
    if lowest_m < low_m:
        return (
            f"its target {_mm(order.target_m)} mm is so close to its lower limit {_mm(low_m)} mm that there is no room "
            f"to come from {_mm(settings.approach_m)} mm below"
        )
    return ""


class Course(ABC):
    """One leg's way to the end of its order; used by the worker of its bus only, until it has an outcome.

    Attributes
    ----------
    may_move
        An order to move has been sent, or its sending was begun.
    due_s
        When to visit the drive next.
    limit_s
        When it is too late to be under way; -inf before it is ordered to move.
    outcome
        None as long as there is something to do; `readback_m` and `detail` belong to it.
    """

    def __init__(self, leg: Leg, drive: Drive, settings: MotionSettings) -> None:
        self.leg, self.drive, self._settings = leg, drive, settings
        self.may_move = False
        self.due_s = -math.inf
        self.limit_s = -math.inf
        self.readback_m = math.nan
        self.detail = ""
        self.outcome: MoveOutcome | None = None
        self._is_ordered = False
        self._expected_s = -math.inf
        self._at_rest_since_s = math.inf
        self._verdict: tuple[MoveOutcome, str] | None = None
        self._n_failures = 0

    def finish(self, outcome: MoveOutcome, detail: str = "") -> None:
        """There is nothing more to do."""
        self.detail = detail
        self.outcome = outcome  # last: other threads look at it

    def halt(self, outcome: MoveOutcome, detail: str) -> None:
        """Stop the leg, and finish as soon as it is seen to stand; the first reason is kept.

        Raises
        ------
        CommunicationError, DeviceFaultError
            The drive did not take the stop. The next visits repeat it as long as the leg moves.
        """
        self._verdict = self._verdict or (outcome, detail)
        self._at_rest_since_s = math.inf
        self.drive.stop()

    def look(self) -> DriveState:
        """The drive's state; the readback is kept."""
        state = self.drive.state()
        self.readback_m = state.position_m
        return state

    @abstractmethod
    def refusal(self, state: DriveState) -> str:
        """Why nothing may be begun; empty when it may."""

    @abstractmethod
    def _begin(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        """Send the first order, or the same again if it is not known whether it was received."""

    @abstractmethod
    def _follow(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        """Judge a drive that was ordered to move; `_rests` tells whether it stands."""

    def check(self) -> None:
        """Ask the drive whether it can be moved; send nothing else. Raises what drives raise."""
        words = self.refusal(self.look())
        if words:
            self.finish(MoveOutcome.REFUSED, words)

    def visit(self, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        """Ask the drive, and do what is to be done next. `may_start` is asked right before a leg is set moving.

        Raises
        ------
        CommunicationError, DeviceFaultError, LimitError
            From the drive; the next visit goes on from there.
        """
        now_s = clock.monotonic_s()  # before the answer: a drive that moved then may have been late, not later
        state = self.look()
        self.due_s = self._next_look_s(now_s)
        if self._verdict is not None:
            self._wind_up(state, now_s)
        elif not self.may_move:
            words = self.refusal(state)
            if words:
                self.finish(MoveOutcome.REFUSED, words)
            else:
                self._begin(state, clock, may_start)
        elif self._is_ordered:
            self._follow(state, clock, may_start)
            if self.outcome is None and self._verdict is None and state.is_moving and now_s > self.limit_s:
                self.halt(MoveOutcome.OFF_TARGET, "it still moved after the longest time that its way can take")
        else:
            self._begin(state, clock, may_start)

    def fail(self, words: str) -> None:
        """The drive refuses or reports a fault in mid-move: it is stopped as well as it takes it."""
        if not self.may_move:
            self.finish(MoveOutcome.REFUSED, words)
            return
        self._n_failures += 1
        if self._n_failures > N_FAILURES:
            self.finish(MoveOutcome.FAULT, words)
            return
        with suppress(CommunicationError, DeviceFaultError):  # the next visit repeats the stop if it moves
            self.halt(MoveOutcome.FAULT, words)

    def _wind_up(self, state: DriveState, now_s: float) -> None:
        outcome, detail = self._verdict or (MoveOutcome.FAULT, "")
        if not state.is_moving:
            self.finish(outcome, detail)
        elif now_s > self.limit_s + GRACE_S:
            self.finish(MoveOutcome.FAULT, f"{detail}; it moves in spite of its stop: cut its power")
        else:
            self.drive.stop()

    def _rests(self, state: DriveState, clock: MonotonicClock) -> bool:
        """Has it stood still for as long as it takes to settle?"""
        now_s = clock.monotonic_s()
        if state.is_moving:
            self._at_rest_since_s = math.inf
            return False
        self._at_rest_since_s = min(self._at_rest_since_s, now_s)
        ready_s = self._at_rest_since_s + self._settings.settle_s
        self.due_s = ready_s
        return now_s >= ready_s

    def _is_under_way(self, clock: MonotonicClock, expected_s: float) -> None:
        """It has been ordered to move, and should take so long."""
        self._is_ordered = True
        self._at_rest_since_s = math.inf
        now_s = clock.monotonic_s()
        self.limit_s = now_s + SLOWNESS * expected_s + GRACE_S
        self._expected_s = now_s + expected_s
        self.due_s = self._next_look_s(now_s)

    def _next_look_s(self, now_s: float) -> float:
        return now_s + max(min(self._expected_s - now_s, MAX_LOOK_S), self._settings.poll_s)


class MoveCourse(Course):
    """To an absolute target, the last way upwards, with one more try when it stands elsewhere."""

    def __init__(self, order: MoveOrder, drive: Drive, settings: MotionSettings) -> None:
        super().__init__(order.leg, drive, settings)
        self.order = order
        self._ways: tuple[float, ...] = ()
        self._is_second_try = False

    def refusal(self, state: DriveState) -> str:
        """See `refusal` of this module."""
        return refusal(self.order, state, self.drive, self._settings)

    def _begin(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        if self._is_lost_or_faulty(state):
            return
        target_m = self.order.target_m
        if not self.may_move and abs(target_m - state.position_m) <= 0.5 * self.drive.resolution_m:
            self.finish(MoveOutcome.ARRIVED)  # no step would bring it closer
            return
        self._ways = self._ways or approach_of(state.position_m, target_m, self._settings.approach_m)
        self._go(clock, may_start)

    def _follow(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        if self._is_lost_or_faulty(state):
            return
        is_there = abs(state.position_m - self._ways[0]) <= self._settings.arrival_tolerance_m
        is_below = len(self._ways) > 1 and not state.is_moving and is_there
        if not is_below and not self._rests(state, clock):
            return
        if len(self._ways) > 1:
            self._ways = self._ways[1:]
            self._go(clock, may_start)
            return
        target_m = self.order.target_m
        off_m = state.position_m - target_m
        if abs(off_m) <= self._settings.arrival_tolerance_m:
            self.finish(MoveOutcome.ARRIVED)
        elif self._is_second_try:
            self.finish(
                MoveOutcome.OFF_TARGET,
                f"after two tries it stands at {_mm(state.position_m)} mm, {_mm(off_m)} mm off its target "
                f"{_mm(target_m)} mm (tolerance {_mm(self._settings.arrival_tolerance_m)} mm)",
            )
        else:
            self._is_second_try = True
            self._ways = approach_of(state.position_m, target_m, self._settings.approach_m)
            self._go(clock, may_start)

    def _go(self, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        if not may_start():
            return  # whoever stops everything finishes this course
        self.may_move = True
        self._is_ordered = False  # until the drive has confirmed it
        way_m = abs(self._ways[0] - self.readback_m)
        self.limit_s = clock.monotonic_s() + SLOWNESS * way_m / self._settings.speed_m_per_s + GRACE_S
        self.drive.start_move(self._ways[0])
        self._is_under_way(clock, way_m / self._settings.speed_m_per_s)

    def _is_lost_or_faulty(self, state: DriveState) -> bool:
        if state.faults:
            self.fail("; ".join(state.faults))
        elif not state.is_homed:
            self.fail("it lost its reference in mid-move (was it reset, or without power?): home it")
        else:
            return False
        return True


class HomeCourse(Course):
    """To the drive's reference."""

    def refusal(self, state: DriveState) -> str:
        """Faults do not hinder: a leg on a limit switch is brought back by homing it."""
        return "it moves, by somebody else's order" if state.is_moving else ""

    def _begin(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        if not may_start():
            return
        low_m, high_m = self.drive.range_m
        expected_s = (high_m - low_m) / self._settings.speed_m_per_s
        self.may_move = True
        self.limit_s = clock.monotonic_s() + SLOWNESS * expected_s + GRACE_S
        self.drive.start_homing()
        self._is_under_way(clock, expected_s)
        self.due_s = clock.monotonic_s() + self._settings.poll_s  # the way to the reference may be short

    def _follow(self, state: DriveState, clock: MonotonicClock, may_start: Callable[[], bool]) -> None:
        if not self._rests(state, clock):
            return
        if state.is_homed and not state.faults:
            self.finish(MoveOutcome.ARRIVED)
        else:
            self.finish(MoveOutcome.FAULT, "; ".join(state.faults) or "the search ended without the reference")


def _mm(length_m: float) -> str:
    return f"{m_to_mm(length_m):.4f}"

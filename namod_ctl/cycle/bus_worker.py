"""One bus's share of a motion: rounds over its drives, what silence means, and stopping them.

A stop begins in a hurry (`Bus.hurry`): orders go out to all legs that may move, each with one short wait for its
answer. Who has not confirmed by then is told again with patience.

All methods with exchanges run in the thread of the bus, one after the other; nothing here waits.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

from namod_ctl.core.drives import Bus, Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOutcome, StopSwitch
from namod_ctl.core.units import m_to_mm
from namod_ctl.cycle.leg_course import Course

LOST_S = 5.0
"""A drive that has not answered for so long, asked again and again, is given up; so is a bus."""
N_SILENT = 3
"""After so many unanswered questions in a row one suspects the bus rather than the drives,"""
BLINK_S = 0.25
"""if it has been silent for longer than this."""
ROUND_S = 2.0
"""So long at most a bus goes on by itself, before the caller's thread has to send it on another round."""
N_HURRIED = 3
"""So often legs are told to stop in a hurry, until they confirm it."""

Answer = TypeVar("Answer")


class BusWorker:
    """The thread of one bus and what it has to do.

    Parameters
    ----------
    drives
        Those of the bus, by their legs.

    Attributes
    ----------
    courses
        Of the legs on this bus that have an order, in the order of the orders.
    broken_facets
        Shared by all workers: facets of which a leg came to nothing, and the words for it. Their legs that have not
        been moved yet stay.
    """

    def __init__(
        self,
        bus: Bus,
        drives: Mapping[Leg, Drive],
        courses: Sequence[Course],
        clock: MonotonicClock,
        switch: StopSwitch,
        broken_facets: dict[int, str],
    ) -> None:
        self.bus = bus
        self.drives = drives
        self.courses = tuple(courses)
        self.broken_facets = broken_facets
        self._clock, self._switch = clock, switch
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"bus {bus.name}")
        self._unchecked = deque(self.courses)
        self._waiting = deque(self.courses)
        self._active: list[Course] = []
        self._silent_since_s: dict[Leg, float] = {}
        self._n_silent = 0
        self._bus_lost_since_s: float | None = None
        self._to_stop: deque[Leg] | None = None
        self._stop_problems: dict[Leg, str] = {}

    def submit(self, work: Callable[[], Answer]) -> Future[Answer]:
        """Have the thread of the bus do something; one thing after the other."""
        return self._thread.submit(work)

    def close(self) -> None:
        """Wait for the thread, and end it."""
        self._thread.shutdown(wait=True)

    # --- looking, before anything moves

    @property
    def is_checked(self) -> bool:
        """Has every drive with an order been asked whether it can be moved?"""
        return not self._unchecked

    def check(self) -> None:
        """A round of questions; whoever is silent comes last in the next one."""
        for course in tuple(self._unchecked):
            if self._switch.is_thrown:
                return
            self._unchecked.popleft()
            if not self._exchange(course, course.check) and course.outcome is None:
                self._unchecked.append(course)
                if self._n_silent >= N_SILENT:
                    return

    # --- moving

    @property
    def is_done(self) -> bool:
        """Have all its legs an outcome?"""
        return all(course.outcome is not None for course in self.courses)

    def is_due(self, now_s: float) -> bool:
        """Is there anything to do now?"""
        if self._unchecked:
            return True
        self._active = [course for course in self._active if course.outcome is None]
        if any(course.due_s <= now_s for course in self._active):
            return True
        has_waiting = any(course.outcome is None for course in self._waiting)
        return has_waiting and len(self._active) < self.bus.max_moving

    def move(self) -> None:
        """A round: passes over the legs, as long as time passes meanwhile and everybody answers."""
        self._unchecked.clear()  # homing begins without
        began_s = pass_s = self._clock.monotonic_s()
        while True:
            has_answered = self._pass(began_s + ROUND_S)
            now_s = self._clock.monotonic_s()
            is_round_over = not pass_s < now_s < began_s + ROUND_S
            if is_round_over or not has_answered or self._switch.is_thrown or not self.is_due(now_s):
                break
            pass_s = now_s
        if self._n_silent >= N_SILENT and not self._switch.is_thrown:
            self._suspect_bus()

    def _pass(self, until_s: float) -> bool:
        """Once over the legs that move, and as many new ones as may move with them; not beyond `until_s`.

        Returns
        -------
        bool
            Everybody has answered.
        """
        has_answered = True
        for course in tuple(self._active):
            if course.due_s <= self._clock.monotonic_s():
                has_answered &= self._visit(course)
                self._active.remove(course)
                self._active.append(course)  # a pass that ends early begins with others the next time
                if self._switch.is_thrown or self._clock.monotonic_s() >= until_s:
                    break
        self._active = [course for course in self._active if course.outcome is None]
        while self._waiting and self._may_begin_another() and self._clock.monotonic_s() < until_s:
            course = self._waiting.popleft()
            if course.outcome is not None:
                continue
            has_answered &= self._visit(course)
            if course.outcome is None:
                self._active.append(course)
            if self._n_silent >= N_SILENT:
                break
        return has_answered

    def _may_begin_another(self) -> bool:
        is_bus_well = self._bus_lost_since_s is None
        return is_bus_well and len(self._active) < self.bus.max_moving and not self._switch.is_thrown

    def _visit(self, course: Course) -> bool:
        """Has the drive answered, or need not be asked?"""
        broken = self.broken_facets.get(course.leg.facet_id)
        if broken is not None and not course.may_move:
            course.finish(MoveOutcome.REFUSED, broken)
            return True
        has_answered = self._exchange(course, lambda: course.visit(self._clock, lambda: not self._switch.is_thrown))
        if course.outcome not in (None, MoveOutcome.ARRIVED):
            self.broken_facets.setdefault(course.leg.facet_id, broken_text(course))
        return has_answered

    def _exchange(self, course: Course, exchange: Callable[[], None]) -> bool:
        """Has the drive answered?"""
        try:
            exchange()
        except CommunicationError as error:
            self._keep_silent(course, str(error))
            return False
        except (DeviceFaultError, LimitError) as error:
            course.fail(str(error))
        self._n_silent = 0
        self._silent_since_s.pop(course.leg, None)
        if self._bus_lost_since_s is not None:
            self._recover(self._bus_lost_since_s)
        return True

    def _keep_silent(self, course: Course, words: str) -> None:
        self._n_silent += 1
        now_s = self._clock.monotonic_s()
        since_s = self._silent_since_s.setdefault(course.leg, now_s)
        # one that moves unheard takes its share of the current until it must have come to its end
        if now_s >= max(since_s + LOST_S, course.limit_s):
            course.readback_m = math.nan
            course.finish(MoveOutcome.LOST, f"no answer for {now_s - since_s:.1f} s: {words}")

    def _suspect_bus(self) -> None:
        """Ask another drive whether it is the bus that is lost; give up what waits when it is lost for long."""
        now_s = self._clock.monotonic_s()
        if self._bus_lost_since_s is None:
            other = next((drive for leg, drive in self.drives.items() if leg not in self._silent_since_s), None)
            open_legs = {course.leg for course in self.courses if course.outcome is None}
            since_s = min((since_s for leg, since_s in self._silent_since_s.items() if leg in open_legs), default=now_s)
            if other is not None and self._answers(other):
                self._n_silent = 0
                return
            if now_s < since_s + BLINK_S:
                return
            self._bus_lost_since_s = since_s
        if now_s >= self._bus_lost_since_s + LOST_S:
            for course in self._waiting:
                if course.outcome is None:
                    course.finish(MoveOutcome.LOST, f"{self.bus.name} is lost; it was not ordered to move")

    def _recover(self, since_s: float) -> None:
        """The bus is back: what moved unwatched stops, what has not been begun stays."""
        lost_s = self._clock.monotonic_s() - since_s
        self._bus_lost_since_s = None
        words = f"{self.bus.name} was lost for {lost_s:.1f} s"
        for course in self.courses:
            if course.outcome is None and not course.may_move:
                course.finish(MoveOutcome.STOPPED, f"{words}: not begun")
            elif course.outcome is None:
                with suppress(CommunicationError, DeviceFaultError):  # its next visit stops it if it moves
                    course.halt(MoveOutcome.STOPPED, f"{words}: stopped when it came back")

    # --- stopping

    @property
    def is_stopped(self) -> bool:
        """Has every drive taken its stop, and is every leg that was moved seen to stand?"""
        return self._to_stop is not None and not self._to_stop and self.is_done

    def stop_in_a_hurry(self, everybody: bool) -> None:
        """Orders to stop to all legs that may move, or to `everybody`, whoever is silent; then the hurry is over."""
        to_stop = self._to_stop = deque(self._stop_order())
        urgent = list(to_stop) if everybody else self._movers()
        self.bus.hurry(True)
        try:
            for _ in range(N_HURRIED):
                for leg in urgent:
                    with suppress(CommunicationError, DeviceFaultError):  # it stays among those to stop
                        self.drives[leg].stop()
                        to_stop.remove(leg)
                urgent = [leg for leg in urgent if leg in to_stop]
        finally:
            self.bus.hurry(False)

    def stop(self) -> None:
        """A round of stops to all drives that have not taken theirs, and a look at the legs that were moved."""
        if self._to_stop is None:
            self._to_stop = deque(self._stop_order())
        n_silent = 0
        for leg in tuple(self._to_stop):
            self._to_stop.popleft()
            try:
                self.drives[leg].stop()
            except (CommunicationError, DeviceFaultError) as error:
                self._stop_problems[leg] = str(error)
                self._to_stop.append(leg)
                n_silent += isinstance(error, CommunicationError)
                if n_silent >= N_SILENT:
                    break  # the next round begins with others
            else:
                self._stop_problems.pop(leg, None)
                n_silent = 0
        self._see_standing()

    def _see_standing(self) -> None:
        waiting = set(self._to_stop or ())
        for course in self.courses:
            if course.outcome is not None:
                continue
            if not course.may_move:
                course.finish(MoveOutcome.STOPPED, f"not begun: {self._switch.reason}")
            elif course.leg not in waiting:
                try:
                    state = course.look()
                    if not state.is_moving:
                        course.finish(MoveOutcome.STOPPED, self._switch.reason)
                        continue
                    course.drive.stop()
                except (CommunicationError, DeviceFaultError) as error:
                    self._stop_problems[course.leg] = str(error)

    def give_up_stopping(self) -> None:
        """Outcomes for the legs that did not take their stop."""
        for course in self.courses:
            if course.outcome is None:
                course.readback_m = math.nan
                problem = self._stop_problems.get(course.leg, "it still moves")
                words = f"{self._switch.reason}; it was not seen to stop: {problem}. Cut its power"
                course.finish(MoveOutcome.LOST, words)

    def standings(self) -> dict[Leg, str]:
        """In words, what became of every drive of the bus that was to stop."""
        found = {}
        for leg, drive in self.drives.items():
            if leg in (self._to_stop or ()):
                found[leg] = (
                    f"did not take its stop: {self._stop_problems.get(leg, 'the bus is silent')}. Cut its power"
                )
                continue
            state = self.read(drive)
            if isinstance(state, str):
                found[leg] = f"took its stop, then: {state}"
            elif state.is_moving:
                found[leg] = "took its stop and still moves: cut its power"
            else:
                found[leg] = f"stands at {m_to_mm(state.position_m):.4f} mm"
        return found

    def _stop_order(self) -> list[Leg]:
        """Those that move and answer, those that move and are silent, all others."""
        return list(dict.fromkeys([*self._movers(), *self.drives]))

    def _movers(self) -> list[Leg]:
        """Legs with orders that may move, those that answer first."""
        moving = [course.leg for course in self.courses if course.may_move and course.outcome is None]
        lost = [course.leg for course in self.courses if course.outcome is MoveOutcome.LOST]
        first = sorted(moving, key=lambda leg: leg in self._silent_since_s)
        return [*first, *lost]

    # --- reading

    @staticmethod
    def _answers(drive: Drive) -> bool:
        try:
            drive.state()
        except CommunicationError:
            return False
        except DeviceFaultError:
            return True
        return True

    @staticmethod
    def identity(drive: Drive) -> str:
        """What a drive says of itself; empty when it does not answer."""
        try:
            return drive.identity()
        except (CommunicationError, DeviceFaultError):
            return ""

    @staticmethod
    def read(drive: Drive) -> DriveState | str:
        """A drive's state, or why there is none."""
        try:
            return drive.state()
        except (CommunicationError, DeviceFaultError) as error:
            return str(error)


def broken_text(course: Course) -> str:
    """Why the other legs of a leg's facet stay."""
    return f"its facet moves whole or not at all, and leg {course.leg.index + 1} does not: {course.detail}"

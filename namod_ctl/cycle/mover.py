"""Reads and moves the drives of all buses at once, and stops them whatever happens.

Each bus has one thread. The caller's thread sends the buses on rounds and lets time pass between them: so the caller's
thread alone waits, journals and notices what other terminals ask for, and on the twin all buses live in one time.
When the switch is thrown, a round ends after the exchange that is on the line, and that is cut short; every bus then
stops its drives, those it set moving first, whatever the other buses are doing. Drives hear their stops even where
their answers are lost: so all of them are told, in a hurry, before anybody is asked again with patience.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import ExitStack
from functools import partial
from typing import TypeVar

from namod_ctl.core.drives import Bus, Drive, DriveState, Leg
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.cycle.bus_worker import BusWorker, broken_text
from namod_ctl.cycle.leg_course import Course, HomeCourse, MoveCourse
from namod_ctl.cycle.leg_watch import Heard, LegWatch, WatchedDrive

LOOK_S = 0.05
"""So often at least the caller's thread looks at the stop switch."""
STOP_S = 3.0
"""For so long, and"""
N_STOP_ROUNDS = 3
"""for so many rounds at least, drives that do not take their stop are told again,"""
MAX_PAUSE_S = 0.4
"""after pauses that grow up to this: a line that comes back is stopped soon."""

Answer = TypeVar("Answer")


class Mover:
    """All drives of a telescope. For one caller at a time; the switch may be thrown from any thread.

    Parameters
    ----------
    switch
        Thrown by people, by the cycle, and by the mover itself when anything goes wrong in its caller. Once thrown,
        this mover moves nothing any more.
    show
        Given what the drives said last, by leg, at most twice a second and at the end of whatever is asked of them;
        called in the caller's thread. It must not raise: nobody stops a telescope for a display.

    Raises
    ------
    ValueError
        A leg has drives on two buses.
    """

    def __init__(
        self,
        buses: Sequence[Bus],
        clock: MonotonicClock,
        settings: MotionSettings,
        switch: StopSwitch,
        show: Callable[[Mapping[Leg, Heard]], None] = lambda heard: None,
    ) -> None:
        self._buses = tuple(buses)
        self._clock, self._settings, self._switch = clock, settings, switch
        self._bus_of = {leg: bus for bus in self._buses for leg in bus.drives}
        self._watch = LegWatch(show)
        self._drives: dict[Leg, Drive] = {
            leg: WatchedDrive(leg, drive, self._watch) for bus in self._buses for leg, drive in bus.drives.items()
        }
        if len(self._drives) != sum(len(bus.drives) for bus in self._buses):
            raise ValueError("a leg has two drives")

    @property
    def legs(self) -> tuple[Leg, ...]:
        """All legs that have a drive, bus by bus."""
        return tuple(self._drives)

    def bus_mates(self, leg: Leg) -> tuple[Leg, ...]:
        """The other legs on a leg's bus. Raises KeyError for a leg without a drive."""
        return tuple(mate for mate in self._bus_of[leg].drives if mate != leg)

    def range_m(self, leg: Leg) -> tuple[float, float]:
        """Soft limits of a leg. Raises KeyError for a leg without a drive."""
        return self._drives[leg].range_m

    def drive_name(self, leg: Leg) -> str:
        """Drive, address and line of a leg, for a person. Raises KeyError for a leg without a drive."""
        return self._drives[leg].name

    def read_states(self, legs: Sequence[Leg] | None = None) -> dict[Leg, DriveState | str]:
        """State of the drives of `legs` (None: all), in their order, or why there is none: a line for a person."""
        return self._ask(self.legs if legs is None else legs, BusWorker.read)

    def identities(self, legs: Sequence[Leg] | None = None) -> dict[Leg, str]:
        """What the drives say of themselves; empty from those that do not answer."""
        return self._ask(self.legs if legs is None else legs, BusWorker.identity)

    def execute(
        self,
        orders: Sequence[MoveOrder],
        on_result: Callable[[MoveResult], None],
        while_waiting: Callable[[], None],
    ) -> list[MoveResult]:
        """Carry out orders whose intent is on record already.

        A facet moves whole or not at all, as far as that can be known before it moves. Whatever `on_result`,
        `while_waiting` or a worker raises throws the switch, stops all drives, and is raised again when they stand.

        Parameters
        ----------
        on_result
            Called in the caller's thread, once per order, as soon as its result is known.
        while_waiting
            Called in the caller's thread again and again; it may throw the switch.

        Returns
        -------
        list[MoveResult]
            In the order of the orders.

        Raises
        ------
        ValueError
            Two orders for one leg.
        """
        if len({order.leg for order in orders}) != len(orders):
            raise ValueError("two orders for one leg")
        courses = {
            order.leg: MoveCourse(order, self._drives[order.leg], self._settings)
            for order in orders
            if order.leg in self._drives
        }
        told: dict[Leg, MoveResult] = {}

        def tell(result: MoveResult) -> None:
            told[result.order.leg] = result  # before: a result that could not be kept is not told twice
            on_result(result)

        def tell_finished() -> None:
            for leg, course in courses.items():
                if course.outcome is not None and leg not in told:
                    tell(MoveResult(course.order, course.outcome, course.readback_m, course.detail))

        broken_facets = {
            order.leg.facet_id: f"its facet moves whole or not at all, and leg {order.leg.index + 1} has no drive"
            for order in orders
            if order.leg not in courses
        }

        def refuse_undrivable() -> None:
            for order in orders:
                if order.leg not in courses:
                    tell(MoveResult(order, MoveOutcome.REFUSED, float("nan"), "it has no drive in the config"))

        self._run(list(courses.values()), broken_facets, refuse_undrivable, tell_finished, while_waiting)
        return [told[order.leg] for order in orders]

    def home(self, legs: Sequence[Leg], while_waiting: Callable[[], None]) -> dict[Leg, str]:
        """Bring drives to their references; empty words for those that are homed now, else why not.

        Raises KeyError for a leg without a drive; what `while_waiting` raises as in `execute`.
        """
        courses = [HomeCourse(leg, self._drives[leg], self._settings) for leg in legs]
        self._run(courses, None, lambda: None, lambda: None, while_waiting)
        return {
            course.leg: "" if course.outcome is MoveOutcome.ARRIVED else course.detail or str(course.outcome)
            for course in courses
        }

    def stop_all(self, reason: str) -> dict[Leg, str]:
        """Throw the switch and stop all drives; in words, what became of each."""
        self._switch.throw(reason)
        with ExitStack() as stack:
            workers = self._workers(stack, [], {})
            interrupt = self._halt(workers, everybody=True)
            futures = [worker.submit(worker.standings) for worker in workers]
            found = {leg: words for future in futures for leg, words in future.result().items()}
        self._watch.show(now=True)
        if interrupt is not None:
            raise interrupt
        return found

    # --- inside

    def _run(
        self,
        courses: Sequence[Course],
        broken_facets: dict[int, str] | None,
        begin: Callable[[], None],
        tell_finished: Callable[[], None],
        while_waiting: Callable[[], None],
    ) -> None:
        """Bring all courses to an outcome. `broken_facets` None: legs do not care for the others of their facet."""
        is_whole = broken_facets is not None
        broken = broken_facets if broken_facets is not None else {}

        def look() -> None:
            tell_finished()
            self._watch.show()
            while_waiting()

        with ExitStack() as stack:
            workers = self._workers(stack, courses, broken)
            try:
                begin()
                if is_whole:
                    self._rounds(workers, BusWorker.check, lambda worker: worker.is_checked, look)
                    self._break_facets(courses, broken)
                self._rounds(workers, BusWorker.move, lambda worker: worker.is_done, look)
                interrupt = self._halt(workers) if self._switch.is_thrown else None
            except BaseException as error:  # noqa: BLE001 - raised again when everything stands
                self._switch.throw(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
                self._halt(workers)
                try:
                    tell_finished()
                    self._watch.show(now=True)
                finally:
                    raise error  # the first one counts: a journal that fails cannot keep the rest either
            tell_finished()
            self._watch.show(now=True)
            if interrupt is not None:
                raise interrupt

    def _workers(self, stack: ExitStack, courses: Sequence[Course], broken_facets: dict[int, str]) -> list[BusWorker]:
        workers = []
        for bus in self._buses:
            own = [course for course in courses if course.leg in bus.drives]
            drives = {leg: self._drives[leg] for leg in bus.drives}
            worker = BusWorker(bus, drives, own, self._clock, self._switch, broken_facets)
            stack.callback(worker.close)
            workers.append(worker)
        return workers

    def _break_facets(self, courses: Sequence[Course], broken_facets: dict[int, str]) -> None:
        for course in courses:
            if course.outcome is not None:
                broken_facets.setdefault(course.leg.facet_id, broken_text(course))
        for course in courses:
            if course.outcome is None and course.leg.facet_id in broken_facets:
                course.finish(MoveOutcome.REFUSED, broken_facets[course.leg.facet_id])

    def _rounds(
        self,
        workers: Sequence[BusWorker],
        round_of: Callable[[BusWorker], None],
        is_over: Callable[[BusWorker], bool],
        look: Callable[[], None],
    ) -> None:
        """Send all buses on rounds until all are over; return at once when the switch is thrown."""
        while not self._must_stop() and not all(is_over(worker) for worker in workers):
            began_s = sent_s = self._clock.monotonic_s()
            rounds: dict[BusWorker, Future[None]] = {}
            _send(workers, round_of, is_over, rounds, began_s)
            while not _all_done(list(rounds.values()), LOOK_S):
                look()
                if self._must_stop():
                    return
                now_s = self._clock.monotonic_s()
                if now_s > sent_s:  # who was quick does not wait for who is slow
                    _send(workers, round_of, is_over, rounds, sent_s := now_s)
            look()
            spent_s = self._clock.monotonic_s() - began_s
            if not self._must_stop():
                self._clock.wait_s(max(min(self._settings.poll_s, LOOK_S) - spent_s, 0.0))

    def _must_stop(self) -> bool:
        return self._switch.is_thrown

    def _halt(self, workers: Sequence[BusWorker], *, everybody: bool = False) -> BaseException | None:
        """Stop all drives on all buses. An interrupt meanwhile does not shorten it: it is returned, for later.

        Those with orders that may move are told first, in a hurry; `everybody` where nothing is known of orders.
        """
        interrupt = self._tell_in_a_hurry(workers, everybody)
        began_s = self._clock.monotonic_s()
        n_rounds = 0
        while n_rounds < N_STOP_ROUNDS or self._clock.monotonic_s() < began_s + STOP_S:
            try:
                left = [worker for worker in workers if not worker.is_stopped]
                if not left:
                    return interrupt
                n_rounds += 1
                if n_rounds > 1:
                    self._clock.wait_s(min(LOOK_S * 2.0 ** (n_rounds - 2), MAX_PAUSE_S))
                rounds = [worker.submit(worker.stop) for worker in left]
                wait(rounds)
                for each in rounds:
                    interrupt = interrupt or each.exception()  # a bug on one bus must not keep the others moving
            except (KeyboardInterrupt, SystemExit) as error:
                interrupt = interrupt or error
        for worker in workers:
            worker.submit(worker.give_up_stopping).result()
        return interrupt

    def _tell_in_a_hurry(self, workers: Sequence[BusWorker], everybody: bool) -> BaseException | None:
        """Orders to stop to all legs that may move, on all buses at once. What was raised meanwhile is returned."""
        interrupt: BaseException | None = None
        rounds: list[Future[None]] = []
        while True:
            try:
                for worker in workers[len(rounds) :]:
                    worker.bus.hurry(True)  # now: the question under way is cut short
                    rounds.append(worker.submit(partial(worker.stop_in_a_hurry, everybody)))
                wait(rounds)
                break
            except (KeyboardInterrupt, SystemExit) as error:
                interrupt = interrupt or error
        return next((bug for each in rounds if (bug := each.exception()) is not None), interrupt)

    def _ask(self, legs: Sequence[Leg], question: Callable[[Drive], Answer]) -> dict[Leg, Answer]:
        """Ask all buses at once; an interrupt ends it after the exchanges that are under way."""
        is_over = False

        def ask_bus(worker: BusWorker) -> dict[Leg, Answer]:
            drives = worker.drives
            return {leg: question(drives[leg]) for leg in legs if leg in drives and not is_over}

        with ExitStack() as stack:
            workers = self._workers(stack, [], {})
            futures = [worker.submit(partial(ask_bus, worker)) for worker in workers]
            try:
                while not _all_done(futures, LOOK_S):
                    self._watch.show()
            finally:
                is_over = True
            found = {leg: answer for future in futures for leg, answer in future.result().items()}
        self._watch.show()
        return {leg: found[leg] for leg in legs}


def _send(
    workers: Sequence[BusWorker],
    round_of: Callable[[BusWorker], None],
    is_over: Callable[[BusWorker], bool],
    rounds: dict[BusWorker, Future[None]],
    now_s: float,
) -> None:
    """Send those on a round that are not on one and have something to do."""
    for worker in workers:
        if worker in rounds:
            if not rounds[worker].done():
                continue
            rounds[worker].result()  # raises what the round raised
        if not is_over(worker) and worker.is_due(now_s):
            rounds[worker] = worker.submit(partial(round_of, worker))


def _all_done(futures: Sequence[Future[Answer]], timeout_s: float) -> bool:
    """Are they all done, waited for a moment? Raises what any of them raised."""
    done, others = wait(futures, timeout_s)
    for future in done:
        future.result()
    return not others

"""Every way to stop: everything stands half a second later, and every order has its result."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable

import pytest
from fake_drives import HURRIED_S, FakeDrive, TestClock
from mover_rig import STOPPED_WITHIN_S, Rig

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import CommunicationError, StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.units import mm_to_m


@pytest.fixture
def rig() -> Rig:
    return Rig()


def after(clock: TestClock, time_s: float, action: Callable[[], object]) -> Callable[[], None]:
    def while_waiting() -> None:
        if clock.now_s >= time_s:
            action()

    return while_waiting


def raising(error: BaseException) -> Callable[[], None]:
    def action() -> None:
        raise error

    return action


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(143), StoreError("disk full")])
def test_whatever_is_raised_while_waiting_stops_everything_first(rig: Rig, error: BaseException) -> None:
    with pytest.raises(type(error)):
        rig.mover.execute(rig.orders(), rig.told.append, after(rig.clock, 0.4, raising(error)))
    assert rig.switch.is_thrown
    rig.assert_all_stand(0.45)
    assert len(rig.told) == 12
    assert {result.outcome for result in rig.told} == {MoveOutcome.STOPPED}
    begun = [result for result in rig.told if rig.drives[result.order.leg].moves()]
    assert len(begun) == 6
    for result in begun:
        assert 0.0 < result.readback_m < mm_to_m(0.6)
        assert result.readback_m == pytest.approx(rig.drives[result.order.leg].true_m())


def test_a_journal_that_fails_stops_everything(rig: Rig) -> None:
    def keep(result: MoveResult) -> None:
        raise StoreError(f"disk full at {result.order.leg}")

    rig.drives[Leg(1, 0)].place(mm_to_m(0.9))
    orders = [MoveOrder(Leg(1, 0), mm_to_m(0.9), mm_to_m(1.0)), *rig.orders(legs=list(rig.drives)[1:])]
    with pytest.raises(StoreError, match="facet 1 leg 1"):
        rig.mover.execute(orders, keep, lambda: None)
    assert 0.0 < rig.clock.now_s < 1.0
    assert not any(drive.moves_at(rig.clock.now_s) for drive in rig.drives.values())
    assert not rig.drives[Leg(3, 1)].moves()


def test_a_bug_in_a_worker_stops_everything(rig: Rig) -> None:
    def break_one() -> None:
        rig.drives[Leg(4, 0)].bug = ZeroDivisionError("bug")

    with pytest.raises(ZeroDivisionError):
        rig.mover.execute(rig.orders(), rig.told.append, after(rig.clock, 0.4, break_one))
    others = [drive for leg, drive in rig.drives.items() if leg != Leg(4, 0)]
    assert not any(drive.moves_at(0.45 + STOPPED_WITHIN_S) for drive in others)
    assert all(any(order == "stop" and time_s < 1.0 for time_s, order, _ in drive.orders) for drive in others)


def test_a_command_from_another_thread_stops_everything(rig: Rig) -> None:
    def throw() -> None:
        thread = threading.Thread(target=rig.switch.throw, args=("somebody pressed stop",))
        thread.start()
        thread.join()

    results = rig.execute(while_waiting=after(rig.clock, 0.4, throw))
    rig.assert_all_stand(0.45)
    assert {result.outcome for result in results.values()} == {MoveOutcome.STOPPED}
    assert "somebody pressed stop" in results[Leg(1, 0)].detail
    assert "not begun" in results[Leg(3, 1)].detail


def test_a_stop_in_the_middle_of_a_round_ends_the_round(rig: Rig) -> None:
    """A drive that is just about to be started when the switch is thrown is not started."""
    n_questions = itertools.count()

    def throw() -> None:
        if next(n_questions) == 1:  # the second question precedes its start
            rig.switch.throw("now")

    rig.drives[Leg(1, 1)].on_question = throw
    results = rig.execute()
    assert results[Leg(1, 1)].outcome is MoveOutcome.STOPPED
    assert not rig.drives[Leg(1, 1)].moves()
    rig.assert_all_stand(rig.clock.now_s)


def test_nothing_moves_after_the_switch_was_thrown(rig: Rig) -> None:
    rig.switch.throw("held")
    results = rig.execute()
    assert {result.outcome for result in results.values()} == {MoveOutcome.STOPPED}
    assert not any(drive.moves() for drive in rig.drives.values())


def test_a_drive_that_does_not_take_its_stop_is_told_again_and_the_others_stand(rig: Rig) -> None:
    deaf = rig.drives[Leg(1, 0)]

    def throw() -> None:
        deaf.never_answers_stop = True
        rig.switch.throw("stop")

    results = rig.execute(while_waiting=after(rig.clock, 0.4, throw))
    for leg, drive in rig.drives.items():
        if leg != Leg(1, 0):
            assert not drive.moves_at(0.45 + STOPPED_WITHIN_S)
    assert results[Leg(1, 0)].outcome is MoveOutcome.LOST
    assert "no answer to the stop" in results[Leg(1, 0)].detail


def test_drives_that_answer_are_stopped_before_silent_ones(rig: Rig) -> None:
    """Two of the three drives that move have fallen silent: every question to them takes four timeouts of 0.1 s."""
    for leg in (Leg(1, 0), Leg(1, 1)):
        rig.drives[leg].silent_s = (0.3, math.inf)
        rig.drives[leg].timeouts_take_s = 0.4
    thrown_s = []

    def throw() -> None:
        thrown_s.append(rig.clock.now_s)
        rig.switch.throw("stop")

    rig.execute(rig.orders(mm_to_m(2.0)), after(rig.clock, 1.3, throw))  # when both have been asked once
    assert not rig.drives[Leg(2, 0)].moves_at(thrown_s[0] + STOPPED_WITHIN_S)
    assert rig.drives[Leg(2, 0)].true_m() < mm_to_m(1.9)  # it was on its way


def test_a_bus_that_waits_for_an_answer_does_not_hold_up_the_stop_of_another(rig: Rig) -> None:
    is_waiting, is_stopped = threading.Event(), threading.Event()
    was_in_time = []

    def wait_for_an_answer() -> None:
        if rig.clock.now_s > 0.3 and not is_waiting.is_set():
            is_waiting.set()
            was_in_time.append(is_stopped.wait(5.0))

    rig.drives[Leg(4, 0)].on_question = wait_for_an_answer
    rig.drives[Leg(2, 0)].on_question = lambda: is_stopped.set() if rig.switch.is_thrown else None
    rig.execute(while_waiting=lambda: rig.switch.throw("stop") if is_waiting.is_set() else None)
    assert was_in_time == [True]


def test_a_second_interrupt_does_not_shorten_the_stop(rig: Rig) -> None:
    waits = itertools.count()

    def interrupted_wait(duration_s: float) -> None:
        rig.clock.now_s += duration_s
        if rig.switch.is_thrown and next(waits) == 0:
            raise KeyboardInterrupt

    rig.clock.wait_s = interrupted_wait  # type: ignore[method-assign]
    rig.drives[Leg(4, 1)].refuses_stops = True  # so that a second round is needed

    def relent() -> None:
        if rig.switch.is_thrown and rig.clock.now_s > 0.5:
            rig.drives[Leg(4, 1)].refuses_stops = False

    rig.drives[Leg(4, 1)].on_question = relent
    with pytest.raises(KeyboardInterrupt):
        rig.mover.execute(rig.orders(), rig.told.append, after(rig.clock, 0.4, lambda: rig.switch.throw("stop")))
    assert len(rig.told) == 12
    rig.assert_all_stand(0.45)


def test_stop_all_says_what_became_of_every_drive(rig: Rig) -> None:
    rig.drives[Leg(1, 0)].start_move(mm_to_m(2.0))
    rig.drives[Leg(4, 0)].never_answers_stop = True
    rig.clock.wait_s(0.5)
    words = rig.mover.stop_all("emergency")
    assert words[Leg(1, 0)] == "stands at 0.5000 mm"
    assert "did not take its stop" in words[Leg(4, 0)]
    assert rig.switch.reason == "emergency"
    assert set(words) == set(rig.drives)


def test_all_that_move_are_told_in_a_hurry_though_nobody_answers(rig: Rig) -> None:
    """All hear their stops and none is heard: with patience, four timeouts of 0.1 s each, the last would be late."""
    told_s: dict[str, float] = {}

    def unheard(drive: FakeDrive) -> Callable[[], None]:
        def stop() -> None:
            told_s.setdefault(drive.name, rig.clock.now_s)
            rig.clock.now_s += HURRIED_S if drive.is_hurried else 0.4
            raise CommunicationError(f"{drive.name}: no answer")

        return stop

    def throw() -> None:
        for drive in rig.drives.values():
            drive.stop = unheard(drive)  # type: ignore[method-assign]
        rig.switch.throw("stop")

    orders = rig.orders(legs=[leg for leg in rig.drives if leg.facet_id <= 3])  # all buses share the clock of the test
    results = rig.execute(orders, after(rig.clock, 0.4, throw))
    movers = {drive.name for drive in rig.drives.values() if drive.moves()}
    assert len(movers) == 3
    assert max(told_s[name] for name in movers) <= 0.45 + len(movers) * HURRIED_S
    assert not any(drive.is_hurried for drive in rig.drives.values())
    assert MoveOutcome.ARRIVED not in rig.outcomes(results)

"""Motion: what arrives, what is refused and why, and that everything stands after a stop, whatever its cause."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Sequence

import pytest
from fake_drives import SPEED_M_PER_S, STEP_M, FakeBus, FakeDrive, TestClock

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.cycle.mover import Mover

SETTINGS = MotionSettings(
    max_travel_per_cycle_m=mm_to_m(2.0),
    approach_m=um_to_m(30.0),
    arrival_tolerance_m=um_to_m(6.0),
    settle_s=0.1,
    poll_s=0.05,
    speed_m_per_s=SPEED_M_PER_S,
)
STOPPED_WITHIN_S = 0.5


class Rig:
    """Facets of two legs; facets 1-3 on bus A, 4-6 on bus B."""

    def __init__(self, max_moving: int = 3) -> None:
        self.clock = TestClock()
        self.switch = StopSwitch()
        self.drives = {
            Leg(facet, index): FakeDrive(self.clock, f"drive {facet}.{index + 1}")
            for facet in range(1, 7)
            for index in range(2)
        }
        self.buses = [
            FakeBus(name, {leg: drive for leg, drive in self.drives.items() if leg.facet_id in facets}, max_moving)
            for name, facets in (("A", (1, 2, 3)), ("B", (4, 5, 6)))
        ]
        self.mover = Mover(self.buses, self.clock, SETTINGS, self.switch)
        self.told: list[MoveResult] = []

    def orders(self, target_m: float = mm_to_m(1.0), legs: Sequence[Leg] | None = None) -> list[MoveOrder]:
        return [MoveOrder(leg, 0.0, target_m) for leg in legs or self.drives]

    def execute(
        self, orders: list[MoveOrder] | None = None, while_waiting: Callable[[], None] = lambda: None
    ) -> dict[Leg, MoveResult]:
        orders = self.orders() if orders is None else orders
        results = self.mover.execute(orders, self.told.append, while_waiting)
        assert [result.order for result in results] == orders
        assert sorted(map(str, self.told)) == sorted(map(str, results))  # each one was told, once
        return {result.order.leg: result for result in results}

    def assert_all_stand(self, thrown_s: float) -> None:
        for drive in self.drives.values():
            assert not drive.moves_at(thrown_s + STOPPED_WITHIN_S), drive.name
            assert all(time_s <= thrown_s for time_s, order, _ in drive.orders if order == "move")

    def outcomes(self, results: dict[Leg, MoveResult]) -> dict[MoveOutcome, set[Leg]]:
        return {
            outcome: {leg for leg, result in results.items() if result.outcome is outcome}
            for outcome in {result.outcome for result in results.values()}
        }


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


def test_everything_arrives(rig: Rig) -> None:
    results = rig.execute()
    for leg, result in results.items():
        assert (result.outcome, result.detail) == (MoveOutcome.ARRIVED, "")
        assert result.readback_m == pytest.approx(mm_to_m(1.0), abs=STEP_M)
        assert len(rig.drives[leg].moves()) == 1


def test_every_target_is_reached_upwards(rig: Rig) -> None:
    rig.execute(rig.orders(mm_to_m(-0.9)))
    for drive in rig.drives.values():
        below_m, target_m = drive.moves()
        assert below_m == pytest.approx(mm_to_m(-0.93), abs=STEP_M)
        assert target_m == pytest.approx(mm_to_m(-0.9), abs=STEP_M)


def test_a_leg_on_its_target_is_not_moved(rig: Rig) -> None:
    results = rig.execute(rig.orders(0.4 * STEP_M))
    assert {result.outcome for result in results.values()} == {MoveOutcome.ARRIVED}
    assert not any(drive.orders for drive in rig.drives.values())


@pytest.mark.parametrize("max_moving", [1, 2, 4])
def test_no_more_drives_move_at_once_than_the_supply_can_feed(max_moving: int) -> None:
    rig = Rig(max_moving)
    most = {bus.name: 0 for bus in rig.buses}

    def count() -> None:
        for bus in rig.buses:
            n_moving = sum(rig.drives[leg].moves_at(rig.clock.now_s) for leg in bus.drives)
            most[bus.name] = max(most[bus.name], n_moving)

    for drive in rig.drives.values():
        drive.on_question = count
    rig.execute()
    assert most == {"A": max_moving, "B": max_moving}


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda drive: setattr(drive, "is_homed", False), "not homed"),
        (lambda drive: setattr(drive, "faults", ("overtemperature",)), "overtemperature"),
        (lambda drive: drive.start_move(mm_to_m(1.0)), "it moves"),
        (lambda drive: drive.place(mm_to_m(0.02)), "0.0200 mm"),
        (lambda drive: setattr(drive, "range_m", (-0.001, 0.0005)), "outside of its range"),
    ],
)
def test_a_facet_is_refused_whole(rig: Rig, spoil: Callable[[FakeDrive], None], words: str) -> None:
    bad = Leg(5, 1)
    spoil(rig.drives[bad])
    n_orders = len(rig.drives[bad].orders)
    results = rig.execute()
    assert rig.outcomes(results) == {
        MoveOutcome.REFUSED: {Leg(5, 0), Leg(5, 1)},
        MoveOutcome.ARRIVED: set(rig.drives) - {Leg(5, 0), Leg(5, 1)},
    }
    assert words in results[bad].detail
    assert "leg 2 does not" in results[Leg(5, 0)].detail
    assert words in results[Leg(5, 0)].detail
    assert len(rig.drives[bad].orders) == n_orders
    assert not rig.drives[Leg(5, 0)].orders


def test_too_long_a_way_is_refused(rig: Rig) -> None:
    results = rig.execute(rig.orders(mm_to_m(2.1)))
    assert {result.outcome for result in results.values()} == {MoveOutcome.REFUSED}
    assert "2.1000 mm is more than the 2.0000 mm" in results[Leg(1, 0)].detail


def test_no_room_for_the_approach_is_refused_not_clipped(rig: Rig) -> None:
    rig.drives[Leg(1, 0)].range_m = (mm_to_m(-1.0), mm_to_m(1.0))
    results = rig.execute(rig.orders(mm_to_m(-0.99), [Leg(1, 0)]))
    assert results[Leg(1, 0)].outcome is MoveOutcome.REFUSED
    assert "no room" in results[Leg(1, 0)].detail
    assert not rig.drives[Leg(1, 0)].orders


def test_numbers_that_are_none_are_refused(rig: Rig) -> None:
    results = rig.execute([MoveOrder(Leg(1, 0), 0.0, math.nan), MoveOrder(Leg(2, 0), math.nan, 0.0)])
    assert {result.outcome for result in results.values()} == {MoveOutcome.REFUSED}
    assert not any(drive.orders for drive in rig.drives.values())


def test_a_leg_without_a_drive_takes_its_facet_out(rig: Rig) -> None:
    results = rig.execute(rig.orders(legs=[Leg(1, 0), Leg(1, 2), Leg(2, 0)]))
    assert [result.outcome.value for result in results.values()] == ["refused", "refused", "arrived"]
    assert not rig.drives[Leg(1, 0)].orders


def test_two_orders_for_one_leg_are_a_bug(rig: Rig) -> None:
    with pytest.raises(ValueError, match="two orders"):
        rig.mover.execute(rig.orders(legs=[Leg(1, 0)]) * 2, rig.told.append, lambda: None)


@pytest.mark.parametrize(
    ("spoil", "outcome", "words"),
    [
        ({"reset_at_s": 0.5}, MoveOutcome.FAULT, "lost its reference"),
        ({"barrier_m": mm_to_m(0.4)}, MoveOutcome.FAULT, "limit switch"),
        ({"lost_share": 0.3}, MoveOutcome.OFF_TARGET, "after two tries"),
        ({"silent_s": (0.5, math.inf)}, MoveOutcome.LOST, "no answer for"),
    ],
)
def test_what_happens_to_one_leg_does_not_hinder_the_others(
    rig: Rig, spoil: dict[str, object], outcome: MoveOutcome, words: str
) -> None:
    bad = Leg(1, 0)
    for name, value in spoil.items():
        setattr(rig.drives[bad], name, value)
    results = rig.execute()
    assert results[bad].outcome is outcome
    assert words in results[bad].detail
    assert {result.outcome for leg, result in results.items() if leg != bad} == {MoveOutcome.ARRIVED}
    assert math.isnan(results[bad].readback_m) == (outcome in (MoveOutcome.LOST,) or "reset_at_s" in spoil)


def test_one_more_try_brings_a_leg_that_lost_few_steps_to_its_target(rig: Rig) -> None:
    drive = rig.drives[Leg(1, 0)]
    drive.lost_share = 0.05  # 50 um of 1 mm, then 2.5 um of 50 um
    result = rig.execute()[Leg(1, 0)]
    assert result.outcome is MoveOutcome.ARRIVED
    assert len(drive.moves()) == 2


def test_a_short_silence_is_waited_out(rig: Rig) -> None:
    for drive in rig.drives.values():
        drive.silent_s = (0.5, 0.6)
    rig.drives[Leg(1, 0)].silent_s = (0.3, 1.9)
    results = rig.execute()
    assert {result.outcome for result in results.values()} == {MoveOutcome.ARRIVED}


def test_a_drive_that_never_answers_takes_its_facet_out(rig: Rig) -> None:
    rig.drives[Leg(2, 1)].silent_s = (0.0, math.inf)
    results = rig.execute()
    assert results[Leg(2, 1)].outcome is MoveOutcome.LOST
    assert results[Leg(2, 0)].outcome is MoveOutcome.REFUSED
    assert not rig.drives[Leg(2, 0)].orders
    assert len(rig.outcomes(results)[MoveOutcome.ARRIVED]) == 10


def test_a_drive_that_moved_between_check_and_start_is_refused() -> None:
    rig = Rig(max_moving=1)  # facet 3 has to wait
    late = Leg(3, 0)
    n_questions = itertools.count()

    def somebody_pushes() -> None:
        if next(n_questions) == 1:
            rig.drives[late].place(mm_to_m(0.5))

    rig.drives[late].on_question = somebody_pushes
    results = rig.execute()
    assert rig.outcomes(results)[MoveOutcome.REFUSED] == {Leg(3, 0), Leg(3, 1)}
    assert not rig.drives[late].orders


def test_a_bus_that_comes_back_is_stopped_and_the_other_bus_goes_on(rig: Rig) -> None:
    for leg in rig.buses[0].drives:
        rig.drives[leg].silent_s = (0.3, 0.8)
    results = rig.execute()
    assert {results[leg].outcome for leg in rig.buses[1].drives} == {MoveOutcome.ARRIVED}
    assert {results[leg].outcome for leg in rig.buses[0].drives} == {MoveOutcome.STOPPED}
    assert "A was lost for" in results[Leg(1, 0)].detail
    for leg in rig.buses[0].drives:
        assert not rig.drives[leg].moves_at(0.8 + STOPPED_WITHIN_S)
        assert results[leg].readback_m == pytest.approx(rig.drives[leg].true_m())
    assert not rig.switch.is_thrown


def test_a_bus_that_stays_away_is_given_up(rig: Rig) -> None:
    for leg in rig.buses[0].drives:
        rig.drives[leg].silent_s = (0.3, math.inf)
    results = rig.execute()
    assert {results[leg].outcome for leg in rig.buses[1].drives} == {MoveOutcome.ARRIVED}
    assert {results[leg].outcome for leg in rig.buses[0].drives} == {MoveOutcome.LOST}
    assert rig.clock.now_s < 30.0


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


def test_states_of_silent_drives_are_words(rig: Rig) -> None:
    rig.drives[Leg(4, 0)].silent_s = (0.0, math.inf)
    states = rig.mover.read_states()
    assert list(states) == list(rig.drives)
    assert states[Leg(4, 0)] == "drive 4.1: no answer"
    assert not isinstance(states[Leg(1, 0)], str)


def test_homing(rig: Rig) -> None:
    rig.drives[Leg(1, 0)].is_homed = False
    rig.drives[Leg(1, 1)].place(mm_to_m(1.5))
    rig.drives[Leg(4, 0)].silent_s = (0.0, math.inf)
    homed = rig.mover.home([Leg(1, 0), Leg(1, 1), Leg(4, 0)], lambda: None)
    assert (homed[Leg(1, 0)], homed[Leg(1, 1)]) == ("", "")
    assert "no answer" in homed[Leg(4, 0)]
    assert rig.drives[Leg(1, 1)].true_m() == pytest.approx(0.0)

"""Motion: what arrives, what is refused and why, and what one leg's trouble does to the others."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable

import pytest
from fake_drives import STEP_M, FakeDrive
from mover_rig import STOPPED_WITHIN_S, Rig

from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome
from namod_ctl.core.units import mm_to_m


@pytest.fixture
def rig() -> Rig:
    return Rig()


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
        rig.drives[leg].silent_s = (0.3, 0.95)
    results = rig.execute()
    assert {results[leg].outcome for leg in rig.buses[1].drives} == {MoveOutcome.ARRIVED}
    assert {results[leg].outcome for leg in rig.buses[0].drives} == {MoveOutcome.STOPPED}
    assert "A was lost for" in results[Leg(1, 0)].detail
    for leg in rig.buses[0].drives:
        assert not rig.drives[leg].moves_at(0.95 + STOPPED_WITHIN_S)
        assert results[leg].readback_m == pytest.approx(rig.drives[leg].true_m())
    assert not rig.switch.is_thrown


def test_a_bus_that_stays_away_is_given_up(rig: Rig) -> None:
    for leg in rig.buses[0].drives:
        rig.drives[leg].silent_s = (0.3, math.inf)
    results = rig.execute()
    assert {results[leg].outcome for leg in rig.buses[1].drives} == {MoveOutcome.ARRIVED}
    assert {results[leg].outcome for leg in rig.buses[0].drives} == {MoveOutcome.LOST}
    assert rig.clock.now_s < 30.0


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


def test_a_bus_does_not_wait_for_a_slow_one(rig: Rig) -> None:
    """Bus B hangs in one question until all legs on bus A have arrived, in batches of three."""
    is_over = threading.Event()
    was_in_time: list[bool] = []
    slow = rig.drives[Leg(4, 0)]

    def hang() -> None:
        if slow.moves() and not was_in_time:
            was_in_time.append(is_over.wait(5.0))

    def look() -> None:
        rig.clock.wait_s(0.1)  # time passes by itself, as it does outside of the twin
        if sum(result.order.leg.facet_id <= 3 for result in rig.told) == 6:
            is_over.set()

    slow.on_question = hang
    results = rig.execute(while_waiting=look)
    assert was_in_time == [True]
    assert {result.outcome for result in results.values()} == {MoveOutcome.ARRIVED}

"""Faults of drives and lines, and every way to stop, on the twin's drives with the bytes of real protocols.

What the legs truly did is read in the twin, not in what the drives say.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from types import FrameType

import pytest
from motion_rig import N_MOVING, MotionRig, legs_by_outcome, motion_rig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, StopSwitch
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.cycle.mover import Mover

CONFIGS = ["fact_actuated", "fact_zaber", "fact_modbus_rtu", "fact_modbus_tcp"]
BAD = Leg(4, 1)
TRAVEL_M = mm_to_m(0.8)
STOPPED_WITHIN_S = 0.5
PLAY_M = um_to_m(10.0)


@pytest.fixture
def rig() -> Iterator[MotionRig]:
    with motion_rig() as made:
        yield made


@pytest.mark.parametrize("name", CONFIGS)
def test_legs_truly_travel_what_was_ordered(name: str) -> None:
    """Up, then down past the start: play between spindle and leg does not count, as targets are reached upwards.

    Tolerance: the drives' steps at start and target, and the play that the first way upwards may take up.
    """
    with motion_rig(name) as rig:
        for travel_m in (TRAVEL_M, -2.0 * TRAVEL_M, um_to_m(30.0)):
            before_m = {leg: rig.drives.travel_m(leg) for leg in rig.drives.legs}
            results = rig.execute(rig.orders(travel_m))
            assert set(legs_by_outcome(results)) == {MoveOutcome.ARRIVED}
            tolerance_m = rig.settings.arrival_tolerance_m + (PLAY_M if travel_m == TRAVEL_M else 0.0)
            for leg in rig.drives.legs:
                assert rig.drives.travel_m(leg) - before_m[leg] == pytest.approx(travel_m, abs=tolerance_m)


@pytest.mark.parametrize("name", CONFIGS)
def test_no_more_drives_move_at_once_than_the_line_may_feed(name: str) -> None:
    with motion_rig(name) as rig:
        most = []
        rig.execute(rig.orders(TRAVEL_M), lambda: most.append(rig.n_moving()))
        assert max(most) == 2 * N_MOVING


# --- stop


def by_command(switch: StopSwitch) -> None:
    switch.throw("namod-ctl stop")


def by_ctrl_c(switch: StopSwitch) -> None:
    raise KeyboardInterrupt


def by_sigterm(switch: StopSwitch) -> None:
    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


def by_full_disk(switch: StopSwitch) -> None:
    raise StoreError("no space left on the device")


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(
    ("way", "raised"),
    [(by_command, None), (by_ctrl_c, KeyboardInterrupt), (by_sigterm, SystemExit), (by_full_disk, StoreError)],
)
def test_nothing_moves_after_a_stop(
    name: str, way: Callable[[StopSwitch], None], raised: type[BaseException] | None
) -> None:
    with motion_rig(name) as rig:
        orders = rig.orders(TRAVEL_M)
        stopped_s = []

        def while_waiting() -> None:
            if not stopped_s and rig.clock.monotonic_s() > 0.3 and rig.n_moving() == 2 * N_MOVING:
                stopped_s.append(rig.clock.monotonic_s())
                way(rig.switch)

        if raised is None:
            rig.execute(orders, while_waiting)
        else:
            with pytest.raises(raised):
                rig.execute(orders, while_waiting)
        assert stopped_s
        assert rig.n_moving() == 0
        assert_stood_from(rig, stopped_s[0])
        assert legs_by_outcome({r.order.leg: r for r in rig.told}) == {MoveOutcome.STOPPED: set(rig.drives.legs)}
        readbacks_m = rig.readbacks_m()
        for result in rig.told:
            at_m = result.order.start_m if math.isnan(result.readback_m) else result.readback_m
            assert readbacks_m[result.order.leg] == pytest.approx(at_m, abs=um_to_m(3.0))


def assert_stood_from(rig: MotionRig, stopped_s: float) -> None:
    """By the drives' own log: no order to move after the stop, all at rest in time, and at rest ever after."""
    late = [entry for entry in rig.drives.log if entry.order == "move" and entry.time_s > stopped_s]
    assert not late
    rests = {entry.leg: entry.time_s for entry in rig.drives.log if entry.order == "arrived"}
    assert max(rests.values()) <= stopped_s + STOPPED_WITHIN_S
    true_m = {leg: rig.drives.travel_m(leg) for leg in rig.drives.legs}
    rig.clock.wait_s(10.0)
    assert rig.n_moving() == 0
    assert {leg: rig.drives.travel_m(leg) for leg in rig.drives.legs} == true_m


@pytest.mark.parametrize("name", ["fact_actuated", "fact_zaber", "fact_modbus_rtu"])
def test_a_stop_takes_less_than_half_a_second_of_real_time(name: str) -> None:
    """Everything in the computer's own time, over pseudo terminals; the drives' ramps alone take 0.2 s."""
    with motion_rig(name, in_memory=False, clock=SystemMonotonicClock()) as rig:
        orders = rig.orders(mm_to_m(1.9))
        thrown_s = []

        def while_waiting() -> None:
            if not thrown_s and rig.n_moving() == 2 * N_MOVING:
                thrown_s.append(rig.clock.monotonic_s())
                rig.switch.throw("stop")

        results = rig.execute(orders, while_waiting)
        assert set(legs_by_outcome(results)) == {MoveOutcome.STOPPED}
        rests_s = [entry.time_s for entry in rig.drives.log if entry.order == "arrived"]
        assert max(rests_s) <= thrown_s[0] + STOPPED_WITHIN_S
        assert rig.n_moving() == 0


def test_stop_while_answers_get_lost(rig: MotionRig) -> None:
    orders = rig.orders(TRAVEL_M)
    rig.inject("lost_answers", rig.clock.monotonic_s() + 0.3, share=0.5)

    def while_waiting() -> None:
        if rig.clock.monotonic_s() > 0.4:
            rig.switch.throw("stop")

    rig.execute(orders, while_waiting)
    rests = [entry.time_s for entry in rig.drives.log if entry.order == "arrived"]
    assert max(rests) <= 0.45 + STOPPED_WITHIN_S
    assert rig.n_moving() == 0


def test_a_lost_bus_is_stopped_when_it_comes_back_and_the_other_goes_on(rig: MotionRig) -> None:
    orders = rig.orders(mm_to_m(1.5))
    back_s = rig.clock.monotonic_s() + 0.9
    rig.inject("bus_unplugged", back_s - 0.5, 0.5, bus="south")
    results = rig.execute(orders)
    assert legs_by_outcome(results) == {MoveOutcome.ARRIVED: rig.north, MoveOutcome.STOPPED: rig.south}
    rests = [entry.time_s for entry in rig.drives.log if entry.order == "arrived" and entry.leg in rig.south]
    assert max(rests) <= back_s + STOPPED_WITHIN_S
    readbacks_m = rig.readbacks_m()
    assert all(readbacks_m[leg] < results[leg].order.target_m for leg in rig.south)
    assert any(readbacks_m[leg] > results[leg].order.start_m + mm_to_m(0.2) for leg in rig.south)  # it had set off


def test_a_bus_that_stays_away_is_given_up(rig: MotionRig) -> None:
    orders = rig.orders(TRAVEL_M)
    rig.inject("bus_unplugged", rig.clock.monotonic_s() + 0.4, bus="south")
    results = rig.execute(orders)
    assert legs_by_outcome(results) == {MoveOutcome.ARRIVED: rig.north, MoveOutcome.LOST: rig.south}
    assert sum("it was not ordered to move" in result.detail for result in results.values()) == 9 - N_MOVING
    assert rig.clock.monotonic_s() < 20.0


# --- faults of drives


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        ("fact_actuated", {Leg(BAD.facet_id, index) for index in range(3)}),  # one module for the three legs of a facet
        ("fact_zaber", {BAD}),
        ("fact_modbus_rtu", {BAD}),
    ],
)
def test_a_drive_that_is_reset_in_mid_move_is_a_fault(name: str, lost: set[Leg]) -> None:
    with motion_rig(name) as rig:
        orders = rig.orders(TRAVEL_M)
        rig.inject("drive_reset", facet=BAD.facet_id, leg=BAD.index + 1)
        results = rig.execute(orders)
        assert legs_by_outcome(results) == {MoveOutcome.FAULT: lost, MoveOutcome.ARRIVED: set(rig.drives.legs) - lost}
        assert all("lost its reference" in results[leg].detail for leg in lost)
        assert all(math.isnan(results[leg].readback_m) for leg in lost)


@pytest.mark.parametrize("name", CONFIGS)
def test_a_limit_switch_is_a_fault(name: str) -> None:
    with motion_rig(name) as rig:
        orders = rig.orders(TRAVEL_M)
        rig.inject("limit_switch", rig.clock.monotonic_s() + 0.4, facet=BAD.facet_id, leg=BAD.index + 1, end=1.0)
        results = rig.execute(orders)
        assert legs_by_outcome(results) == {MoveOutcome.FAULT: {BAD}, MoveOutcome.ARRIVED: set(rig.drives.legs) - {BAD}}
        assert "limit" in results[BAD].detail.lower()


@pytest.mark.parametrize(("fault", "params"), [("stuck_leg", {}), ("lost_steps", {"share": 0.3})])
def test_what_a_drive_without_encoder_can_not_notice_does_no_harm(
    rig: MotionRig, fault: str, params: dict[str, float]
) -> None:
    """The drive counts its steps and has arrived; that the facet did not turn is seen in the sky, by learning."""
    orders = rig.orders(TRAVEL_M)
    rig.inject(fault, facet=BAD.facet_id, leg=BAD.index + 1, **params)
    results = rig.execute(orders)
    assert legs_by_outcome(results) == {MoveOutcome.ARRIVED: set(rig.drives.legs)}
    assert rig.drives.travel_m(BAD) < TRAVEL_M - um_to_m(200.0)


# --- faults of lines


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(
    ("fault", "params"),
    [
        ("bit_errors", {"share": 0.01}),
        ("line_noise", {"share": 0.2}),
        ("lost_answers", {"share": 0.1}),
        ("lost_requests", {"share": 0.1}),
        ("slow_answers", {"share": 0.1}),
    ],
)
def test_a_bad_line_is_waited_out(name: str, fault: str, params: dict[str, float]) -> None:
    with motion_rig(name) as rig:
        orders = rig.orders(TRAVEL_M)
        rig.inject(fault, bus="south", **params)
        results = rig.execute(orders)
        assert legs_by_outcome(results) == {MoveOutcome.ARRIVED: set(rig.drives.legs)}
        for leg in rig.drives.legs:
            tolerance_m = rig.settings.arrival_tolerance_m + PLAY_M
            assert rig.drives.travel_m(leg) == pytest.approx(TRAVEL_M, abs=tolerance_m)


def test_real_lines(rig: MotionRig) -> None:
    """Pseudo terminals: served by threads, with timeouts that are the computer's time."""
    with motion_rig(in_memory=False) as rig:
        results = rig.execute(rig.orders(TRAVEL_M, [Leg(3, 0), Leg(19, 0)]))
        assert set(legs_by_outcome(results)) == {MoveOutcome.ARRIVED}


# --- after a crash


def test_orders_that_are_carried_out_again_move_nothing_twice(rig: MotionRig) -> None:
    """A killed program comes back, reads the drives, and finishes what is left: targets are absolute."""
    orders = rig.orders(TRAVEL_M)

    def kill() -> None:
        if rig.clock.monotonic_s() > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rig.execute(orders, kill)
    again = Mover(rig.buses, rig.clock, rig.settings, StopSwitch())
    at_m = rig.readbacks_m()
    left = [MoveOrder(order.leg, at_m[order.leg], order.target_m) for order in orders]
    for _ in range(2):
        results = again.execute(left, lambda result: None, lambda: None)
        assert {result.outcome for result in results} == {MoveOutcome.ARRIVED}
        left = [MoveOrder(r.order.leg, r.readback_m, r.order.target_m) for r in results]
    for leg in rig.drives.legs:
        assert rig.drives.travel_m(leg) == pytest.approx(TRAVEL_M, abs=rig.settings.arrival_tolerance_m + PLAY_M)


def test_orders_reckoned_from_elsewhere_are_refused(rig: MotionRig) -> None:
    """What a second, blind sending of relative corrections would be."""
    orders = rig.orders(TRAVEL_M)
    rig.execute(orders)
    n_moves = {leg: len(rig.moves_of(leg)) for leg in rig.drives.legs}
    assert set(legs_by_outcome(rig.execute(orders))) == {MoveOutcome.REFUSED}
    assert {leg: len(rig.moves_of(leg)) for leg in rig.drives.legs} == n_moves

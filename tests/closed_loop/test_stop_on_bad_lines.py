"""A stop while answers get lost: drives hear it all the same, and in time. Computer's own time, on pseudo terminals."""

from __future__ import annotations

import pytest
from motion_rig import N_MOVING, MotionRig, motion_rig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import mm_to_m

STOPPED_WITHIN_S = 0.5
FULL_SPEED_S = 0.3
"""So long after the last start all go at full speed; questions to silent drives are under way by then."""
RAMP_S = 0.2
"""Of the drives, from full speed; what is left of half a second may pass until the last one is told."""


def told_and_rested_s(rig: MotionRig, thrown_s: float) -> tuple[float, float]:
    """By the drives' own log, since the switch: when the last mover was first told, and when the last one stood."""
    moved = {entry.leg for entry in rig.drives.log if entry.order == "move"}
    assert len(moved) == 2 * N_MOVING
    log = [entry for entry in rig.drives.log if entry.time_s >= thrown_s]
    told_s = [min(entry.time_s for entry in log if (entry.leg, entry.order) == (leg, "stop")) for leg in moved]
    return max(told_s) - thrown_s, max(entry.time_s for entry in log if entry.order == "arrived") - thrown_s


@pytest.mark.parametrize("name", ["fact_actuated", "fact_zaber", "fact_modbus_rtu"])
@pytest.mark.parametrize(
    "fault", [{}, {"share": 0.2}, {"share": 1.0, "bus": "south"}], ids=["healthy", "a fifth lost", "a bus unheard"]
)
def test_a_stop_reaches_all_drives_in_time_whoever_is_heard(name: str, fault: dict[str, float | str]) -> None:
    with motion_rig(name, in_memory=False, clock=SystemMonotonicClock()) as rig:
        orders = rig.orders(mm_to_m(1.9))
        begun_s: list[float] = []
        thrown_s: list[float] = []

        def while_waiting() -> None:
            now_s = rig.clock.monotonic_s()
            if not begun_s and rig.n_moving() == 2 * N_MOVING:
                begun_s.append(now_s)
                if fault:
                    rig.inject("lost_answers", now_s, **fault)
            if begun_s and not thrown_s and now_s > begun_s[0] + FULL_SPEED_S:
                thrown_s.append(now_s)
                rig.switch.throw("stop")

        results = rig.execute(orders, while_waiting)
        told_s, rested_s = told_and_rested_s(rig, thrown_s[0])
        assert told_s <= STOPPED_WITHIN_S - RAMP_S
        assert rested_s <= STOPPED_WITHIN_S
        assert rig.n_moving() == 0
        assert {result.outcome for result in results.values()} <= {MoveOutcome.STOPPED, MoveOutcome.LOST}
        heard = [result for leg, result in results.items() if fault.get("share") != 1.0 or leg not in rig.south]
        assert {result.outcome for result in heard} == {MoveOutcome.STOPPED}

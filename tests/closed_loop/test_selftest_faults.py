"""The drives' self-test on the twin: it passes what is well, and names what is not."""

from __future__ import annotations

import pytest
from motion_rig import MotionRig, motion_rig

from namod_ctl.core.drives import Leg
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.cycle.selftest import LegTest, self_test

BAD = Leg(4, 1)
OTHER = Leg(5, 2)
TRAVEL_M = mm_to_m(0.2)


def run_selftest(rig: MotionRig) -> dict[Leg, LegTest]:
    return {test.leg: test for test in self_test(rig.mover, rig.mover.legs, TRAVEL_M, rig.settings, lambda: None)}


@pytest.mark.parametrize("name", ["fact_actuated", "fact_zaber", "fact_modbus_rtu", "fact_modbus_tcp"])
def test_what_is_well_passes_and_is_back_where_it_was(name: str) -> None:
    with motion_rig(name) as rig:
        before_m = {leg: rig.drives.motor(leg).true_spindle_steps for leg in rig.drives.legs}
        tests = run_selftest(rig)
        assert [test for test in tests.values() if not test.has_passed] == []
        for bus in rig.buses:
            assert {tests[leg].n_watched for leg in bus.drives} == {len(bus.drives) - 1}
        assert all(test.identity for test in tests.values())
        for leg in rig.drives.legs:
            assert len(rig.moves_of(leg)) == 3  # out, below, back
            steps = rig.drives.motor(leg).true_spindle_steps - before_m[leg]
            assert abs(steps) / rig.drives.motor(leg).settings.steps_per_m <= um_to_m(6.0)


def test_a_drive_that_listens_to_another_address_is_found() -> None:
    """Then one address is silent, and the drive moves when another is asked to."""
    with motion_rig("fact_zaber") as rig:
        rig.inject(
            "same_address",
            facet=BAD.facet_id,
            leg=BAD.index + 1,
            other_facet=OTHER.facet_id,
            other_leg=OTHER.index + 1,
        )
        tests = run_selftest(rig)
        assert not tests[BAD].has_passed
        assert not tests[OTHER].has_passed or tests[OTHER].n_watched < 8


def test_a_silent_drive_a_limit_switch_and_a_reset_are_told() -> None:
    with motion_rig("fact_zaber") as rig:
        rig.inject("limit_switch", facet=BAD.facet_id, leg=BAD.index + 1, end=1.0)
        rig.inject("drive_reset", facet=OTHER.facet_id, leg=OTHER.index + 1)
        tests = run_selftest(rig)
        failed = {leg: " ".join(test.problems) for leg, test in tests.items() if not test.has_passed}
        assert set(failed) == {BAD, OTHER}
        assert "limit" in failed[BAD]
        assert "lost its reference" in failed[OTHER]


def test_after_a_stop_nothing_more_is_tested() -> None:
    with motion_rig() as rig:
        n_looks = 0

        def stop_soon() -> None:
            nonlocal n_looks
            n_looks += 1
            if n_looks == 10:
                rig.switch.throw("enough")

        tests = list(self_test(rig.mover, rig.mover.legs, TRAVEL_M, rig.settings, stop_soon))
        assert len(tests) < 3
        assert "enough" in tests[-1].problems[0]
        assert rig.n_moving() == 0

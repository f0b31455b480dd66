"""Any mix of faults at any moment: every order gets its one result, what has arrived is there, nothing moves then."""

from __future__ import annotations

import random

import pytest
from motion_rig import FACETS, MotionRig, motion_rig

from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import mm_to_m

FAULTS: list[tuple[str, dict[str, float | str]]] = [
    ("bit_errors", {"share": 0.02}),
    ("line_noise", {"share": 0.3}),
    ("lost_answers", {"share": 0.3}),
    ("lost_requests", {"share": 0.3}),
    ("slow_answers", {"share": 0.3}),
    ("bus_unplugged", {"bus": "south"}),
    ("drive_reset", {"facet": FACETS["south"][1], "leg": 1}),
    ("limit_switch", {"facet": FACETS["north"][1], "leg": 2, "end": 1.0}),
]


def inject_some(rig: MotionRig, chance: random.Random) -> None:
    now_s = rig.clock.monotonic_s()
    for name, params in chance.sample(FAULTS, chance.randint(1, 4)):
        rig.inject(name, now_s + chance.uniform(0.0, 1.5), chance.choice([0.3, 1.0, 5.0]), **params)


@pytest.mark.parametrize("seed", range(12))
def test_any_mix_of_faults(seed: int) -> None:
    chance = random.Random(seed)
    config = chance.choice(["fact_actuated", "fact_zaber", "fact_modbus_rtu", "fact_modbus_tcp"])
    with motion_rig(config) as rig:
        orders = rig.orders(mm_to_m(chance.uniform(-1.5, 1.5)))
        stop_s = rig.clock.monotonic_s() + chance.choice([chance.uniform(0.0, 2.0), 1000.0])
        inject_some(rig, chance)
        results = rig.execute(orders, lambda: rig.switch.throw("x") if rig.clock.monotonic_s() > stop_s else None)
        assert sorted(result.order.leg for result in rig.told) == sorted(rig.drives.legs)
        assert rig.n_moving() == 0
        for leg, result in results.items():
            motor = rig.drives.motor(leg)
            if result.outcome is MoveOutcome.ARRIVED and motor.is_homed:
                # the spindle's own place; the sign of the count is the config's, +1 in these
                true_m = motor.true_spindle_steps / motor.settings.steps_per_m
                assert true_m == pytest.approx(result.order.target_m, abs=rig.settings.arrival_tolerance_m)

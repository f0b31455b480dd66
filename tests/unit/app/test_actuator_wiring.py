"""The rule that gives the legs of facets their drives."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.app.config.actuator_schema import AXES, ActuatorsSection
from namod_ctl.app.config.actuator_wiring import wires_of
from namod_ctl.core.drives import Leg


@given(
    facets=st.lists(st.integers(0, 99), min_size=1, max_size=30, unique=True),
    n_legs=st.integers(2, 6),
    protocol=st.sampled_from(["tmcl", "zaber"]),
    axes_per_address=st.integers(1, 6),
    first_address=st.integers(1, 20),
)
def test_the_rule_gives_every_leg_its_own_drive_and_leaves_no_hole(
    facets: list[int], n_legs: int, protocol: str, axes_per_address: int, first_address: int
) -> None:
    bus = {
        "name": "it",
        "url": "loopback://it",
        "protocol": protocol,
        "max_moving": 1,
        "facet_ids": facets,
        "axes_per_address": axes_per_address,
        "first_address": first_address,
    }
    limits = {"step_um": 1.0, "range_mm": [-1.0, 1.0], "speed_mm_per_s": 1.0, "acceleration_mm_per_s2": 1.0}
    actuators = ActuatorsSection.model_validate({**limits, "buses": [bus]})
    wires = wires_of(actuators, actuators.buses[0], n_legs)
    assert [wire.leg for wire in wires] == [Leg(facet, index) for facet in facets for index in range(n_legs)]
    first_axis = AXES[protocol][0]
    numbers = [(w.address - first_address) * axes_per_address + w.axis - first_axis for w in wires]
    assert numbers == list(range(len(wires)))
    assert {wire.axis for wire in wires} <= set(range(first_axis, first_axis + axes_per_address))

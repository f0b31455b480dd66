"""Which drive moves which leg, from a bus's rule and its written-out wires."""

from __future__ import annotations

from dataclasses import dataclass

from namod_ctl.app.config.actuator_schema import AXES, ActuatorsSection, BusSection
from namod_ctl.app.config.schema import LegsMountSection, TripodMountSection
from namod_ctl.core.drives import Leg


@dataclass(frozen=True, slots=True)
class Wire:
    """One leg's drive on a bus; address and axis as the protocol counts them."""

    leg: Leg
    address: int
    axis: int
    sign: int


def n_legs_of(mount: TripodMountSection | LegsMountSection) -> int:
    """Number of legs of a mount."""
    return 3 if isinstance(mount, TripodMountSection) else len(mount.positions_m)


def wires_of(actuators: ActuatorsSection, bus: BusSection, n_legs: int) -> tuple[Wire, ...]:
    """The drives of one bus, in the order of the rule, then those that are written out.

    Neither addresses nor facets are checked here. A leg that is written out is not wired by the rule as well; the
    rule's other addresses stay as they were.
    """
    first_axis = AXES[bus.protocol][0]
    written = tuple(
        Wire(
            Leg(wire.facet, wire.leg - 1),
            wire.address,
            first_axis if wire.axis is None else wire.axis,
            actuators.sign if wire.sign is None else wire.sign,
        )
        for wire in bus.wires
    )
    legs = [Leg(facet_id, index) for facet_id in bus.facet_ids for index in range(n_legs)]
    places = [divmod(number, bus.axes_per_address) for number in range(len(legs))]
    by_rule = tuple(
        Wire(leg, bus.first_address + address, first_axis + axis, actuators.sign)
        for leg, (address, axis) in zip(legs, places, strict=True)
    )
    elsewhere = {wire.leg for wire in written}
    return tuple(wire for wire in by_rule if wire.leg not in elsewhere) + written

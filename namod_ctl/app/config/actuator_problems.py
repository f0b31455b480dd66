"""What contradicts itself in the section `[actuators]`, found before any line is opened."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from namod_ctl.app.config.actuator_parts import bus_settings_of, standing_error_m
from namod_ctl.app.config.actuator_schema import ADDRESSES, AXES, ActuatorsSection, BusSection
from namod_ctl.app.config.actuator_wiring import Wire, n_legs_of, wires_of
from namod_ctl.app.config.schema import LegsMountSection, TripodMountSection
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import m_to_mm, mm_to_m, um_to_m
from namod_ctl.devices.buses import check_drives

MAX_SHOWN = 8


def actuator_problems(
    actuators: ActuatorsSection,
    mount: TripodMountSection | LegsMountSection,
    facet_ids: Sequence[int],
    source: str,
) -> list[str]:
    """One text per problem, each with key, value, rule and remedy."""
    n_legs = n_legs_of(mount)
    problems = _twins(actuators, source)
    legs: dict[Leg, list[str]] = defaultdict(list)
    for number, bus in enumerate(actuators.buses, start=1):
        where = f"{source}: actuators.buses[{number}]"
        wires = wires_of(actuators, bus, n_legs)
        problems += _bad_places(bus, wires, where)
        problems += _bad_legs(bus, n_legs, set(facet_ids), where)
        problems += _bad_settings(actuators, bus, n_legs, where)
        for wire in wires:
            legs[wire.leg].append(bus.name)
    problems += _wired_again(legs, source)
    problems += _half_wired(set(legs), n_legs, source)
    return problems + _bad_motion(actuators, mount, source)


def _wired_again(legs: Mapping[Leg, Sequence[str]], source: str) -> list[str]:
    """Legs with more than one drive; `legs` holds the buses that each is on."""
    again: dict[tuple[int, tuple[str, ...]], list[int]] = defaultdict(list)
    for leg, buses in legs.items():
        if len(buses) > 1:
            again[leg.facet_id, tuple(buses)].append(leg.index + 1)
    return [
        f"{source}: actuators: facet {facet_id} leg {_shown(numbers)}: wired {len(buses)} times ({', '.join(buses)}); "
        "every leg has one drive"
        for (facet_id, buses), numbers in again.items()
    ]


def _twins(actuators: ActuatorsSection, source: str) -> list[str]:
    """Buses that share what each needs for itself."""
    problems = []
    for key in ("name", "url"):
        numbers: dict[str, list[int]] = defaultdict(list)
        for number, bus in enumerate(actuators.buses, start=1):
            numbers[getattr(bus, key)].append(number)
        problems += [
            f"{source}: actuators.buses[{same[1]}].{key} = {value!r} is also that of actuators.buses[{same[0]}]; "
            f"every bus needs its own"
            for value, same in numbers.items()
            if len(same) > 1
        ]
    return problems


def _bad_places(bus: BusSection, wires: Sequence[Wire], where: str) -> list[str]:
    """Addresses and axes that do not exist, and those that two legs share."""
    problems = []
    legs_at: dict[tuple[int, int], list[Leg]] = defaultdict(list)
    for wire in wires:
        legs_at[wire.address, wire.axis].append(wire.leg)
    lowest, highest = ADDRESSES[bus.protocol]
    beyond = sorted({wire.address for wire in wires if not lowest <= wire.address <= highest})
    if beyond:
        problems.append(
            f"{where}: addresses {_shown(beyond)} do not exist, protocol {bus.protocol} has {lowest} to {highest}: "
            "lower first_address, raise axes_per_address, or spread the facets over more buses"
        )
    first, last = AXES[bus.protocol]
    wrong = [wire for wire in wires if not first <= wire.axis <= last]
    problems += [
        f"{where}: {wire.leg} has axis = {wire.axis}, protocol {bus.protocol} has {first} to {last}; correct it"
        for wire in wrong
    ]
    problems += [
        f"{where}: address {address}, axis {axis} is that of {' and of '.join(map(str, legs))}; every leg needs "
        "its own drive: correct first_address, axes_per_address, facet_ids or wires"
        for (address, axis), legs in legs_at.items()
        if len(legs) > 1 and len(set(legs)) > 1
    ]
    return problems


def _bad_legs(bus: BusSection, n_legs: int, facet_ids: set[int], where: str) -> list[str]:
    problems = [
        f"{where}.{key}: there is no facet {facet_id}; the reflector has {_shown(sorted(facet_ids))}"
        for key, named in (("facet_ids", bus.facet_ids), ("wires", tuple(wire.facet for wire in bus.wires)))
        for facet_id in sorted(set(named) - facet_ids)
    ]
    problems += [
        f"{where}.wires[{number}].leg = {wire.leg}: the mount of facet {wire.facet} has legs 1 to {n_legs}; correct it"
        for number, wire in enumerate(bus.wires, start=1)
        if wire.leg > n_legs
    ]
    return problems


def _bad_settings(actuators: ActuatorsSection, bus: BusSection, n_legs: int, where: str) -> list[str]:
    """What the register map or the drives would refuse."""
    try:
        settings = bus_settings_of(actuators, bus, n_legs, where)
    except ConfigError as problem:
        return str(problem).splitlines()
    problems = []
    least_m, asked_um = standing_error_m([settings]), actuators.motion.arrival_tolerance_um
    if asked_um is not None and um_to_m(asked_um) < least_m:
        problems.append(
            f"{where}: actuators.motion.arrival_tolerance_um = {asked_um:g} is less than {m_to_mm(least_m):g} mm, "
            "as close as its drives come to a target (a step, and what their register map allows); raise it"
        )
    try:
        check_drives(settings)
    except ConfigError as problem:
        problems.append(f"{where}: {problem}")
    return problems


def _half_wired(legs: set[Leg], n_legs: int, source: str) -> list[str]:
    """Facets of which only some legs have a drive: none of their corrections could be carried out."""
    problems = []
    for facet_id in sorted({leg.facet_id for leg in legs}):
        missing = [str(index + 1) for index in range(n_legs) if Leg(facet_id, index) not in legs]
        if missing:
            problems.append(
                f"{source}: actuators: facet {facet_id} has no drive for leg {' and '.join(missing)} of its {n_legs} "
                "legs; wire all of them or none"
            )
    return problems


def _bad_motion(actuators: ActuatorsSection, mount: TripodMountSection | LegsMountSection, source: str) -> list[str]:
    motion = actuators.motion
    problems = []
    if motion.max_travel_per_cycle_mm is not None and motion.max_travel_per_cycle_mm > mount.travel_limit_mm:
        problems.append(
            f"{source}: actuators.motion.max_travel_per_cycle_mm = {motion.max_travel_per_cycle_mm:g} is more than "
            f"mount.travel_limit_mm = {mount.travel_limit_mm:g}; lower it"
        )
    if motion.approach_mm > 0.0 and mm_to_m(motion.approach_mm) < um_to_m(mount.backlash_um):
        problems.append(
            f"{source}: actuators.motion.approach_mm = {motion.approach_mm:g} is less than mount.backlash_um = "
            f"{mount.backlash_um:g}: the approach would not take up the play; raise it, or write 0 to do without"
        )
    return problems


def _shown(numbers: Sequence[int]) -> str:
    """Numbers in order, cut where there are many."""
    if len(numbers) <= MAX_SHOWN:
        return ", ".join(map(str, numbers))
    return f"{', '.join(map(str, numbers[: MAX_SHOWN - 1]))} ... {numbers[-1]}"

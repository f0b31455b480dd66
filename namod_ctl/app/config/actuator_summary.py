"""What a config says of its actuators, in words for a person, and what in it deserves a second look."""

from __future__ import annotations

from collections.abc import Iterable

from namod_ctl.app.build.actuators import build_motion_settings
from namod_ctl.app.config.actuator_parts import register_map_of
from namod_ctl.app.config.actuator_schema import FACTORY_BAUD, LOOPBACK, MODBUS, ActuatorsSection, BusSection
from namod_ctl.app.config.actuator_wiring import n_legs_of, wires_of
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.views.number_ranges import counted, runs_in_words
from namod_ctl.core.units import m_to_mm

PROTOCOL_WORDS = {"tmcl": "TMCL", "zaber": "Zaber ASCII", "modbus_rtu": "Modbus RTU", "modbus_tcp": "Modbus TCP"}


def actuator_rows(config: InstrumentConfig) -> tuple[tuple[str, str], ...]:
    """Labels and values; for an instrument without actuators one that says so."""
    actuators = config.actuators
    if actuators is None:
        return (("drives", "none: legs are moved by hand"),)
    n_legs = n_legs_of(config.mount)
    n_drives = sum(len(wires_of(actuators, bus, n_legs)) for bus in actuators.buses)
    n_facets = len(_wired_facets(config))
    motion = build_motion_settings(config)
    low_mm, high_mm = actuators.range_mm
    rows = [
        (
            "drives",
            f"{n_drives} on {counted(len(actuators.buses), 'bus')}, for {n_facets} of {len(config.facets)} facets",
        )
    ]
    if actuators.step_um is not None:
        rows.append(("step", f"{actuators.step_um:g} um"))
    rows += [
        ("counting up", f"moves a leg {'to the sky' if actuators.sign > 0 else 'away from the sky'}"),
        ("soft limits", f"{low_mm:g} to {high_mm:g} mm from the reference"),
        ("ramp", f"{actuators.speed_mm_per_s:g} mm/s, {actuators.acceleration_mm_per_s2:g} mm/s2"),
        ("travel per cycle", f"at most {m_to_mm(motion.max_travel_per_cycle_m):g} mm"),
        (
            "approach",
            f"from {actuators.motion.approach_mm:g} mm below"
            if actuators.motion.approach_mm
            else "straight to the target",
        ),
        ("arrived", f"within {m_to_mm(motion.arrival_tolerance_m):g} mm, after {motion.settle_s:g} s of rest"),
    ]
    rows += [(f"bus {bus.name}", _bus_in_words(actuators, bus, n_legs)) for bus in actuators.buses]
    return tuple(rows)


def actuator_warnings(config: InstrumentConfig) -> list[str]:
    """What is allowed but may not be meant."""
    actuators = config.actuators
    if actuators is None:
        return []
    warnings = []
    by_hand = sorted({facet.id for facet in config.facets} - _wired_facets(config))
    if by_hand:
        warnings.append(f"facets without drives, which stay as they are: {runs_in_words(by_hand)}")
    if actuators.motion.approach_mm == 0.0 and config.mount.backlash_um > 0.0:
        warnings.append(
            f"legs have a play of {config.mount.backlash_um:g} um and are not approached from one side "
            "(actuators.motion.approach_mm = 0)"
        )
    in_memory = [bus.name for bus in actuators.buses if bus.url.startswith(LOOPBACK)]
    if in_memory:
        warnings.append(f"buses in memory, for the twin only ({LOOPBACK}): {', '.join(in_memory)}")
    return warnings


def _bus_in_words(actuators: ActuatorsSection, bus: BusSection, n_legs: int) -> str:
    wires = wires_of(actuators, bus, n_legs)
    addresses = _span("address", "addresses", (wire.address for wire in wires))
    axes = "" if bus.protocol in MODBUS else f", {_span('axis', 'axes', (wire.axis for wire in wires))}"
    register_map = register_map_of(bus, bus.name)
    kind = "" if register_map is None else f" ({register_map.name})"
    baud = "" if bus.protocol == "modbus_tcp" else f" at {bus.baud or FACTORY_BAUD[bus.protocol]} baud"
    return (
        f"{PROTOCOL_WORDS[bus.protocol]}{kind} on {bus.url}{baud}: {counted(len(wires), 'drive')}, {addresses}{axes}; "
        f"at most {bus.max_moving} at once; {bus.timeout_s:g} s for an answer, asked again up to {bus.retries} times"
    )


def _span(one: str, many: str, numbers: Iterable[int]) -> str:
    found = sorted(set(numbers))
    return f"{one if len(found) == 1 else many} {runs_in_words(found)}"


def _wired_facets(config: InstrumentConfig) -> set[int]:
    if config.actuators is None:
        return set()
    n_legs = n_legs_of(config.mount)
    buses = config.actuators.buses
    return {wire.leg.facet_id for bus in buses for wire in wires_of(config.actuators, bus, n_legs)}

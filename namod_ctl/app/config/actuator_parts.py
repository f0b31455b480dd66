"""Settings of a bus from its section of the config, in SI units."""

from __future__ import annotations

from collections.abc import Sequence

from namod_ctl.app.config.actuator_schema import FACTORY_BAUD, ActuatorsSection, BusSection
from namod_ctl.app.config.actuator_wiring import wires_of
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.devices.buses import BusSettings, DriveSettings
from namod_ctl.devices.drive_maps import RegisterMap, drive_map_of
from namod_ctl.devices.links import LineSettings

BITS_PER_CHARACTER = 11
SILENT_CHARACTERS = 3.5
"""So long a line must be silent for Modbus RTU to end a frame (Modbus over Serial Line V1.02, 2.5.1.1)."""


def bus_settings_of(actuators: ActuatorsSection, bus: BusSection, n_legs: int, where: str) -> BusSettings:
    """One bus, its drives wired to legs of mounts with `n_legs` legs; `where` names it in errors.

    Raises
    ------
    ConfigError
        Its register map is wrong, or the travel of a step is missing.
    """
    register_map = register_map_of(bus, where)
    counts_per_m = 1.0 / step_m_of(actuators, register_map, where)
    low_mm, high_mm = actuators.range_mm
    baud = bus.baud or FACTORY_BAUD[bus.protocol]
    return BusSettings(
        name=bus.name,
        url=bus.url,
        protocol=bus.protocol,
        baud=baud,
        line=LineSettings(
            timeout_s=bus.timeout_s,
            n_retries=bus.retries,
            silence_s=max(LineSettings().silence_s, SILENT_CHARACTERS * BITS_PER_CHARACTER / baud),
            has_echo=bus.has_echo,
            turnaround_s=bus.turnaround_s,
        ),
        max_moving=bus.max_moving,
        drives=tuple(
            DriveSettings(wire.leg, wire.address, wire.axis, wire.sign * counts_per_m)
            for wire in wires_of(actuators, bus, n_legs)
        ),
        range_m=(mm_to_m(low_mm), mm_to_m(high_mm)),
        speed_m_per_s=mm_to_m(actuators.speed_mm_per_s),
        acceleration_m_per_s2=mm_to_m(actuators.acceleration_mm_per_s2),
        register_map=register_map,
    )


def register_map_of(bus: BusSection, where: str) -> RegisterMap | None:
    """The register map of the drives of a bus; None where they speak no Modbus. Raises ConfigError."""
    if bus.drive_map is None:
        return None
    if isinstance(bus.drive_map, str):
        raise TypeError("register maps are read by load_config, which writes them out")
    return drive_map_of(bus.drive_map, f"{where}.drive_map")


def step_m_of(actuators: ActuatorsSection, register_map: RegisterMap | None, where: str) -> float:
    """Travel of a leg per count of its drive.

    Raises
    ------
    ConfigError
        The drive counts steps, and the config does not say what a step is.
    """
    if register_map is not None and register_map.position_unit == "m":
        return _count_m(register_map)
    if actuators.step_um is None:
        raise ConfigError(
            f"{where}: its drives count steps, but actuators.step_um is missing; add a leg's travel per step, in um"
        )
    return um_to_m(actuators.step_um)


def standing_error_m(buses: Sequence[BusSettings]) -> float:
    """The farthest from its target at which any of the drives may say that it stands there, and be well."""
    return max(_reached_within(bus) / abs(drive.steps_per_m) for bus in buses for drive in bus.drives)


def _reached_within(bus: BusSettings) -> float:
    """In counts: one of rounding, and what the register map allows."""
    register_map = bus.register_map
    if register_map is None or register_map.reached_within is None:
        return 1.0
    in_steps = register_map.position_unit == "steps"
    return 1.0 + register_map.reached_within / (1.0 if in_steps else _count_m(register_map))


def _count_m(register_map: RegisterMap) -> float:
    """Metres per count of the target register, of a map in metres."""
    return abs(register_map.registers[register_map.target].scale)

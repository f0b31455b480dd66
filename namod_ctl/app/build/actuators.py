"""The drives that a config describes, and how legs are moved with them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from namod_ctl.app.config.actuator_parts import bus_settings_of, standing_error_m
from namod_ctl.app.config.actuator_schema import ActuatorsSection
from namod_ctl.app.config.actuator_wiring import n_legs_of
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.devices.buses import BusSettings, DriveBus, open_bus, open_buses

ARRIVAL_SHARE = 2.0
"""Unless the config says otherwise a leg has arrived so many times farther from its target than its drive stands."""


def actuators_of(config: InstrumentConfig) -> ActuatorsSection:
    """The section of the actuators. Raises ConfigError for an instrument without."""
    if config.actuators is None:
        raise ConfigError(
            f"{config.telescope.name}: the config has no [actuators]: its legs are moved by hand. Add the section, or "
            "take a config that has it, such as fact_actuated"
        )
    return config.actuators


def build_bus_settings(config: InstrumentConfig) -> list[BusSettings]:
    """All buses of the config, in their order. Raises ConfigError for an instrument without actuators."""
    actuators = actuators_of(config)
    n_legs = n_legs_of(config.mount)
    return [bus_settings_of(actuators, bus, n_legs, f"bus {bus.name!r}") for bus in actuators.buses]


def build_motion_settings(config: InstrumentConfig) -> MotionSettings:
    """How legs are moved, as the config says. Raises ConfigError for an instrument without actuators."""
    actuators = actuators_of(config)
    motion = actuators.motion
    limit_mm = motion.max_travel_per_cycle_mm
    tolerance_um = motion.arrival_tolerance_um
    return MotionSettings(
        max_travel_per_cycle_m=mm_to_m(config.mount.travel_limit_mm if limit_mm is None else limit_mm),
        approach_m=mm_to_m(motion.approach_mm),
        arrival_tolerance_m=(
            ARRIVAL_SHARE * standing_error_m(build_bus_settings(config))
            if tolerance_um is None
            else um_to_m(tolerance_um)
        ),
        settle_s=motion.settle_s,
        poll_s=motion.poll_s,
        speed_m_per_s=mm_to_m(actuators.speed_mm_per_s),
    )


@contextmanager
def open_actuators(config: InstrumentConfig) -> Iterator[list[DriveBus]]:
    """The hardware's buses, open and connected; closed in the end.

    Raises
    ------
    ConfigError, CommunicationError
        All lines that cannot be opened, together. Drives that do not answer are in each bus's `unreachable` instead.
    """
    buses = open_buses(build_bus_settings(config))
    try:
        yield buses
    finally:
        for bus in buses:
            bus.close()


def check_ports(config: InstrumentConfig) -> None:
    """Open every line of the config for a moment; nothing is said on any.

    Raises
    ------
    ConfigError
        The instrument has no actuators, or all lines that cannot be opened, together.
    """
    problems = []
    for settings in build_bus_settings(config):
        try:
            open_bus(settings).close()
        except (ConfigError, CommunicationError) as problem:
            problems.append(f"bus {settings.name!r}: {problem}")
    if problems:
        raise ConfigError("\n".join(problems))

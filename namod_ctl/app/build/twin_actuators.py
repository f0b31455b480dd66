"""The twin's drives, wired as a config says, and the production drivers that talk to them over real lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from namod_ctl.app.build.actuators import build_bus_settings
from namod_ctl.app.config.actuator_schema import LOOPBACK, SOCKET
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.devices.buses import BusSettings, DriveBus, open_buses
from namod_ctl.twin.drive_lines import DriveLine, LoopbackLine, PtyLine, TcpLine
from namod_ctl.twin.drive_settings import MotorSettings
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire
from namod_ctl.twin.drives import TwinDrives

SWITCH_MARGIN_M = mm_to_m(1.0)
"""The twin's limit switches lie this far outside of the soft limits."""
START_SHARE = 0.1
"""The twin's drives begin up to this share of the range away from the reference."""
MOTOR_RESERVE = 1.2
"""The twin's motors can go so much faster than they are told to: registers round speeds."""
FINEST_STEP_M = um_to_m(0.01)
"""Of a twin's motor: register maps of floating point numbers in metres have no steps."""


def twin_wiring(config: InstrumentConfig) -> tuple[BusWiring, ...]:
    """How the twin's drives are wired: as the config says. Empty for an instrument without actuators."""
    if config.actuators is None:
        return ()
    backlash_m = um_to_m(config.mount.backlash_um)
    return tuple(_wiring_of(bus, backlash_m) for bus in build_bus_settings(config))


@contextmanager
def build_twin_actuators(config: InstrumentConfig, drives: TwinDrives) -> Iterator[list[DriveBus]]:
    """The buses of the config with the twin's drives at the other end, open and connected; closed in the end.

    The config's URL says what kind of line is served: memory for `loopback://`, a TCP port of this computer for
    `socket://`, else a pseudo terminal. The names of the buses tell which it is.

    Parameters
    ----------
    drives
        The twin's, wired by `twin_wiring` of the same config.

    Raises
    ------
    ConfigError
        An instrument without actuators.
    """
    settings = build_bus_settings(config)
    loopbacks: dict[str, Callable[[bytes], bytes]] = {}
    served = []
    with ExitStack() as stack:
        for bus in settings:
            line = DriveLine(drives, bus.name)
            if bus.url.startswith(LOOPBACK):
                loopbacks[bus.url.removeprefix(LOOPBACK)] = LoopbackLine(line)
                served.append(bus)
            elif bus.url.startswith(SOCKET):
                tcp = stack.enter_context(TcpLine(line))
                served.append(replace(bus, url=f"{SOCKET}{tcp.host}:{tcp.port}"))
            else:
                served.append(replace(bus, url=stack.enter_context(PtyLine(line)).port))
        buses = open_buses(served, loopbacks)
        for opened in buses:
            stack.callback(opened.close)
        yield buses


def _wiring_of(bus: BusSettings, backlash_m: float) -> BusWiring:
    low_m, high_m = bus.range_m
    return BusWiring(
        name=bus.name,
        protocol=bus.protocol,
        wires=tuple(
            DriveWire(drive.leg, drive.address, drive.axis, _twin_steps_per_m(drive.steps_per_m))
            for drive in bus.drives
        ),
        motor=MotorSettings(
            max_speed_m_per_s=MOTOR_RESERVE * bus.speed_m_per_s,
            max_acceleration_m_per_s2=MOTOR_RESERVE * bus.acceleration_m_per_s2,
            homing_speed_m_per_s=bus.speed_m_per_s / 2.0,
            limits_m=(min(low_m, 0.0) - SWITCH_MARGIN_M, max(high_m, 0.0) + SWITCH_MARGIN_M),
            backlash_m=backlash_m,
        ),
        register_map=bus.register_map,
        start_spread_m=START_SHARE * min(abs(low_m), abs(high_m)),
    )


def _twin_steps_per_m(steps_per_m: float) -> float:
    finest = 1.0 / FINEST_STEP_M
    return steps_per_m if abs(steps_per_m) > 1.0 else finest if steps_per_m > 0.0 else -finest

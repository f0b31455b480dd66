"""Drives for tests: a few legs on one bus, and clocks."""

from __future__ import annotations

import tomllib
from pathlib import Path

from firmware_protocols.modbus_drive import RegisterMap
from firmware_protocols.modbus_map import read_register_map
from namod_ctl.core.drives import Leg
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drive_settings import PLAIN_MOTOR, MotorSettings
from namod_ctl.twin.drive_wiring import BusWiring, DriveWire, Protocol
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan

MAPS = Path(__file__).parents[3] / "config" / "drives"
BUS = "east"
STEP_M = 1.0 / PLAIN_MOTOR.steps_per_m


class TickingClock(ManualClock):
    """A clock on which time passes whenever somebody looks: for foreign programs that wait in their own time."""

    def __init__(self, tick_s: float) -> None:
        super().__init__()
        self._tick_s = tick_s

    def monotonic_s(self) -> float:
        """A tick later than the last time."""
        self.wait_s(self._tick_s)
        return super().monotonic_s()


def register_map(name: str) -> RegisterMap:
    """One of the maps that come with the program."""
    return read_register_map(tomllib.loads((MAPS / f"{name}.toml").read_text()))


def some_drives(
    protocol: Protocol = "tmcl",
    n_legs: int = 3,
    clock: ManualClock | None = None,
    map_name: str = "pulse_stepper",
    motor: MotorSettings = PLAIN_MOTOR,
    start_spread_m: float = 0.0,
    is_homed: bool = True,
    seed: int = 1,
    facets: tuple[int, ...] = (7,),
) -> TwinDrives:
    """Drives of some facets: addresses 1, 2, ... ; motor 0 or axis 1 of each."""
    legs = [Leg(facet, leg) for facet in facets for leg in range(n_legs)]
    per_m = motor.steps_per_m if map_name != "two_register" else 1e6  # its register counts micrometres
    wires = tuple(DriveWire(leg, address, int(protocol == "zaber"), per_m) for address, leg in enumerate(legs, start=1))
    bus = BusWiring(
        BUS,
        protocol,
        wires,
        motor=motor,
        register_map=register_map(map_name) if protocol.startswith("modbus") else None,
        start_spread_m=start_spread_m,
        is_homed=is_homed,
    )
    return TwinDrives([bus], clock or ManualClock(), FaultPlan(), seed)

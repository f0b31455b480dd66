"""How the twin's drives are wired: what the config says, and what wiring faults make of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from firmware_protocols.modbus_drive import RegisterMap
from namod_ctl.core.drives import Leg
from namod_ctl.core.units import mm_to_m
from namod_ctl.twin.drive_settings import PLAIN_MOTOR, MotorSettings
from namod_ctl.twin.faults import FaultPlan

Protocol = Literal["tmcl", "zaber", "modbus_rtu", "modbus_tcp"]


@dataclass(frozen=True, slots=True)
class DriveWire:
    """One leg's drive.

    Attributes
    ----------
    address, axis
        Of module and motor (from 0) in TMCL, device and axis (from 1) in Zaber, unit in Modbus, where the axis is idle.
    steps_per_m
        Counts per travel of the leg along +z, with sign; of a drive that speaks metres the counts of its target
        register.
    """

    leg: Leg
    address: int
    axis: int = 0
    steps_per_m: float = PLAIN_MOTOR.steps_per_m


@dataclass(frozen=True, slots=True)
class BusWiring:
    """Drives on one line.

    Attributes
    ----------
    motor
        Of all its drives; the steps per metre of each are its own.
    register_map
        Of Modbus drives.
    start_spread_m
        The drives stand up to so far from their references when the twin begins.
    is_homed
        Have they been homed before?
    """

    name: str
    protocol: Protocol
    wires: tuple[DriveWire, ...]
    motor: MotorSettings = PLAIN_MOTOR
    register_map: RegisterMap | None = None
    start_spread_m: float = mm_to_m(1.0)
    is_homed: bool = True


@dataclass(frozen=True, slots=True)
class Gearing:
    """The leg that a motor truly moves, and how far: leg travel per travel that the config expects, with sign."""

    leg: Leg
    factor: float = 1.0


WIRING_FAULTS = frozenset({"wrong_sign", "wrong_scale", "swapped_addresses", "wrong_facet", "same_address"})
"""They are true of a twin all the time that they last, whether anything moves or not."""


def true_gearing(legs: Iterable[Leg], faults: FaultPlan, time_s: float) -> dict[Leg, Gearing]:
    """By the leg that the config names, what its drive moves. Swapped addresses are swapped legs, seen from the bus."""
    found = {leg: Gearing(leg) for leg in legs}
    for fault in faults.active("swapped_addresses", time_s):
        one, other = _pair(
            fault.value("facet"), fault.value("leg"), fault.value("other_facet"), fault.value("other_leg")
        )
        found[one], found[other] = found[other], found[one]
    for fault in faults.active("wrong_facet", time_s):
        for leg in [leg for leg in found if leg.facet_id == fault.value("facet")]:
            other = Leg(int(fault.value("other_facet")), leg.index)
            if other in found:
                found[leg], found[other] = found[other], found[leg]
    for name in ("wrong_sign", "wrong_scale"):
        for fault in faults.active(name, time_s):
            factor = -1.0 if name == "wrong_sign" else fault.value("factor")
            for leg, gearing in found.items():
                if fault.concerns_leg(gearing.leg):
                    found[leg] = Gearing(gearing.leg, gearing.factor * factor)
    return found


def true_addresses(wires: Iterable[DriveWire], faults: FaultPlan, time_s: float) -> dict[int, int]:
    """By the address that the config gives a drive, the address that it listens to."""
    address_of = {wire.leg: wire.address for wire in wires}
    found = {address: address for address in address_of.values()}
    for fault in faults.active("same_address", time_s):
        one, other = _pair(
            fault.value("facet"), fault.value("leg"), fault.value("other_facet"), fault.value("other_leg")
        )
        if one in address_of and other in address_of:
            found[address_of[one]] = address_of[other]
    return found


def _pair(facet: float, leg: float, other_facet: float, other_leg: float) -> tuple[Leg, Leg]:
    return Leg(int(facet), int(leg) - 1), Leg(int(other_facet), int(other_leg) - 1)

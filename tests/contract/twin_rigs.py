"""The twin's TMCL and Zaber drives in memory, with the drivers of the product on them."""

from __future__ import annotations

from dataclasses import replace

from drive_contract import RANGE_M, START_M, DriveRig

from namod_ctl.core.drives import Drive
from namod_ctl.devices.links import LineSettings, TmclLink, ZaberLink
from namod_ctl.devices.tmcl_drive import TmclDrive
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.devices.zaber_drive import ZaberDrive
from namod_ctl.twin.drive_motor import DriveMotor, MotorSettings
from namod_ctl.twin.drive_tmcl import TmclLine, TmclModule
from namod_ctl.twin.drive_zaber import ZaberDevice, ZaberLine

MOTOR = MotorSettings()
SPEEDS = {"speed_m_per_s": 0.001, "acceleration_m_per_s2": 0.005}


class Wire:
    """The wire between a link and a twin's line: counts, and can be cut."""

    def __init__(self, line: TmclLine | ZaberLine) -> None:
        self._line = line
        self.n_written = 0
        self.is_cut = False

    def receive(self, data: bytes) -> bytes:
        self.n_written += len(data)
        return b"" if self.is_cut else self._line.receive(data)


def rig_of(drive: Drive, motor: DriveMotor, wire: Wire) -> DriveRig:
    now_s = 0.0

    def advance(time_s: float) -> None:
        nonlocal now_s
        now_s += time_s
        motor.update(now_s)

    def trip_limit_switch() -> None:
        motor.conditions = replace(motor.conditions, is_high_limit_stuck=True)

    return DriveRig(
        drive=drive,
        advance=advance,
        true_position_m=lambda: motor.true_leg_steps / MOTOR.steps_per_m,
        reset=motor.reset,
        trip_limit_switch=trip_limit_switch,
        n_written=lambda: wire.n_written,
        unplug=lambda: setattr(wire, "is_cut", True),
    )


def tmcl_rig(module: int = 5, motor_number: int = 1) -> DriveRig:
    """Module 5 with two motors, the second under test."""
    motor = DriveMotor(MOTOR, round(START_M * MOTOR.steps_per_m), is_homed=True)
    electronics = TmclModule(module, {0: DriveMotor(MOTOR), motor_number: motor})
    line = TmclLine(lambda address: [electronics] if address == module else [], frozenset({module}))
    wire = Wire(line)
    link = TmclLink(LoopbackTransport("loopback://tmcl", wire.receive), LineSettings())
    drive = TmclDrive(link, module, motor_number, steps_per_m=MOTOR.steps_per_m, range_m=RANGE_M, **SPEEDS)
    drive.configure()
    return rig_of(drive, motor, wire)


def zaber_rig(device: int = 3, axis: int = 2) -> DriveRig:
    """Device 3 with two axes, the second under test."""
    motor = DriveMotor(MOTOR, round(START_M * MOTOR.steps_per_m), is_homed=True)
    electronics = ZaberDevice(device, {1: DriveMotor(MOTOR), axis: motor})
    wire = Wire(ZaberLine(lambda address: [electronics] if address == device else [], [device]))
    link = ZaberLink(LoopbackTransport("loopback://zaber", wire.receive), LineSettings())
    drive = ZaberDrive(link, device, axis, steps_per_m=MOTOR.steps_per_m, range_m=RANGE_M, **SPEEDS)
    drive.configure()
    return rig_of(drive, motor, wire)

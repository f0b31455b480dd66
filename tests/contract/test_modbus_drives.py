"""The contract of drives, for the Modbus driver on the twin's electronics: every register map of the program."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from drive_contract import RANGE_M, START_M, DriveContract, DriveRig
from twin_rigs import MOTOR, SPEEDS, Wire, rig_of

from namod_ctl.core.errors import DeviceFaultError
from namod_ctl.devices.drive_maps import load_register_map
from namod_ctl.devices.links import LineSettings
from namod_ctl.devices.modbus_drive import ModbusDrive
from namod_ctl.devices.modbus_link import Framing, ModbusLink
from namod_ctl.devices.transports import LoopbackTransport
from namod_ctl.twin.drive_modbus import ModbusRtuLine, ModbusTcpLine
from namod_ctl.twin.drive_modbus_units import unit_kind
from namod_ctl.twin.drive_motor import DriveMotor

UNIT = 17


def modbus_rig(map_name: str, framing: Framing, *, is_absolute: bool = False) -> DriveRig:
    register_map = load_register_map(map_name)
    in_steps = register_map.position_unit == "steps"
    steps_per_m = MOTOR.steps_per_m if in_steps else 1.0 / register_map.registers[register_map.target].scale
    settings = replace(MOTOR, steps_per_m=steps_per_m, has_encoder=is_absolute, is_absolute=is_absolute)
    motor = DriveMotor(settings, round(START_M * settings.steps_per_m), is_homed=True)
    unit = unit_kind(register_map)(UNIT, register_map, motor)

    def listeners(address: int) -> list[object]:
        return [unit] if address == UNIT else []

    line = ModbusRtuLine(listeners, [UNIT]) if framing is Framing.RTU else ModbusTcpLine(listeners)
    wire = Wire(line)
    link = ModbusLink(LoopbackTransport("loopback://modbus", wire.receive), LineSettings(), framing)
    drive = ModbusDrive(link, UNIT, register_map, steps_per_m=steps_per_m, range_m=RANGE_M, **SPEEDS)
    drive.configure()
    rig = rig_of(drive, motor, wire)
    rig.true_position_m = lambda: motor.true_leg_steps / steps_per_m
    return rig


class TestCia402OnRtu(DriveContract):
    """CiA 402 on a serial line."""

    @pytest.fixture
    def rig(self) -> DriveRig:
        return modbus_rig("cia402", Framing.RTU)

    def test_a_reset_drive_is_not_moved_before_it_is_homed(self, rig: DriveRig) -> None:
        rig.reset()
        with pytest.raises(DeviceFaultError, match="not homed"):
            rig.drive.start_move(0.0)
        rig.advance(1.0)
        assert not rig.drive.state().is_moving


class TestCia402OnTcp(DriveContract):
    """CiA 402 behind a gateway or with its own network plug."""

    @pytest.fixture
    def rig(self) -> DriveRig:
        return modbus_rig("cia402", Framing.TCP)


class TestPulseStepper(DriveContract):
    """A stepper drive with position records on a serial line."""

    @pytest.fixture
    def rig(self) -> DriveRig:
        return modbus_rig("pulse_stepper", Framing.RTU)


class TestTwoRegisters(DriveContract):
    """An actuator with an absolute sensor and without a reference."""

    is_absolute = True

    @pytest.fixture
    def rig(self) -> DriveRig:
        return modbus_rig("two_register", Framing.RTU, is_absolute=True)

    def test_homing_makes_it_homed_at_the_end_only(self, rig: DriveRig) -> None:
        rig.drive.start_homing()
        state = rig.drive.state()
        assert (state.is_moving, state.is_homed) == (False, True)
        assert not math.isnan(state.position_m)

    def test_a_search_that_was_stopped_leaves_it_not_homed(self, rig: DriveRig) -> None:
        pytest.skip("it has no search")

    def test_a_limit_switch_is_told_in_words_and_left_again(self, rig: DriveRig) -> None:
        pytest.skip("it has no register for it")

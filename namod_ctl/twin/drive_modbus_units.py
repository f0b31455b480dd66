"""Electronics of the twin's Modbus drives: what registers hold, and what writing them does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pymodbus.constants import ExcCodes

from firmware_protocols.errors import LocalProtocolError
from firmware_protocols.modbus_drive import Register, RegisterImage, RegisterMap
from namod_ctl.twin.drive_motor import DriveMotor, MotorFault

IDENTITY = {"product_code": 560, "firmware_version": 0x0112, "pulses_per_turn": 1000}
FIRST_SERIAL = 7000


class Refused(Exception):  # noqa: N818 - an answer, not an error
    """The drive takes a request and refuses it, with a Modbus exception code."""

    def __init__(self, code: ExcCodes) -> None:
        self.code = code


class ModbusUnit:
    """One drive: its registers follow its motor, and its motor follows its registers. Base of the three kinds."""

    def __init__(self, address: int, register_map: RegisterMap, motor: DriveMotor) -> None:
        self.address = address
        self._map = register_map
        self._motor = motor
        self._begin()

    def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
        """Words of registers as they are now. Raises RemoteProtocolError for registers that do not exist."""
        self._follow_motor()
        return self._image.read(function, address, count)

    def write(self, function: int, address: int, words: Sequence[int]) -> None:
        """Write registers and act on it, or refuse and leave all as it was.

        Raises
        ------
        RemoteProtocolError
            The registers do not exist or cannot be written.
        Refused
            The drive does not want the value now.
        """
        self._follow_motor()
        before = {name: self._image[name] for name in self._map.registers}
        names = self._image.write(function, address, words)
        try:
            for name in names:
                self._check(name)
        except Refused:
            for name, raw in before.items():
                self._image[name] = raw
            raise
        for name in names:
            self._act(name, int(before[name]))

    def _begin(self) -> None:
        """Power comes on."""
        self._n_resets = self._motor.n_resets
        self._image = RegisterImage(self._map)
        for name, raw in IDENTITY.items():
            if name in self._map.registers:
                self._image[name] = raw
        if "serial_number" in self._map.registers:
            self._image["serial_number"] = FIRST_SERIAL + self.address
        limits = {self._map.speed: self._motor.max_speed}
        limits.update(dict.fromkeys(self._map.accelerations, self._motor.max_acceleration))
        for limited, steps in limits.items():
            if limited is not None:
                self._image[limited] = self._raw(limited, steps)
        self._image[self._map.target] = self._raw(self._map.target, self._motor.target)
        self._powered()

    def _follow_motor(self) -> None:
        if self._n_resets != self._motor.n_resets:
            self._begin()
        self._image[self._map.position] = self._raw(self._map.position, self._motor.position)
        if self._map.temperature is not None:
            name = self._map.temperature
            self._image[name] = self._map.registers[name].raw_of(self._motor.temperature_k)
        self._tell_status()

    def _raw(self, name: str, steps: float) -> float:
        """Raw value of steps, steps/s or steps/s2, cut to what the register can hold."""
        register = self._map.registers[name]
        raw = register.raw_of(steps * self._unit_per_step(register))
        try:
            register.encode_raw(raw)
        except LocalProtocolError:
            bits = 16 * register.count
            low, high = (0, 2**bits - 1) if register.type.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
            return float(min(max(raw, low), high))
        return raw

    def _steps(self, name: str) -> float:
        """The same backwards."""
        register = self._map.registers[name]
        return register.value_of(self._image[name]) / self._unit_per_step(register)

    def _unit_per_step(self, register: Register) -> float:
        """A step of a drive that speaks metres is one count of its target register."""
        return abs(self._map.registers[self._map.target].scale) if register.unit.startswith("m") else 1.0

    def _speed(self) -> float:
        return min(self._steps(self._map.speed), self._motor.max_speed) if self._map.speed else self._motor.max_speed

    def _acceleration(self) -> float:
        given = [self._steps(name) for name in self._map.accelerations]
        return min([*given, self._motor.max_acceleration])

    def _move(self) -> None:
        self._motor.start_move(round(self._steps(self._map.target)), self._speed(), self._acceleration())

    def _check(self, name: str) -> None:
        """Refuse speeds and accelerations that are none or more than the motor can."""
        limits = {self._map.speed: self._motor.max_speed}
        limits.update(dict.fromkeys(self._map.accelerations, self._motor.max_acceleration))
        if name in limits and not 0 < self._image[name] <= self._raw(name, limits[name]):
            raise Refused(ExcCodes.ILLEGAL_VALUE)

    def _powered(self) -> None:
        """What is special after power came on."""

    def _tell_status(self) -> None:
        """Set the registers that tell how the drive is."""
        raise NotImplementedError

    def _act(self, name: str, before: int) -> None:
        """Do what writing a register means; its former raw value was `before`."""
        raise NotImplementedError


class Cia402Unit(ModbusUnit):
    """A drive of the CiA 402 profile: state machine, profile position mode, homing mode (IEC 61800-7-201)."""

    STATES: ClassVar[Mapping[str, int]] = {
        "disabled": 0x40,
        "ready": 0x21,
        "switched_on": 0x23,
        "enabled": 0x27,
        "quick_stop": 0x07,
        "fault": 0x08,
    }
    REMOTE, REACHED, LIMIT, SPECIAL, ERROR, HOMED = 0x0200, 0x0400, 0x0800, 0x1000, 0x2000, 0x8000
    START, FAULT_RESET = 0x10, 0x80
    POSITION_MODE, HOMING_MODE = 1, 6
    FOLLOWING_ERROR_CODE = 0x8611

    def _powered(self) -> None:
        self._state = "disabled"
        self._is_homing_order = False

    def _tell_status(self) -> None:
        motor, faults = self._motor, self._motor.faults
        if MotorFault.FOLLOWING_ERROR in faults:
            self._state = "fault"
            self._image["error_code"] = self.FOLLOWING_ERROR_CODE
        word = self.STATES[self._state] | self.REMOTE
        word |= 0 if motor.is_moving else self.REACHED
        word |= self.LIMIT if motor.is_at_low_limit or motor.is_at_high_limit else 0
        word |= self.HOMED if motor.is_homed else 0
        if self._image["mode"] == self.HOMING_MODE:
            is_done = self._is_homing_order and not motor.is_moving
            word |= self.SPECIAL if is_done and motor.is_homed else 0
            word |= self.ERROR if is_done and not motor.is_homed else 0
        else:
            word |= self.SPECIAL if int(self._image["controlword"]) & self.START else 0
            word |= self.ERROR if MotorFault.FOLLOWING_ERROR in faults else 0
        self._image["statusword"] = word
        self._image["mode_display"] = self._image["mode"]

    def _check(self, name: str) -> None:
        super()._check(name)
        if name == "mode" and self._image[name] not in (0, self.POSITION_MODE, self.HOMING_MODE):
            raise Refused(ExcCodes.ILLEGAL_VALUE)

    def _act(self, name: str, before: int) -> None:
        if name != "controlword":
            return
        control = int(self._image[name])
        rising = control & ~before
        if self._state == "fault":
            if rising & self.FAULT_RESET:
                self._state = "disabled"
                self._image["error_code"] = 0
                self._motor.clear_faults()
            return
        self._change_state(control)
        if self._state == "enabled" and rising & self.START:
            if self._image["mode"] == self.POSITION_MODE:
                self._move()
            elif self._image["mode"] == self.HOMING_MODE:
                self._is_homing_order = True
                self._motor.start_homing()

    def _change_state(self, control: int) -> None:
        """Transitions of the profile's state machine by bits 0 to 3 of the controlword."""
        was_powered = self._state in ("enabled", "quick_stop")
        if not control & 0b0010:
            self._state = "disabled"
        elif not control & 0b0100:
            self._state = "quick_stop" if was_powered else "disabled"
        elif self._state == "quick_stop":
            return  # left through "disabled" only
        elif control & 0b0111 == 0b0110:
            self._state = "ready"
        elif control & 0b1111 == 0b0111 and self._state != "disabled":
            self._state = "switched_on"
        elif control & 0b1111 == 0b1111 and self._state in ("switched_on", "enabled"):
            self._state = "enabled"
        if was_powered and self._state != "enabled":
            self._motor.stop(self._motor.max_acceleration)


class RecordStepperUnit(ModbusUnit):
    """A stepper drive with position records that a trigger starts."""

    ENABLED, RUNNING, HOMED, FAULT = 0x02, 0x04, 0x40, 0x01
    GO, HOME, STOP = 0x10, 0x20, 0x40
    ABSOLUTE = 1
    CLEAR = 0x1111
    SHAFT_ALARM = 0x80

    def _tell_status(self) -> None:
        motor = self._motor
        has_alarm = bool(motor.faults & {MotorFault.FOLLOWING_ERROR, MotorFault.NO_REFERENCE})
        self._image["alarm"] = self.SHAFT_ALARM if has_alarm else 0
        self._image["status"] = (
            self.ENABLED
            | (self.RUNNING if motor.is_moving else 0)
            | (self.HOMED if motor.is_homed else 0)
            | (self.FAULT if has_alarm else 0)
        )
        self._image["digital_inputs"] = int(motor.is_at_high_limit) | int(motor.is_at_low_limit) << 1

    def _act(self, name: str, before: int) -> None:
        if name == "control" and self._image[name] == self.CLEAR:
            self._motor.clear_faults()
        if name != "trigger":
            return
        order = int(self._image[name])
        self._image[name] = 0  # taken
        if order == self.STOP:
            self._motor.stop(self._motor.max_acceleration)
        elif order == self.HOME:
            self._motor.start_homing()
        elif order == self.GO and int(self._image["record_mode"]) & 0x0F == self.ABSOLUTE:
            self._move()


class FollowingUnit(ModbusUnit):
    """An actuator that goes where its target register says; its sensor always knows where it is."""

    def _tell_status(self) -> None:
        """It has no status."""

    def _check(self, name: str) -> None:
        per_m = self._motor.settings.steps_per_m
        low_m, high_m = self._motor.settings.limits_m
        if not low_m * per_m <= self._steps(name) <= high_m * per_m:
            raise Refused(ExcCodes.ILLEGAL_VALUE)

    def _act(self, name: str, before: int) -> None:
        self._move()


def unit_kind(register_map: RegisterMap) -> type[ModbusUnit]:
    """Which of the three a map describes."""
    if "controlword" in register_map.registers:
        return Cia402Unit
    return RecordStepperUnit if "trigger" in register_map.registers else FollowingUnit

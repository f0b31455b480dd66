"""Electronics of the twin's Zaber controllers: the ASCII protocol's commands, settings, flags and rejections."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from firmware_protocols.errors import RemoteProtocolError
from firmware_protocols.zaber_ascii import (
    ACCELERATION_DATA_PER_STEP_PER_S2,
    NO_WARNING,
    SPEED_DATA_PER_STEP_PER_S,
    Command,
    CommandParser,
    Reply,
    Status,
)
from namod_ctl.core.units import k_to_celsius
from namod_ctl.twin.drive_answers import Heard, Listeners, collide, hear_nothing
from namod_ctl.twin.drive_motor import DriveMotor, MotorFault

DEVICE_ID = 30211
VERSION = "6.28"
FIRST_SERIAL = 52000
ALL = 0
FLAGS = {
    MotorFault.FOLLOWING_ERROR: "FS",
    MotorFault.NO_REFERENCE: "FS",
    MotorFault.LOW_LIMIT: "WL",
    MotorFault.HIGH_LIMIT: "WL",
}
PRIORITY = ("FS", "FO", "WL", "WR")
"""Of warning flags, the first that applies is in every answer."""


class _Rejected(Exception):  # noqa: N818 - an answer, not an error
    """Its text is the reason."""


class _Axis:
    """One axis; its settings outlive a loss of power."""

    def __init__(self, motor: DriveMotor) -> None:
        self.motor = motor
        self.max_speed_data = math.floor(motor.max_speed * SPEED_DATA_PER_STEP_PER_S)
        self.max_accel_data = max(math.floor(motor.max_acceleration * ACCELERATION_DATA_PER_STEP_PER_S2), 1)
        self.speed_data, self.accel_data = self.max_speed_data, self.max_accel_data
        low_m, high_m = motor.settings.limits_m
        self.limits = math.ceil(low_m * motor.settings.steps_per_m), math.floor(high_m * motor.settings.steps_per_m)
        self.is_enabled = True
        self.n_resets = motor.n_resets

    @property
    def speed(self) -> float:
        """Steps per second."""
        return min(self.speed_data / SPEED_DATA_PER_STEP_PER_S, self.motor.max_speed)

    @property
    def acceleration(self) -> float:
        """Steps per second squared; one unit of the wire is already 6100 of them."""
        return min(self.accel_data / ACCELERATION_DATA_PER_STEP_PER_S2, self.motor.max_acceleration)

    def flags(self) -> tuple[str, ...]:
        """Warning flags, the gravest first."""
        if self.n_resets != self.motor.n_resets:
            self.n_resets, self.is_enabled = self.motor.n_resets, True
        found = {FLAGS[fault] for fault in self.motor.faults}
        if not self.is_enabled:
            found.add("FO")
        if not self.motor.is_homed:
            found.add("WR")
        return tuple(flag for flag in PRIORITY if flag in found)


class ZaberDevice:
    """One controller with its axes, by number from 1; a `ZaberLine` asks it."""

    def __init__(self, address: int, motors: Mapping[int, DriveMotor]) -> None:
        self.address = address
        self._axes = {number: _Axis(motor) for number, motor in sorted(motors.items())}

    def answer(self, command: Command, address: int) -> bytes:
        """Carry out a command and answer it from `address`."""
        axes = (
            list(self._axes.values())
            if command.axis == ALL
            else [self._axes[command.axis]]
            if (command.axis in self._axes)
            else []
        )
        is_ok, data = True, "0"
        try:
            if not axes:
                raise _Rejected("BADAXIS")
            data = self._data(command.words.split(), axes, command.axis == ALL, address)
        except _Rejected as rejected:
            is_ok, data = False, str(rejected)
        told = axes or list(self._axes.values())
        status = Status.BUSY if any(axis.motor.is_moving for axis in told) else Status.IDLE
        flags = _flags(told)
        reply = Reply(
            address,
            command.axis,
            is_ok,
            status,
            flags[0] if flags else NO_WARNING,
            data,
            command.message_id,
            command.has_checksum,
        )
        return reply.encode()

    def _data(self, words: Sequence[str], axes: Sequence[_Axis], is_whole_device: bool, address: int) -> str:
        match words:
            case []:
                return "0"
            case ["get", setting]:
                of_device = self._device_setting(setting, address)
                if of_device is not None:
                    if not is_whole_device:
                        raise _Rejected("DEVICEONLY")
                    return of_device
                return " ".join(_setting(axis, setting) for axis in axes)
            case ["set", setting, value]:
                for change in [_change(axis, setting, _integer(value)) for axis in axes]:
                    change()
            case ["move", "abs" | "rel" | "vel" as kind, value]:
                for move in [_move(axis, kind, _integer(value)) for axis in axes]:
                    move()
            case ["move", "min" | "max" as end]:
                for move in [_move(axis, "abs", axis.limits[end == "max"]) for axis in axes]:
                    move()
            case ["home"]:
                for axis in axes:
                    _refuse_disabled(axis)
                    axis.motor.start_homing()
            case ["stop"] | ["estop"]:
                for axis in axes:
                    axis.motor.stop(axis.acceleration)
            case ["warnings"] | ["warnings", "clear"]:
                flags = _flags(axes)
                if len(words) > 1:
                    for axis in axes:
                        axis.motor.clear_faults()
                return " ".join([f"{len(flags):02d}", *flags])
            case ["driver", "enable" | "disable" as what]:
                for axis in axes:
                    axis.is_enabled = what == "enable"
            case ["system", "reset"]:
                for axis in self._axes.values():
                    axis.motor.reset()
            case _:
                raise _Rejected("BADCOMMAND")
        return "0"

    def _device_setting(self, setting: str, address: int) -> str | None:
        return {
            "device.id": str(DEVICE_ID),
            "deviceid": str(DEVICE_ID),
            "version": VERSION,
            "system.serial": str(FIRST_SERIAL + self.address),
            "system.axiscount": str(len(self._axes)),
            "comm.address": str(address),
        }.get(setting)


def _flags(axes: Sequence[_Axis]) -> tuple[str, ...]:
    found = {flag for axis in axes for flag in axis.flags()}
    return tuple(flag for flag in PRIORITY if flag in found)


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise _Rejected("BADDATA") from None


def _refuse_disabled(axis: _Axis) -> None:
    if not axis.is_enabled:
        raise _Rejected("DRIVERDISABLED")


def _setting(axis: _Axis, setting: str) -> str:
    motor = axis.motor
    match setting:
        case "pos":
            return str(motor.position)
        case "encoder.pos" if motor.settings.has_encoder:
            return str(motor.position)
        case "maxspeed":
            return str(axis.speed_data)
        case "accel":
            return str(axis.accel_data)
        case "limit.min":
            return str(axis.limits[0])
        case "limit.max":
            return str(axis.limits[1])
        case "driver.temperature":
            return f"{k_to_celsius(motor.temperature_k):.1f}"
        case "driver.enabled":
            return str(int(axis.is_enabled))
    raise _Rejected("BADCOMMAND")


def _change(axis: _Axis, setting: str, value: int) -> Callable[[], None]:
    """The change of a setting, checked and not made yet: a command for all axes is carried out as a whole."""
    limits = {"maxspeed": axis.max_speed_data, "accel": axis.max_accel_data}
    names = {"maxspeed": "speed_data", "accel": "accel_data"}
    if setting not in limits:
        raise _Rejected("BADCOMMAND")
    if not 1 <= value <= limits[setting]:
        raise _Rejected("BADDATA")
    return lambda: setattr(axis, names[setting], value)


def _move(axis: _Axis, kind: str, value: int) -> Callable[[], None]:
    """A move, checked and not begun yet."""
    _refuse_disabled(axis)
    motor = axis.motor
    if kind == "vel":
        if abs(value) > axis.max_speed_data:
            raise _Rejected("BADDATA")
        speed = math.copysign(min(abs(value) / SPEED_DATA_PER_STEP_PER_S, motor.max_speed), value) if value else 0.0
        return lambda: motor.start_rotation(speed, axis.acceleration)
    target = value if kind == "abs" else motor.count + value
    if not axis.limits[0] <= target <= axis.limits[1]:
        raise _Rejected("BADDATA")
    return lambda: motor.start_move(target, axis.speed, axis.acceleration)


class ZaberLine:
    """All devices of one bus."""

    def __init__(
        self, listeners: Listeners[ZaberDevice], addresses: Sequence[int], heard: Heard = hear_nothing
    ) -> None:
        self._listeners, self._heard = listeners, heard
        self._addresses = sorted(addresses)
        self._parser = CommandParser()

    def receive(self, data: bytes) -> bytes:
        """The devices' answers to what has come over the line; there is none to a line that is damaged."""
        answers = b""
        self._parser.receive_data(data)
        while True:
            try:
                command = self._parser.next_message()
            except RemoteProtocolError:
                continue
            if command is None:
                return answers
            if not (command.words.startswith("get ") or command.words in ("", "warnings")):
                self._heard(command.encode())
            for address in self._addresses if command.device == ALL else [command.device]:
                answers += collide([device.answer(command, address) for device in self._listeners(address)])

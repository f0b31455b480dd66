"""Electronics of the twin's TMCL modules: a Trinamic module for stepper motors with ramps in steps and seconds."""

from __future__ import annotations

from collections.abc import Mapping

from firmware_protocols.errors import RemoteProtocolError
from firmware_protocols.tmcl import (
    ANALOG_BANK,
    FRAME_LENGTH,
    TEMPERATURE_PORT,
    USER_BANK,
    AxisParameter,
    Command,
    MoveType,
    ReferenceSearch,
    Reply,
    Request,
    RequestParser,
    Status,
    firmware_value,
)
from namod_ctl.core.units import k_to_celsius
from namod_ctl.twin.drive_answers import Heard, Listeners, collide, hear_nothing
from namod_ctl.twin.drive_motor import DriveMotor, MotorFault

HOST = 2
MODEL, MAJOR, MINOR = 6110, 1, 21
HOMED_VARIABLE = 64
"""User variable of motor 0, the next ones follow: the controller notes there that a motor's reference was found."""
N_USER_VARIABLES = 256
ENCODER_POSITION = 209
STALLED, DEVIATED = 1, 2
"""Bits of the extended error flags."""
STORED = {
    AxisParameter.MAX_CURRENT: (255, 128),
    AxisParameter.STANDBY_CURRENT: (255, 8),
    AxisParameter.MICROSTEP_RESOLUTION: (8, 0),
    AxisParameter.REFERENCE_SEARCH_MODE: (8, 7),
    AxisParameter.REFERENCE_SEARCH_SPEED: (2**23, 0),
    AxisParameter.REFERENCE_SWITCH_SPEED: (2**23, 0),
}
"""Axis parameters that are kept and change nothing here: largest value, default."""


READING = frozenset({Command.GAP, Command.GGP, Command.GIO, Command.GET_FIRMWARE_VERSION})


class _Refused(Exception):  # noqa: N818 - an answer, not an error
    def __init__(self, status: Status) -> None:
        self.status = status


class _Axis:
    """What a module keeps for one motor; lost with power."""

    def __init__(self, motor: DriveMotor) -> None:
        self.motor = motor
        self.target = motor.target
        self.speed = int(motor.max_speed)
        self.acceleration = int(motor.max_acceleration)
        self.stored = {parameter: default for parameter, (_, default) in STORED.items()}


class TmclModule:
    """One module with its motors, by number; `receive` of a `TmclLine` asks it."""

    def __init__(self, address: int, motors: Mapping[int, DriveMotor]) -> None:
        self.address = address
        self._motors = motors
        self._axes = {number: _Axis(motor) for number, motor in motors.items()}
        self._user = [0] * N_USER_VARIABLES
        for number, motor in motors.items():
            self._user[HOMED_VARIABLE + number] = int(motor.is_homed)
        self._n_resets = self._resets()

    def answer(self, request: Request) -> bytes:
        """Carry out a request and answer it."""
        if self._resets() != self._n_resets:
            self._n_resets = self._resets()
            self._user = [0] * N_USER_VARIABLES
            self._axes = {number: _Axis(motor) for number, motor in self._motors.items()}
        if request.command == Command.GET_FIRMWARE_VERSION and request.type == 0:
            return bytes([HOST]) + f"{MODEL}V{MAJOR}{MINOR}".encode()  # the one answer without a sum
        status, value = Status.OK, request.value
        try:
            value = self._value(request)
        except _Refused as refused:
            status = refused.status
        return Reply(HOST, request.module, status, request.command, value).encode()

    def _resets(self) -> int:
        return sum(motor.n_resets for motor in self._motors.values())

    def _value(self, request: Request) -> int:
        match request.command:
            case Command.GGP | Command.SGP:
                return self._user_variable(request)
            case Command.GIO:
                if (request.motor, request.type) != (ANALOG_BANK, TEMPERATURE_PORT):
                    raise _Refused(Status.WRONG_TYPE)
                return round(max(k_to_celsius(motor.temperature_k) for motor in self._motors.values()))
            case Command.SIO:
                raise _Refused(Status.WRONG_TYPE)
            case Command.GET_FIRMWARE_VERSION:
                if request.type != 1:
                    raise _Refused(Status.WRONG_TYPE)
                return firmware_value(MODEL, MAJOR, MINOR)
            case Command.ROR | Command.ROL | Command.MST | Command.MVP | Command.SAP | Command.GAP | Command.RFS:
                axis = self._axes.get(request.motor)
                if axis is None:
                    raise _Refused(Status.INVALID_VALUE)
                return _axis_value(axis, request)
        raise _Refused(Status.INVALID_COMMAND)

    def _user_variable(self, request: Request) -> int:
        if request.motor != USER_BANK:
            raise _Refused(Status.WRONG_TYPE)
        if request.command == Command.SGP:
            self._user[request.type] = request.value
        return self._user[request.type]


def _axis_value(axis: _Axis, request: Request) -> int:
    motor, value = axis.motor, request.value
    match request.command:
        case Command.ROR | Command.ROL:
            _rotate(axis, value if request.command == Command.ROR else -value)
        case Command.MST:
            motor.stop(axis.acceleration)
        case Command.MVP:
            if request.type not in (MoveType.ABS, MoveType.REL):
                raise _Refused(Status.WRONG_TYPE)
            axis.target = value if request.type == MoveType.ABS else motor.count + value
            motor.start_move(axis.target, axis.speed, axis.acceleration)
        case Command.RFS:
            return _search(axis, request)
        case Command.SAP:
            _set_parameter(axis, request.type, value)
        case Command.GAP:
            return _parameter(axis, request.type)
    return value


def _rotate(axis: _Axis, speed: int) -> None:
    if abs(speed) > axis.motor.max_speed:
        raise _Refused(Status.INVALID_VALUE)
    axis.motor.start_rotation(float(speed), axis.acceleration)


def _search(axis: _Axis, request: Request) -> int:
    match request.type:
        case ReferenceSearch.START:
            axis.target = 0
            axis.motor.start_homing()
        case ReferenceSearch.STOP:
            axis.motor.stop(axis.acceleration)
        case ReferenceSearch.STATUS:
            return int(axis.motor.is_homing)
        case _:
            raise _Refused(Status.WRONG_TYPE)
    return request.value


def _set_parameter(axis: _Axis, parameter: int, value: int) -> None:
    motor = axis.motor
    match parameter:
        case AxisParameter.TARGET_POSITION:
            axis.target = value
            motor.start_move(value, axis.speed, axis.acceleration)
        case AxisParameter.ACTUAL_POSITION:
            if motor.is_moving:
                raise _Refused(Status.COMMAND_NOT_AVAILABLE)
            motor.set_count(value)
        case AxisParameter.TARGET_SPEED:
            _rotate(axis, value)
        case AxisParameter.MAX_SPEED:
            if not 0 < value <= motor.max_speed:
                raise _Refused(Status.INVALID_VALUE)
            axis.speed = value
        case AxisParameter.MAX_ACCELERATION:
            if not 0 < value <= motor.max_acceleration:
                raise _Refused(Status.INVALID_VALUE)
            axis.acceleration = value
        case _ if parameter in axis.stored:
            known = AxisParameter(parameter)
            if not 0 <= value <= STORED[known][0]:
                raise _Refused(Status.INVALID_VALUE)
            axis.stored[known] = value
        case _:
            raise _Refused(Status.WRONG_TYPE)


def _parameter(axis: _Axis, parameter: int) -> int:
    motor = axis.motor
    match parameter:
        case AxisParameter.TARGET_POSITION:
            return axis.target
        case AxisParameter.ACTUAL_POSITION:
            return motor.count
        case AxisParameter.TARGET_SPEED | AxisParameter.ACTUAL_SPEED:
            return round(motor.speed)
        case AxisParameter.MAX_SPEED:
            return axis.speed
        case AxisParameter.MAX_ACCELERATION:
            return axis.acceleration
        case AxisParameter.POSITION_REACHED:
            return int(motor.count == axis.target and not motor.is_moving)
        case AxisParameter.REFERENCE_SWITCH:
            return int(motor.is_below_reference)
        case AxisParameter.RIGHT_LIMIT_SWITCH:
            return int(motor.is_at_high_limit)
        case AxisParameter.LEFT_LIMIT_SWITCH:
            return int(motor.is_at_low_limit)
        case AxisParameter.EXTENDED_ERROR_FLAGS:
            stalled = STALLED if MotorFault.NO_REFERENCE in motor.faults else 0
            return stalled | (DEVIATED if MotorFault.FOLLOWING_ERROR in motor.faults else 0)
        case AxisParameter.DRIVER_ERROR_FLAGS:
            return 0
        case _ if parameter == ENCODER_POSITION and motor.settings.has_encoder:
            return motor.position
        case _ if parameter in axis.stored:
            return axis.stored[AxisParameter(parameter)]
    raise _Refused(Status.WRONG_TYPE)


class TmclLine:
    """All modules of one bus."""

    def __init__(
        self, listeners: Listeners[TmclModule], addresses: frozenset[int], heard: Heard = hear_nothing
    ) -> None:
        self._listeners, self._heard = listeners, heard
        self._addresses = addresses
        self._parser = RequestParser(addresses)

    def receive(self, data: bytes) -> bytes:
        """The modules' answers to what has come over the line."""
        answers = b""
        self._parser.receive_data(data)
        while True:
            try:
                request = self._parser.next_message()
            except RemoteProtocolError:
                if len(data) != FRAME_LENGTH or data[0] not in self._addresses:
                    continue  # it hears no telegram, and is silent
                self._parser.reset()
                wrong = Reply(HOST, data[0], Status.WRONG_CHECKSUM, data[1])
                return answers + collide([wrong.encode() for _ in self._listeners(data[0])])
            if request is None:
                return answers
            is_question = request.command == Command.RFS and request.type == ReferenceSearch.STATUS
            if request.command not in READING and not is_question:
                self._heard(request.encode())
            answers += collide([module.answer(request) for module in self._listeners(request.module)])

"""Trinamic TMCL, the binary "direct mode" of Trinamic's motor modules over RS-232, RS-485 and USB serial.

Nine bytes each way; numbers are big-endian, the last byte is the sum of the other eight, modulo 256:

    request   module, command, type, motor or bank, value (4 bytes, two's complement), sum
    reply     host, module, status, command, value (4 bytes, two's complement), sum

A module answers every request addressed to it, once, in the order in which they came. A reply names neither the motor
nor the parameter it speaks of; who asks must see to it that a late answer is not taken for one to a later question.

The sum finds every single wrong bit. Frames carry no start mark: after damage the parsers look for the next place
where nine bytes make a frame that is also plausible, and `reset` begins anew after a silence on the line.

Source: Trinamic, TMCM-6110 TMCL Firmware Manual 1.x, section 3 (binary command format, status codes, commands) and
section 4 (axis parameters), TMCL Reference and Programming Manual 2.x.
"""

from __future__ import annotations

import struct
from collections.abc import Container
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, TypeVar

from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError

FRAME_LENGTH = 9
_LAYOUT = struct.Struct(">BBBBi")
_BYTE_MAX = 0xFF
VALUE_MIN, VALUE_MAX = -(2**31), 2**31 - 1


class Command(IntEnum):
    """Commands, by their mnemonics in the manual."""

    ROR = 1  # rotate right, velocity in value
    ROL = 2
    MST = 3  # motor stop
    MVP = 4  # move to position, type is a MoveType
    SAP = 5  # set axis parameter
    GAP = 6
    SGP = 9  # set global parameter, bank instead of motor
    GGP = 10
    RFS = 13  # reference search, type is a ReferenceSearch
    SIO = 14
    GIO = 15  # get input, bank instead of motor
    GET_FIRMWARE_VERSION = 136  # type 0: eight characters, type 1: a number (see `firmware_text`)


class MoveType(IntEnum):
    """Type byte of MVP."""

    ABS = 0
    REL = 1
    COORD = 2


class ReferenceSearch(IntEnum):
    """Type byte of RFS. STATUS answers 0 when no search is active."""

    START = 0
    STOP = 1
    STATUS = 2


class AxisParameter(IntEnum):
    """Type byte of SAP and GAP; speeds in steps/s, accelerations in steps/s2 on modules with ramps in real units."""

    TARGET_POSITION = 0
    ACTUAL_POSITION = 1
    TARGET_SPEED = 2
    ACTUAL_SPEED = 3
    MAX_SPEED = 4
    MAX_ACCELERATION = 5
    MAX_CURRENT = 6
    STANDBY_CURRENT = 7
    POSITION_REACHED = 8  # 1 when actual position and target agree
    REFERENCE_SWITCH = 9  # 1 when the switch is active
    RIGHT_LIMIT_SWITCH = 10
    LEFT_LIMIT_SWITCH = 11
    MICROSTEP_RESOLUTION = 140
    REFERENCE_SEARCH_MODE = 193
    REFERENCE_SEARCH_SPEED = 194
    REFERENCE_SWITCH_SPEED = 195
    EXTENDED_ERROR_FLAGS = 207
    DRIVER_ERROR_FLAGS = 208


USER_BANK = 2
"""Bank of GGP/SGP that holds the user variables 0 to 255; those from 56 on are lost at a reset, by the manual."""

ANALOG_BANK = 1
TEMPERATURE_PORT = 9
"""Bank and port of GIO that give the module's temperature in degrees Celsius."""

EXTENDED_ERROR_WORDS = {0: "motor stopped by stall detection", 1: "motor stopped by encoder deviation"}
DRIVER_ERROR_WORDS = {1: "overtemperature shutdown", 3: "short to ground, coil A", 4: "short to ground, coil B"}
"""Bits of the two error parameters that mean a fault; the others (load, standstill, prewarnings) are no faults."""


class Status(IntEnum):
    """Status byte of a reply."""

    WRONG_CHECKSUM = 1
    INVALID_COMMAND = 2
    WRONG_TYPE = 3
    INVALID_VALUE = 4
    EEPROM_LOCKED = 5
    COMMAND_NOT_AVAILABLE = 6
    OK = 100
    LOADED_TO_EEPROM = 101


STATUS_WORDS = {
    Status.WRONG_CHECKSUM: "wrong checksum",
    Status.INVALID_COMMAND: "invalid command",
    Status.WRONG_TYPE: "wrong type",
    Status.INVALID_VALUE: "invalid value",
    Status.EEPROM_LOCKED: "configuration EEPROM locked",
    Status.COMMAND_NOT_AVAILABLE: "command not available",
    Status.OK: "successfully executed",
    Status.LOADED_TO_EEPROM: "loaded into the program memory",
}

_COMMANDS = frozenset(Command)
_STATUSES = frozenset(Status)


def status_words(status: int) -> str:
    """A status code in words, for a person."""
    return STATUS_WORDS[Status(status)] if status in _STATUSES else f"unknown status {status}"


def checksum(data: bytes) -> int:
    """Sum of the bytes, modulo 256."""
    return sum(data) & _BYTE_MAX


def _pack(head: tuple[tuple[str, int], ...], value: int) -> bytes:
    for name, number in head:
        if not 0 <= number <= _BYTE_MAX:
            raise LocalProtocolError(f"TMCL {name} {number} does not fit one byte (0 to {_BYTE_MAX})")
    if not VALUE_MIN <= value <= VALUE_MAX:
        raise LocalProtocolError(f"TMCL value {value} does not fit 32 bits with sign ({VALUE_MIN} to {VALUE_MAX})")
    body = _LAYOUT.pack(*(number for _, number in head), value)
    return body + bytes([checksum(body)])


def _unpack(frame: bytes) -> tuple[int, int, int, int, int]:
    if len(frame) != FRAME_LENGTH:
        raise RemoteProtocolError(f"TMCL frame of {len(frame)} bytes instead of {FRAME_LENGTH}: {frame.hex(' ')}")
    expected = checksum(frame[:-1])
    if frame[-1] != expected:
        raise RemoteProtocolError(f"TMCL frame {frame.hex(' ')}: its sum is {expected:02x}")
    a, b, c, d, value = _LAYOUT.unpack_from(frame)
    return a, b, c, d, value


@dataclass(frozen=True, slots=True)
class Request:
    """What the controller asks. `type` and `motor` mean what the command's section of the manual says."""

    module: int
    command: int
    type: int = 0
    motor: int = 0
    value: int = 0

    def encode(self) -> bytes:
        """The nine bytes.

        Raises
        ------
        LocalProtocolError
            A number does not fit its place.
        """
        head = (("module", self.module), ("command", self.command), ("type", self.type), ("motor", self.motor))
        return _pack(head, self.value)

    @classmethod
    def decode(cls, frame: bytes) -> Request:
        """The request in nine bytes.

        Raises
        ------
        RemoteProtocolError
            Not nine bytes, or the sum is wrong.
        """
        return cls(*_unpack(frame))


@dataclass(frozen=True, slots=True)
class Reply:
    """What a module answers: GAP, GGP and GIO put their value there; of commands that set something most echo it."""

    host: int
    module: int
    status: int
    command: int
    value: int = 0

    def encode(self) -> bytes:
        """The nine bytes.

        Raises
        ------
        LocalProtocolError
            A number does not fit its place.
        """
        head = (("host", self.host), ("module", self.module), ("status", self.status), ("command", self.command))
        return _pack(head, self.value)

    @classmethod
    def decode(cls, frame: bytes) -> Reply:
        """The reply in nine bytes.

        Raises
        ------
        RemoteProtocolError
            Not nine bytes, or the sum is wrong.
        """
        return cls(*_unpack(frame))


def firmware_value(model: int, major: int, minor: int) -> int:
    """Value of the reply to GET_FIRMWARE_VERSION of type 1: model in the upper half, version in the lower bytes."""
    return int(struct.unpack(">i", struct.pack(">HBB", model, major, minor))[0])


def firmware_text(value: int) -> str:
    """Model and version in the reply to GET_FIRMWARE_VERSION of type 1: "TMCM-6110 firmware 1.21"."""
    model, major, minor = struct.unpack(">HBB", struct.pack(">i", value))
    return f"TMCM-{model} firmware {major}.{minor:02d}"


Message = TypeVar("Message", Request, Reply)


class _FrameParser(Generic[Message]):
    """Cuts a stream into frames; damaged stretches raise once and are then skipped byte by byte."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._is_lost = False
        self.n_skipped = 0

    def receive_data(self, data: bytes) -> None:
        """Take bytes from the line."""
        self._buffer += data

    def next_message(self) -> Message | None:
        """The next whole message, or None until more bytes come.

        Raises
        ------
        RemoteProtocolError
            The sum of a frame is wrong. Raised once per damaged stretch; call again to go on. `n_skipped` counts the
            bytes that belonged to no message.
        """
        while len(self._buffer) >= FRAME_LENGTH:
            frame = bytes(self._buffer[:FRAME_LENGTH])
            try:
                message = self._decode(frame)
            except RemoteProtocolError:
                self._skip_byte()
                if not self._is_lost:
                    self._is_lost = True
                    raise
                continue
            if self._is_lost and not self._is_plausible(message):
                self._skip_byte()
                continue
            self._is_lost = False
            del self._buffer[:FRAME_LENGTH]
            return message
        return None

    def reset(self) -> int:
        """Forget what is incomplete, after a silence on the line: the next byte begins a frame. How many bytes went."""
        n_dropped = len(self._buffer)
        self.n_skipped += n_dropped
        self._buffer.clear()
        self._is_lost = False
        return n_dropped

    def _skip_byte(self) -> None:
        del self._buffer[0]
        self.n_skipped += 1

    def _decode(self, frame: bytes) -> Message:
        raise NotImplementedError

    def _is_plausible(self, message: Message) -> bool:
        raise NotImplementedError


class RequestParser(_FrameParser[Request]):
    """The module's ear.

    Parameters
    ----------
    modules
        Addresses on this line: after damage a frame counts only if it is for one of them and its command is known.
        While in step, frames for any address and of any command are given.
    """

    def __init__(self, modules: Container[int]) -> None:
        super().__init__()
        self._modules = modules

    def _decode(self, frame: bytes) -> Request:
        return Request.decode(frame)

    def _is_plausible(self, message: Request) -> bool:
        return message.module in self._modules and message.command in _COMMANDS


class ReplyParser(_FrameParser[Reply]):
    """The controller's ear.

    Parameters
    ----------
    host
        Address of the controller: after damage a frame counts only if it is for it, with a known status and command.
    """

    def __init__(self, host: int) -> None:
        super().__init__()
        self._host = host

    def _decode(self, frame: bytes) -> Reply:
        return Reply.decode(frame)

    def _is_plausible(self, message: Reply) -> bool:
        return message.host == self._host and message.status in _STATUSES and message.command in _COMMANDS

r"""Zaber ASCII, the line protocol of Zaber's motion controllers.

    command   /[device [axis [id]]][ words][:CC]\r\n
    reply     @device axis [id] OK|RJ BUSY|IDLE FLAG data[:CC]\r\n
    info      #device axis [id] text[:CC]\r\n
    alert     !device axis BUSY|IDLE FLAG[ data][:CC]\r\n

Device 0 and axis 0 mean all. The reply repeats the message id of its command, so that a late answer is known for what
it is. CC is the checksum in two hexadecimal digits: the two's complement of the sum of the bytes between the first
character and the colon, so that these bytes and the checksum add up to 0 modulo 256. It finds every single wrong bit.

Lines end with a line feed, carriage returns around it are ignored. What stands before the first character of a message
is garbage; a message that was cut off by the beginning of another one is garbage too, and the other one is found.

Source: Zaber, ASCII Protocol Manual 6.x/7.x, "Message format", "Warning flags", "Rejection reasons", "Settings".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, TypeVar

from firmware_protocols.errors import LocalProtocolError, RemoteProtocolError

MAX_LINE_LENGTH = 512
"""Longest line that is waited for; the manual's packets are at most 80 (firmware 6) to 128 characters."""

DEVICE_MAX, AXIS_MAX, MESSAGE_ID_MAX = 99, 9, 99
NO_WARNING = "--"

SPEED_DATA_PER_STEP_PER_S = 1.6384
"""`maxspeed` counts in steps/s times this (manual, setting `maxspeed`)."""
ACCELERATION_DATA_PER_STEP_PER_S2 = 1.6384 / 10000
"""`accel` counts in steps/s2 times this (manual, setting `accel`)."""

WARNING_WORDS = {
    "FF": "critical system error",
    "FH": "driver disabled by the emergency stop",
    "FV": "driver disabled by too high or too low voltage",
    "FO": "driver disabled",
    "FC": "current inrush error",
    "FM": "motor temperature error",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FA": "analog encoder synchronisation error",
    "FR": "overdrive limit exceeded",
    "FS": "stalled and stopped",
    "FE": "limit error",
    "WL": "unexpected limit switch",
    "WV": "supply voltage out of range",
    "WT": "controller temperature high",
    "WS": "stalled with recovery",
    "WM": "displaced when stationary",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "manual control",
    "NI": "movement interrupted",
    "NR": "value rounded",
    "NT": "value truncated",
    "NU": "setting update pending",
}
"""Warning flags; F are faults that stop the drive, W warnings, N notes."""

UNHOMED_FLAGS = frozenset({"WR", "WH"})
DRIVER_OFF_FLAGS = frozenset({"FH", "FV", "FO", "FC", "FM", "FD", "FR"})
"""Flags with which the motor has no current: `driver enable` ends them."""

REJECTION_WORDS = {
    "AGAIN": "the command can not be processed now",
    "BADAXIS": "there is no such axis",
    "BADCOMMAND": "unknown command or setting",
    "BADDATA": "value out of range",
    "BADMESSAGEID": "bad message id",
    "DEVICEONLY": "command is for the whole device only",
    "DRIVERDISABLED": "the motor has no current",
    "LOCKSTEP": "axis is locked to another one",
    "NOACCESS": "access level too low",
    "NOTSUPP": "not supported in this mode",
    "PARKED": "the axis is parked",
    "STATUSBUSY": "not while it moves",
}


class Status(StrEnum):
    """Whether the axis moves."""

    IDLE = "IDLE"
    BUSY = "BUSY"


def checksum(body: bytes) -> int:
    """Two's complement of the sum of the bytes between a message's first character and its colon, modulo 256."""
    return -sum(body) & 0xFF


def warning_words(flag: str) -> str:
    """A warning flag in words, for a person."""
    return WARNING_WORDS.get(flag, f"unknown warning {flag}")


def rejection_words(reason: str) -> str:
    """A rejection reason in words, for a person."""
    return REJECTION_WORDS.get(reason, f"rejected with {reason}")


def _line(mark: str, fields: list[str], has_checksum: bool) -> bytes:
    body = " ".join(fields).rstrip(" ")
    if not all(" " <= character <= "~" for character in body) or ":" in body:
        raise LocalProtocolError(f"Zaber message {body!r} has characters other than printable ASCII without colons")
    raw = body.encode("ascii")
    tail = f":{checksum(raw):02X}" if has_checksum else ""
    return mark.encode("ascii") + raw + tail.encode("ascii") + b"\r\n"


def _checked(name: str, number: int, largest: int) -> int:
    if not 0 <= number <= largest:
        raise LocalProtocolError(f"Zaber {name} {number} is outside of 0 to {largest}")
    return number


def _head(device: int, axis: int, message_id: int | None) -> list[str]:
    fields = [f"{_checked('device', device, DEVICE_MAX):02d}", str(_checked("axis", axis, AXIS_MAX))]
    return fields if message_id is None else [*fields, f"{_checked('message id', message_id, MESSAGE_ID_MAX):02d}"]


def _is_flag(word: str) -> bool:
    return word == NO_WARNING or (len(word) == 2 and word.isascii() and word.isupper() and word.isalpha())


@dataclass(frozen=True, slots=True)
class Command:
    """What the controller asks: "get pos", "move abs 1000". `words` are joined by single spaces."""

    device: int
    axis: int
    words: str
    message_id: int | None = None
    has_checksum: bool = True

    def encode(self) -> bytes:
        """The line.

        Raises
        ------
        LocalProtocolError
            A number or character that the protocol can not express.
        """
        fields = [str(_checked("device", self.device, DEVICE_MAX)), *_head(0, self.axis, self.message_id)[1:]]
        return _line("/", [*fields, self.words], self.has_checksum)


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to one command; `data` is "0" where there is nothing to say, the reason where it was rejected."""

    device: int
    axis: int
    is_ok: bool
    status: Status
    warning: str = NO_WARNING
    data: str = "0"
    message_id: int | None = None
    has_checksum: bool = True

    def encode(self) -> bytes:
        """The line.

        Raises
        ------
        LocalProtocolError
            A number or character that the protocol can not express.
        """
        if not _is_flag(self.warning) or not self.data.strip():
            raise LocalProtocolError(f"Zaber reply with flag {self.warning!r} (two capitals or --), data {self.data!r}")
        head = _head(self.device, self.axis, self.message_id)
        return _line(
            "@", [*head, "OK" if self.is_ok else "RJ", self.status.value, self.warning, self.data], self.has_checksum
        )


@dataclass(frozen=True, slots=True)
class Info:
    """A further line of an answer."""

    device: int
    axis: int
    text: str
    message_id: int | None = None
    has_checksum: bool = True

    def encode(self) -> bytes:
        """The line.

        Raises
        ------
        LocalProtocolError
            A number or character that the protocol can not express.
        """
        return _line("#", [*_head(self.device, self.axis, self.message_id), self.text], self.has_checksum)


@dataclass(frozen=True, slots=True)
class Alert:
    """Something a drive says unasked, such as that its move is over."""

    device: int
    axis: int
    status: Status
    warning: str = NO_WARNING
    data: str = ""
    has_checksum: bool = True

    def encode(self) -> bytes:
        """The line.

        Raises
        ------
        LocalProtocolError
            A number or character that the protocol can not express.
        """
        if not _is_flag(self.warning):
            raise LocalProtocolError(f"Zaber warning flag {self.warning!r} is not two capital letters or --")
        fields = [*_head(self.device, self.axis, None), self.status.value, self.warning, self.data]
        return _line("!", fields, self.has_checksum)


Answer = Reply | Info | Alert
"""What a drive sends."""


def _number(word: str, largest: int) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 2 and int(word) <= largest):
        raise RemoteProtocolError(f"Zaber message has {word!r} where a number from 0 to {largest} belongs")
    return int(word)


def _body(line: bytes) -> tuple[list[str], bool]:
    """The words of a line without its first character, and whether it carried a (right) checksum."""
    if not all(0x20 <= byte <= 0x7E for byte in line):
        raise RemoteProtocolError(f"Zaber message {line!r} has characters that are not printable ASCII")
    body, colon, tail = line[1:].rpartition(b":")
    if not colon:
        return line[1:].decode("ascii").split(), False
    try:
        given = int(tail, 16) if len(tail) == 2 and tail.isalnum() else -1
    except ValueError:
        given = -1
    if given != checksum(body):
        raise RemoteProtocolError(f"Zaber message {line!r}: its checksum is {checksum(body):02X}")
    return body.decode("ascii").split(), True


def _taken_id(words: list[str]) -> tuple[int | None, list[str]]:
    if words and len(words[0]) <= 2 and words[0].isascii() and words[0].isdigit():
        return int(words[0]), words[1:]
    return None, words


def decode_command(line: bytes) -> Command:
    """The command in one line without its line end. Leading numbers are device, axis and message id, as far as they go.

    Raises
    ------
    RemoteProtocolError
        No command, wrong checksum, or numbers out of range.
    """
    if line[:1] != b"/":
        raise RemoteProtocolError(f"Zaber command {line!r} does not begin with /")
    words, has_checksum = _body(line)
    numbers: list[int] = []
    for word, largest in zip(words, (DEVICE_MAX, AXIS_MAX, MESSAGE_ID_MAX), strict=False):
        if not (word.isascii() and word.isdigit()):
            break
        numbers.append(_number(word, largest))
    device, axis = [*numbers[:2], 0, 0][:2]
    message_id = numbers[2] if len(numbers) > 2 else None
    return Command(device, axis, " ".join(words[len(numbers) :]), message_id, has_checksum)


def decode_answer(line: bytes) -> Answer:
    """The reply, info or alert in one line without its line end.

    Raises
    ------
    RemoteProtocolError
        None of them, or a wrong checksum.
    """
    words, has_checksum = _body(line)
    if line[:1] not in (b"@", b"#", b"!") or len(words) < 2:
        raise RemoteProtocolError(f"{line!r} is no Zaber reply, info or alert")
    device, axis = _number(words[0], DEVICE_MAX), _number(words[1], AXIS_MAX)
    rest = words[2:]
    if line[:1] == b"#":
        message_id, rest = _taken_id(rest)
        return Info(device, axis, " ".join(rest), message_id, has_checksum)
    if line[:1] == b"!":
        status, warning = _status(line, rest)
        return Alert(device, axis, status, warning, " ".join(rest[2:]), has_checksum)
    message_id, rest = _taken_id(rest)
    if not rest or rest[0] not in ("OK", "RJ") or len(rest) < 4:
        raise RemoteProtocolError(f"Zaber reply {line!r} lacks OK or RJ, or its data")
    status, warning = _status(line, rest[1:])
    return Reply(device, axis, rest[0] == "OK", status, warning, " ".join(rest[3:]), message_id, has_checksum)


def _status(line: bytes, words: list[str]) -> tuple[Status, str]:
    if len(words) < 2 or words[0] not in ("IDLE", "BUSY") or not _is_flag(words[1]):
        raise RemoteProtocolError(f"Zaber message {line!r} lacks IDLE or BUSY and a warning flag")
    return Status(words[0]), words[1]


Message = TypeVar("Message")


class _LineParser(Generic[Message]):
    """Cuts a stream into messages; garbage raises once per line, and what follows it is still found."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._ready: list[Message] = []
        self.n_skipped = 0

    def receive_data(self, data: bytes) -> None:
        """Take bytes from the line."""
        self._buffer += data

    def next_message(self) -> Message | None:
        """The next whole message, or None until more bytes come.

        Raises
        ------
        RemoteProtocolError
            A line held something that is no message. Raised once per line; call again to go on, also for a message at
            the end of that line. `n_skipped` counts the bytes that belonged to no message.
        """
        if self._ready:
            return self._ready.pop()
        while True:
            end = self._buffer.find(b"\n")
            if end < 0:
                if len(self._buffer) > MAX_LINE_LENGTH:
                    n_dropped = self.reset()
                    raise RemoteProtocolError(f"{n_dropped} bytes without a line end on a line of Zaber drives")
                return None
            line = bytes(self._buffer[:end]).strip(b"\r")
            del self._buffer[: end + 1]
            if line:
                return self._message(line)

    def reset(self) -> int:
        """Forget what is incomplete, after a silence on the line. How many bytes went."""
        n_dropped = len(self._buffer)
        self.n_skipped += n_dropped
        self._buffer.clear()
        self._ready.clear()
        return n_dropped

    def _message(self, line: bytes) -> Message:
        error = RemoteProtocolError(f"{line[:80]!r} holds no Zaber message")
        for start in self._starts(line):
            try:
                message = self._decode(line[start:])
            except RemoteProtocolError as problem:
                error = problem
                continue
            self.n_skipped += start
            if start == 0:
                return message
            self._ready.append(message)
            raise RemoteProtocolError(f"{line[:start][:80]!r} stood before a Zaber message")
        self.n_skipped += len(line)
        raise error

    def _starts(self, line: bytes) -> list[int]:
        raise NotImplementedError

    def _decode(self, line: bytes) -> Message:
        raise NotImplementedError


class CommandParser(_LineParser[Command]):
    """The drive's ear. A slash begins a command wherever it stands, so that half a command never swallows the next."""

    def _starts(self, line: bytes) -> list[int]:
        return [start] if (start := line.rfind(b"/")) >= 0 else []

    def _decode(self, line: bytes) -> Command:
        return decode_command(line)


class AnswerParser(_LineParser[Answer]):
    """The controller's ear. Texts may hold the first characters of messages, so the first that fits counts."""

    def _starts(self, line: bytes) -> list[int]:
        return [index for index, byte in enumerate(line) if byte in b"@#!"]

    def _decode(self, line: bytes) -> Answer:
        return decode_answer(line)

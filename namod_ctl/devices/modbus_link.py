"""Modbus RTU and TCP requests and their answers over any line; framing, checks and PDUs are pymodbus's.

Modbus TCP numbers its answers. RTU answers name the unit and the function only, so an answer that comes too late
could be taken for another register's. A unit that left a request unanswered is therefore asked for a *marker* first: a
read of another length than all that is unanswered and than what is asked next. Units answer in order: when the
marker's answer is here, whatever was on its way has arrived. A refusal will do as well, but names no length: only the
first marker can be told by it. Where markers come to nothing, a long silence must do. Repeating one and the same
request needs neither.

Source: MODBUS Application Protocol V1.1b3; MODBUS over Serial Line V1.02, section 2.5; Messaging on TCP/IP V1.0b.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from enum import Enum

from pymodbus.framer.base import FramerBase
from pymodbus.framer.rtu import FramerRTU
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.core.drives import ByteTransport
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.devices.links import AttemptError, Line, LineSettings

_MBAP_LENGTH = 7  # bytes of the header of Modbus TCP: transaction, protocol, length, unit
_MAX_PDU = 253
_MAX_RTU_FRAME = _MAX_PDU + 3
_N_TRANSACTIONS = 0x10000
_FUNCTIONS = (3, 4, 6, 16)
_REFUSED = 0x80  # bit in the function code of an exception
_N_LATE_TIMEOUTS = 10  # later than so many timeouts nothing is expected to arrive
_BUSY = 6
_GATEWAY_EXCEPTIONS = (0x0A, 0x0B)
_EXCEPTION_WORDS = {  # section 7 of the application protocol
    1: "it does not know this function",
    2: "it has no such register: is it the drive that the register map describes?",
    3: "it refuses this value",
    4: "it failed while carrying the order out",
    5: "it needs long for this order",
    _BUSY: "it is busy",
    8: "its memory is damaged",
    0x0A: "the gateway has no path to it",
    0x0B: "it does not answer its gateway",
}


class Framing(Enum):
    """How Modbus is put on the line."""

    RTU = "rtu"
    TCP = "tcp"


class RtuParser:
    """Answers from a stream of bytes of Modbus RTU.

    pymodbus's own framer drops everything behind a frame and everything on a wrong checksum, and waits for the rest of
    what garbage announces. Here a sound frame is found wherever it begins.
    """

    def __init__(self) -> None:
        self._decoder = DecodePDU(False)
        self._buffer = b""
        self._is_lost = False
        self.n_skipped = 0

    def receive_data(self, data: bytes) -> None:
        """Take bytes as they come."""
        self._buffer += data

    def reset(self) -> int:
        """Forget what has arrived; the number of bytes of it."""
        n_left = len(self._buffer)
        self.n_skipped += n_left
        self._buffer = b""
        self._is_lost = False
        return n_left

    def next_message(self) -> ModbusPDU | None:
        """The next sound answer with its unit, None while there is none yet.

        Raises
        ------
        RemoteProtocolError
            What arrived cannot begin an answer; once per stretch of damage.
        """
        for offset in range(len(self._buffer)):
            size = self._size_at(offset)
            frame = self._buffer[offset : offset + size]
            if len(frame) < size or not _is_sound(frame) or not _is_pdu(frame[1:-2]):
                continue
            message = self._decoder.decode(frame[1:-2])
            if message is None:
                continue
            message.dev_id = frame[0]
            self.n_skipped += offset
            self._buffer = self._buffer[offset + size :]
            self._is_lost = False
            return message
        self._drop_damage()
        return None

    def _size_at(self, offset: int) -> int:
        """Length of the frame that begins at `offset`; more than there is while too little is there; 0 if none does."""
        head = self._buffer[offset:]
        if len(head) < FramerRTU.MIN_SIZE:
            return FramerRTU.MIN_SIZE
        pdu_class = self._decoder.lookupPduClass(head) if head[1] & ~_REFUSED in _FUNCTIONS else None
        if pdu_class is None:
            return 0
        size = pdu_class.calculateRtuFrameSize(head)
        return size if 0 < size <= _MAX_RTU_FRAME else 0

    def _drop_damage(self) -> None:
        n_damaged = 0
        while n_damaged < len(self._buffer) and self._size_at(n_damaged) <= len(self._buffer) - n_damaged:
            n_damaged += 1
        damage, self._buffer = self._buffer[:n_damaged], self._buffer[n_damaged:]
        self.n_skipped += n_damaged
        if damage and not self._is_lost:
            self._is_lost = True
            raise RemoteProtocolError(f"damaged: {damage[:40].hex(' ')}")


def _is_sound(frame: bytes) -> bool:
    return len(frame) >= FramerRTU.MIN_SIZE and FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big"))


def _is_pdu(pdu: bytes) -> bool:
    """Whether it is an answer to a function that is used here, of the right length; pymodbus logs where it is not."""
    function, length = pdu[0], len(pdu)
    if function & ~_REFUSED not in _FUNCTIONS:
        return False
    if function & _REFUSED:
        return length == 2
    if function in (3, 4):
        return length >= 2 and length == 2 + pdu[1] and pdu[1] % 2 == 0
    return length == 5


class TcpParser:
    """Answers from a stream of bytes of Modbus TCP."""

    def __init__(self) -> None:
        self._decoder = DecodePDU(False)
        self._buffer = b""
        self._is_lost = False
        self.n_skipped = 0

    def receive_data(self, data: bytes) -> None:
        """Take bytes as they come."""
        self._buffer += data

    def reset(self) -> int:
        """Forget what has arrived; the number of bytes of it."""
        n_left = len(self._buffer)
        self.n_skipped += n_left
        self._buffer = b""
        self._is_lost = False
        return n_left

    def next_message(self) -> ModbusPDU | None:
        """The next answer with its unit and transaction, None while there is none yet.

        Raises
        ------
        RemoteProtocolError
            What arrived cannot begin an answer; once per stretch of damage.
        """
        while len(self._buffer) >= _MBAP_LENGTH:
            length = int.from_bytes(self._buffer[4:6], "big")
            size = _MBAP_LENGTH - 1 + length
            is_header = self._buffer[2:4] == b"\0\0" and 2 <= length <= _MAX_PDU + 1
            if is_header and len(self._buffer) < size:
                return None
            pdu = self._buffer[_MBAP_LENGTH:size]
            message = self._decoder.decode(pdu) if is_header and _is_pdu(pdu) else None
            if message is not None:
                message.transaction_id = int.from_bytes(self._buffer[:2], "big")
                message.dev_id = self._buffer[6]
                self._buffer = self._buffer[size:]
                self._is_lost = False
                return message
            damage = self._buffer[:_MBAP_LENGTH]
            self._buffer = self._buffer[1:]
            self.n_skipped += 1
            if not self._is_lost:
                self._is_lost = True
                raise RemoteProtocolError(f"damaged: {damage.hex(' ')}")
        return None


class ModbusLink(Line[ModbusPDU]):
    """Reads and writes registers of the units on one line."""

    def __init__(self, transport: ByteTransport, settings: LineSettings, framing: Framing) -> None:
        super().__init__(transport, settings, RtuParser() if framing is Framing.RTU else TcpParser())
        self._framing = framing
        self._framer: FramerBase = (FramerRTU if framing is Framing.RTU else FramerSocket)(DecodePDU(False))
        self._transaction = 0
        self._doubts: dict[int, set[int]] = {}  # by unit: lengths of what may still be answered late
        self._readable: dict[int, ModbusPDU] = {}  # by unit: a read that it answered

    def read(self, unit: int, function: int, address: int, count: int) -> tuple[int, ...]:
        """The words of `count` registers, read in one request by function 3 (holding) or 4 (input).

        Raises
        ------
        CommunicationError
            No usable answer.
        DeviceFaultError
            The unit refuses, and says why.
        """
        kind = ReadHoldingRegistersRequest if function == 3 else ReadInputRegistersRequest
        return tuple(self._exchange(unit, kind(address=address, count=count)).registers)

    def write(self, unit: int, function: int, address: int, words: Sequence[int]) -> None:
        """Write registers in one request, by function 6 (one) or 16 (several). Raises as `read`."""
        if function == 6:
            self._exchange(unit, WriteSingleRegisterRequest(address=address, registers=list(words)))
        else:
            request = WriteMultipleRegistersRequest(address=address, count=len(words), registers=list(words))
            self._exchange(unit, request)

    def _exchange(self, unit: int, request: ModbusPDU) -> ModbusPDU:
        who = f"Modbus unit {unit}"
        for _ in range(self._settings.n_retries + 1):
            answer = self._answer(who, unit, request)
            if not isinstance(answer, ExceptionResponse):
                return answer
            if answer.exception_code not in (_BUSY, *_GATEWAY_EXCEPTIONS):
                break
        code = answer.exception_code
        words = _EXCEPTION_WORDS.get(code, "see its manual")
        place = f"function {request.function_code}, register {request.address}"
        error = CommunicationError if code in _GATEWAY_EXCEPTIONS else DeviceFaultError
        raise error(f"{who} on {self.name}, {place}: {words} (Modbus exception {code})")

    def _answer(self, who: str, unit: int, request: ModbusPDU) -> ModbusPDU:
        n_sent = 0
        is_in_step = unit not in self._doubts

        def attempt() -> ModbusPDU:
            nonlocal n_sent, is_in_step
            if not is_in_step and not self.is_hurried:
                self._get_in_step(unit, request)
                is_in_step = True
            n_sent += 1
            if self._framing is Framing.RTU:
                self._doubts.setdefault(unit, set()).add(request.count)
            answer = self._ask(unit, request)
            if not is_in_step:
                raise AttemptError("told in a hurry; what came may answer an earlier request")
            return answer

        answer = self.persist(who, attempt)
        if n_sent == 1:
            self._doubts.pop(unit, None)
        if request.function_code in (3, 4):
            self._readable[unit] = request
        return answer

    def _get_in_step(self, unit: int, request: ModbusPDU) -> None:
        counts = self._doubts[unit]
        if len(counts) > self._settings.n_retries + 1:
            self._outwait(_N_LATE_TIMEOUTS * self._settings.timeout_s)
        else:
            count = next(count for count in range(1, len(counts) + 3) if count not in {*counts, request.count})
            is_first = len(counts) == 1
            counts.add(count)
            place = request if request.function_code in (3, 4) else self._readable.get(unit)
            kind = ReadHoldingRegistersRequest if place is None else type(place)
            marker = kind(address=request.address if place is None else place.address, count=count)
            self._ask(unit, marker, takes_refusal=is_first)
        del self._doubts[unit]

    def _outwait(self, silence_s: float) -> None:
        """Listen until nothing has come for so long; a line that babbles on is left to the next question to judge."""
        end_s = time.monotonic() + 2.0 * silence_s
        quiet_s = 0.0
        while quiet_s < silence_s and time.monotonic() < end_s:
            if self.is_hurried:
                raise AttemptError("it was to be outwaited, and then there was a hurry")
            data = self._transport.read(_MAX_RTU_FRAME, self._settings.timeout_s)
            quiet_s = 0.0 if data else quiet_s + self._settings.timeout_s
            self.statistics.n_garbage_bytes += len(data)

    def _ask(self, unit: int, request: ModbusPDU, *, takes_refusal: bool = True) -> ModbusPDU:
        self._transaction = (self._transaction + 1) % _N_TRANSACTIONS
        request.dev_id, request.transaction_id = unit, self._transaction

        def answer_in(message: ModbusPDU) -> ModbusPDU | None:
            if message.dev_id != unit or message.transaction_id != request.transaction_id * self._has_transactions:
                return None
            if isinstance(message, ExceptionResponse):
                is_answer = takes_refusal and message.function_code & ~_REFUSED == request.function_code
            else:
                is_answer = _is_answer(request, message)
            return message if is_answer else None

        return self.ask(self._framer.buildFrame(request), answer_in)

    @property
    def _has_transactions(self) -> bool:
        return self._framing is Framing.TCP


def _is_answer(request: ModbusPDU, message: ModbusPDU) -> bool:
    """Whether a message carries what the request asked for, as far as Modbus says."""
    if message.function_code != request.function_code:
        return False
    if request.function_code in (3, 4):
        return len(message.registers) == request.count
    if request.function_code == 6:
        return (message.address, message.registers) == (request.address, request.registers)
    return (message.address, message.count) == (request.address, request.count)

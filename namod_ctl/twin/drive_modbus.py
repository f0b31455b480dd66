"""The twin's Modbus lines: requests in RTU or TCP frames to the units, which `drive_modbus_units` lets act."""

from __future__ import annotations

from collections.abc import Sequence

from pymodbus.constants import ExcCodes
from pymodbus.framer.rtu import FramerRTU
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.twin.drive_answers import Heard, Listeners, collide, hear_nothing
from namod_ctl.twin.drive_modbus_units import ModbusUnit, Refused

BROADCAST = 0
MAX_RTU_FRAME = 256
TCP_HEAD = 8
"""Header and function code."""
TCP_PROTOCOL = b"\x00\x00"
MIN_TCP_LENGTH, MAX_TCP_LENGTH = 2, 254
FUNCTIONS = (3, 4, 6, 16)
WRITING = (6, 16)


class ModbusRtuLine:
    """All units of one serial bus. Unit 0 is everyone, who act and are silent."""

    def __init__(self, listeners: Listeners[ModbusUnit], addresses: Sequence[int], heard: Heard = hear_nothing) -> None:
        self._listeners, self._heard = listeners, heard
        self._addresses = addresses
        self._decoder = DecodePDU(True)
        self._framer = FramerRTU(self._decoder)
        self._buffer = b""

    def receive(self, data: bytes) -> bytes:
        """The units' answers; a damaged frame gets none, and sound ones are found behind it.

        Source: MODBUS over Serial Line V1.02, section 2.5.1. The silence between frames is not seen here: a frame is
        found by its check sum, at any offset.
        """
        self._buffer += data
        answers, offset = b"", 0
        while len(self._buffer) - offset >= FramerRTU.MIN_SIZE:
            size = self._size(self._buffer[offset:])
            if size:
                frame = self._buffer[offset : offset + size]
                self._buffer, offset = self._buffer[offset + size :], 0
                if frame[1] in WRITING:
                    self._heard(frame)
                answers += self._answer(frame[0], frame[1:-2])
            else:
                offset += 1
        self._buffer = self._buffer[-MAX_RTU_FRAME:]
        return answers

    def _size(self, view: bytes) -> int:
        """Length of the sound frame at the beginning, 0 if there is none."""
        kind = self._decoder.lookupPduClass(view)
        size = kind.calculateRtuFrameSize(view) if kind is not None else FramerRTU.MIN_SIZE
        if not FramerRTU.MIN_SIZE <= size <= len(view):
            return 0
        return size if FramerRTU.check_CRC(view[: size - 2], int.from_bytes(view[size - 2 : size], "big")) else 0

    def _answer(self, address: int, body: bytes) -> bytes:
        if address == BROADCAST:
            for each in self._addresses:
                for unit in self._listeners(each):
                    _response(unit, self._decoder.decode(body), body)
            return b""
        answers = []
        for unit in self._listeners(address):
            response = _response(unit, self._decoder.decode(body), body)
            response.dev_id = address
            answers.append(self._framer.buildFrame(response))
        return collide(answers)


class ModbusTcpLine:
    """All units behind one gateway."""

    def __init__(self, listeners: Listeners[ModbusUnit], heard: Heard = hear_nothing) -> None:
        self._listeners, self._heard = listeners, heard
        self._decoder = DecodePDU(True)
        self._framer = FramerSocket(self._decoder)
        self._buffer = b""

    def receive(self, data: bytes) -> bytes:
        """The units' answers; where no unit listens, or several, the gateway says that nobody answered it soundly."""
        self._buffer += data
        answers = b""
        while len(self._buffer) >= TCP_HEAD:
            length = int.from_bytes(self._buffer[4:6], "big")
            if self._buffer[2:4] != TCP_PROTOCOL or not MIN_TCP_LENGTH <= length <= MAX_TCP_LENGTH:
                self._buffer = self._buffer[1:]  # garbage: look for the next header
                continue
            used, address, transaction, body = self._framer.decode(self._buffer)
            if not used:
                break
            if body[0] in WRITING:
                self._heard(self._buffer[:used])
            self._buffer = self._buffer[used:]
            units = self._listeners(address)
            responses = [_response(unit, self._decoder.decode(body), body) for unit in units]
            nobody = ExceptionResponse(body[0], ExcCodes.GATEWAY_NO_RESPONSE)
            response = responses[0] if len(responses) == 1 else nobody
            response.dev_id, response.transaction_id = address, transaction
            answers += self._framer.buildFrame(response)
        return answers


def _response(unit: ModbusUnit, request: ModbusPDU | None, body: bytes) -> ModbusPDU:
    """What a unit answers; `request` is None where the body makes no sense, also where it wants too many registers.

    Source: MODBUS Application Protocol V1.1b3, sections 6.3, 6.4, 6.6, 6.12 and 7.
    """
    function = body[0]
    try:
        match request:
            case None if function in FUNCTIONS:
                return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
            case ReadHoldingRegistersRequest():  # the request for input registers is one, too
                words = list(unit.read(function, request.address, request.count))
                is_holding = function == ReadHoldingRegistersRequest.function_code
                return (ReadHoldingRegistersResponse if is_holding else ReadInputRegistersResponse)(registers=words)
            case WriteSingleRegisterRequest():
                unit.write(function, request.address, request.registers)
                return WriteSingleRegisterResponse(address=request.address, registers=request.registers)
            case WriteMultipleRegistersRequest():
                if request.count != len(request.registers):
                    return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
                unit.write(function, request.address, request.registers)
                return WriteMultipleRegistersResponse(address=request.address, count=request.count)
    except RemoteProtocolError:
        return ExceptionResponse(function, ExcCodes.ILLEGAL_ADDRESS)
    except Refused as refused:
        return ExceptionResponse(function, refused.code)
    return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)

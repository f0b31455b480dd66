"""A Modbus line with three units whose registers tell whose they are, and what befalls their answers."""

from __future__ import annotations

import random
from collections.abc import Sequence

from pymodbus.constants import ExcCodes

from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.devices.modbus_link import Framing
from namod_ctl.twin.drive_modbus import ModbusRtuLine, ModbusTcpLine
from namod_ctl.twin.drive_modbus_units import Refused

UNITS = (1, 2, 3)


def word_at(unit: int, function: int, address: int) -> int:
    """What a register holds: a word that tells whose it is."""
    return (unit * 20011 + function * 5003 + address * 7) % 0x10000


class KnowingUnit:
    """Every register can be read, 0 to 99 be written; `busy` so often it answers that it is busy."""

    def __init__(self, address: int) -> None:
        self._address = address
        self.written: list[tuple[int, int, tuple[int, ...]]] = []
        self.n_busy = 0

    def read(self, function: int, address: int, count: int) -> tuple[int, ...]:
        if self.n_busy:
            self.n_busy -= 1
            raise Refused(ExcCodes.DEVICE_BUSY)
        return tuple(word_at(self._address, function, at) for at in range(address, address + count))

    def write(self, function: int, address: int, words: Sequence[int]) -> None:
        if address >= 100:
            raise RemoteProtocolError("no such register")
        self.written.append((function, address, tuple(words)))


class Bus:
    """Three units and what befalls their answers."""

    def __init__(self, framing: Framing, seed: int = 0, late: float = 0.0, lost: float = 0.0, damaged: float = 0.0):
        self.units = {address: KnowingUnit(address) for address in UNITS}

        def listeners(address: int) -> list[KnowingUnit]:
            return [self.units[address]] if address in self.units else []

        self._line = ModbusRtuLine(listeners, UNITS) if framing is Framing.RTU else ModbusTcpLine(listeners)
        self._random = random.Random(seed)
        self._chances = late, lost, damaged

    def receive(self, data: bytes) -> bytes:
        return self._line.receive(data)

    def peer(self, data: bytes) -> list[tuple[float, bytes]]:
        late, lost, damaged = self._chances
        answer = self._line.receive(self._damaged(data, damaged))
        if not answer or self._random.random() < lost:
            return []
        delay_s = self._random.uniform(0.0, 1.0) if self._random.random() < late else 0.001
        cut = self._random.randrange(len(answer))
        answer = self._damaged(answer, damaged)
        return [(delay_s, answer[:cut]), (0.001, answer[cut:])] if cut else [(delay_s, answer)]

    def _damaged(self, data: bytes, chance: float) -> bytes:
        if self._random.random() >= chance:
            return data
        damaged = bytearray(data)
        damaged[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return bytes(damaged)

"""A line whose time passes only while somebody waits, and TMCL modules on it that know one number per question."""

from __future__ import annotations

import random
from collections.abc import Callable

from firmware_protocols import tmcl
from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.core.errors import CommunicationError

HOST = 2


class VirtualLine:
    """A `ByteTransport`. What `peer` answers is a list of (delay / s, bytes); answers leave it in order."""

    name = "virtual line"

    def __init__(self, peer: Callable[[bytes], list[tuple[float, bytes]]], latency_s: float = 0.0) -> None:
        self._peer = peer
        self._latency_s = latency_s
        self._under_way: list[tuple[float, bytes]] = []
        self._now_s = 0.0
        self.is_plugged = True
        self.n_reopened = 0
        self.written: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        self._check()
        self.written.append((self._now_s, data))
        for delay_s, answer in self._peer(data):
            after_s = self._under_way[-1][0] if self._under_way else 0.0
            self._under_way.append((max(after_s, self._now_s + self._latency_s + delay_s), answer))

    def read(self, n_max: int, timeout_s: float) -> bytes:
        self._check()
        if not self._under_way or self._under_way[0][0] > self._now_s + timeout_s:
            self._now_s += timeout_s
            return b""
        due_s, data = self._under_way.pop(0)
        self._now_s = max(self._now_s, due_s)
        if len(data) > n_max:
            self._under_way.insert(0, (due_s, data[n_max:]))
        return data[:n_max]

    def discard_input(self) -> None:
        while self.read(4096, 0.0):
            pass

    def reopen(self) -> None:
        self.n_reopened += 1
        self._under_way.clear()
        self._check()

    def close(self) -> None:
        self.is_plugged = False

    def _check(self) -> None:
        if not self.is_plugged:
            raise CommunicationError("unplugged")


def number_of(request: tmcl.Request) -> int:
    """What every module answers to a read: a number that tells from which module, motor and parameter it is."""
    return (request.module << 16 | request.motor << 8 | request.type) * 1009


class KnowingModules:
    """Modules 1 to 3. Each read parameter has a number of its own, user variables keep what is written."""

    def __init__(self) -> None:
        self._parser = tmcl.RequestParser(range(1, 4))
        self._variables: dict[tuple[int, int], int] = {}

    def receive(self, data: bytes) -> list[bytes]:
        self._parser.receive_data(data)
        answers = []
        while True:
            try:
                request = self._parser.next_message()
            except RemoteProtocolError:
                answers.append(tmcl.Reply(HOST, 1, tmcl.Status.WRONG_CHECKSUM, 0).encode())
                continue
            if request is None:
                return answers
            if request.module in range(1, 4):
                answers.append(self._answer(request).encode())

    def _answer(self, request: tmcl.Request) -> tmcl.Reply:
        key = (request.module, request.type)
        value = number_of(request)
        if request.command == tmcl.Command.SGP:
            value = self._variables[key] = request.value
        elif request.command == tmcl.Command.GGP:
            value = self._variables.get(key, 0)
        return tmcl.Reply(HOST, request.module, tmcl.Status.OK, request.command, value)


class BadLuck:
    """Delays, loses, damages answers and questions and babbles, each with its own probability."""

    def __init__(self, seed: int, late: float, lost: float, damaged: float, babbled: float) -> None:
        self._random = random.Random(seed)
        self._chances = late, lost, damaged, babbled
        self._modules = KnowingModules()

    def peer(self, data: bytes) -> list[tuple[float, bytes]]:
        late, lost, damaged, babbled = self._chances
        answers = []
        for answer in self._modules.receive(self._damaged(data, damaged)):
            if self._random.random() < lost:
                continue
            delay_s = self._random.uniform(0.0, 1.0) if self._random.random() < late else 0.001
            answers.append((delay_s, self._damaged(answer, damaged)))
        if self._random.random() < babbled:
            answers.insert(0, (0.0, self._random.randbytes(self._random.randrange(1, 12))))
        return answers

    def _damaged(self, data: bytes, chance: float) -> bytes:
        if self._random.random() >= chance:
            return data
        damaged = bytearray(data)
        damaged[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
        return bytes(damaged)

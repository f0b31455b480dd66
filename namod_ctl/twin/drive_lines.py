"""Lines to the twin's buses: in memory, on a pseudo terminal, on a TCP port; with the faults that lines have."""

from __future__ import annotations

import os
import select
import socket
import struct
import tempfile
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from namod_ctl.core.errors import CommunicationError
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.randomness import generator

READ_SIZE = 4096
LOOK_S = 0.02
"""So often an idle line looks whether it has been pulled out: the twin's clock rings no bell."""
LOCALHOST = "127.0.0.1"


class DriveLine:
    """The bytes of one bus, with what faults of the line do to them. For one user at a time."""

    def __init__(self, drives: TwinDrives, bus: str) -> None:
        self._drives = drives
        self.bus = bus
        self._n_exchanges = 0
        # On TCP nothing arrives damaged: what the wire behind a gateway damages, the gateway drops.
        self._is_gateway = drives.wiring[bus].protocol == "modbus_tcp"

    @property
    def is_unplugged(self) -> bool:
        """Is the line pulled out at present?"""
        return bool(self._active("bus_unplugged"))

    def exchange(self, data: bytes) -> tuple[bytes, float]:
        """What comes back when `data` are sent, and how late (s)."""
        if self.is_unplugged:
            return b"", 0.0
        self._n_exchanges += 1
        rng = generator(self._drives.seed, f"line {self.bus}", self._n_exchanges)
        if self._happens("lost_requests", rng):
            return b"", 0.0
        answer = self._drives.receive(self.bus, self._flipped(data, rng))
        if not answer or self._happens("lost_answers", rng):
            return b"", 0.0
        answer = self._flipped(answer, rng)
        if self._happens("line_noise", rng) and not self._is_gateway:
            most = max(int(fault["count"]) for fault in self._active("line_noise"))
            answer = rng.bytes(int(rng.integers(1, most + 1))) + answer
        is_late = self._happens("slow_answers", rng)
        return answer, max(fault["delay_s"] for fault in self._active("slow_answers")) if is_late else 0.0

    def _active(self, name: str) -> list[dict[str, float]]:
        active = self._drives.faults.active(name, self._drives.clock.monotonic_s())
        return [
            {key: fault.value(key) for key in fault.params if key != "bus"}
            for fault in active
            if fault.concerns_bus(self.bus)
        ]

    def _happens(self, name: str, rng: np.random.Generator) -> bool:
        chance = rng.random()  # drawn in any case: one fault must not change another's course
        return any(chance < fault["share"] for fault in self._active(name))

    def _flipped(self, data: bytes, rng: np.random.Generator) -> bytes:
        share = max((fault["share"] for fault in self._active("bit_errors")), default=0.0)
        if share == 0.0:
            return data
        flips = np.where(rng.random(len(data)) < share, 1 << rng.integers(0, 8, len(data)), 0)
        if self._is_gateway and flips.any():
            return b""
        return bytes(byte ^ int(flip) for byte, flip in zip(data, flips, strict=True))


class LoopbackLine:
    """The peer of a line in memory: call it with what is sent, it gives what has come back by then."""

    def __init__(self, line: DriveLine) -> None:
        self._line = line
        self._late = b""

    def __call__(self, data: bytes) -> bytes:
        """Answers at once; a late one comes with the next.

        Raises
        ------
        CommunicationError
            The line is pulled out.
        """
        if self._line.is_unplugged:
            self._late = b""
            raise CommunicationError(f"bus {self._line.bus} of the twin is unplugged; plug it in again")
        answer, delay_s = self._line.exchange(data)
        arrived = self._late + (b"" if delay_s else answer)
        self._late = answer if delay_s else b""
        return arrived


class _ServedLine(ABC):
    """A line with a thread that serves it until `close`. Delays of answers are the computer's time, as timeouts are."""

    def __init__(self, line: DriveLine) -> None:
        self._line = line
        self._late: deque[tuple[float, bytes]] = deque()
        self._is_closing = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._is_plugged = not line.is_unplugged
        if self._is_plugged:
            self._plug()
        self._thread = threading.Thread(target=self._serve, name=f"twin's bus {line.bus}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Pull the line out for good; harmless when it was done before."""
        if not self._is_closing.is_set():
            self._is_closing.set()
            os.write(self._wake_write, b"x")
            self._thread.join()
            os.close(self._wake_write)
            os.close(self._wake_read)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _plug(self) -> None:
        """Open what a client can open."""

    @abstractmethod
    def _unplug(self) -> None:
        """Close it so that a client notices."""

    @abstractmethod
    def _sources(self) -> list[int]:
        """File descriptors that may have something."""

    @abstractmethod
    def _take(self, source: int) -> bytes:
        """Bytes from a source that is ready; empty if there are none for the drives."""

    @abstractmethod
    def _send(self, data: bytes) -> None:
        """Send an answer to whoever listens, if anybody does."""

    def _serve(self) -> None:
        try:
            while not self._is_closing.is_set():
                self._look_at_plug()
                timeout_s = LOOK_S
                if self._late:
                    timeout_s = min(max(self._late[0][0] - time.monotonic(), 0.0), LOOK_S)
                sources = self._sources() if self._is_plugged else []
                for source in select.select([*sources, self._wake_read], [], [], timeout_s)[0]:
                    data = self._take(source) if source != self._wake_read else b""
                    self._look_at_plug()
                    if data and self._is_plugged:
                        answer, delay_s = self._line.exchange(data)
                        self._late.append((time.monotonic() + delay_s, answer))
                while self._late and self._late[0][0] <= time.monotonic():
                    self._send(self._late.popleft()[1])
        finally:
            if self._is_plugged:
                self._unplug()

    def _look_at_plug(self) -> None:
        if self._line.is_unplugged == self._is_plugged:
            self._is_plugged = not self._is_plugged
            self._late.clear()
            if self._is_plugged:
                self._plug()
            else:
                self._unplug()


class PtyLine(_ServedLine):
    """A serial port.

    Attributes
    ----------
    port
        Path of the port; the same after it was pulled out and plugged in again.
    """

    def __init__(self, line: DriveLine) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="namod-twin-")
        self.port = str(Path(self._folder.name) / line.bus.replace("/", "_"))
        super().__init__(line)

    def close(self) -> None:
        """Pull the line out for good."""
        super().close()
        self._folder.cleanup()

    def _plug(self) -> None:
        self._master, self._slave = os.openpty()  # the slave stays open here: clients may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        new = f"{self.port}.new"
        Path(new).symlink_to(os.ttyname(self._slave))
        os.replace(new, self.port)

    def _unplug(self) -> None:
        Path(self.port).unlink()
        os.close(self._slave)
        os.close(self._master)

    def _sources(self) -> list[int]:
        return [self._master]

    def _take(self, source: int) -> bytes:
        with suppress(BlockingIOError):
            return os.read(source, READ_SIZE)
        return b""

    def _send(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # nobody reads: a wire keeps nothing
            os.write(self._master, data)


class TcpLine(_ServedLine):
    """A TCP port for one client at a time, as serial servers have; another one is turned away.

    Attributes
    ----------
    host, port
        The port is chosen by the system unless one is given, and stays the same.
    """

    def __init__(self, line: DriveLine, port: int = 0) -> None:
        self.host, self.port = LOCALHOST, port
        self._client: socket.socket | None = None
        if line.is_unplugged:  # the number must be known before
            with socket.create_server((self.host, port)) as server:
                self.port = int(server.getsockname()[1])
        super().__init__(line)

    def _plug(self) -> None:
        self._server = socket.create_server((self.host, self.port))
        self.port = int(self._server.getsockname()[1])

    def _unplug(self) -> None:
        self._server.close()
        if self._client is not None:
            # closing without lingering resets the connection
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._hang_up()

    def _sources(self) -> list[int]:
        return [self._server.fileno()] + ([self._client.fileno()] if self._client is not None else [])

    def _take(self, source: int) -> bytes:
        if source == self._server.fileno():
            client, _ = self._server.accept()
            if self._client is not None:
                client.close()
                return b""
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client
            return b""
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_SIZE)
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def _send(self, data: bytes) -> None:
        if self._client is not None and data:
            try:
                self._client.sendall(data)
            except OSError:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self._late.clear()

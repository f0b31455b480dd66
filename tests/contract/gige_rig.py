"""Aravis' fake GigE Vision camera as a process of its own, and a network cable to it that can be tampered with.

The fake is a program of the Aravis project; it answers on 127.0.0.1 and delivers a frame some milliseconds after its
trigger, however long it is to expose. The cable, at an address of its own, adds what a sensor and a network do.
"""

from __future__ import annotations

import contextlib
import fcntl
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from camera_contract import CameraRig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.devices.cameras.genicam_camera import GenicamCamera
from namod_ctl.devices.cameras.genicam_library import library
from namod_ctl.devices.cameras.settings import CameraSettings

FAKE = shutil.which("arv-fake-gv-camera-0.8")
GVCP_PORT = 3956  # GigE Vision 1.2, 13: the control port of every camera
CAMERA_IP, CABLE_IP = "127.0.0.1", "127.0.0.2"
SERIAL_NUMBER = "NAMOD-7"
COLUMNS, ROWS = 320, 240
STARTED_WITHIN_S = 30.0

DISCOVERY, DISCOVERY_ACK, READREG, WRITEREG, WRITEREG_ACK = 0x02, 0x03, 0x80, 0x82, 0x83
CONTROL_PRIVILEGE, STREAM_PORT, STREAM_ADDRESS = 0x0A00, 0x0D00, 0x0D18  # GigE Vision 1.2, table 28-1
TRIGGER, ACQUISITION, EXPOSURE_US, FRAME_PERIOD_US = 0x30C, 0x124, 0x120, 0x138  # of the fake: arvfakecamera.h
QUICK_PERIOD_US = 5000
"""The fake looks that often for a trigger; by default every 40 ms."""


def why_not() -> str:
    """What is missing for these tests; "" when nothing is."""
    try:
        library()
    except ConfigError as error:
        return str(error)
    return "" if FAKE else "Aravis' fake camera is not installed (apt install aravis-tools)"


@contextlib.contextmanager
def gige_port() -> Iterator[None]:
    """While inside, no other test on this computer has a camera on the one port that GigE Vision knows."""
    with (Path(tempfile.gettempdir()) / "namod-ctl-tests-gige.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


class FakeProcess:
    """The fake camera; it can be killed and started again."""

    def __init__(self, command: list[str]) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Return when it answers."""
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline_s = time.monotonic() + STARTED_WITHIN_S
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.settimeout(0.05)
            while time.monotonic() < deadline_s and self._process.poll() is None:
                probe.sendto(struct.pack(">BBHHH", 0x42, 0x01, DISCOVERY, 0, 1), (CAMERA_IP, GVCP_PORT))
                with contextlib.suppress(OSError):
                    probe.recv(1024)
                    return
        self.kill()
        raise RuntimeError(f"{self._command} does not answer: is there another camera on {CAMERA_IP}:{GVCP_PORT}?")

    def kill(self) -> None:
        """As a power cut does it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def fake_camera(*options: str) -> FakeProcess:
    """Aravis' program; options as in its help."""
    assert FAKE is not None
    return FakeProcess([FAKE, "-i", CAMERA_IP, "-s", SERIAL_NUMBER, *options])


def star_camera() -> FakeProcess:
    """Aravis' fake with a star in it."""
    return FakeProcess([sys.executable, str(Path(__file__).with_name("gige_star.py")), CAMERA_IP, SERIAL_NUMBER])


def register(address: int) -> int:
    """What stands in a register of the camera."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.settimeout(2.0)
        probe.sendto(struct.pack(">BBHHHI", 0x42, 0x01, READREG, 4, 1, address), (CAMERA_IP, GVCP_PORT))
        return int(struct.unpack(">8xI", probe.recv(1024))[0])


@dataclass
class _Waiting:
    """A trigger command that the camera gets when its exposure is over."""

    datagram: bytes
    due_s: float


class Cable:
    """Between `CABLE_IP` and the camera. It holds a trigger back for as long as the exposure lasts.

    Attributes
    ----------
    is_cut
        Nothing passes.
    is_slow
        Frames are kept; they arrive when it is not slow any more and the next trigger comes.
    repeats
        Frames come twice: at once, and once more with the next trigger.
    loses_acknowledgement
        That of the next trigger, once.
    """

    def __init__(self) -> None:
        self.is_cut = self.is_slow = self.repeats = self.loses_acknowledgement = False
        self._kept: list[tuple[bytes, tuple[str, int]]] = []
        self._losing = self._lost = ""
        self._lost_block = -1
        self._exposure_s = 0.0
        self._trigger: _Waiting | None = None
        self._hosts: dict[int, tuple[str, int]] = {}
        self._host_stream = ["", 0]
        self._front, self._back, self._stream_in, self._stream_out = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)
        )
        self._front.bind((CABLE_IP, GVCP_PORT))
        self._back.bind((CAMERA_IP, 0))
        self._stream_in.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._stream_in.bind((CAMERA_IP, 0))
        self._stream_out.bind((CABLE_IP, 0))
        self._wake_in, self._wake_out = socket.socketpair()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self._thread.start()

    def lose_next_frame(self, *, wholly: bool) -> None:
        """Lose the next frame, or every fifth packet of it."""
        self._losing = "all" if wholly else "some"

    def take_control_away(self) -> None:
        """The camera forgets who controls it, as after a reset."""
        self.write_register(CONTROL_PRIVILEGE, 0)

    def close(self) -> None:
        """End it."""
        self._wake_out.send(b"x")
        self._thread.join(10.0)
        for each in (self._front, self._back, self._stream_in, self._stream_out, self._wake_in, self._wake_out):
            each.close()

    def _pass_on(self) -> None:
        sources = {self._front: self._from_host, self._back: self._from_camera, self._stream_in: self._from_stream}
        while True:
            trigger = self._trigger
            wait_s = None if trigger is None else max(trigger.due_s - time.monotonic(), 0.0)
            ready, _, _ = select.select([*sources, self._wake_in], [], [], wait_s)
            if self._wake_in in ready:
                return
            for source in ready:
                datagram, sender = source.recvfrom(65536)
                if not self.is_cut:
                    sources[source](datagram, sender)
            if self._trigger is not None and self._trigger.due_s <= time.monotonic():
                self._back.sendto(self._trigger.datagram, (CAMERA_IP, GVCP_PORT))
                self._trigger = None

    def _from_host(self, datagram: bytes, sender: tuple[str, int]) -> None:
        _, _, command, _, number = struct.unpack(">BBHHH", datagram[:8])
        self._hosts[number] = sender
        if command == WRITEREG:
            address, value = struct.unpack(">II", datagram[8:16])
            if address == TRIGGER:
                self._trigger = _Waiting(datagram, time.monotonic() + self._exposure_s)
                while self._kept and not self.is_slow:
                    self._stream_out.sendto(*self._kept.pop(0))
                self._hosts.pop(number)  # there will be no acknowledgement but this
                if self.loses_acknowledgement:
                    self.loses_acknowledgement = False
                    return
                self._front.sendto(struct.pack(">HHHHHH", 0, WRITEREG_ACK, 4, number, 0, 1), sender)
                return
            datagram = datagram[:12] + struct.pack(">I", self._noticed(address, value)) + datagram[16:]
        self._back.sendto(datagram, (CAMERA_IP, GVCP_PORT))

    def _noticed(self, address: int, value: int) -> int:
        """What the camera is to get in place of the value."""
        if address == EXPOSURE_US:
            self._exposure_s = value / 1e6
        elif address == ACQUISITION:
            self._trigger = None
        elif address == CONTROL_PRIVILEGE and value:
            self.write_register(FRAME_PERIOD_US, QUICK_PERIOD_US)
        elif address == STREAM_PORT and value:
            self._host_stream[1] = value & 0xFFFF
            return int(self._stream_in.getsockname()[1])
        elif address == STREAM_ADDRESS and value:
            self._host_stream[0] = socket.inet_ntoa(struct.pack(">I", value))
            return int.from_bytes(socket.inet_aton(CAMERA_IP))
        return value

    def _from_camera(self, datagram: bytes, sender: tuple[str, int]) -> None:
        _, command, _, number = struct.unpack(">HHHH", datagram[:8])
        host = self._hosts.pop(number, None)
        if host is None:
            return
        if command == DISCOVERY_ACK:  # it says where it is: 36 bytes behind the header
            datagram = datagram[:44] + socket.inet_aton(CABLE_IP) + datagram[48:]
        self._front.sendto(datagram, host)

    def _from_stream(self, datagram: bytes, sender: tuple[str, int]) -> None:
        block, packet = struct.unpack(">HI", datagram[2:8])
        kind, number = packet >> 24 & 0x7F, packet & 0xFFFFFF
        if kind == 1 and self._losing:  # the leader of the next frame
            self._lost_block, self._lost, self._losing = block, self._losing, ""
        if block == self._lost_block and (self._lost == "all" or number % 5 == 3):
            return
        addressed = datagram, (str(self._host_stream[0]), int(self._host_stream[1]))
        if self.is_slow or self.repeats:
            self._kept.append(addressed)
        if not self.is_slow:
            self._stream_out.sendto(*addressed)

    def write_register(self, address: int, value: int) -> None:
        """Change something in the camera behind its user's back."""
        datagram = struct.pack(">BBHHHII", 0x42, 0x01, WRITEREG, 8, 0xFFFF, address, value)
        self._back.sendto(datagram, (CAMERA_IP, GVCP_PORT))


def settings(**changes: object) -> CameraSettings:
    """Of the fake camera at the far end of the cable."""
    usual = {"columns": COLUMNS, "rows": ROWS, "full_scale_adu": 255.0, "address": CABLE_IP}
    return CameraSettings(role="star", driver="genicam", **{**usual, **changes})  # type: ignore[arg-type]


@dataclass
class Bench:
    """A camera process and the cable to it."""

    process: FakeProcess
    cable: Cable

    def open(self, **changes: object) -> GenicamCamera:
        """The camera, through the cable."""
        return GenicamCamera(settings(**changes), SystemMonotonicClock())

    def rig(self) -> CameraRig:
        """For the contract of all cameras."""
        return CameraRig(
            camera=self.open(),
            clock=SystemMonotonicClock(),
            columns=COLUMNS,
            rows=ROWS,
            short_s=0.02,
            other_s=0.06,
            long_s=3.0,
            quantum_s=1e-6,
            timeout_s=2.0,
            mid_error_s=0.002,
            reopen=self.open,
            lose_next_frame=lambda: self.cable.lose_next_frame(wholly=False),
            take_away=self.process.kill,
        )


@contextlib.contextmanager
def bench(process: FakeProcess | None = None) -> Iterator[Bench]:
    """A camera that runs, and a cable to it."""
    with gige_port():
        process = fake_camera() if process is None else process
        process.start()
        cable = Cable()
        try:
            yield Bench(process, cable)
        finally:
            cable.close()
            process.kill()

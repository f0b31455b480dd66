"""What our camera drivers cost per frame beside the bare loop of the library they use, and how often they copy it.

Run: python benchmarks/bench_cameras.py [--frames 60]

Both loops take an exposure after a software trigger and end with an array of their own. They take turns: frame by frame
with one and the same open device (pylon), or in blocks (Aravis: a GigE camera obeys one program at a time). A frame's
time is nearly all the emulated camera's; so the caller's processor time is shown as well. `frames` is the memory that
is allocated at most while one frame is taken, in frames: 1 is one copy, or one buffer that is given away without any.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import subprocess
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError, NamodError
from namod_ctl.core.interfaces import Camera
from namod_ctl.core.units import s_to_ms, s_to_us
from namod_ctl.devices.cameras.genicam_camera import GenicamCamera
from namod_ctl.devices.cameras.genicam_library import library
from namod_ctl.devices.cameras.pylon_camera import PylonCamera
from namod_ctl.devices.cameras.settings import CameraSettings

LIMIT_SHARE, LIMIT_FRAMES = 0.10, 1.0
FRAMES_TOLERANCE = 0.1  # of a frame: small things of Python
EXPOSURE_S, TIMEOUT_S = 1e-3, 5.0
PYLON_FORMATS = (("Mono8", 255.0, 2560, 1920), ("Mono12", 4095.0, 2560, 1920), ("BGR8Packed", 255.0, 1024, 768))
FAKE, FAKE_ADDRESS = "arv-fake-gv-camera-0.8", "127.0.0.1"
FAKE_COLUMNS, FAKE_ROWS, N_BLOCKS = 1024, 1024, 3

Image = NDArray[np.unsignedinteger[Any]]


@dataclass
class Loop:
    """One way to take frames, and how long each took: in all, and the caller's processor time."""

    take: Callable[[], Image]
    wall_s: list[float] = field(default_factory=list)
    busy_s: list[float] = field(default_factory=list)
    n_frames_allocated: float = 0.0

    def measure(self) -> None:
        wall_s, busy_s = time.perf_counter(), time.thread_time()
        self.take()
        self.wall_s.append(time.perf_counter() - wall_s)
        self.busy_s.append(time.thread_time() - busy_s)

    def count_frames_allocated(self) -> None:
        tracemalloc.start()
        image = self.take()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        self.n_frames_allocated = peak / image.nbytes


def of_driver(camera: Camera) -> Callable[[], Image]:
    def take() -> Image:
        camera.start(EXPOSURE_S)
        return camera.fetch(TIMEOUT_S).image

    return take


def of_pylon(camera: PylonCamera) -> Callable[[], Image]:
    """The loop of pypylon's own examples, with the device that our driver has opened and set up."""
    pylon = importlib.import_module("pypylon.pylon")
    device, timeout_ms = camera.device, int(s_to_ms(TIMEOUT_S))

    def take() -> Image:
        device.ExposureTime.SetValue(s_to_us(EXPOSURE_S))
        device.WaitForFrameTriggerReady(timeout_ms, pylon.TimeoutHandling_ThrowException)
        device.TriggerSoftware.Execute()
        result = device.RetrieveResult(timeout_ms, pylon.TimeoutHandling_ThrowException)
        assert result.GrabSucceeded()
        image: Image = result.Array
        result.Release()
        return image

    return take


def pylon_rows(n_frames: int) -> Iterator[str]:
    os.environ.setdefault("PYLON_CAMEMU", "2")
    for pixel_format, full_scale_adu, columns, rows in PYLON_FORMATS:
        settings = CameraSettings(
            "star", "pylon", columns, rows, full_scale_adu, "0815-0000", pixel_format=pixel_format
        )
        camera = PylonCamera(settings, SystemMonotonicClock())
        try:
            bare, ours = Loop(of_pylon(camera)), Loop(of_driver(camera))
            for _ in range(n_frames):
                bare.measure()
                ours.measure()
            for loop in (bare, ours):
                loop.count_frames_allocated()
        finally:
            camera.close()
        yield row(f"pylon {pixel_format}", columns, rows, bare, ours)


@contextmanager
def bare_aravis() -> Iterator[Callable[[], Image]]:
    """The loop of Aravis' own examples, with two buffers that take turns."""
    call = library().call
    camera = call("arv_camera_new", FAKE_ADDRESS.encode())
    for name, value in ((b"Width", FAKE_COLUMNS), (b"Height", FAKE_ROWS)):
        call("arv_camera_set_integer", camera, name, value)
    call("arv_camera_set_string", camera, b"PixelFormat", b"Mono8")
    call("arv_camera_set_exposure_time", camera, s_to_us(EXPOSURE_S))
    call("arv_camera_set_trigger", camera, b"Software")
    stream = call("arv_camera_create_stream", camera, None, None)
    memory = {}
    for _ in range(2):
        data = np.empty(FAKE_COLUMNS * FAKE_ROWS, dtype=np.uint8)
        buffer = call("arv_buffer_new_full", data.size, data.ctypes.data, None, None)
        memory[buffer] = data
        call("arv_stream_push_buffer", stream, buffer)
    call("arv_camera_start_acquisition", camera)

    def take() -> Image:
        call("arv_camera_software_trigger", camera)
        buffer = call("arv_stream_timeout_pop_buffer", stream, int(s_to_us(TIMEOUT_S)))
        assert call("arv_buffer_get_status", buffer) == 0
        image = memory[buffer].reshape(FAKE_ROWS, FAKE_COLUMNS).copy()
        call("arv_stream_push_buffer", stream, buffer)
        return image

    try:
        yield take
    finally:
        call("arv_camera_stop_acquisition", camera)
        call("g_object_unref", stream)
        call("g_object_unref", camera)


@contextmanager
def our_genicam() -> Iterator[Callable[[], Image]]:
    settings = CameraSettings("star", "genicam", FAKE_COLUMNS, FAKE_ROWS, 255.0, address=FAKE_ADDRESS)
    camera = GenicamCamera(settings, SystemMonotonicClock())
    try:
        yield of_driver(camera)
    finally:
        camera.close()


def aravis_rows(n_frames: int) -> Iterator[str]:
    library()
    program = shutil.which(FAKE)
    if program is None:
        raise ConfigError("Aravis' fake camera is not installed: apt-get install aravis-tools")
    with ExitStack() as stack:
        fake = stack.enter_context(subprocess.Popen([program, "-i", FAKE_ADDRESS], stdout=subprocess.DEVNULL))
        stack.callback(fake.kill)
        wait_until_open(our_genicam)
        bare, ours = Loop(lambda: np.zeros(1, np.uint8)), Loop(lambda: np.zeros(1, np.uint8))
        for block in range(N_BLOCKS):
            for loop, opened in ((bare, bare_aravis), (ours, our_genicam)):
                with opened() as loop.take:
                    loop.take()  # the first frame of a stream has its own costs
                    for _ in range(n_frames // N_BLOCKS):
                        loop.measure()
                    if block == N_BLOCKS - 1:
                        loop.count_frames_allocated()
    yield row("Aravis Mono8", FAKE_COLUMNS, FAKE_ROWS, bare, ours)


def wait_until_open(open_camera: Callable[[], Any]) -> None:
    """Return when the fake camera, which has just been started, can be opened."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        with suppress(NamodError), open_camera():
            return
    raise ConfigError(f"the fake camera at {FAKE_ADDRESS} does not answer")


def row(name: str, columns: int, rows: int, bare: Loop, ours: Loop) -> str:
    bare_s, ours_s = float(np.median(bare.wall_s)), float(np.median(ours.wall_s))
    extra_s = float(np.median(ours.busy_s) - np.median(bare.busy_s))
    share = ours_s / bare_s - 1.0
    is_good = share <= LIMIT_SHARE and ours.n_frames_allocated <= LIMIT_FRAMES + FRAMES_TOLERANCE
    return (
        f"{name:18s}{columns:6d} x {rows:4d}{s_to_ms(bare_s):9.2f}{s_to_ms(ours_s):9.2f}{100.0 * share:8.1f} %"
        f"{s_to_ms(extra_s):10.3f}{bare.n_frames_allocated:9.2f}{ours.n_frames_allocated:9.2f}"
        f"   {'ok' if is_good else 'TOO MUCH'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60)
    n_frames = parser.parse_args().frames
    print(f"medians of {n_frames} frames each, taking turns; at most {100.0 * LIMIT_SHARE:.0f} % and one frame")
    print(
        f"{'library, format':18s}{'frame':>13s}{'bare ms':>9s}{'ours ms':>9s}{'more':>10s}{'CPU +ms':>10s}"
        f"{'frames':>9s}{'of ours':>9s}"
    )
    for rows in (pylon_rows, aravis_rows):
        try:
            for line in rows(n_frames):
                print(line)
        except ConfigError as error:
            print(f"left out: {error}")


if __name__ == "__main__":
    main()

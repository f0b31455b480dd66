"""Basler's own library with its emulated cameras behind the contract of all cameras, and what only this driver does."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from camera_contract import STOPPED_S, CameraContract, CameraRig
from numpy.typing import NDArray

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.pylon_camera import PylonCamera, list_cameras
from namod_ctl.devices.cameras.pylon_nodes import DeviceTimes, PylonNodes
from namod_ctl.devices.cameras.settings import CameraSettings

pytest.importorskip("pypylon.pylon", reason="pypylon is not installed: pip install 'namod-ctl[pylon]'")

SERIAL_NUMBERS = ("0815-0000", "0815-0001")
COLUMNS, ROWS = 384, 288
CLOCK = SystemMonotonicClock()


@pytest.fixture(autouse=True)
def emulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The library has two emulated cameras."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")


def settings(**changed: Any) -> CameraSettings:
    usual: dict[str, Any] = {
        "role": "star",
        "driver": "pylon",
        "columns": COLUMNS,
        "rows": ROWS,
        "full_scale_adu": 255.0,
    }
    return CameraSettings(**(usual | {"serial_number": SERIAL_NUMBERS[0]} | changed))


@contextmanager
def opened(**changed: Any) -> Iterator[PylonCamera]:
    camera = PylonCamera(settings(**changed), CLOCK)
    try:
        yield camera
    finally:
        camera.close()


def fail_next_buffer(camera: PylonCamera) -> None:
    camera.device.ForceFailedBufferCount.SetValue(1)
    camera.device.ForceFailedBuffer.Execute()


def take(camera: PylonCamera) -> NDArray[np.unsignedinteger[Any]]:
    camera.start(0.001)
    return camera.fetch(2.0).image


class _PylonContract(CameraContract):
    asked: dict[str, Any]  # beyond the usual settings
    is_colour = False

    @pytest.fixture
    def rig(self) -> Iterator[CameraRig]:
        def open_camera() -> PylonCamera:
            return PylonCamera(settings(**self.asked), CLOCK)

        camera = open_camera()
        rig = CameraRig(
            camera=camera,
            clock=CLOCK,
            columns=COLUMNS,
            rows=ROWS,
            full_scale_adu=self.asked["full_scale_adu"],
            is_colour=self.is_colour,
            short_s=0.02,
            other_s=0.05,
            long_s=3.0,
            quantum_s=1e-6,
            timeout_s=1.0,
            mid_error_s=0.02,
            reopen=open_camera,
            lose_next_frame=lambda: fail_next_buffer(camera),
            take_away=lambda: camera.device.FirePnPCallback.Execute(),
        )
        yield rig
        camera.close()
        rig.camera.close()


class TestGrey8Bit(_PylonContract):
    asked = {"full_scale_adu": 255.0}  # noqa: RUF012 - it is not changed


class TestColour12BitOfABayerPattern(_PylonContract):
    asked = {"full_scale_adu": 4095.0, "pixel_format": "BayerRG12"}  # noqa: RUF012
    is_colour = True


# --- pixels


@pytest.mark.parametrize(
    ("pixel_format", "full_scale_adu", "shape", "dtype"),
    [
        (None, 255.0, (ROWS, COLUMNS), np.uint8),
        (None, 65535.0, (ROWS, COLUMNS), np.uint16),
        ("BGR8Packed", 255.0, (ROWS, COLUMNS, 3), np.uint8),
        ("RGB8Packed", 255.0, (ROWS, COLUMNS, 3), np.uint8),
    ],
)
def test_pixels_are_those_that_the_camera_was_shown(
    tmp_path: Path, pixel_format: str | None, full_scale_adu: float, shape: tuple[int, ...], dtype: type
) -> None:
    rng = np.random.default_rng(1)
    with opened(pixel_format=pixel_format, full_scale_adu=full_scale_adu) as camera:
        for name in ("a.png", "b.png"):
            cv2.imwrite(str(tmp_path / name), np.zeros(shape, dtype=dtype))
        camera.show_pictures(tmp_path)
        for _ in range(5):
            shown: NDArray[Any] = rng.integers(0, int(full_scale_adu) + 1, shape).astype(dtype)
            for name in ("a.png", "b.png"):
                cv2.imwrite(str(tmp_path / name), shown)
            assert np.array_equal(take(camera), shown)


@pytest.mark.parametrize("full_scale_adu", [1023.0, 4095.0])
def test_depths_between_are_right_aligned(tmp_path: Path, full_scale_adu: float) -> None:
    """The emulated camera takes the upper bits of 16."""
    shown = np.linspace(0, 65535, ROWS * COLUMNS).astype(np.uint16).reshape(ROWS, COLUMNS)
    cv2.imwrite(str(tmp_path / "ramp.png"), shown)
    with opened(full_scale_adu=full_scale_adu) as camera:
        camera.show_pictures(tmp_path)
        image = take(camera)
    assert image.max() == full_scale_adu
    assert np.abs(image / full_scale_adu - shown / 65535.0).max() < 1.0 / full_scale_adu


# --- settings


def test_region_and_binning_are_set_and_the_region_is_in_the_middle() -> None:
    with opened(binning=2, gain=6.0) as camera:
        device = camera.device
        assert (device.BinningHorizontal.Value, device.BinningVertical.Value) == (2, 2)
        assert device.Gain.Value == pytest.approx(6.0, abs=0.1)
        for size, offset, most in ((COLUMNS, "OffsetX", "WidthMax"), (ROWS, "OffsetY", "HeightMax")):
            free = getattr(device, most).Value - size
            assert abs(getattr(device, offset).Value - free / 2) <= 1
    with opened(offset_px=(16, 32)) as camera:
        assert (camera.device.OffsetX.Value, camera.device.OffsetY.Value) == (16, 32)
        assert camera.device.Gain.Value == camera.device.Gain.Min


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"columns": 5000}, ["Width = 5000", "1 to 4096", "columns"]),
        ({"binning": 7}, ["BinningHorizontal = 7", "1 to 4", "binning"]),
        ({"gain": 90.0}, ["Gain = 90", "0 to 48", "gain"]),
        ({"offset_px": (4000, 0)}, ["OffsetX = 4000", "0 to 3712", "offset_px"]),
        ({"pixel_format": "Mono12Packed", "full_scale_adu": 4095.0}, ["Mono12Packed", "Mono12", "pixel_format"]),
        ({"pixel_format": "Mono12"}, ["Mono12", "4095", "full_scale_adu"]),
        ({"full_scale_adu": 511.0}, ["9 bit", "Mono8", "full_scale_adu"]),
        ({"serial_number": None}, [*SERIAL_NUMBERS, "serial_number"]),
        ({"address": "192.0.2.7"}, ["serial_number", "address"]),
    ],
)
def test_what_the_camera_does_not_take_is_refused(changed: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught, opened(**changed):
        pass
    assert all(word in str(caught.value) for word in ["star camera", *words]), caught.value


def test_a_refused_camera_is_free_for_the_next_try() -> None:
    with pytest.raises(ConfigError), opened(columns=5000):
        pass
    with opened() as camera:
        assert take(camera).shape == (ROWS, COLUMNS)


def test_a_camera_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(DeviceFaultError) as caught, opened(serial_number="21838345"):
        pass
    assert all(number in str(caught.value) for number in ("21838345", *SERIAL_NUMBERS))


def test_settings_left_by_another_program_are_undone() -> None:
    with opened() as camera:
        camera.device.StopGrabbing()
        for name, value in (("GainAuto", "Continuous"), ("ExposureAuto", "Once"), ("Gamma", 2.2), ("ReverseX", True)):
            getattr(camera.device, name).SetValue(value)
        camera._configure()  # the emulated camera forgets them when it is closed, so it is set up again right here
        assert camera.device.GainAuto.Value == camera.device.ExposureAuto.Value == "Off"
        assert camera.device.Gamma.Value == 1.0
        assert not camera.device.ReverseX.Value


class StubbornNode:
    """Takes every value without a word, and keeps its own."""

    def __init__(self, kept: str) -> None:
        self.kept = kept

    def GetValue(self) -> str:  # noqa: N802 - the library's name
        return self.kept

    def SetValue(self, value: str) -> None:  # noqa: N802
        pass


def test_a_setting_that_is_silently_ignored_is_refused_with_both_values() -> None:
    genicam = importlib.import_module("pypylon.genicam")
    names = {name: getattr(genicam, name) for name in dir(genicam) if name.endswith("Exception")}
    readable = SimpleNamespace(IsReadable=lambda node: True, IsWritable=lambda node: True, **names)
    node_map = SimpleNamespace(GetNode=lambda name: StubbornNode("Continuous"))
    nodes = PylonNodes(node_map, readable, "star camera Basler X (7)")
    with pytest.raises(ConfigError, match=r"star camera Basler X \(7\): GainAuto = Off .* keeps Continuous"):
        nodes.set_if_there("GainAuto", "Off")


class TickingCamera:
    """Nodes of a camera whose clock is behind ours, of GigE Vision's kind or of GenICam SFNC 2's."""

    def __init__(self, now_s: Callable[[], float], names: tuple[str, str], ticks_per_s: int, *, says_so: bool) -> None:
        self.now_s, self.ticks_per_s = now_s, ticks_per_s
        self.ticks = 0
        self.nodes = {
            names[0]: SimpleNamespace(Execute=self.latch),
            names[1]: SimpleNamespace(GetValue=lambda: self.ticks),
        }
        if says_so:
            self.nodes["GevTimestampTickFrequency"] = SimpleNamespace(GetValue=lambda: ticks_per_s)

    def find(self, name: str) -> Any | None:
        return self.nodes.get(name)

    def latch(self) -> None:
        self.ticks = self.at(self.now_s())

    def at(self, time_s: float) -> int:
        return round((time_s - 990.0) * self.ticks_per_s)


@pytest.mark.parametrize(
    ("names", "ticks_per_s", "says_so"),
    [
        (("GevTimestampControlLatch", "GevTimestampValue"), 125_000_000, True),
        (("TimestampLatch", "TimestampLatchValue"), 1_000_000_000, False),
    ],
)
def test_the_cameras_own_clock_is_brought_onto_ours(names: tuple[str, str], ticks_per_s: int, says_so: bool) -> None:
    clock = SimpleNamespace(monotonic_s=lambda: 1000.0)
    camera = TickingCamera(clock.monotonic_s, names, ticks_per_s, says_so=says_so)
    times = DeviceTimes(camera, clock)  # type: ignore[arg-type] # as much of a camera as it uses
    times.compare()
    assert times.host_s(camera.at(1000.25)) == pytest.approx(1000.25, abs=1e-8)
    assert np.isnan(times.host_s(0))  # a frame without a time


@pytest.mark.parametrize(("delay_s", "is_believed"), [(0.002, True), (0.03, False), (-3000.0, False), (np.nan, False)])
def test_a_time_stamp_is_believed_where_it_can_be_the_exposures_start(delay_s: float, is_believed: bool) -> None:
    with opened() as camera:
        camera.start(0.02)
        assert camera._running is not None
        triggered_s = camera._running.start_s
        stamped_s = triggered_s + delay_s
        camera._times = SimpleNamespace(host_s=lambda ticks: stamped_s)  # type: ignore[assignment]
        exposure = camera.fetch(1.0)
    start_s = exposure.mid_exposure_s - exposure.exposure_s / 2.0
    assert start_s == pytest.approx(stamped_s if is_believed else triggered_s, abs=1e-9)


# --- stopping, and frames that do not come


def test_closing_ends_a_wait_for_a_frame_that_does_not_come() -> None:
    with opened() as camera:
        camera.device.TriggerSelector.SetValue("FrameEnd")  # software triggers fall into the void
        camera.start(0.001)
        outcome: list[object] = []

        def fetch() -> None:
            try:
                outcome.append(camera.fetch(30.0))
            except CommunicationError as error:
                outcome.append(error)

        thread = threading.Thread(target=fetch)
        thread.start()
        CLOCK.wait_s(0.2)
        began_s = time.monotonic()
        camera.close()
        thread.join(10.0)
        assert time.monotonic() - began_s < STOPPED_S
        assert isinstance(outcome[0], CommunicationError)
        assert "closed" in str(outcome[0])


def test_a_frame_that_does_not_come_is_told_in_time_and_the_next_one_comes() -> None:
    """Also where SIGALRM is not the library's, whose own timeouts then never end."""
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        with opened() as camera:
            take(camera)
            camera.device.TriggerSelector.SetValue("FrameEnd")
            camera.start(0.001)
            began_s = time.monotonic()
            with pytest.raises(CommunicationError, match=r"no frame within 0\.2 s"):
                camera.fetch(0.2)
            assert time.monotonic() - began_s < 1.0
            camera.device.TriggerSelector.SetValue("FrameStart")
            take(camera)
    finally:
        signal.signal(signal.SIGALRM, before)


def test_a_frame_that_was_lost_says_how() -> None:
    with opened() as camera:
        fail_next_buffer(camera)
        camera.start(0.001)
        with pytest.raises(CommunicationError, match="incompletely grabbed"):
            camera.fetch(1.0)


# --- finding


def test_cameras_are_listed() -> None:
    expected = [FoundCamera("pylon", "Basler", "Emulation", number, "") for number in SERIAL_NUMBERS]
    assert list_cameras() == expected


def test_a_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypylon.pylon", None)
    with pytest.raises(ConfigError, match=r"pip install 'namod-ctl\[pylon\]'"):
        list_cameras()

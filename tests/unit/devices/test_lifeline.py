"""A camera on a USB from which it vanishes: what brings it back, what does not, and what is said meanwhile."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import numpy as np
import pytest
from virtual_usb import VirtualUsb, basler

from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.devices.cameras.lifeline import FORGIVEN_AFTER_S, LOOK_EVERY_S, MAX_SILENCES, RETRY_AFTER_S, Lifeline
from namod_ctl.devices.usb_reset import CameraReset, UsbReset

SERIAL = "21979447"


@dataclass
class Clock:
    now_s: float = 0.0

    def monotonic_s(self) -> float:
        return self.now_s

    def wait_s(self, duration_s: float) -> None:
        self.now_s += duration_s


@dataclass
class Bench:
    """One USB camera, its bus, and how often it was opened; `open` is what a driver does."""

    clock: Clock = field(default_factory=Clock)
    device: object = None
    n_opened: int = 0
    n_closed: int = 0

    def __post_init__(self) -> None:
        self.device = basler(int(SERIAL))
        self.bus = VirtualUsb([self.device])

    def open(self) -> BenchCamera:
        if self.device not in self.bus.devices:
            raise DeviceFaultError(f"no camera with serial number {SERIAL}; found: none")
        if self.device.is_hung:
            raise DeviceFaultError("the camera cannot be opened")
        self.n_opened += 1
        return BenchCamera(self)

    def lifeline(self) -> Lifeline:
        return Lifeline(self.open, self.clock, CameraReset(SERIAL, {0x2676}, self.bus))

    def unplug(self) -> None:
        self.bus.devices.remove(self.device)

    def plug(self) -> None:
        self.bus.devices.append(self.device)


class BenchCamera:
    """A driver whose frames come as long as the device is on the bus and not hung."""

    name = "bench camera 21979447"
    exposure_range_s = (1e-3, 3.0)

    def __init__(self, bench: Bench) -> None:
        self._bench, self._n = bench, 0
        self._is_lost = False

    def _check(self) -> None:
        if self._is_lost or self._bench.device not in self._bench.bus.devices:
            self._is_lost = True
            raise DeviceFaultError("the device was removed")

    def start(self, exposure_s: float) -> None:
        if exposure_s > 3.0:
            raise LimitError("3 s at most")
        self._check()

    def fetch(self, timeout_s: float) -> Exposure:
        self._check()
        self._n += 1
        if self._bench.device.is_hung:
            raise CommunicationError("no frame")
        return Exposure(np.zeros((2, 2), np.uint8), 0.1, self._bench.clock.now_s, self._n)

    def close(self) -> None:
        self._bench.n_closed += 1


def tried(camera: Lifeline, clock: Clock, seconds: float) -> tuple[list[Exposure], list[str]]:
    """What comes of trying once a second, as the recorder does."""
    frames, said = [], []
    end_s = clock.now_s + seconds
    while clock.now_s < end_s:
        try:
            camera.start(0.1)
            frames.append(camera.fetch(1.0))
        except (DeviceFaultError, CommunicationError) as error:
            said.append(str(error))
        clock.wait_s(1.0)
    return frames, said


def test_a_camera_that_is_well_is_left_alone() -> None:
    bench = Bench()
    camera = bench.lifeline()
    frames, said = tried(camera, bench.clock, 5.0)
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 4, 5]
    assert said == []
    assert (bench.n_opened, bench.device.n_resets, camera.n_recoveries) == (1, 0, 0)
    with pytest.raises(LimitError):
        camera.start(4.0)


def test_a_camera_whose_plug_was_out_comes_back_and_its_frames_count_on() -> None:
    bench = Bench()
    camera = bench.lifeline()
    before, _ = tried(camera, bench.clock, 3.0)
    bench.unplug()
    none, said = tried(camera, bench.clock, 4.0)
    assert none == []
    assert "the device was removed" in said[0]
    assert "no such camera on the USB" in said[0]
    assert "no camera with serial number" in said[-1]
    bench.plug()
    after, _ = tried(camera, bench.clock, 12.0)
    ids = [frame.frame_id for frame in before + after]
    assert ids == list(range(1, len(ids) + 1))
    assert len(after) > 3
    assert bench.device.n_resets == 0  # it was not there to be reset
    assert (bench.n_opened, bench.n_closed, camera.n_recoveries) == (2, 1, 1)


def test_a_camera_that_sends_nothing_any_more_is_reset_and_opened_again() -> None:
    bench = Bench()
    camera = bench.lifeline()
    tried(camera, bench.clock, 2.0)
    bench.device.is_hung = True
    _, said = tried(camera, bench.clock, float(MAX_SILENCES))
    assert said[:-1] == ["no frame"] * (MAX_SILENCES - 1)
    assert "in a row" in said[-1]
    assert "reset once" in said[-1]
    frames, _ = tried(camera, bench.clock, 5.0)
    assert len(frames) >= 4
    assert bench.device.n_resets == 1


def test_resets_are_bounded_and_then_it_says_what_was_tried_and_what_to_do() -> None:
    bench = Bench()
    camera = bench.lifeline()
    bench.device.is_hung, bench.device.is_mended_by_reset = True, False
    _, said = tried(camera, bench.clock, MAX_SILENCES + sum(RETRY_AFTER_S) + 10.0)
    assert f"reset {len(RETRY_AFTER_S)} times, opened {len(RETRY_AFTER_S)} times" in said[-1]
    assert "given up" in said[-1]
    assert "plug" in said[-1]
    tried(camera, bench.clock, 300.0)
    assert bench.device.n_resets == len(RETRY_AFTER_S)
    bench.device.is_hung = False  # somebody has taken the plug out and in again
    frames, _ = tried(camera, bench.clock, LOOK_EVERY_S + 5.0)
    assert len(frames) >= 4


def test_after_it_has_worked_for_a_while_it_is_worth_as_many_attempts_as_before() -> None:
    bench = Bench()
    camera = bench.lifeline()
    for n in range(1, 5):
        bench.unplug()
        _, said = tried(camera, bench.clock, 5.0)
        assert "attempt 1 of" in said[0]
        assert "lost 0 s ago" in said[0]
        bench.plug()
        tried(camera, bench.clock, FORGIVEN_AFTER_S + 10.0)
        assert camera.n_recoveries == n


def test_a_camera_that_comes_and_goes_is_not_reset_for_ever() -> None:
    """Each time it is opened it gives one frame and is lost again."""
    bench = Bench()
    camera = bench.lifeline()
    frames, said = [], []
    healthy = BenchCamera.fetch

    def fetch(self: BenchCamera, timeout_s: float) -> Exposure:
        if self._n == 1:
            raise DeviceFaultError("lost again")
        return healthy(self, timeout_s)

    BenchCamera.fetch = fetch  # type: ignore[method-assign]
    try:
        frames, said = tried(camera, bench.clock, 600.0)
    finally:
        BenchCamera.fetch = healthy  # type: ignore[method-assign]
    assert bench.device.n_resets == len(RETRY_AFTER_S)
    assert 10 < len(frames) < 60  # and whenever it can, it works
    assert "given up" in said[-1]


def test_a_camera_that_opens_but_never_delivers_does_not_count_as_back() -> None:
    bench = Bench()
    camera = bench.lifeline()

    def lost(self: BenchCamera, timeout_s: float) -> Exposure:
        raise DeviceFaultError("lost again")

    healthy, BenchCamera.fetch = BenchCamera.fetch, lost  # type: ignore[method-assign]
    try:
        _, said = tried(camera, bench.clock, 2.0 * sum(RETRY_AFTER_S))
    finally:
        BenchCamera.fetch = healthy  # type: ignore[method-assign]
    assert bench.device.n_resets == len(RETRY_AFTER_S)
    assert "given up" in said[-1]


def test_a_camera_that_cannot_be_reset_is_opened_again() -> None:
    bench = Bench()
    camera = Lifeline(bench.open, bench.clock)
    bench.unplug()
    tried(camera, bench.clock, 2.0)
    bench.plug()
    frames, _ = tried(camera, bench.clock, 10.0)
    assert frames


def test_without_permission_the_rule_is_part_of_what_is_said() -> None:
    bench = Bench()
    camera = bench.lifeline()
    bench.device.is_hung = bench.device.is_forbidden = True
    _, said = tried(camera, bench.clock, MAX_SILENCES + 1.0)
    assert 'ATTR{idVendor}=="2676"' in said[-1]


def test_closing_ends_it_for_good_even_while_it_is_being_opened() -> None:
    bench = Bench()
    is_opening, may_go_on = threading.Event(), threading.Event()
    may_go_on.set()

    def slow_open() -> BenchCamera:
        is_opening.set()
        assert may_go_on.wait(10.0)
        return bench.open()

    camera = Lifeline(slow_open, bench.clock)
    bench.unplug()
    tried(camera, bench.clock, 1.5)
    bench.plug()
    is_opening.clear()
    may_go_on.clear()
    bench.clock.wait_s(10.0)
    failures: list[str] = []

    def use() -> None:
        try:
            camera.start(0.1)
        except DeviceFaultError as error:
            failures.append(str(error))

    user = threading.Thread(target=use)
    user.start()
    assert is_opening.wait(10.0)
    camera.close()
    may_go_on.set()
    user.join(10.0)
    assert "is closed" in failures[0]
    assert bench.n_opened == bench.n_closed == 2
    camera.close()
    with pytest.raises(DeviceFaultError, match="closed"):
        camera.start(0.1)
    with pytest.raises(DeviceFaultError, match="closed"):
        camera.fetch(0.1)


def test_a_camera_that_is_not_there_at_first_is_an_error_at_once() -> None:
    bench = Bench()
    bench.unplug()
    with pytest.raises(DeviceFaultError, match=SERIAL):
        bench.lifeline()


def test_what_a_reset_says_reaches_the_person() -> None:
    bench = Bench()
    camera = Lifeline(bench.open, bench.clock, lambda: UsbReset(False, "libusb is missing"))
    bench.unplug()
    _, said = tried(camera, bench.clock, 1.0)
    assert "libusb is missing" in said[0]

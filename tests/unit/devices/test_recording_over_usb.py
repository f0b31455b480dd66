"""A recording whose camera vanishes from the USB, hangs, and comes back: no stored record is lost, and it says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fake_night import FACETS, TELESCOPE, FakeCamera, Night, new_run
from virtual_usb import VirtualDevice, VirtualUsb, basler

from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.records import Record
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.devices.cameras.lifeline import RETRY_AFTER_S, Lifeline
from namod_ctl.devices.usb_reset import CameraReset
from namod_ctl.store.run import RunStore

SERIAL = 21979447
SETTINGS = RecordSettings(region_radius_rad=0.002)
VANISHES_S, RETURNS_S = 4.0, 21.0


class UsbDriver:
    """What a driver is: frames of the night while the device is on the bus; a new one counts frames from 1."""

    def __init__(self, camera: FakeCamera, bus: UsbNight) -> None:
        if bus.device not in bus.usb.devices or bus.device.is_hung:
            raise DeviceFaultError(f"no camera with serial number {SERIAL} answers")
        self._camera, self._bus, self._n = camera, bus, 0
        self._is_lost = False
        self.name, self.exposure_range_s = camera.name, camera.exposure_range_s
        bus.n_opened += 1

    def _check(self) -> None:
        self._bus.happen()
        if self._is_lost or self._bus.device not in self._bus.usb.devices:
            self._is_lost = True
            raise DeviceFaultError("the device has been removed")

    def start(self, exposure_s: float) -> None:
        self._check()
        self._camera.start(exposure_s)

    def fetch(self, timeout_s: float) -> Exposure:
        fresh = self._camera.fetch(timeout_s)
        self._check()
        if self._bus.device.is_hung:
            raise CommunicationError("no frame came")
        self._n += 1
        return replace(fresh, frame_id=self._n)

    def close(self) -> None:
        self._camera.close()


class UsbNight(Night):
    """The night with one of its cameras on a USB; `happen` does to the bus what is due."""

    def __init__(self, role: str, what: Callable[[UsbNight, float], None]) -> None:
        super().__init__()
        self.device: VirtualDevice = basler(SERIAL)
        self.usb = VirtualUsb([self.device])
        self.n_opened = 0
        self._role, self._what = role, what
        camera = self.star if role == "star" else self.reflector

        def open_again() -> UsbDriver:
            self.happen()
            return UsbDriver(camera, self)

        self.lifeline = Lifeline(open_again, self.clock, CameraReset(str(SERIAL), backend=self.usb))

    def happen(self) -> None:
        self._what(self, self.clock.now_s)

    @property
    def equipment(self) -> Equipment:
        if self._role == "star":
            return Equipment(self.lifeline, self.reflector, self.clock, self.clock)
        return Equipment(self.star, self.lifeline, self.clock, self.clock)


def unplugged(night: UsbNight, now_s: float) -> None:
    night.usb.devices[:] = [] if VANISHES_S < now_s < RETURNS_S else [night.device]


def hung(night: UsbNight, now_s: float) -> None:
    if now_s > VANISHES_S and night.device.n_resets == 0:
        night.device.is_hung = True


def gone_for_good(night: UsbNight, now_s: float) -> None:
    night.usb.devices[:] = [] if now_s > VANISHES_S else [night.device]


def recorded(path: Path, night: UsbNight, stop: StopRule) -> tuple[list[Record], list[Progress]]:
    """The records, after a look at those that were stored when the camera was lost: they must stay as they were."""
    seen: list[Progress] = []
    stored_before: list[Record] = []
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)

        def watch(progress: Progress) -> None:
            seen.append(progress)
            if progress.source.trouble and not stored_before:
                stored_before.extend(store.records())

        recorder.record(stop, watch)
    with RunStore.open(path) as store:
        records = store.records()
    for before, after in zip(stored_before, records[: len(stored_before)], strict=True):
        assert before.index == after.index
        assert before.facet_intensity.tobytes() == after.facet_intensity.tobytes()
    assert [record.index for record in records] == list(range(len(records)))
    return records, seen


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_a_plug_that_was_out_costs_time_and_no_record(tmp_path: Path, role: str) -> None:
    night = UsbNight(role, unplugged)
    records, seen = recorded(tmp_path / "RUN", night, StopRule(n_records=60, duration_s=300.0))
    assert sum(record.reject_reason is None for record in records) == 60
    assert night.lifeline.n_recoveries == 1
    assert night.n_opened == 2
    times_s = [record.star_mid_exposure_s for record in records]
    assert not [time_s for time_s in times_s if VANISHES_S < time_s < RETURNS_S]
    assert min(time_s for time_s in times_s if time_s > VANISHES_S) < RETURNS_S + max(RETRY_AFTER_S)
    assert seen[-1].source.dropped[DropCause.CAMERA_LOST] >= 5
    assert DropCause.STALE_FRAME not in seen[-1].source.dropped  # its frames count on, though it counts from 1 again
    assert seen[-1].source.trouble == ""


@pytest.mark.parametrize("role", ["star", "reflector"])
def test_a_camera_that_hangs_is_reset_and_the_recording_goes_on(tmp_path: Path, role: str) -> None:
    night = UsbNight(role, hung)
    records, _ = recorded(tmp_path / "RUN", night, StopRule(n_records=40, duration_s=300.0))
    assert sum(record.reject_reason is None for record in records) == 40
    assert night.device.n_resets == 1
    assert night.lifeline.n_recoveries == 1


def test_the_crew_reads_what_is_tried_and_then_what_to_do(tmp_path: Path) -> None:
    night = UsbNight("star", gone_for_good)
    records, seen = recorded(tmp_path / "RUN", night, StopRule(duration_s=VANISHES_S + sum(RETRY_AFTER_S) + 30.0))
    assert len(records) >= 5
    assert all(len(record.facet_intensity) == len(FACETS) for record in records)
    said = [progress.trouble for progress in seen if progress.trouble]
    assert any("has been removed" in text and "attempt" in text for text in said)
    assert "given up" in said[-1]
    assert f"opened {len(RETRY_AFTER_S)} times" in said[-1]
    assert "no such camera on the USB" in said[-1]
    assert "cable and power" in seen[-1].warning

"""GenICam cameras: the contract of all cameras, what reaches the device, and the camera of another maker.

The cameras are Aravis' fake GigE Vision camera, a program of its own, and the fake of the viva-genicam project, which
shares no code with Aravis. All on loopback.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from camera_contract import CameraContract, CameraRig
from gige_rig import CABLE_IP, CAMERA_IP, COLUMNS, ROWS, SERIAL_NUMBER, Bench, bench, gige_port, register, why_not

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.cameras import genicam_library
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.genicam_camera import GenicamCamera, list_cameras, without_padding
from namod_ctl.devices.cameras.settings import CameraSettings

needs_camera = pytest.mark.skipif(bool(why_not()), reason=why_not())

# Registers of Aravis' fake, from its arvfakecamera.h
WIDTH, HEIGHT, BINNING_X, BINNING_Y, GAIN, PIXEL_FORMAT = 0x100, 0x104, 0x108, 0x10C, 0x110, 0x128
OFFSET_X, OFFSET_Y, EXPOSURE_US, TRIGGER_MODE, TRIGGER_SOURCE, GAIN_AUTO = 0x130, 0x134, 0x120, 0x300, 0x304, 0x114
OFF, CONTINUOUS = 1, 2  # of GAIN_AUTO: GenICam description of the fake
PFNC = {"Mono8": 0x01080001, "Mono16": 0x01100007, "RGB8": 0x02180014, "BayerRG8": 0x01080009}
"""EMVA, Pixel Format Naming Convention 2.4, list of 32-bit values."""


@needs_camera
class TestGenicamCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> Iterator[CameraRig]:
        with bench() as there:
            rig = there.rig()
            yield rig
            rig.camera.close()


@pytest.fixture
def there() -> Iterator[Bench]:
    with bench() as it:
        yield it


@needs_camera
@pytest.mark.parametrize(
    ("full_scale_adu", "pixel_format", "chosen", "shape", "dtype"),
    [
        (255.0, None, "Mono8", (48, 64), np.uint8),
        (65535.0, None, "Mono16", (48, 64), np.uint16),
        (255.0, "RGB8", "RGB8", (48, 64, 3), np.uint8),
        (255.0, "BayerRG8", "BayerRG8", (48, 64, 3), np.uint8),
    ],
)
def test_settings_reach_the_device(
    there: Bench, full_scale_adu: float, pixel_format: str | None, chosen: str, shape: tuple[int, ...], dtype: type
) -> None:
    there.cable.write_register(GAIN_AUTO, CONTINUOUS)
    assert register(GAIN_AUTO) == CONTINUOUS
    camera = there.open(
        columns=64,
        rows=48,
        offset_px=(16, 8),
        binning=2,
        gain=3.0,
        full_scale_adu=full_scale_adu,
        pixel_format=pixel_format,
    )
    camera.start(0.0123)
    exposure = camera.fetch(2.0)
    assert exposure.image.shape == shape
    assert exposure.image.dtype == dtype
    present = [register(a) for a in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, BINNING_X, BINNING_Y, GAIN, EXPOSURE_US)]
    assert present == [64, 48, 16, 8, 2, 2, 3, 12300]
    assert register(PIXEL_FORMAT) == PFNC[chosen]
    assert [register(TRIGGER_MODE), register(TRIGGER_SOURCE)] == [1, 1]  # on, by software
    assert register(GAIN_AUTO) == OFF
    camera.close()


@needs_camera
def test_a_region_is_centred_unless_something_else_is_asked_for(there: Bench) -> None:
    there.open().close()
    sensor_columns, sensor_rows = 2048, 2048  # as its SensorWidth and SensorHeight say
    assert register(OFFSET_X) == (sensor_columns - COLUMNS) // 2
    assert register(OFFSET_Y) == (sensor_rows - ROWS) // 2


@needs_camera
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"columns": 5000}, r"columns = 5000: its Width goes from 1 to 2048"),
        ({"rows": 0}, "rows = 0: its Height goes from 1 to 2048"),
        ({"binning": 32}, "binning = 32: its BinningHorizontal goes from 1 to 16"),
        ({"gain": 99.0}, "gain = 99: it goes from 0 to 10"),
        ({"offset_px": (-1, 0)}, "offset_px = -1: its OffsetX goes from 0 to 1728"),
        ({"offset_px": (0, 1809)}, "offset_px = 1809: its OffsetY goes from 0 to 1808"),
        ({"pixel_format": "Mono12", "full_scale_adu": 4095.0}, r'no pixel_format = "Mono12": it offers .*Mono8'),
        ({"pixel_format": "Mono16"}, 'pixel_format = "Mono16" goes to 65535, but full_scale_adu = 255'),
        ({"full_scale_adu": 1023.0}, r"no pixel format of 10 bit.*the camera offers .*Mono8"),
    ],
)
def test_what_the_camera_cannot_do_is_refused(there: Bench, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        there.open(**changes)
    assert SERIAL_NUMBER in str(caught.value)
    there.open().close()  # it was let go of


@needs_camera
def test_cameras_are_found_and_opened_by_serial_number(there: Bench) -> None:
    assert FoundCamera("genicam", "Aravis", "Fake", SERIAL_NUMBER, CAMERA_IP) in list_cameras()
    camera = there.open(address=None, serial_number=SERIAL_NUMBER)
    assert camera.name == f"star camera Aravis Fake, serial number {SERIAL_NUMBER}"
    camera.close()
    for changes in ({"address": None, "serial_number": "X1"}, {"address": "127.0.0.9"}):
        with pytest.raises(DeviceFaultError, match=rf"(X1|127\.0\.0\.9).* found: .*{SERIAL_NUMBER}, at {CAMERA_IP}"):
            there.open(**changes)
    with pytest.raises(DeviceFaultError, match=f"X1 at {CABLE_IP} is not there: at that address is .*{SERIAL_NUMBER}"):
        there.open(serial_number="X1")


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def not_there(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", not_there)
    genicam_library.library.cache_clear()
    try:
        with pytest.raises(ConfigError, match=r"apt install libaravis-0\.8-0"):
            list_cameras()
        with pytest.raises(ConfigError, match=r"apt install libaravis-0\.8-0"):
            GenicamCamera(CameraSettings("star", "genicam", 64, 48, 255.0, address=CAMERA_IP), SystemMonotonicClock())
    finally:
        genicam_library.library.cache_clear()


def test_bytes_that_end_a_row_are_no_pixels() -> None:
    rows = np.array([[1, 2, 3, 0, 0], [4, 5, 6, 0, 0]], dtype=np.uint8)
    chunk_data = np.array([9], dtype=np.uint8)
    data = np.concatenate([rows.reshape(-1), chunk_data])
    assert without_padding(data, rows=2, row_padding=2).reshape(-1).tolist() == [1, 2, 3, 4, 5, 6]
    assert without_padding(data, rows=2, row_padding=0) is data


@needs_camera
class TestCameraOfAnotherMaker:
    """The fake of viva-genicam: other feature names, packets that can be asked for again, control that can be lost."""

    @pytest.fixture
    def made(self) -> Iterator[Any]:
        testing = pytest.importorskip("viva_genicam.testing", reason="pip install viva-genicam")
        running = []

        def make(ip: str = CAMERA_IP, **how: Any) -> Any:
            fake = testing.FakeGigeCamera(width=COLUMNS, height=ROWS, fps=50, bind_ip=ip, **how)
            fake.start()
            running.append(fake)
            return fake

        with gige_port():
            yield make
            for fake in running:
                fake.stop()

    @staticmethod
    def opened(ip: str = CAMERA_IP, full_scale_adu: float = 255.0) -> GenicamCamera:
        settings = CameraSettings("star", "genicam", COLUMNS, ROWS, full_scale_adu, address=ip)
        return GenicamCamera(settings, SystemMonotonicClock())

    @pytest.mark.parametrize(
        ("pixel_format", "full_scale_adu", "dtype"), [("Mono8", 255.0, np.uint8), ("Mono16", 65535.0, np.uint16)]
    )
    def test_it_exposes_by_software_trigger(
        self, made: Any, pixel_format: str, full_scale_adu: float, dtype: type
    ) -> None:
        fake = made(pixel_format=pixel_format)
        camera = self.opened(full_scale_adu=full_scale_adu)
        for number in (1, 2, 3):
            camera.start(0.01 * number)
            exposure = camera.fetch(2.0)
            assert exposure.exposure_s == pytest.approx(0.01 * number)
            assert exposure.frame_id == number
            assert exposure.image.shape == (ROWS, COLUMNS)
            assert exposure.image.dtype == dtype
        assert fake.software_triggers() == fake.blocks_sent() == 3
        camera.close()
        assert fake.controller() is None

    def test_packets_that_get_lost_are_asked_for_again(self, made: Any) -> None:
        images = []
        for dropped in (None, [(1, 5), (1, 17)]):
            fake = made(drop_packets=dropped)
            camera = self.opened()
            camera.start(0.01)
            images.append(camera.fetch(2.0).image)
            camera.close()
            fake.stop()
        assert np.array_equal(*images)  # the first frame of this fake always shows the same
        assert images[0].any()

    def test_packets_that_cannot_be_had_again_are_told(self, made: Any) -> None:
        made(drop_packets=[(1, 5)], packet_resend=False)
        camera = self.opened()
        camera.start(0.01)
        with pytest.raises(CommunicationError, match="incomplete"):
            camera.fetch(2.0)
        camera.close()

    def test_control_that_is_taken_away_is_told(self, made: Any) -> None:
        fake = made()
        camera = self.opened()
        fake.revoke_control()
        deadline_s = time.monotonic() + 5.0
        with pytest.raises(DeviceFaultError, match="is lost"):  # noqa: PT012 - one of the next exposures says so
            while time.monotonic() < deadline_s:
                camera.start(0.01)
                camera.fetch(2.0)
        camera.close()

    def test_two_cameras_expose_at_once(self, made: Any) -> None:
        made(CAMERA_IP), made(CABLE_IP)
        cameras = [self.opened(CAMERA_IP), self.opened(CABLE_IP)]
        for _ in range(5):
            for camera in cameras:
                camera.start(0.02)
            middles_s = [camera.fetch(2.0).mid_exposure_s for camera in cameras]
            assert abs(middles_s[0] - middles_s[1]) < 0.02
        for camera in cameras:
            camera.close()

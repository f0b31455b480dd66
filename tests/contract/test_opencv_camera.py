"""The driver of V4L2 cameras against a webcam made here, as computers that run tests have none, and the kernel's own
virtual one needs a module; and against OpenCV's real `VideoCapture`, as far as it goes without a camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_contract import CameraContract, CameraRig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.devices.cameras import opencv_camera
from namod_ctl.devices.cameras.opencv_camera import OpencvCamera, list_cameras
from namod_ctl.devices.cameras.settings import CameraSettings

CLOCK = SystemMonotonicClock()
COLUMNS, ROWS = 64, 48
SETTINGS = CameraSettings("star", "opencv", COLUMNS, ROWS, 255.0, address="/dev/video0")
FOURCC = {name: cv2.VideoWriter.fourcc(*name) for name in ("MJPG", "YUYV", "GREY", "Y12 ")}


class Webcam:
    """What `cv2.VideoCapture` on a UVC camera does: one frame after the other, each transferred while the next one is
    exposed; settings that are brought to their limits; an exposure that takes effect after the frame that is next.

    Every frame shows in its pixels its number; `begun_s` and `exposed_s` tell the truth about it.
    """

    def __init__(self, formats: tuple[str, ...] = ("YUYV", "MJPG"), stuck: dict[int, float] | None = None) -> None:
        self.begun_s: list[float] = []
        self.exposed_s: list[float] = []
        self.n_to_lose = 0
        self.is_gone = threading.Event()
        self.is_open = True
        self.grabbing: set[int] = set()
        self._formats, self._stuck = formats, stuck or {}
        self._values = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FOURCC: float(FOURCC["MJPG"]),
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_EXPOSURE: 156.0,
            cv2.CAP_PROP_GAIN: 64.0,
            cv2.CAP_PROP_CONVERT_RGB: 1.0,
        }
        self._pending_width = 0.0
        self._next_units = 156.0
        now_s = CLOCK.monotonic_s()
        self._transferred = self._exposed = (now_s, 0.0)

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self.is_open

    def get(self, number: int) -> float:
        return self._stuck.get(number, self._values.get(number, -1.0))

    def set(self, number: int, value: float) -> bool:
        if number in self._stuck or number not in self._values:
            return False
        if number == cv2.CAP_PROP_FRAME_WIDTH:
            self._pending_width = value
            return True
        if number == cv2.CAP_PROP_FRAME_HEIGHT:
            self._values[cv2.CAP_PROP_FRAME_WIDTH] = min(self._pending_width, 1280.0)
            value = min(value, 720.0)
        if number == cv2.CAP_PROP_FOURCC and value not in [FOURCC[name] for name in self._formats]:
            return False
        if number == cv2.CAP_PROP_EXPOSURE:
            value = float(np.clip(value, 3.0, 5000.0))
        if number == cv2.CAP_PROP_GAIN:
            value = float(np.clip(value, 16.0, 255.0))
        self._values[number] = value
        return True

    def grab(self) -> bool:
        self.grabbing.add(threading.get_ident())
        if self.is_gone.is_set():
            return False
        begun_s, duration_s = self._exposed
        left_s = begun_s + duration_s - CLOCK.monotonic_s()
        if left_s > 0.0:
            self.is_gone.wait(left_s)
        self.begun_s.append(self._transferred[0])
        self.exposed_s.append(self._transferred[1])
        self._transferred, self._exposed = self._exposed, (CLOCK.monotonic_s(), self._next_units * 1e-4)
        self._next_units = self.get(cv2.CAP_PROP_EXPOSURE)
        return not self.is_gone.is_set()

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        if self.n_to_lose:
            self.n_to_lose -= 1
            return False, None
        is_colour = self._values[cv2.CAP_PROP_CONVERT_RGB] > 0.0
        is_deep = self._values[cv2.CAP_PROP_FOURCC] == FOURCC["Y12 "]
        shape = (int(self.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(self.get(cv2.CAP_PROP_FRAME_WIDTH)))
        number = len(self.begun_s) - 1
        image = np.full(shape + ((3,) if is_colour else ()), number % 200, dtype=np.uint16 if is_deep else np.uint8)
        return True, image

    def release(self) -> None:
        self.is_open = False


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's list of video devices, with one camera (two nodes)."""
    folder = tmp_path / "video4linux"
    add_node(folder, 0, "C920 HD Pro Webcam", "A1B2")
    add_node(folder, 1, "C920 HD Pro Webcam", "A1B2", index=1)
    monkeypatch.setattr(opencv_camera, "VIDEO_DEVICES", folder)
    return folder


def add_node(folder: Path, number: int, model: str, serial_number: str, index: int = 0) -> None:
    """As the kernel does: the node's `device` is the USB interface, whose parent is the USB device."""
    usb = folder.parent / f"usb_{serial_number}"
    (usb / "1-4:1.0").mkdir(parents=True, exist_ok=True)
    (usb / "serial").write_text(f"{serial_number}\n")
    (usb / "manufacturer").write_text("Logitech\n")
    (folder / f"video{number}").mkdir(parents=True)
    (folder / f"video{number}" / "name").write_text(f"{model}\n")
    (folder / f"video{number}" / "index").write_text(f"{index}\n")
    (folder / f"video{number}" / "device").symlink_to(usb / "1-4:1.0")


def plug(monkeypatch: pytest.MonkeyPatch, *webcams: Webcam) -> None:
    """From now on OpenCV opens these, one after the other."""
    waiting = list(webcams)
    opened = []

    def open_capture(address: str, backend: int) -> Webcam:
        assert backend == cv2.CAP_V4L2
        opened.append(address)
        return waiting.pop(0)

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)


@pytest.mark.parametrize("kind", ["colour", "12 bit"])
class TestOpencvCamera(CameraContract):
    @pytest.fixture
    def rig(self, kind: str, node: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[CameraRig]:
        formats = ("YUYV",) if kind == "colour" else ("Y12 ",)
        webcams = [Webcam(formats) for _ in range(2)]
        plug(monkeypatch, *webcams)
        settings = SETTINGS if kind == "colour" else replace(SETTINGS, full_scale_adu=4095.0)

        def reopen() -> OpencvCamera:
            return OpencvCamera(settings, CLOCK)

        rig = CameraRig(
            camera=reopen(),
            clock=CLOCK,
            columns=COLUMNS,
            rows=ROWS,
            is_colour=kind == "colour",
            full_scale_adu=settings.full_scale_adu,
            short_s=0.01,
            other_s=0.03,
            long_s=0.4,
            quantum_s=1e-4,
            timeout_s=2.0,
            mid_error_s=0.5,  # it cannot be triggered: some frames go by until one counts
            reopen=reopen,
            lose_next_frame=lambda: setattr(webcams[0], "n_to_lose", 1),
            take_away=webcams[0].is_gone.set,
        )
        yield rig
        rig.camera.close()
        assert not webcams[0].is_open


def test_a_frame_was_begun_after_the_start_with_the_exposure_asked_for(
    node: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    webcam = Webcam()
    plug(monkeypatch, webcam)
    camera = OpencvCamera(SETTINGS, CLOCK)
    for exposure_s in (0.01, 0.01, 0.03, 0.03, 0.005, 0.02):
        CLOCK.wait_s(0.037)  # frames go by meanwhile
        started_s = CLOCK.monotonic_s()
        camera.start(exposure_s)
        exposure = camera.fetch(2.0)
        number = int(exposure.image[0, 0, 0])
        assert webcam.begun_s[number] >= started_s
        assert webcam.exposed_s[number] == pytest.approx(exposure_s, abs=1e-9)
        assert exposure.exposure_s == pytest.approx(exposure_s, abs=1e-9)
        assert exposure.mid_exposure_s == pytest.approx(
            webcam.begun_s[number] + exposure_s / 2.0,
            abs=exposure_s + 0.02,  # the transfer takes as long
        )
    camera.close()
    assert len(webcam.grabbing) == 1  # OpenCV's object is not for two threads


def test_a_closed_camera_takes_no_more_frames(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    webcam = Webcam()
    plug(monkeypatch, webcam)
    camera = OpencvCamera(SETTINGS, CLOCK)
    camera.close()
    n_frames = len(webcam.begun_s)
    CLOCK.wait_s(0.1)
    assert len(webcam.begun_s) == n_frames


def test_the_range_is_what_the_camera_says_and_the_config_allows(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plug(monkeypatch, Webcam(), Webcam(), Webcam())
    camera = OpencvCamera(SETTINGS, CLOCK)
    assert camera.exposure_range_s == pytest.approx((3e-4, 0.5))
    camera.close()
    camera = OpencvCamera(replace(SETTINGS, exposure_range_s=(1e-3, 3.0)), CLOCK)
    assert camera.exposure_range_s == pytest.approx((1e-3, 0.5))
    camera.close()
    with pytest.raises(
        ConfigError, match=r"exposure_range_s = \[1\.0, 3\.0\] is beyond what it makes, 0\.0003 to 0\.5"
    ):
        OpencvCamera(replace(SETTINGS, exposure_range_s=(1.0, 3.0)), CLOCK)


@pytest.mark.parametrize(
    ("stuck", "changes", "says"),
    [
        ({cv2.CAP_PROP_EXPOSURE: 156.0}, {}, r"ignores its exposure.*0\.0156 and 0\.0156"),
        ({cv2.CAP_PROP_EXPOSURE: -1.0}, {}, r"ignores its exposure"),
        ({cv2.CAP_PROP_AUTO_EXPOSURE: 3.0}, {}, r"exposure by hand = 1 was asked for, it stays at 3"),
        ({cv2.CAP_PROP_AUTO_WB: 1.0}, {}, r"automatic white balance cannot be turned off"),
        ({}, {"gain": 400.0}, r"gain = 400 was asked for, it stays at 255"),
        ({}, {"columns": 2560}, r"columns = 2560 was asked for, it stays at 1280"),
        ({}, {"rows": 1920}, r"rows = 1920 was asked for, it stays at 720"),
        ({}, {"full_scale_adu": 1023.0}, r"pixel format Y10  was asked for, it stays at MJPG"),
        ({}, {"full_scale_adu": 200.0}, r"pixel format of 200 ADU"),
        ({}, {"pixel_format": "GREY"}, r"pixel format GREY was asked for, it stays at MJPG"),
        ({}, {"pixel_format": "H264"}, r"\"H264\" is not known; known are GREY"),
        ({}, {"pixel_format": "YUYV", "full_scale_adu": 1023.0}, r"\"YUYV\" ends at 255"),
    ],
)
def test_a_setting_that_the_camera_ignores_is_refused(
    stuck: dict[int, float],
    changes: dict[str, object],
    says: str,
    node: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    webcam = Webcam(stuck=stuck)
    plug(monkeypatch, webcam)
    with pytest.raises(ConfigError, match=says):
        OpencvCamera(replace(SETTINGS, **changes), CLOCK)
    assert not webcam.is_open


def test_automatics_are_off_and_the_gain_is_the_lowest_or_the_one_asked_for(
    node: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for gain, expected in ((None, 16.0), (100.0, 100.0)):
        webcam = Webcam()
        plug(monkeypatch, webcam)
        OpencvCamera(replace(SETTINGS, gain=gain), CLOCK).close()
        assert webcam.get(cv2.CAP_PROP_GAIN) == expected
        assert webcam.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 1.0
        assert webcam.get(cv2.CAP_PROP_AUTO_WB) == 0.0


def test_grey_is_taken_where_there_is_grey(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plug(monkeypatch, Webcam(("MJPG", "YUYV", "GREY")))
    camera = OpencvCamera(SETTINGS, CLOCK)
    camera.start(0.01)
    assert camera.fetch(2.0).image.shape == (ROWS, COLUMNS)
    camera.close()


def test_a_lost_camera_fails_soon(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    webcam = Webcam()
    plug(monkeypatch, webcam)
    camera = OpencvCamera(SETTINGS, CLOCK)
    camera.start(0.2)
    webcam.is_gone.set()
    began_s = time.monotonic()
    with pytest.raises(DeviceFaultError, match="check its cable"):
        camera.fetch(30.0)
    assert time.monotonic() - began_s < 5.0
    camera.close()


def test_a_frame_of_another_size_is_told(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    webcam = Webcam()
    plug(monkeypatch, webcam)
    camera = OpencvCamera(SETTINGS, CLOCK)
    webcam.set(cv2.CAP_PROP_FRAME_WIDTH, 32)
    webcam.set(cv2.CAP_PROP_FRAME_HEIGHT, 24)
    camera.start(0.01)
    with pytest.raises(CommunicationError, match=r"\(24, 32, 3\), uint8, came; \(48, 64, 3\)"):
        camera.fetch(2.0)
    camera.close()


def test_cameras_are_found_once_each_and_by_number_path_or_serial_number(
    node: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [(found.vendor, found.model, found.serial_number, found.address) for found in list_cameras()] == [
        ("Logitech", "C920 HD Pro Webcam", "A1B2", "/dev/video0")
    ]
    add_node(node, 2, "C270", "77")
    for changes in ({"address": "2"}, {"address": "/dev/video2"}, {"address": None, "serial_number": "77"}):
        plug(monkeypatch, Webcam())
        camera = OpencvCamera(replace(SETTINGS, **changes), CLOCK)
        assert camera.name == "star camera (C270, serial number 77, /dev/video2)"
        camera.close()
    for changes, says in (
        ({"address": None}, "more than one fits"),
        ({"address": "5"}, "there is no such camera.*/dev/video5.*C920.*C270"),
        ({"serial_number": "77"}, "there is no such camera.*serial number 77, /dev/video0"),
    ):
        with pytest.raises(DeviceFaultError, match=says):
            OpencvCamera(replace(SETTINGS, **changes), CLOCK)


def test_a_computer_without_cameras_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opencv_camera, "VIDEO_DEVICES", tmp_path / "video4linux")
    assert list_cameras() == []
    with pytest.raises(DeviceFaultError, match="found: no camera"):
        OpencvCamera(replace(SETTINGS, address=None), CLOCK)


def test_the_real_opencv_says_when_there_is_nothing_at_the_path(node: Path, tmp_path: Path) -> None:
    add_node(node, 97, "a webcam that is gone", "97")
    with pytest.raises(DeviceFaultError, match=r"video97.*cannot be opened"):
        OpencvCamera(replace(SETTINGS, address="/dev/video97"), CLOCK)


def test_a_real_video_file_has_no_exposure_and_is_refused(
    node: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV's own object, on a file: `set` and `get` are the real ones, and nothing that is set is taken."""
    path = tmp_path / "sky.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (COLUMNS, ROWS))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video files")
    for number in range(5):
        writer.write(np.full((ROWS, COLUMNS, 3), 40 * number, dtype=np.uint8))
    writer.release()
    capture = cv2.VideoCapture(str(path))
    assert capture.isOpened()
    plug(monkeypatch, capture)
    with pytest.raises(ConfigError, match="was asked for, it stays at"):
        OpencvCamera(replace(SETTINGS, pixel_format="MJPG"), CLOCK)
    assert not capture.isOpened()

"""Webcams and other cameras of Linux' video system (V4L2), through OpenCV: for the desk, where no maker's library is.

Such a camera cannot be triggered: it takes one frame after the other. A thread takes them all, so that none waits in a
buffer to be taken for a new one, and after a `start` those are left out whose exposure may have begun before.
The time of an exposure is known from the moment its frame arrived: it is late by what the transfer takes, some ms.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.core.units import s_to_us, us_to_s
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

VIDEO_DEVICES = Path("/sys/class/video4linux")

EXPOSURE_UNIT_US = 100.0  # V4L2_CID_EXPOSURE_ABSOLUTE
_MANUAL_EXPOSURE = 1.0  # V4L2_EXPOSURE_MANUAL
_BELOW_ALL_EXPOSURES, _ABOVE_ALL_EXPOSURES = 1.0, 100_000.0  # units; V4L2 brings what is beyond to its limit

GREY_FORMATS = {"GREY": 255.0, "Y10 ": 1023.0, "Y12 ": 4095.0, "Y16 ": 65535.0}
COLOUR_FORMATS = ("YUYV", "UYVY", "MJPG", "BGR3", "RGB3")
"""FourCC of V4L2; colour comes with 8 bit, converted by OpenCV."""

N_STALE = 2
"""Frames after a start that may have begun before it: one in the buffer, one being exposed."""
N_STALE_AFTER_CHANGE = 4
"""The same after a new exposure was set: what is exposed meanwhile still has the old one, as UVC cameras do."""

N_FAILURES_OF_LOST = 3
RETRY_S = 0.05
JOIN_S = 0.4
"""A camera that hangs is left behind by `close` after this time; its thread lets go of it when it returns."""


@dataclass(slots=True, eq=False)
class _Order:
    """An exposure that is wanted, and what came of it."""

    number: int
    units: int
    start_s: float
    exposure_s: float = 0.0
    arrived_s: float = 0.0
    image: NDArray[Any] | None = None
    problem: str = ""
    done: threading.Event = field(default_factory=threading.Event)


class OpencvCamera:
    """A V4L2 camera: `settings.address` is its path or number, else `serial_number`, else it is the only one.

    Raises
    ------
    ConfigError
        A setting that the camera or OpenCV does not take, with what it says instead.
    DeviceFaultError
        There is no such camera; the text lists those that are there.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._settings, self._clock = settings, clock
        address, self._name = _choose(settings)
        self._capture = cv2.VideoCapture(address, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise DeviceFaultError(
                f"{self._name}: cannot be opened; another program may use it, or you may not: add yourself to the "
                f"group video; found: {_in_words(list_cameras())}"
            )
        try:
            self._configure()
            self._range_s = self._find_exposure_range_s()
        except BaseException:
            self._capture.release()
            raise
        self._units = 0
        self._n_starts = 0
        self._order: _Order | None = None
        self._is_closed = threading.Event()
        self._fault = ""
        self._lock = threading.Lock()
        self._reader = threading.Thread(target=self._read, name=f"{settings.role}_webcam", daemon=True)
        self._reader.start()

    @property
    def name(self) -> str:
        """Role, model, serial number and path."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """What the camera takes, and within that what the config says."""
        return self._range_s

    def start(self, exposure_s: float) -> None:
        """Let the frames count that begin from now on. Raises LimitError, DeviceFaultError."""
        self._refuse_when_gone()
        refuse_outside(self._name, exposure_s, self._range_s)
        with self._lock:
            self._give_up("the exposure was given up")
            self._n_starts += 1
            units = max(round(s_to_us(exposure_s) / EXPOSURE_UNIT_US), 1)
            self._order = _Order(self._n_starts, units, self._clock.monotonic_s())

    def fetch(self, timeout_s: float) -> Exposure:
        """The first frame that was begun after the start. Raises CommunicationError, DeviceFaultError."""
        self._refuse_when_gone()
        order = self._order
        if order is None:
            raise CommunicationError(f"{self._name}: no exposure was begun; start one before fetching it")
        asked_s = us_to_s(order.units * EXPOSURE_UNIT_US)
        left_s = order.start_s + asked_s + timeout_s - self._clock.monotonic_s()
        is_done = order.done.wait(max(left_s, 0.0))
        with self._lock:
            if self._order is order:
                self._order = None
        if self._fault and not self._is_closed.is_set():
            raise DeviceFaultError(self._fault)
        if not is_done:
            raise CommunicationError(f"{self._name}: no frame within {timeout_s:g} s of the exposure's end; try again")
        if order.image is None:
            raise CommunicationError(f"{self._name}: {order.problem}; try again")
        self._check_image(order.image)
        return Exposure(order.image, order.exposure_s, order.arrived_s - order.exposure_s / 2.0, order.number)

    def close(self) -> None:
        """End the thread and let go of the camera."""
        self._is_closed.set()
        with self._lock:
            self._give_up("the camera was closed")
        self._reader.join(JOIN_S)

    def _refuse_when_gone(self) -> None:
        if self._is_closed.is_set():
            raise DeviceFaultError(f"{self._name}: is closed")
        if self._fault:
            raise DeviceFaultError(self._fault)

    def _give_up(self, why: str) -> None:
        if self._order is not None:
            self._order.problem = why
            self._order.done.set()
            self._order = None

    def _read(self) -> None:
        """Take every frame, and keep those that are wanted. All that is done with the open camera is done here."""
        served: _Order | None = None
        n_stale = n_failures = 0
        while not self._is_closed.is_set():
            order = self._order
            if order is not None and order is not served:
                served, n_stale = order, self._set_exposure(order)
            if not self._capture.grab():
                n_failures += 1
                if n_failures == N_FAILURES_OF_LOST:
                    self._fault = f"{self._name}: delivers nothing any more; check its cable and power"
                    with self._lock:
                        self._give_up(self._fault)
                    break
                self._is_closed.wait(RETRY_S)
                continue
            n_failures = 0
            if order is None or order.done.is_set():
                continue
            if n_stale:
                n_stale -= 1
                continue
            order.arrived_s = self._clock.monotonic_s()
            is_whole, image = self._capture.retrieve()
            order.image = image if is_whole else None
            order.problem = "the frame arrived incomplete"
            order.done.set()
        self._capture.release()

    def _set_exposure(self, order: _Order) -> int:
        """Set and read back the exposure; how many frames from now on are none of this order."""
        is_change = order.units != self._units
        if is_change:
            self._capture.set(cv2.CAP_PROP_EXPOSURE, order.units)
            self._units = order.units
        order.exposure_s = us_to_s(self._capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_US)
        return N_STALE_AFTER_CHANGE if is_change else N_STALE

    def _configure(self) -> None:
        settings = self._settings
        self._set_pixel_format()
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.columns)  # OpenCV waits for the rows, to set both
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.rows)
        self._expect("columns", cv2.CAP_PROP_FRAME_WIDTH, settings.columns)
        self._expect("rows", cv2.CAP_PROP_FRAME_HEIGHT, settings.rows)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # one frame can be stale, not four
        self._set("exposure by hand", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        for what, automatic in (
            ("automatic white balance", cv2.CAP_PROP_AUTO_WB),
            ("autofocus", cv2.CAP_PROP_AUTOFOCUS),
        ):
            self._capture.set(automatic, 0.0)
            if self._capture.get(automatic) > 0.0:  # -1: it has none
                raise ConfigError(f"{self._name}: {what} cannot be turned off; use another camera")
        if settings.gain is None:
            self._capture.set(cv2.CAP_PROP_GAIN, 0.0)  # brought to the lowest that there is
        else:
            self._set("gain", cv2.CAP_PROP_GAIN, settings.gain)

    def _set_pixel_format(self) -> None:
        settings = self._settings
        if settings.pixel_format is not None:
            wanted = [f"{settings.pixel_format:4}"]
            full_scale_adu = 255.0 if wanted[0] in COLOUR_FORMATS else GREY_FORMATS.get(wanted[0])
            if full_scale_adu is None:
                raise ConfigError(
                    f'{self._name}: pixel_format = "{settings.pixel_format}" is not known; known are '
                    f"{', '.join((*GREY_FORMATS, *COLOUR_FORMATS))}"
                )
            if settings.full_scale_adu > full_scale_adu:
                raise ConfigError(
                    f'{self._name}: pixel_format = "{settings.pixel_format}" ends at {full_scale_adu:g}, but '
                    f"full_scale_adu = {settings.full_scale_adu:g}; correct one of them"
                )
        else:
            wanted = [name for name, top_adu in GREY_FORMATS.items() if settings.full_scale_adu == top_adu]
            wanted += COLOUR_FORMATS if settings.full_scale_adu == GREY_FORMATS["GREY"] else ()
        got = ""
        for name in wanted:
            self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*name))
            got = _fourcc_text(self._capture.get(cv2.CAP_PROP_FOURCC))
            if got == name:
                self._is_colour = name in COLOUR_FORMATS
                self._set("conversion to colour", cv2.CAP_PROP_CONVERT_RGB, float(self._is_colour))
                return
        raise ConfigError(
            f"{self._name}: pixel format {' or '.join(wanted) or f'of {settings.full_scale_adu:g} ADU'} was asked for, "
            f"it stays at {got or 'its own'}; choose pixel_format or full_scale_adu by what the camera has"
        )

    def _set(self, what: str, number: int, value: float) -> None:
        self._capture.set(number, value)
        self._expect(what, number, value)

    def _expect(self, what: str, number: int, value: float) -> None:
        present = self._capture.get(number)
        if present != value:
            raise ConfigError(
                f"{self._name}: {what} = {value:g} was asked for, it stays at {present:g}; correct the config, or use "
                "another camera"
            )

    def _find_exposure_range_s(self) -> tuple[float, float]:
        """From the camera, by asking for too much and for too little; it stays at the shortest one."""
        found = []
        for units in (_ABOVE_ALL_EXPOSURES, _BELOW_ALL_EXPOSURES):
            self._capture.set(cv2.CAP_PROP_EXPOSURE, units)
            found.append(us_to_s(self._capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_US))
        longest_s, shortest_s = found
        if not 0.0 < shortest_s < longest_s:
            raise ConfigError(
                f"{self._name}: ignores its exposure: asked for less and for more, it stays at {shortest_s:g} and "
                f"{longest_s:g} s; it cannot be used"
            )
        wish_s = self._settings.exposure_range_s or (shortest_s, longest_s)
        if wish_s[1] < shortest_s or wish_s[0] > longest_s:
            raise ConfigError(
                f"{self._name}: exposure_range_s = {list(wish_s)} is beyond what it makes, {shortest_s:g} to "
                f"{longest_s:g} s"
            )
        return max(shortest_s, wish_s[0]), min(longest_s, wish_s[1])

    def _check_image(self, image: NDArray[Any]) -> None:
        shape = (self._settings.rows, self._settings.columns) + ((3,) if self._is_colour else ())
        kind = np.uint8 if self._settings.full_scale_adu <= 255.0 else np.uint16
        if image.shape != shape or image.dtype != kind:
            raise CommunicationError(
                f"{self._name}: a frame of shape {image.shape}, {image.dtype}, came; {shape} was set; try again"
            )


def list_cameras() -> list[FoundCamera]:
    """The V4L2 cameras of this computer, in the order of their paths; [] where there is no V4L2."""
    found = []
    for node in sorted(VIDEO_DEVICES.glob("video*"), key=lambda path: (len(path.name), path.name)):
        if _text(node / "index") not in ("", "0"):
            continue  # the same camera's second node, with data about frames
        usb = (node / "device").resolve().parent
        vendor, serial_number = _text(usb / "manufacturer"), _text(usb / "serial")
        found.append(FoundCamera("opencv", vendor, _text(node / "name"), serial_number, f"/dev/{node.name}"))
    return found


def _choose(settings: CameraSettings) -> tuple[str, str]:
    """Path and name of the camera that the settings mean."""
    cameras = list_cameras()
    address = settings.address
    if address is not None and address.isdecimal():
        address = f"/dev/video{address}"
    if address is not None:
        real = str(Path(address).resolve())  # /dev/v4l/by-id/... stays the same when cameras are plugged in elsewhere
        fitting = [camera for camera in cameras if camera.address in (address, real)]
    else:
        fitting = cameras
    if settings.serial_number is not None:
        fitting = [camera for camera in fitting if camera.serial_number == settings.serial_number]
    if len(fitting) != 1:
        wanted = f"serial number {settings.serial_number}" if settings.serial_number else ""
        wanted = ", ".join(part for part in (wanted, address) if part) or "nothing"
        problem = "more than one fits" if fitting else "there is no such camera"
        raise DeviceFaultError(
            f"{settings.role} camera (opencv): {problem}: the config names {wanted}; found: {_in_words(cameras)}"
        )
    camera = fitting[0]
    number = f", serial number {camera.serial_number}" if camera.serial_number else ""
    return camera.address, f"{settings.role} camera ({camera.model or 'webcam'}{number}, {camera.address})"


def _in_words(cameras: list[FoundCamera]) -> str:
    return "; ".join(map(str, cameras)) or "no camera"


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _fourcc_text(code: float) -> str:
    return int(max(code, 0)).to_bytes(4, "little").decode("ascii", errors="replace").strip("\0")

"""GigE Vision and USB3 Vision cameras of any maker, through the Aravis library, by software trigger.

An exposure's moment is that of the trigger command, known to half the time that its acknowledgement takes (0.1 ms on a
network): what a device's own time stamp marks, start or end of exposure, readout or transmission, differs by maker.
Packets that get lost are asked for again by the library, and its packets become smaller when large ones do not arrive.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import NoReturn

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.genicam_aravis import (
    STATUS_NAMES,
    STATUS_SUCCESS,
    Arrival,
    Bytes,
    Device,
    Stream,
    find_devices,
)
from namod_ctl.devices.cameras.genicam_library import AravisError
from namod_ctl.devices.cameras.genicam_setup import configure
from namod_ctl.devices.cameras.pixel_formats import image_of
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

LOOK_UP_S = 0.1
"""So often whoever waits for a frame looks whether the camera was closed or lost; a frame wakes it at once."""


MOMENT_KNOWN_WITHIN_S = 0.1
"""A trigger is acknowledged in less than a millisecond; one that took longer was lost on its way and sent again."""

LET_GO = "genicam_let_go"
"""Name of threads that let go of a camera. What they still send must not meet it when it is opened again."""

CLOSED_WITHIN_S = 0.3
"""Nobody waits longer for a camera to be let go of: one that answers needs some milliseconds."""

LET_GO_WITHIN_S = 20.0
"""So long the library takes at most where none answers: it sends five commands, and waits 2.5 s for each of them."""


def list_cameras() -> list[FoundCamera]:
    """Every GigE Vision and USB3 Vision camera that answers within a second.

    Raises
    ------
    ConfigError
        The library is missing.
    """
    return [camera for _, camera in find_devices()]


def without_padding(data: Bytes, rows: int, row_padding: int) -> Bytes:
    """A frame's bytes without the `row_padding` bytes that end each of its rows and are no pixels."""
    if not row_padding:
        return data
    return data[: data.size // rows * rows].reshape(rows, -1)[:, :-row_padding]


@dataclass(frozen=True, slots=True)
class _Running:
    """An exposure that was begun: how long it takes, between which moments it began, and its number."""

    exposure_s: float
    earliest_s: float
    latest_s: float
    number: int

    @property
    def middle_s(self) -> float:
        """The middle of the exposure on the clock, as nearly as it is known."""
        return 0.5 * (self.earliest_s + self.latest_s + self.exposure_s)


class GenicamCamera:
    """A GenICam camera behind `core.interfaces.Camera`, open and set up.

    `frame_id` counts exposures begun, so that a lost frame shows as a gap: GigE Vision's own count starts anew with a
    stream, and after 65535 frames. By it the library drops frames that come twice.

    Raises
    ------
    ConfigError
        The library is missing, or the camera does not take a setting.
    DeviceFaultError
        There is no such camera, or it obeys another program.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._settings, self._clock = settings, clock
        self._lock = threading.Lock()
        self._is_closing = threading.Event()
        self._is_let_go = False
        self._fault = ""
        self._running: _Running | None = None
        self._is_clean = False  # nothing can come on the present stream but the frame of the next exposure
        self._has_delivered = False
        self._stream: Stream | None = None
        self._n_begun = 0
        self._asked_s = self._made_s = 0.0
        self._device, self._name = _open(settings)
        try:
            with contextlib.suppress(AravisError):
                self._device.end_acquisition()  # a program that crashed may have left it running, its settings locked
            self._pixel_format = configure(self._device, settings, self._name)
            self._exposure_range_s = self._device.exposure_range_s()
            self._rearm(self._device)
        except AravisError as error:
            self.close()
            raise DeviceFaultError(f"{self._name} cannot be set up: {error}") from error
        except ConfigError:
            self.close()
            raise

    @property
    def name(self) -> str:
        """Role, vendor, model and serial number."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure of the device, s."""
        return self._exposure_range_s

    def start(self, exposure_s: float) -> None:
        """Begin an exposure and return at once; one that runs is given up. See `core.interfaces.Camera`."""
        with self._lock:
            self._check_usable()
            refuse_outside(self._name, exposure_s, self._exposure_range_s)
            try:
                stream = self._stream
                if stream is None or not self._is_clean:
                    stream = self._rearm(self._device)
                if exposure_s != self._asked_s:
                    self._made_s = self._device.set_exposure_s(exposure_s)
                    self._asked_s = exposure_s
                if stream.n_lent == 0:
                    stream.lend()
                before_s = self._clock.monotonic_s()
                self._is_clean = False
                self._device.trigger()
                after_s = self._clock.monotonic_s()
            except AravisError as error:
                self._lose(str(error))
            self._n_begun += 1
            self._running = _Running(self._made_s, before_s, after_s, self._n_begun)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for. See `core.interfaces.Camera`."""
        with self._lock:
            self._check_usable()
            running, stream = self._running, self._stream
            if running is None or stream is None:
                raise CommunicationError(f"{self._name}: no exposure was begun that a frame could come of")
            self._running = None
            arrival = self._wait(stream, running.latest_s + running.exposure_s + timeout_s)
            if arrival is None:
                self._check_answers()
                hint = "" if self._has_delivered else "; none ever has: does a firewall keep its UDP packets away?"
                raise CommunicationError(
                    f"{self._name}: no frame came within {timeout_s:g} s after an exposure of "
                    f"{running.exposure_s:g} s{hint}"
                )
            if arrival.status != STATUS_SUCCESS:
                what = STATUS_NAMES.get(arrival.status, f"state {arrival.status}")
                raise CommunicationError(
                    f"{self._name}: frame {running.number} arrived incomplete ({what}); where this happens often, look "
                    f"at the cables, or let the system buffer a frame: sysctl net.core.rmem_max={stream.frame_size}"
                )
            settings = self._settings
            data = without_padding(arrival.data, settings.rows, arrival.row_padding)
            image = image_of(data, self._pixel_format, settings.columns, settings.rows)
            self._is_clean = self._has_delivered = True
            if running.latest_s - running.earliest_s > MOMENT_KNOWN_WITHIN_S:
                raise CommunicationError(
                    f"{self._name}: the moment of frame {running.number} is not known: its trigger was acknowledged "
                    f"after {running.latest_s - running.earliest_s:.2g} s only; look at the network"
                )
            return Exposure(image, running.exposure_s, running.middle_s, running.number)

    def close(self) -> None:
        """Abort a running exposure and let go of the device. See `core.interfaces.Camera`."""
        self._is_closing.set()  # whoever waits for a frame lets go of the lock
        with self._lock:
            if self._is_let_go:
                return
            self._is_let_go = True
            thread = threading.Thread(target=self._let_go, name=LET_GO, daemon=True)
            thread.start()
            thread.join(CLOSED_WITHIN_S)

    def _let_go(self) -> None:
        if not self._fault:
            with contextlib.suppress(AravisError):
                self._device.end_acquisition()
        if self._stream is not None:
            self._stream.close()
        self._device.close()

    def _rearm(self, device: Device) -> Stream:
        """Ready for a trigger, on a stream on which no frame of an earlier exposure can come."""
        if self._stream is not None:
            device.end_acquisition()
            self._stream.close()
        self._stream = None
        self._stream = device.new_stream()
        self._stream.lend()
        device.start_acquisition()
        self._is_clean = True
        return self._stream

    def _wait(self, stream: Stream, deadline_s: float) -> Arrival | None:
        """What arrives first; None when nothing has by then."""
        while not self._is_closing.is_set():
            left_s = deadline_s - self._clock.monotonic_s()
            arrival = stream.take(min(max(left_s, 0.0), LOOK_UP_S))
            if arrival is not None or left_s <= 0.0:
                return arrival
            if not self._device.is_ours:
                self._lose("it does not answer any more, or obeys another program")
        raise CommunicationError(f"{self._name} was closed while a frame was waited for")

    def _check_answers(self) -> None:
        try:
            self._device.check_answers()
        except AravisError as error:
            self._lose(str(error))

    def _check_usable(self) -> None:
        if self._fault:
            raise DeviceFaultError(self._fault)
        if self._is_closing.is_set():
            raise DeviceFaultError(f"{self._name} is closed")
        if not self._device.is_ours:
            self._lose("it does not answer any more, or obeys another program")

    def _lose(self, reason: str) -> NoReturn:
        self._running = None
        self._fault = f"{self._name} is lost: {reason}; check its power and its cable, and open it again"
        raise DeviceFaultError(self._fault)


def _open(settings: CameraSettings) -> tuple[Device, str]:
    """The camera that the settings mean, and its name for people. Raises DeviceFaultError; ConfigError: no library."""
    wanted = f"{settings.role} camera"
    if settings.serial_number is not None:
        wanted += f" with serial number {settings.serial_number}"
    if settings.address is not None:
        wanted += f" at {settings.address}"
    for thread in threading.enumerate():
        if thread.name == LET_GO:
            thread.join(LET_GO_WITHIN_S)
    try:
        device = Device(_handle_of(settings, wanted) if settings.address is None else settings.address)
    except AravisError as error:
        found = "; ".join(map(str, list_cameras())) or "none"
        raise DeviceFaultError(f"{wanted} cannot be opened: {error}; GenICam cameras found: {found}") from error
    try:
        vendor, model, serial_number = device.identity()
        name = f"{settings.role} camera {vendor} {model}, serial number {serial_number}"
        if settings.serial_number not in (None, serial_number):
            raise DeviceFaultError(f"{wanted} is not there: at that address is {name}")
        if not device.is_ours:
            raise DeviceFaultError(f"{name} obeys another program: end that one, or wait until its control expires")
    except AravisError as error:
        device.close()
        raise DeviceFaultError(f"{wanted} does not say what it is: {error}") from error
    except DeviceFaultError:
        device.close()
        raise
    return device, name


def _handle_of(settings: CameraSettings, wanted: str) -> str:
    """The library's name of the camera with that serial number, or of the only one there is."""
    devices = find_devices()
    found = "; ".join(str(camera) for _, camera in devices) or "none"
    fitting = [handle for handle, camera in devices if settings.serial_number in (None, camera.serial_number)]
    if not fitting:
        raise DeviceFaultError(f"{wanted} is not there; GenICam cameras found: {found}")
    if len(fitting) > 1:
        raise DeviceFaultError(f"{wanted} could be any of these: {found}; say which by its serial_number or address")
    return fitting[0]

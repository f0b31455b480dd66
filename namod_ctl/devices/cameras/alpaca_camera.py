"""Cameras behind an ASCOM Alpaca server, in the network or on this computer.

A server tells when an exposure began by its own clock, often to the second only: the middle of an exposure is reckoned
from when the order to begin was given. Alpaca's interface knows no pixel formats: a frame is as deep as MaxADU says.

Source: ASCOM ICameraV4; Alpaca API Reference v3.
"""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from typing import Final

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.devices.cameras.alpaca_http import NETWORK_ERRORS, NOT_CONNECTED, AlpacaDevice, AlpacaImageError
from namod_ctl.devices.cameras.alpaca_http import AlpacaRefusalError as Refusal
from namod_ctl.devices.cameras.alpaca_image import image_of_alpaca
from namod_ctl.devices.cameras.alpaca_setup import camera_number, cameras_of, set_up
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.server_address import server_address
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

DEFAULT_PORT: Final = 11111
_POLL_S: Final = 0.02
_N_TRIES: Final = 3  # to begin an exposure
_CLOSE_TIMEOUT_S: Final = 0.15  # for each of two requests: a camera closes within 0.5 s
_DISCOVERY_S: Final = 1
_IDLE, _FAILED = 0, 5  # ASCOM's CameraState


class AlpacaCamera:
    """A camera that an Alpaca server drives; opened and set up when it is made.

    Raises
    ------
    ConfigError
        A setting cannot be had, or was not taken.
    DeviceFaultError
        No server there, or it has no such camera.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._settings, self._clock = settings, clock
        self._address = server_address(settings, DEFAULT_PORT)
        self._name = f"{settings.role} camera on the Alpaca server {self._address[0]}:{self._address[1]}"
        self._device = AlpacaDevice(*self._address, "camera", 0)
        try:
            self._device.number = camera_number(self._device, settings, self._name)
            self._setup = set_up(self._device, settings, self._name)
        except NETWORK_ERRORS as error:
            raise DeviceFaultError(
                f"{self._name}: {_in_words(error)}; start the server, or correct the key address in the config"
            ) from error
        finally:
            self._device.close()
        self._name += f", number {self._device.number}: {self._setup.model}"
        self._n_reconnects = self._device.n_reconnects
        self._n_starts = 0
        self._running: tuple[float, float] | None = None  # when it was begun, its exposure; until it is fetched
        self._is_busy = False
        self._busy_until_s = -math.inf
        self._given_up_until_s = -math.inf
        self._fault = ""
        self._is_closing = threading.Event()

    @property
    def name(self) -> str:
        """Role, address, number, and the server's name for it."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """ExposureMin and ExposureMax of the device."""
        return self._setup.exposure_range_s

    def start(self, exposure_s: float) -> None:
        """Begin an exposure; a running one is aborted. Raises LimitError, DeviceFaultError."""
        self._refuse_gone()
        refuse_outside(self.name, exposure_s, self.exposure_range_s)
        self._running = None
        try:
            begin_s = self._begin(exposure_s)
            self._refuse_changed()
        except Refusal as error:
            if error.number == NOT_CONNECTED:
                raise self._lost(str(error)) from error
            raise DeviceFaultError(f"{self.name} does not begin an exposure: the server says: {error}") from error
        except NETWORK_ERRORS as error:
            raise self._lost(_in_words(error)) from error
        self._n_starts += 1
        self._is_busy, self._busy_until_s = True, begin_s + exposure_s
        self._running = (begin_s, exposure_s)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for. Raises CommunicationError, DeviceFaultError."""
        self._refuse_gone()
        if self._running is None:
            raise CommunicationError(f"{self.name}: no exposure was begun; start one before fetching it")
        (begin_s, asked_s), self._running = self._running, None
        try:
            self._await_frame(begin_s + asked_s, timeout_s)
            planes = self._device.image()
            exposure_s = float(self._device.quantity("lastexposureduration"))
            self._refuse_changed()
        except (Refusal, AlpacaImageError, *NETWORK_ERRORS) as error:
            if self._is_closing.is_set():
                raise CommunicationError(f"{self.name} was closed while a frame was waited for") from error
            is_gone = isinstance(error, NETWORK_ERRORS) or (
                isinstance(error, Refusal) and error.number == NOT_CONNECTED
            )
            if is_gone:
                raise self._lost(_in_words(error)) from error
            raise CommunicationError(f"{self.name}: {error}; try again") from error
        self._is_busy = False
        columns, rows = planes.shape[:2]
        if (columns, rows) != (self._settings.columns, self._settings.rows):
            raise self._lost(
                f"a frame of {columns} x {rows} pixels came, not one of {self._settings.columns} x "
                f"{self._settings.rows} as was set: another program uses this camera, or it was restarted"
            )
        try:
            image = image_of_alpaca(planes, self._settings.full_scale_adu, self._setup.tile)
        except AlpacaImageError as error:
            raise CommunicationError(f"{self.name}: {error}") from error
        return Exposure(image, exposure_s, begin_s + 0.5 * exposure_s, self._n_starts)

    def close(self) -> None:
        """Abort a running exposure and disconnect; harmless when closed already."""
        if self._is_closing.is_set():
            return
        self._is_closing.set()
        self._device.interrupt()
        if self._fault:
            return
        farewell = AlpacaDevice(*self._address, "camera", self._device.number)
        with suppress(Refusal, *NETWORK_ERRORS):
            if self._is_busy and self._setup.can_abort:
                farewell.put("abortexposure", _CLOSE_TIMEOUT_S)
            farewell.put("connected", _CLOSE_TIMEOUT_S, Connected=False)
        farewell.close()

    def _begin(self, exposure_s: float) -> float:
        """Give the order to expose; when that was, on the clock."""
        n_refused = 0
        while True:
            self._give_up()
            before_s = self._clock.monotonic_s()
            try:
                self._device.put("startexposure", Duration=float(exposure_s), Light=True)
            except Refusal as error:
                n_refused += 1
                self._is_busy = True  # for all we know: servers are about that finish what was aborted
                if error.number == NOT_CONNECTED or n_refused == _N_TRIES:
                    raise
            else:
                return 0.5 * (before_s + self._clock.monotonic_s())

    def _give_up(self) -> None:
        """End the running exposure."""
        if not self._is_busy:
            return
        if self._setup.can_abort:
            self._device.put("abortexposure")
        elif self._device.quantity("camerastate") != _IDLE:
            raise DeviceFaultError(
                f"{self.name} exposes and cannot be stopped (CanAbortExposure is false): wait for it"
            )
        self._given_up_until_s = self._busy_until_s
        self._is_busy = False

    def _await_frame(self, end_s: float, timeout_s: float) -> None:
        """Return when the server has the frame.

        Servers are about that finish an exposure although it was aborted: a frame that is ready before its time is
        such a one, and is taken out of the way. One that comes later than the new exposure's end cannot be told.
        """
        look_s = end_s if self._given_up_until_s < self._clock.monotonic_s() else min(end_s, self._given_up_until_s)
        self._wait(look_s - self._clock.monotonic_s())
        while True:
            now_s = self._clock.monotonic_s()
            is_ready = self._device.flag("imageready")
            if is_ready and now_s >= end_s:
                return
            if is_ready:
                self._device.image()
            elif self._device.quantity("camerastate") == _FAILED:
                raise AlpacaImageError("the server reports that the exposure failed")
            if now_s >= end_s + timeout_s:
                raise AlpacaImageError(f"no frame within {timeout_s:g} s of the exposure's end")
            self._wait(_POLL_S)

    def _wait(self, duration_s: float) -> None:
        if self._is_closing.wait(max(duration_s, 0.0)):
            raise AlpacaImageError("closed")

    def _refuse_changed(self) -> None:
        """After the connection was lost and made anew: the camera must still be set up as it was."""
        if self._device.n_reconnects == self._n_reconnects:
            return
        self._n_reconnects = self._device.n_reconnects
        change = self._setup.has_changed(self._device)
        if change:
            raise ConnectionResetError(f"the server was restarted: {change}")

    def _refuse_gone(self) -> None:
        if self._is_closing.is_set():
            raise DeviceFaultError(f"{self.name} is closed")
        if self._fault:
            raise DeviceFaultError(self._fault)

    def _lost(self, why: str) -> DeviceFaultError:
        self._fault = f"{self.name} is lost: {why}"
        self._device.interrupt()
        return DeviceFaultError(self._fault)


def list_cameras() -> list[FoundCamera]:
    """The cameras of the Alpaca servers that answer in this computer's networks; takes two seconds for each network.

    Raises
    ------
    ConfigError
        alpyca is not installed: it looks for the servers.
    """
    try:
        from alpaca.discovery import search_ipv4
    except ImportError as error:
        raise ConfigError(
            "looking for Alpaca servers needs alpyca: install it with pip install 'namod-ctl[alpaca]'"
        ) from error
    found = []
    for address in search_ipv4(numquery=1, timeout=_DISCOVERY_S):
        host, _, port = address.rpartition(":")
        server = AlpacaDevice(host, int(port), "camera", 0)
        with suppress(Refusal, *NETWORK_ERRORS):
            found += [
                FoundCamera("alpaca", "", str(entry.get("DeviceName", "")), str(entry.get("UniqueID", "")), address)
                for entry in cameras_of(server)
            ]
        server.close()
    return found


def _in_words(error: BaseException) -> str:
    """What went wrong with a request, for a person."""
    if isinstance(error, ConnectionRefusedError):
        return "nothing answers there"
    if isinstance(error, TimeoutError):
        return "it does not answer in time"
    return str(error) or type(error).__name__

"""Cameras on an INDI server, in the network or on this computer.

An order to expose is known to have been taken when the driver says Busy. The exposure began between the order and that
answer; where DATE-OBS of the frame lies between them, the server's clock agrees with ours and tells it exactly.

Source: INDI standard properties (CCD_EXPOSURE, CCD_ABORT_EXPOSURE, CCD1).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from threading import Lock
from typing import Any, Final

from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.indi_client import IndiClient
from namod_ctl.devices.cameras.indi_image import frame_of_fits
from namod_ctl.devices.cameras.indi_setup import (
    ABORT,
    EXPOSURE,
    EXPOSURE_VALUE,
    FRAME_BLOB,
    await_devices,
    cameras_of,
    set_up,
)
from namod_ctl.devices.cameras.server_address import server_address
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

DEFAULT_PORT: Final = 7624
_DATE_STEP_S: Final = 1e-3  # INDI cuts DATE-OBS to milliseconds


class _Phase(Enum):
    """How far an exposure has come."""

    ABORTING = "the one before is being aborted"
    ORDERED = "the driver has not answered yet"
    EXPOSING = "it runs"
    DONE = "its frame is here"
    FAILED = "the driver gave it up"


@dataclass(slots=True)
class _Order:
    """One exposure; changed by the client's thread as the driver answers.

    Attributes
    ----------
    sent_s, sent
        When the driver was told to begin: on the cameras' clock, and by the time of day.
    answered_s
        When it said that it had.
    """

    exposure_s: float
    phase: _Phase
    sent_s: float
    sent: datetime
    answered_s: float = 0.0
    fits: bytes = b""


class IndiCamera:
    """A camera that an INDI server drives; opened and set up when it is made.

    Raises
    ------
    ConfigError
        indipyclient is not installed; a setting cannot be had, or was not taken.
    DeviceFaultError
        No server there, or it has no such camera.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._settings, self._clock = settings, clock
        host, port = server_address(settings, DEFAULT_PORT)
        self._name = f"{settings.role} camera on the INDI server {host}:{port}"
        self._lock = Lock()
        self._order: _Order | None = None
        self._is_fetched = True
        self._n_starts = 0
        self._is_closed = False
        self._fault = ""
        self._device = ""
        try:
            self._client = IndiClient(host, port, self._hear)
        except OSError as error:
            raise DeviceFaultError(
                f"{self._name}: nothing answers there ({error}); start indiserver, or correct the key address"
            ) from error
        try:
            self._setup = set_up(self._client, settings, self._name)
        except BaseException:
            self._client.close()
            raise
        self._device = self._setup.device
        self._name = f"{settings.role} camera {self._device} (INDI server {host}:{port})"

    @property
    def name(self) -> str:
        """Role, the server's name for it, and address."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """The limits of CCD_EXPOSURE."""
        return self._setup.exposure_range_s

    def start(self, exposure_s: float) -> None:
        """Begin an exposure; a running one is aborted. Raises LimitError, DeviceFaultError."""
        self._refuse_gone()
        refuse_outside(self.name, exposure_s, self.exposure_range_s)
        with self._lock:
            is_busy = self._order is not None and self._order.phase not in (_Phase.DONE, _Phase.FAILED)
            self._order = _Order(exposure_s, _Phase.ABORTING, self._clock.monotonic_s(), datetime.now(UTC))
            self._is_fetched = False
            self._n_starts += 1
            if is_busy:
                self._client.send(self._device, ABORT, {"ABORT": "On"})
            else:
                self._send_order(self._order)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for. Raises CommunicationError, DeviceFaultError."""
        self._refuse_gone()
        order = self._order
        if order is None or self._is_fetched:
            raise CommunicationError(f"{self.name}: no exposure was begun; start one before fetching it")
        self._is_fetched = True
        wait_s = order.sent_s + order.exposure_s + timeout_s - self._clock.monotonic_s()
        over = (_Phase.DONE, _Phase.FAILED)
        self._client.wait(lambda: self._is_closed or order.phase in over or bool(self._trouble()), wait_s)
        if self._is_closed:
            raise CommunicationError(f"{self.name} was closed while a frame was waited for")
        self._refuse_gone()
        if order.phase is _Phase.FAILED:
            raise CommunicationError(f"{self.name}: the exposure failed: {self._client.messages or 'no reason given'}")
        if order.phase is not _Phase.DONE:
            raise CommunicationError(
                f"{self.name}: no frame within {timeout_s:g} s of the exposure's end ({order.phase.value}); try again"
            )
        return self._exposure_of(order)

    def close(self) -> None:
        """Abort a running exposure and leave the server; harmless when closed already."""
        if self._is_closed:
            return
        self._is_closed = True
        self._client.wake()
        with self._lock:
            if self._order is not None and self._order.phase not in (_Phase.DONE, _Phase.FAILED):
                self._client.send(self._device, ABORT, {"ABORT": "On"})
        self._client.close()

    def _exposure_of(self, order: _Order) -> Exposure:
        settings = self._settings
        try:
            frame = frame_of_fits(order.fits, settings.full_scale_adu, self._setup.corner, settings.binning)
        except CommunicationError as error:
            raise CommunicationError(f"{self.name}: {error}; try again") from error
        rows, columns = frame.image.shape[:2]
        if (columns, rows) != (settings.columns, settings.rows):
            self._fault = (
                f"a frame of {columns} x {rows} pixels came, not one of {settings.columns} x {settings.rows} as was "
                "set: another program uses this camera"
            )
            self._refuse_gone()
        exposure_s = order.exposure_s if frame.exposure_s is None else frame.exposure_s
        begin_s = 0.5 * (order.sent_s + order.answered_s)
        if frame.begin is not None:
            told_s = order.sent_s + (frame.begin - order.sent).total_seconds()
            is_true = order.sent_s - _DATE_STEP_S <= told_s <= order.answered_s
            begin_s = max(told_s, order.sent_s) if is_true else begin_s
        return Exposure(frame.image, exposure_s, begin_s + 0.5 * exposure_s, self._n_starts)

    def _send_order(self, order: _Order) -> None:
        order.phase = _Phase.ORDERED
        order.sent_s, order.sent = self._clock.monotonic_s(), datetime.now(UTC)
        self._client.send(self._device, EXPOSURE, {EXPOSURE_VALUE: order.exposure_s})

    def _hear(self, event: Any) -> None:
        """What the server says, in the client's thread: brings the present order on."""
        if not self._device or event.devicename != self._device:
            return
        with self._lock:
            order = self._order
            if order is None:
                return
            said = (event.vectorname, event.vector.state if event.eventtype in ("Set", "SetBLOB") else "")
            if order.phase is _Phase.ABORTING and event.vectorname == ABORT and event.eventtype == "Set":
                self._send_order(order)
            elif order.phase is _Phase.ORDERED and said == (EXPOSURE, "Busy"):
                order.answered_s = self._clock.monotonic_s()
                order.phase = _Phase.EXPOSING
            elif order.phase is _Phase.ORDERED and said == (EXPOSURE, "Alert"):
                order.phase = _Phase.FAILED
            elif order.phase is _Phase.EXPOSING and said in ((EXPOSURE, "Alert"), (EXPOSURE, "Idle")):
                order.phase = _Phase.FAILED  # idle: another program aborted it
            elif order.phase is _Phase.EXPOSING and event.eventtype == "SetBLOB" and event.vectorname == FRAME_BLOB:
                order.fits = event[FRAME_BLOB]
                order.phase = _Phase.DONE

    def _refuse_gone(self) -> None:
        if self._is_closed:
            raise DeviceFaultError(f"{self.name} is closed")
        if self._trouble():
            raise DeviceFaultError(f"{self.name} is lost: {self._trouble()}")

    def _trouble(self) -> str:
        """Why the camera is lost, once it is; empty before."""
        if not self._fault:
            connection = self._client.find(self._device, "CONNECTION")
            is_on = connection is not None and connection.values.get("CONNECT") == "On"
            self._fault = self._client.lost or (
                "" if is_on else "its driver was restarted, or another program disconnected it"
            )
        return self._fault


def list_cameras() -> list[FoundCamera]:
    """The cameras of the INDI server on this computer. Raises ConfigError when indipyclient is not installed."""
    address = f"127.0.0.1:{DEFAULT_PORT}"
    with suppress(OSError):
        client = IndiClient("127.0.0.1", DEFAULT_PORT, lambda _: None)
        try:
            await_devices(client)
            return [FoundCamera("indi", "", name, "", address) for name in cameras_of(client)]
        finally:
            client.close()
    return []

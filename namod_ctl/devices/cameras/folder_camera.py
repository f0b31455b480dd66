"""A camera behind a folder: another program exposes, and drops its frames there.

What the other program does
    It writes a frame as FITS (`.fits`, `.fit`, `.fts`; image in the primary part, exposure in s under EXPTIME or
    EXPOSURE) or as PNG or TIFF (`.png`, `.tif`, `.tiff`) with a side file of the same name that ends in `.json`
    (`{"exposure_s": 0.02}`) or `.txt` (`exposure_s = 0.02`, one line each, the last one ended). Best under a name that
    starts with a dot, then renamed; a file that is not whole, or still changes, is waited for in any case.
    It may also tell, for good times: the exposure's beginning in UTC with a fraction of a second (DATE-BEG or
    DATE-OBS; `start_utc` in side files), and which request it answers (NAMODREQ; `request`).

What it may read
    `request.json` while an exposure is wanted:
    `{"schema": "namod-exposure-request/1", "role": "star", "request": "4f9c-17", "exposure_s": 0.02}`.
    It is replaced as a whole by the next request, and gone when nothing is wanted any more. A program that gives the
    `request` back is understood exactly. Of others, which expose as they please, only frames count whose exposure
    began after the request; they must not finish what a new request has replaced.

What it may tell once
    `camera.json`: `{"exposure_range_s": [0.001, 30.0], "model": "QHY5III", "serial_number": "123"}`, all optional; the
    config's exposure_range_s goes first, and one of both must say it.

Nothing in the folder is ever deleted but our own request: see to old frames with another program.
"""

from __future__ import annotations

import json
import math
import os
import threading
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.frame_files import (
    FITS_ENDINGS,
    PICTURE_ENDINGS,
    FrameFile,
    UnfinishedFileError,
    read_frame_file,
)
from namod_ctl.devices.cameras.new_files import NewFiles
from namod_ctl.devices.cameras.pixel_formats import image_of
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

REQUEST_FILE = "request.json"
MANIFEST_FILE = "camera.json"
REQUEST_SCHEMA = "namod-exposure-request/1"

LOOK_EVERY_S = 0.01

CLOCK_SLACK_S = 0.1
"""So far the other program's clock may be from ours before its times are taken for wrong."""
FRESH_SLACK_S = 0.02
"""The same where only the times tell a new frame from an old one: clocks kept by NTP are closer."""


@dataclass(frozen=True, slots=True)
class _Request:
    """An exposure that is wanted, from `start_s` on the program's clock."""

    name: str
    number: int
    exposure_s: float
    start_s: float


class FolderCamera:
    """The camera of the program that writes into the folder `settings.address`.

    With `pixel_format` (BayerRG8, ...) grey frames are what a sensor behind that filter saw.

    Raises
    ------
    ConfigError
        There is no such folder, its manifest cannot be understood or is of another camera, or nobody says the
        exposures that are possible.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._settings, self._clock = settings, clock
        self._folder = Path(settings.address or "")
        if not settings.address or not self._folder.is_dir():
            raise ConfigError(
                f"{settings.role} camera: {settings.address}: there is no such folder; make it, or correct address"
            )
        manifest = _read_manifest(self._folder / MANIFEST_FILE)
        self._range_s = _exposure_range_s(settings, manifest, self._folder)
        told = manifest.get("serial_number")
        if told is not None and settings.serial_number is not None and str(told) != settings.serial_number:
            raise ConfigError(
                f"{self._folder / MANIFEST_FILE}: is of the camera with serial number {told}, the config wants "
                f"{settings.serial_number}"
            )
        self._name = f"{settings.role} camera ({manifest.get('model') or 'frames'} in {self._folder})"
        try:
            self._files = NewFiles(self._folder, _is_frame)
        except OSError as error:
            raise self._lose(error) from None
        self._session = uuid.uuid4().hex[:8]  # so that frames for another program's requests are none of ours
        self._n_starts = 0
        self._request: _Request | None = None
        self._is_lost = False
        self._wake = threading.Condition()
        self._is_closed = False

    @property
    def name(self) -> str:
        """Role, model and folder."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """As the config or the folder's manifest says."""
        return self._range_s

    def start(self, exposure_s: float) -> None:
        """Ask for an exposure, and forget all frames until now. Raises LimitError, DeviceFaultError."""
        self._refuse_when_gone()
        refuse_outside(self._name, exposure_s, self._range_s)
        with self._wake:
            self._refuse_when_gone()
            self._n_starts += 1
            name = f"{self._session}-{self._n_starts}"
            self._request = _Request(name, self._n_starts, exposure_s, self._clock.monotonic_s())
            self._write_request(self._request)
            self._wake.notify_all()

    def fetch(self, timeout_s: float) -> Exposure:
        """The first new frame that answers the request. Raises CommunicationError, DeviceFaultError."""
        self._refuse_when_gone()
        request = self._request
        if request is None:
            raise CommunicationError(f"{self._name}: no exposure was begun; start one before fetching it")
        end_s = request.start_s + request.exposure_s + timeout_s
        reasons: dict[str, str] = {}
        try:
            while True:
                exposure = self._answer(request, reasons)
                if exposure is not None:
                    return exposure
                now_s = self._clock.monotonic_s()
                if now_s >= end_s:
                    why = "; ".join(reasons.values()) or "nothing new came"
                    raise CommunicationError(
                        f"{self._name}: no frame within {timeout_s:g} s of the exposure's end: {why}"
                    )
                with self._wake:
                    if self._wake.wait_for(lambda: self._request is not request, min(LOOK_EVERY_S, end_s - now_s)):
                        raise CommunicationError(f"{self._name}: the exposure was given up")
        finally:
            with self._wake:
                if self._request is request:
                    self._request = None
                    self._withdraw_request()

    def close(self) -> None:
        """Withdraw the request; the folder stays as it is."""
        with self._wake:
            if not self._is_closed:
                self._is_closed = True
                self._request = None
                self._withdraw_request()
            self._wake.notify_all()

    def _refuse_when_gone(self) -> None:
        if self._is_closed:
            raise DeviceFaultError(f"{self._name}: is closed")
        if self._is_lost:
            raise DeviceFaultError(f"{self._name}: the folder is gone; bring it back, then open the camera again")

    def _lose(self, error: OSError) -> DeviceFaultError:
        self._is_lost = True
        return DeviceFaultError(f"{self._name}: the folder is gone or cannot be read ({error.strerror})")

    def _answer(self, request: _Request, reasons: dict[str, str]) -> Exposure | None:
        """The frame that answers the request, if it is there now; `reasons` is told, by file, why others are none.

        Raises CommunicationError for a frame that answers but cannot be used, DeviceFaultError.
        """
        try:
            settled = self._files.settled(self._clock.monotonic_s())
        except OSError as error:
            raise self._lose(error) from None
        for name, arrived_s in settled:
            try:
                frame = read_frame_file(self._folder / name)
            except UnfinishedFileError as problem:
                reasons[name] = str(problem)
                continue
            except OSError as error:
                reasons[name] = f"{name}: cannot be read ({error.strerror})"
                continue
            except CommunicationError as problem:
                self._files.dismiss(name)
                raise CommunicationError(f"{self._name}: {problem}") from None
            self._files.dismiss(name)
            middle_s = self._middle_s(request, frame, arrived_s, name, reasons)
            if middle_s is not None:
                return self._checked(request, frame, middle_s, name)
        return None

    def _middle_s(
        self, request: _Request, frame: FrameFile, arrived_s: float, name: str, reasons: dict[str, str]
    ) -> float | None:
        """Middle of the frame's exposure on the program's clock; None, with a reason, when it is another request's."""
        if frame.request is not None and frame.request != request.name:
            reasons[name] = f"{name} answers another request ({frame.request})"
            return None
        start_s = request.start_s if frame.request is not None else arrived_s - frame.exposure_s
        if frame.start is not None:
            ago_s = (SystemClock().now() - frame.start).total_seconds()
            start_s = self._clock.monotonic_s() - ago_s
            if start_s + frame.exposure_s > arrived_s + CLOCK_SLACK_S:
                reasons[name] = f"{name} says that it was exposed after it came: set the clocks of both computers"
                return None
        slack_s = 0.0 if frame.start is None else CLOCK_SLACK_S if frame.request is not None else FRESH_SLACK_S
        if start_s < request.start_s - slack_s:
            hint = "" if frame.start is None else ": set the clocks of both computers"
            reasons[name] = f"{name} began {request.start_s - start_s:.3g} s before it was asked for{hint}"
            return None
        return start_s + frame.exposure_s / 2.0

    def _checked(self, request: _Request, frame: FrameFile, middle_s: float, name: str) -> Exposure:
        settings, image = self._settings, frame.image
        if image.shape[:2] != (settings.rows, settings.columns):
            raise CommunicationError(
                f"{self._name}: {name} has {image.shape[1]} x {image.shape[0]} pixels, the config wants "
                f"{settings.columns} x {settings.rows}; correct columns and rows, or what the other program writes"
            )
        if settings.pixel_format is not None and image.ndim == 2:
            image = image_of(image, settings.pixel_format, settings.columns, settings.rows)
        if (image.dtype == np.uint8) != (settings.full_scale_adu <= 255.0):
            raise CommunicationError(
                f"{self._name}: {name} has pixels of {8 * image.dtype.itemsize} bit, full_scale_adu = "
                f"{settings.full_scale_adu:g} says otherwise; correct that in the config, or what the program writes"
            )
        if image.max() > settings.full_scale_adu:
            raise CommunicationError(
                f"{self._name}: {name} has a pixel of {image.max()}, more than full_scale_adu = "
                f"{settings.full_scale_adu:g}; correct that in the config"
            )
        return Exposure(image, frame.exposure_s, middle_s, request.number)

    def _write_request(self, request: _Request) -> None:
        told = {
            "schema": REQUEST_SCHEMA,
            "role": self._settings.role,
            "request": request.name,
            "exposure_s": request.exposure_s,
        }
        new = self._folder / f".{REQUEST_FILE}.{self._session}"
        try:
            new.write_text(json.dumps(told) + "\n", encoding="utf-8")
            self._files.begin(new)
            new.replace(self._folder / REQUEST_FILE)
        except FileNotFoundError as error:
            raise self._lose(error) from None
        except OSError as error:
            self._is_lost = True
            raise DeviceFaultError(
                f"{self._name}: {REQUEST_FILE} cannot be written there ({error.strerror}); see to rights and space"
            ) from None

    def _withdraw_request(self) -> None:
        try:
            (self._folder / REQUEST_FILE).unlink(missing_ok=True)
        except OSError:
            self._is_lost = True  # the next call says so


def list_cameras() -> list[FoundCamera]:
    """None: any folder may be one, only the config knows which."""
    return []


def _is_frame(name: str) -> bool:
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in FITS_ENDINGS | PICTURE_ENDINGS


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON ({error}); correct or remove it") from None
    if not isinstance(manifest, dict):
        raise ConfigError(f'{path}: must be a JSON object such as {{"exposure_range_s": [0.001, 30.0]}}')
    return manifest


def _exposure_range_s(settings: CameraSettings, manifest: dict[str, Any], folder: Path) -> tuple[float, float]:
    if settings.exposure_range_s is not None:
        return settings.exposure_range_s
    told = manifest.get("exposure_range_s")
    where = f"{folder / MANIFEST_FILE}"
    if told is None:
        raise ConfigError(
            f"{settings.role} camera: which exposures are possible? Say it in the config, exposure_range_s = "
            f"[0.001, 30.0], or in {where}"
        )
    is_range = isinstance(told, list) and len(told) == 2 and all(type(value_s) in (int, float) for value_s in told)
    if not is_range or not 0.0 < told[0] <= told[1] < math.inf:
        raise ConfigError(f"{where}: exposure_range_s = {told!r} must be the shortest and the longest exposure in s")
    return float(told[0]), float(told[1])

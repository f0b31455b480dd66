"""Basler cameras through their maker's library (pypylon): one exposure per software trigger.

A frame is given out when its exposure is over and not before, as real cameras do: the emulated ones of the library
(environment variable `PYLON_CAMEMU`) deliver at once, whatever the exposure.

The library's calls that wait for several things at once, with a timeout, end by SIGALRM (26.9 on Linux): where anything
else in the program handles that signal they wait for ever. Here they are called only when there is nothing to wait for.
"""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.core.units import s_to_ms, s_to_us, us_to_s
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.pixel_formats import Image, choose_format, full_scale_of, image_of
from namod_ctl.devices.cameras.pylon_nodes import DeviceTimes, PylonNodes
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

READY_S = 0.5
"""A camera takes the next trigger some ms after its frame has come; one that does not within this is busy."""
POLL_S = 0.001
LOOK_UP_S = 0.1
"""While a frame is waited for: so often we look whether the camera is being closed, or gone."""
N_BUFFERS = 3
"""Frames that the library keeps memory for; one is used at a time."""
MAX_TRIGGER_DELAY_S = 0.005
"""From a software trigger to its exposure, at most: a time stamp that says more is of another clock, or marks something
else than the exposure's start."""
NO_BLOCK_ID = 2**64 - 1
"""What the library gives for frames of cameras that do not count: its manual, `GetBlockID`."""

_NEUTRAL: tuple[tuple[str, str | float], ...] = (
    ("AcquisitionMode", "Continuous"),
    ("SequencerMode", "Off"),
    ("ExposureMode", "Timed"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("GammaEnable", False),
    ("Gamma", 1.0),
    ("LUTEnable", False),
    ("DigitalShift", 0),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    ("ReverseX", False),
    ("ReverseY", False),
    ("CenterX", False),
    ("CenterY", False),
    ("AcquisitionFrameRateEnable", False),
    ("ChunkModeActive", False),
    ("TriggerDelay", 0.0),
)
"""Whatever another program left in the camera: pixels must be proportional to light, and lie as on the sensor."""


@dataclass(frozen=True, slots=True)
class _Running:
    """An exposure under way: when it was triggered (nan if the camera was not ready), and how long it takes."""

    start_s: float
    exposure_s: float


class PylonCamera:
    """A Basler camera, or an emulated one, open and configured.

    Attributes
    ----------
    device
        The library's own camera, for what this driver has no words for.

    Raises
    ------
    ConfigError
        The library is missing, or the camera does not take a setting.
    DeviceFaultError
        There is no such camera, or it cannot be opened.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._pylon, self._genicam = _library()
        self._settings, self._clock = settings, clock
        self._lock = threading.Lock()
        self._is_closing = threading.Event()
        self._trouble = ""
        self._running: _Running | None = None
        self._is_idle = True
        self._frame_id = 0
        self._last_block_id: int | None = None
        found = _choose(self._pylon, settings)
        self._name = (
            f"{settings.role} camera {found.GetVendorName()} {found.GetModelName()} ({found.GetSerialNumber()})"
        )
        with self._losing("cannot be opened; close other programs that use it"):
            self.device: Any = self._pylon.InstantCamera(self._pylon.TlFactory.GetInstance().CreateDevice(found))
            self.device.Open()
        try:
            with self._losing("fails while it is being set up"):
                self._configure()
                self._grab()
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """Role, model and serial number."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, as the camera said when it was opened."""
        return us_to_s(self._range_us[0]), us_to_s(self._range_us[1])

    def start(self, exposure_s: float) -> None:
        """Begin an exposure; a running one is given up. Raises LimitError, DeviceFaultError."""
        with self._lock:
            self._refuse_lost()
            refuse_outside(self._name, exposure_s, self.exposure_range_s)
            with self._losing("does not take the next exposure"):
                if not self._is_idle:
                    self._give_up()
                self._is_idle = False
                least_us, most_us = self._range_us
                self._exposure.SetValue(min(max(s_to_us(exposure_s), least_us), most_us))
                made_s = us_to_s(float(self._exposure.GetValue()))
                start_s = self._trigger()
            self._refuse_removed()
            self._running = _Running(start_s, made_s)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for. Raises CommunicationError, DeviceFaultError."""
        with self._lock:
            self._refuse_lost()
            running, self._running = self._running, None
            if running is None:
                raise CommunicationError(f"{self._name}: no exposure was begun; start one before fetching it")
            if math.isnan(running.start_s):
                raise CommunicationError(f"{self._name}: was still busy with the frame before; try again")
            with self._losing("does not give its frame"):
                result = self._retrieved(running, timeout_s)
            self._is_idle = True
            try:
                self._count(int(result.GetBlockID()))
                if not result.GrabSucceeded():
                    self._refuse_removed()
                    code = int(result.GetErrorCode()) & 0xFFFFFFFF
                    raise CommunicationError(
                        f"{self._name}: the frame did not arrive whole: {result.GetErrorDescription()} "
                        f"(code {code:#010x}); try again; if that goes on, look at its cable and the line's bandwidth"
                    )
                image = self._image(result)
                start_s = self._exposure_start_s(running, int(result.GetTimeStamp()))
            finally:
                result.Release()
            return Exposure(image, running.exposure_s, start_s + running.exposure_s / 2.0, self._frame_id)

    def close(self) -> None:
        """Abort what is exposed or waited for, and let go of the camera."""
        self._is_closing.set()  # ends a `fetch` that waits in another thread
        with self._lock, suppress(self._genicam.GenericException):
            self._trouble = self._trouble or f"{self._name}: is closed; open it again"
            self.device.Close()
            self.device.DestroyDevice()  # a device that was unplugged is found again only after that

    def show_pictures(self, folder: Path) -> None:
        """An emulated camera shows the pictures in that folder from now on, one after the other, instead of patterns.

        It reads a picture anew for each frame, if there are two or more names in the folder (26.9). They must have
        the size and the depth of its frames.

        Raises
        ------
        ConfigError
            This is no emulated camera.
        """
        with self._lock, self._losing("does not show pictures"):
            self.device.StopGrabbing()
            self._nodes.set("TestImageSelector", "Off")
            self._nodes.set("ImageFileMode", "On")
            self._nodes.set("ImageFilename", str(folder))
            self._grab()

    def _configure(self) -> None:
        """All settings of the config, and what makes images measurements; each is read back."""
        settings = self._settings
        self._nodes = nodes = PylonNodes(self.device.GetNodeMap(), self._genicam, self._name)
        for name, value in _NEUTRAL:
            nodes.set_if_there(name, value)
        nodes.set("PixelFormat", self._chosen_format(), "pixel_format")
        for axis in ("Horizontal", "Vertical"):
            if settings.binning != 1 or nodes.find(f"Binning{axis}") is not None:
                nodes.set(f"Binning{axis}", settings.binning, "binning")
        asked = settings.offset_px or (None, None)
        for size, offset, count, key, at in (
            ("Width", "OffsetX", settings.columns, "columns", asked[0]),
            ("Height", "OffsetY", settings.rows, "rows", asked[1]),
        ):
            nodes.set_if_there(offset, 0)
            nodes.set(size, count, key)
            node = nodes.find(offset)
            if at is not None:
                nodes.set(offset, at, "offset_px")
            elif node is not None:
                nodes.set_if_there(offset, node.GetMax() // 2 // node.GetInc() * node.GetInc())
        self._set_gain()
        for selector in nodes.need("TriggerSelector").GetSymbolics():
            nodes.set("TriggerSelector", selector)
            nodes.set_if_there("TriggerMode", "Off")
        nodes.set("TriggerSelector", "FrameStart")
        nodes.set("TriggerMode", "On")
        nodes.set("TriggerSource", "Software")
        self._software_trigger = nodes.need("TriggerSoftware")
        self._exposure = nodes.need("ExposureTime", "ExposureTimeAbs")
        self._range_us = (float(self._exposure.GetMin()), float(self._exposure.GetMax()))
        self._times = DeviceTimes(nodes, self._clock)
        self.device.MaxNumBuffer.SetValue(N_BUFFERS)

    def _set_gain(self) -> None:
        """As the config says, else the lowest; older GigE cameras have whole numbers of a unit of their own."""
        asked = self._settings.gain
        node = self._nodes.find("Gain", "GainRaw")
        if node is None and asked is None:
            return
        node = self._nodes.need("Gain", "GainRaw")
        lowest = node.GetMin()
        if asked is not None and isinstance(lowest, int) and not asked.is_integer():
            raise ConfigError(
                f"{self._name}: gain = {asked:g} is refused; this camera takes whole numbers, {lowest} to "
                f"{node.GetMax()}; change gain in the config"
            )
        self._nodes.set(node.GetNode().GetName(), lowest if asked is None else type(lowest)(asked), "gain")

    def _chosen_format(self) -> str:
        settings = self._settings
        offered = self._nodes.need("PixelFormat").GetSymbolics()
        try:
            self._format = settings.pixel_format or choose_format(offered, settings.full_scale_adu)
            full_scale_adu = full_scale_of(self._format)
        except ConfigError as error:
            raise ConfigError(f"{self._name}: {error}") from None
        if full_scale_adu != settings.full_scale_adu:
            raise ConfigError(
                f"{self._name}: pixels of format {self._format} go up to {full_scale_adu:g}, full_scale_adu says "
                f"{settings.full_scale_adu:g}; change one of the two in the config"
            )
        return self._format

    def _grab(self) -> None:
        pylon = self._pylon
        self.device.StartGrabbing(pylon.GrabStrategy_OneByOne, pylon.GrabLoop_ProvidedByUser)

    def _give_up(self) -> None:
        """Abort the running exposure and forget frames that were never fetched: none may come as the next one."""
        self._nodes.execute_if_there("AcquisitionAbort")
        self.device.StopGrabbing()
        self._grab()
        self._frame_id += 1
        self._last_block_id = None

    def _trigger(self) -> float:
        """Trigger an exposure; its start on our clock, nan when the camera was not ready for it."""
        deadline_s = self._clock.monotonic_s() + READY_S
        while self.device.CanWaitForFrameTriggerReady() and not self._is_ready():
            if self._is_closing.wait(POLL_S) or self._clock.monotonic_s() > deadline_s:
                return math.nan
        self._times.compare()
        before_s = self._clock.monotonic_s()
        self._software_trigger.Execute()
        return (before_s + self._clock.monotonic_s()) / 2.0

    def _is_ready(self) -> bool:
        return bool(self.device.WaitForFrameTriggerReady(0, self._pylon.TimeoutHandling_Return))

    def _retrieved(self, running: _Running, timeout_s: float) -> Any:
        """The library's frame, to be released."""
        end_s = running.start_s + running.exposure_s
        left_s = end_s - self._clock.monotonic_s()
        self._is_closing.wait(max(left_s, 0.0))
        arrival = self.device.GetGrabResultWaitObject()
        while not self._is_closing.is_set():
            left_s = end_s + timeout_s - self._clock.monotonic_s()
            if arrival.Wait(int(s_to_ms(min(max(left_s, 0.0), LOOK_UP_S)))):
                result = self.device.RetrieveResult(0, self._pylon.TimeoutHandling_Return)
                if result.IsValid():
                    return result
            self._refuse_removed()
            if left_s <= 0.0:
                raise CommunicationError(
                    f"{self._name}: no frame within {timeout_s:g} s of the exposure's end; try again"
                )
        raise CommunicationError(f"{self._name}: was closed while a frame was waited for")

    def _image(self, result: Any) -> Image:
        """The frame's pixels in memory of their own: copied once, or not at all where they are converted anyway."""
        buffer = np.frombuffer(result.GetImageMemoryView(), dtype=np.uint8)
        try:
            image = image_of(buffer, self._format, self._settings.columns, self._settings.rows)
        except CommunicationError as error:
            raise CommunicationError(f"{self._name}: {error}") from None
        return image.copy() if np.may_share_memory(image, buffer) else image

    def _count(self, block_id: int) -> None:
        """Go on to the frame with that number of the camera's; its count begins anew with each grab, and at 65535."""
        last = self._last_block_id
        is_next = block_id == NO_BLOCK_ID or last is None or block_id < last
        self._frame_id += 1 if is_next or last is None else block_id - last
        self._last_block_id = block_id

    def _exposure_start_s(self, running: _Running, ticks: int) -> float:
        """By the camera's clock where it has one and agrees with the moment of the trigger, else that moment."""
        start_s = self._times.host_s(ticks)
        return start_s if abs(start_s - running.start_s) <= MAX_TRIGGER_DELAY_S else running.start_s

    def _refuse_lost(self) -> None:
        if self._trouble:
            raise DeviceFaultError(self._trouble)

    def _refuse_removed(self) -> None:
        if self.device.IsCameraDeviceRemoved():
            raise self._lost("is gone; check its cable and power")

    def _lost(self, why: str) -> DeviceFaultError:
        self._trouble = f"{self._name}: {why}"
        return DeviceFaultError(self._trouble)

    @contextmanager
    def _losing(self, why: str) -> Iterator[None]:
        """What the library complains of in here means that the camera is lost."""
        try:
            yield
        except self._genicam.GenericException as error:
            raise self._lost(f"{why}: {error.GetDescription()}") from None


def list_cameras() -> list[FoundCamera]:
    """All cameras that the library sees. Raises ConfigError when it is missing."""
    pylon, _ = _library()
    return [
        FoundCamera("pylon", found.GetVendorName(), found.GetModelName(), found.GetSerialNumber(), "")
        for found in pylon.TlFactory.GetInstance().EnumerateDevices()
    ]


def _library() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pypylon.pylon"), importlib.import_module("pypylon.genicam")
    except ImportError as error:
        raise ConfigError(
            f"Basler cameras need the library pypylon ({error}): install it with pip install 'namod-ctl[pylon]'"
        ) from None


def _choose(pylon: Any, settings: CameraSettings) -> Any:
    """What the library knows of the camera that is meant."""
    for key in ("address", "device"):
        if getattr(settings, key) is not None:
            raise ConfigError(f"{settings.role} camera: pylon finds cameras by serial_number; leave {key} out")
    found = list(pylon.TlFactory.GetInstance().EnumerateDevices())
    texts = ", ".join(f"{one.GetModelName()} ({one.GetSerialNumber()})" for one in found) or "none"
    wanted = settings.serial_number
    matching = [one for one in found if wanted in (None, one.GetSerialNumber())]
    if not matching:
        which = "" if wanted is None else f" with serial number {wanted}"
        raise DeviceFaultError(
            f"{settings.role} camera: no Basler camera{which} found; found: {texts}; check its cable and power, and "
            "serial_number in the config"
        )
    if len(matching) > 1:
        raise ConfigError(f"{settings.role} camera: say which one with serial_number; found: {texts}")
    return matching[0]

"""IDS uEye cameras, such as both of FACT's NAMOD (UI-1480SE-M, DCU223C), through their maker's library (pyueye).

Tried on no camera: none was at hand. It was written after the maker's manual (uEye SDK 4.9x, programming reference) and
runs, through the real pyueye, on a stand-in for the maker's shared library that the tests compile. Whoever first has
such a camera should look at `namod-ctl camera snap` with several exposures before a night.
"""

from __future__ import annotations

import ctypes
import importlib
import threading
from typing import Any

import numpy as np

from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure, MonotonicClock
from namod_ctl.core.units import ms_to_s, s_to_ms
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.pixel_formats import Image, choose_format, full_scale_of, image_of, is_colour
from namod_ctl.devices.cameras.settings import CameraSettings, refuse_outside

WANTED_LONGEST_S = 3.0
"""Exposures of so long are to be possible (arXiv:1605.06274): they are with a slow pixel clock only."""
POLL_S = 0.002
"""The library's events differ between its versions; that a picture is there can be asked in all of them."""
N_TIMEOUT_TICKS_PER_S = 100  # manual, is_SetTimeout: in steps of 10 ms
TRIGGER_TIMEOUT_MARGIN_S = 10.0
NEUTRAL_GAMMA = 100  # manual, is_Gamma: hundredths

_FORMATS = {
    "Mono8": ("IS_CM_MONO8", 8),
    "Mono10": ("IS_CM_MONO10", 16),
    "Mono12": ("IS_CM_MONO12", 16),
    "Mono16": ("IS_CM_MONO16", 16),
    "BGR8": ("IS_CM_BGR8_PACKED", 24),
}
"""By their GenICam names: colour mode, and bits per pixel in memory."""
_AUTOMATICS = ("GAIN", "SHUTTER", "WHITEBALANCE", "FRAMERATE")
_BINNINGS = (1, 2, 3, 4, 5, 6, 8, 16)


class UeyeCamera:
    """A uEye camera, open and configured.

    Raises
    ------
    ConfigError
        The library is missing, or the camera does not take a setting.
    DeviceFaultError
        There is no such camera, or it cannot be opened.
    """

    def __init__(self, settings: CameraSettings, clock: MonotonicClock) -> None:
        self._ueye = _library()
        self._settings, self._clock = settings, clock
        self._lock = threading.Lock()
        self._is_closing = threading.Event()
        self._trouble = ""
        self._running: tuple[float, float] | None = None
        self._is_idle = True
        self._frame_id = 0
        info = _choose(self._ueye, settings)
        self._serial_number = _text(info.SerNo)
        self._name = f"{settings.role} camera IDS {_text(info.FullModelName)} ({self._serial_number})"
        self._handle = ctypes.c_uint(int(info.dwDeviceID) | self._ueye.IS_USE_DEVICE_ID)
        code = self._ueye.is_InitCamera(self._handle, None)
        if code != self._ueye.IS_SUCCESS:
            raise DeviceFaultError(
                f"{self._name}: cannot be opened (uEye error {code}); close other programs that use it, and see "
                "that the maker's service (ueyeusbdrc or ueyeethdrc) runs"
            )
        try:
            self._configure()
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """Role, model and serial number."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure at the pixel clock that was chosen, as the camera said."""
        return ms_to_s(self._range_ms[0]), ms_to_s(self._range_ms[1])

    def start(self, exposure_s: float) -> None:
        """Begin an exposure; a running one is given up. Raises LimitError, DeviceFaultError."""
        ueye = self._ueye
        with self._lock:
            self._refuse_lost()
            refuse_outside(self._name, exposure_s, self.exposure_range_s)
            if not self._is_idle:
                ueye.is_StopLiveVideo(self._handle, ueye.IS_FORCE_VIDEO_STOP)
            self._is_idle = False
            exposure_ms = ctypes.c_double(min(max(s_to_ms(exposure_s), self._range_ms[0]), self._range_ms[1]))
            for command in (ueye.IS_EXPOSURE_CMD_SET_EXPOSURE, ueye.IS_EXPOSURE_CMD_GET_EXPOSURE):
                self._call("is_Exposure", command, exposure_ms, ctypes.sizeof(exposure_ms))
            before_s = self._clock.monotonic_s()
            self._call("is_FreezeVideo", ueye.IS_DONT_WAIT)  # in this trigger mode: one software trigger
            self._frame_id += 1
            self._running = ((before_s + self._clock.monotonic_s()) / 2.0, ms_to_s(exposure_ms.value))

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for; its time is that of its trigger.

        Raises CommunicationError, DeviceFaultError.
        """
        with self._lock:
            self._refuse_lost()
            running, self._running = self._running, None
            if running is None:
                raise CommunicationError(f"{self._name}: no exposure was begun; start one before fetching it")
            start_s, exposure_s = running
            self._wait_for_frame(start_s + exposure_s, timeout_s)
            image = self._image()
            self._is_idle = True
            return Exposure(image, exposure_s, start_s + exposure_s / 2.0, self._frame_id)

    def close(self) -> None:
        """Abort what is exposed or waited for, and let go of the camera."""
        self._is_closing.set()
        with self._lock:
            if self._handle.value:
                self._ueye.is_StopLiveVideo(self._handle, self._ueye.IS_FORCE_VIDEO_STOP)
                self._ueye.is_ExitCamera(self._handle)  # frees the picture's memory as well
                self._handle.value = 0
            self._trouble = self._trouble or f"{self._name}: is closed; open it again"

    def _configure(self) -> None:
        """All settings of the config, and what makes images measurements; what can be read back is."""
        ueye = self._ueye
        self._call("is_ResetToDefault")
        self._call("is_SetDisplayMode", ueye.IS_SET_DM_DIB)
        self._turn_automatics_off()
        self._set_format()
        self._set_region()
        self._range_ms = self._choose_pixel_clock()
        self._set_gain()
        self._memory, self._memory_id, pitch = ueye.c_mem_p(), ctypes.c_int(), ctypes.c_int()
        columns, rows, bits = self._settings.columns, self._settings.rows, _FORMATS[self._format][1]
        self._call("is_AllocImageMem", columns, rows, bits, self._memory, self._memory_id)
        self._call("is_SetImageMem", self._memory, self._memory_id)
        self._call("is_GetImageMemPitch", pitch)
        self._row_bytes, self._pitch = columns * bits // 8, pitch.value
        self._call("is_SetExternalTrigger", ueye.IS_SET_TRIGGER_SOFTWARE)
        longest_s = self.exposure_range_s[1] + TRIGGER_TIMEOUT_MARGIN_S
        self._call("is_SetTimeout", ueye.IS_TRIGGER_TIMEOUT, int(longest_s * N_TIMEOUT_TICKS_PER_S))

    def _turn_automatics_off(self) -> None:
        """Whatever changes pixels by itself; what a model does not have, it refuses, and that is as good."""
        ueye, handle = self._ueye, self._handle
        for place in ("", "SENSOR_"):
            for what in _AUTOMATICS:
                name = f"ENABLE_AUTO_{place}{what}"
                present, ignored = ctypes.c_double(0.0), ctypes.c_double(0.0)
                ueye.is_SetAutoParameter(handle, getattr(ueye, f"IS_SET_{name}"), present, ignored)
                code = ueye.is_SetAutoParameter(handle, getattr(ueye, f"IS_GET_{name}"), present, ignored)
                if code == ueye.IS_SUCCESS and present.value != 0.0:
                    raise self._refused(name, "off", "on", "")
        ueye.is_SetGainBoost(handle, ueye.IS_SET_GAINBOOST_OFF)
        ueye.is_SetHardwareGamma(handle, ueye.IS_SET_HW_GAMMA_OFF)
        gamma = ctypes.c_int(NEUTRAL_GAMMA)
        ueye.is_Gamma(handle, ueye.IS_GAMMA_CMD_SET, gamma, ctypes.sizeof(gamma))
        code = ueye.is_Gamma(handle, ueye.IS_GAMMA_CMD_GET, gamma, ctypes.sizeof(gamma))
        if code == ueye.IS_SUCCESS and gamma.value != NEUTRAL_GAMMA:
            raise self._refused("gamma", f"{NEUTRAL_GAMMA}", f"{gamma.value}", "")

    def _set_format(self) -> None:
        settings, ueye = self._settings, self._ueye
        self._sensor = ueye.SENSORINFO()
        self._call("is_GetSensorInfo", self._sensor)
        mode = self._sensor.nColorMode
        sees_colour = int.from_bytes(getattr(mode, "value", mode), "little") == ueye.IS_COLORMODE_BAYER
        own = [name for name in _FORMATS if is_colour(name) == sees_colour]
        try:
            self._format = settings.pixel_format or choose_format(own, settings.full_scale_adu)
            full_scale_adu = full_scale_of(self._format)
        except ConfigError as error:
            raise ConfigError(f"{self._name}: {error}") from None
        if self._format not in _FORMATS:
            raise self._refused("pixel format", self._format, f"those it has: {', '.join(_FORMATS)}", "pixel_format")
        if full_scale_adu != settings.full_scale_adu:
            raise ConfigError(
                f"{self._name}: pixels of format {self._format} go up to {full_scale_adu:g}, full_scale_adu says "
                f"{settings.full_scale_adu:g}; change one of the two in the config"
            )
        asked = int(getattr(ueye, _FORMATS[self._format][0]))
        ueye.is_SetColorMode(self._handle, asked)
        present = ueye.is_SetColorMode(self._handle, ueye.IS_GET_COLOR_MODE)
        if present != asked:
            raise self._refused("pixel format", self._format, f"the library's colour mode {present}", "pixel_format")

    def _set_region(self) -> None:
        settings, ueye = self._settings, self._ueye
        n = settings.binning
        if n not in _BINNINGS:
            raise self._refused("binning", f"{n}", f"those it has: {', '.join(map(str, _BINNINGS))}", "binning")
        mode = ueye.IS_BINNING_DISABLE
        if n > 1:
            mode = getattr(ueye, f"IS_BINNING_{n}X_VERTICAL") | getattr(ueye, f"IS_BINNING_{n}X_HORIZONTAL")
        ueye.is_SetBinning(self._handle, mode)
        present = ueye.is_SetBinning(self._handle, ueye.IS_GET_BINNING)
        if present != mode:
            raise self._refused("binning", f"{n}", f"the library's mode {present}", "binning")
        step = ueye.IS_POINT_2D()
        self._call("is_AOI", ueye.IS_AOI_IMAGE_GET_POS_INC, step, ctypes.sizeof(step))
        if settings.offset_px is None:
            x = (int(self._sensor.nMaxWidth) // n - settings.columns) // 2 // int(step.s32X) * int(step.s32X)
            y = (int(self._sensor.nMaxHeight) // n - settings.rows) // 2 // int(step.s32Y) * int(step.s32Y)
        else:
            x, y = settings.offset_px
        asked = (max(x, 0), max(y, 0), settings.columns, settings.rows)
        region = ueye.IS_RECT()
        region.s32X, region.s32Y, region.s32Width, region.s32Height = (ueye.c_int(value) for value in asked)
        ueye.is_AOI(self._handle, ueye.IS_AOI_IMAGE_SET_AOI, region, ctypes.sizeof(region))
        self._call("is_AOI", ueye.IS_AOI_IMAGE_GET_AOI, region, ctypes.sizeof(region))
        got = tuple(int(value) for value in (region.s32X, region.s32Y, region.s32Width, region.s32Height))
        if got != asked:
            raise self._refused(
                "region (x, y, columns, rows)",
                f"{asked}",
                f"{got} of {int(self._sensor.nMaxWidth)} x {int(self._sensor.nMaxHeight)} pixels",
                "columns, rows and offset_px",
            )

    def _choose_pixel_clock(self) -> tuple[float, float]:
        """The fastest pixel clock that allows exposures of `WANTED_LONGEST_S`, else the slowest; the range in ms."""
        ueye = self._ueye
        n_clocks = ctypes.c_uint()
        self._call("is_PixelClock", ueye.IS_PIXELCLOCK_CMD_GET_NUMBER, n_clocks, ctypes.sizeof(n_clocks))
        clocks = (ctypes.c_uint * n_clocks.value)()
        self._call("is_PixelClock", ueye.IS_PIXELCLOCK_CMD_GET_LIST, clocks, ctypes.sizeof(clocks))
        for clock_mhz in sorted(clocks, reverse=True):
            clock = ctypes.c_uint(clock_mhz)
            self._call("is_PixelClock", ueye.IS_PIXELCLOCK_CMD_SET, clock, ctypes.sizeof(clock))
            shortest_s, longest_s, step_s = ctypes.c_double(), ctypes.c_double(), ctypes.c_double()
            self._call("is_GetFrameTimeRange", shortest_s, longest_s, step_s)
            rate_per_s = ctypes.c_double()
            self._call("is_SetFrameRate", 1.0 / longest_s.value, rate_per_s)
            range_ms = (ctypes.c_double * 3)()
            self._call("is_Exposure", ueye.IS_EXPOSURE_CMD_GET_EXPOSURE_RANGE, range_ms, ctypes.sizeof(range_ms))
            if ms_to_s(range_ms[1]) >= WANTED_LONGEST_S:
                break
        return range_ms[0], range_ms[1]

    def _set_gain(self) -> None:
        """The gain of all colours together, 0 to 100; those of single colours stay the maker's."""
        ueye, same = self._ueye, self._ueye.IS_IGNORE_PARAMETER
        asked = int(self._settings.gain or 0)
        ueye.is_SetHardwareGain(self._handle, asked, same, same, same)
        present = ueye.is_SetHardwareGain(self._handle, ueye.IS_GET_MASTER_GAIN, same, same, same)
        if present != asked:
            raise self._refused("gain", f"{self._settings.gain}", f"{present}, of 0 to 100", "gain")

    def _wait_for_frame(self, end_s: float, timeout_s: float) -> None:
        ueye = self._ueye
        wait_s = max(end_s - self._clock.monotonic_s(), 0.0)
        deadline_s = end_s + timeout_s
        while not self._is_closing.wait(wait_s):
            state = ctypes.c_int(ueye.IS_CAPTURE_STATUS)  # asks for errors as well: manual, is_IsVideoFinish
            code = ueye.is_IsVideoFinish(self._handle, state)
            if code != ueye.IS_SUCCESS:
                self._refuse_removed()
                raise CommunicationError(f"{self._name}: is_IsVideoFinish failed (uEye error {code}); try again")
            if state.value == ueye.IS_VIDEO_FINISH:
                return
            if state.value == ueye.IS_CAPTURE_STATUS:
                self._refuse_removed()
                raise CommunicationError(
                    f"{self._name}: the frame did not arrive whole; try again; if that goes on, look at its cable and "
                    "give it a USB controller of its own"
                )
            if self._clock.monotonic_s() > deadline_s:
                self._refuse_removed()
                raise CommunicationError(
                    f"{self._name}: no frame within {timeout_s:g} s of the exposure's end; try again"
                )
            wait_s = POLL_S
        raise CommunicationError(f"{self._name}: was closed while a frame was waited for")

    def _image(self) -> Image:
        """The frame's pixels in memory of their own: copied once, or not at all where they are converted anyway."""
        address = ctypes.cast(self._memory, ctypes.POINTER(ctypes.c_ubyte))
        memory = np.ctypeslib.as_array(address, (self._settings.rows, self._pitch))
        pixels = memory[:, : self._row_bytes]
        image = image_of(pixels, self._format, self._settings.columns, self._settings.rows)
        return image.copy() if np.may_share_memory(image, memory) else image

    def _call(self, function: str, *arguments: Any) -> None:
        """Call a function of the library. Raises DeviceFaultError when it does not succeed: the camera is lost."""
        code = getattr(self._ueye, function)(self._handle, *arguments)
        if code != self._ueye.IS_SUCCESS:
            self._trouble = f"{self._name}: {function} failed (uEye error {code}); check its cable and power"
            raise DeviceFaultError(self._trouble)

    def _refused(self, setting: str, asked: str, present: str, key: str) -> ConfigError:
        remedy = f"change {key} in the config" if key else "set it with the maker's program, or report this"
        return ConfigError(f"{self._name}: {setting} = {asked} was asked for, the camera keeps {present}; {remedy}")

    def _refuse_lost(self) -> None:
        if self._trouble:
            raise DeviceFaultError(self._trouble)

    def _refuse_removed(self) -> None:
        if all(_text(info.SerNo) != self._serial_number for info in _attached(self._ueye)):
            self._trouble = f"{self._name}: is gone; check its cable and power"
            raise DeviceFaultError(self._trouble)


def list_cameras() -> list[FoundCamera]:
    """All cameras that the library sees. Raises ConfigError when it is missing."""
    return [
        FoundCamera("ueye", "IDS", _text(info.FullModelName), _text(info.SerNo), "") for info in _attached(_library())
    ]


def _library() -> Any:
    try:
        return importlib.import_module("pyueye.ueye")
    except ImportError as error:
        raise ConfigError(
            f"uEye cameras need the library pyueye ({error}): install it with pip install 'namod-ctl[ueye]', and "
            "IDS' own library (IDS Software Suite, en.ids-imaging.com), which pyueye calls"
        ) from None


def _attached(ueye: Any) -> list[Any]:
    """What the library knows of each camera at this computer."""
    n_cameras = ctypes.c_int()
    ueye.is_GetNumberOfCameras(n_cameras)
    if n_cameras.value == 0:
        return []
    cameras = ueye.UEYE_CAMERA_LIST(ueye.UEYE_CAMERA_INFO * n_cameras.value)
    cameras.dwCount = ueye.c_uint(n_cameras.value)
    ueye.is_GetCameraList(cameras)
    return list(cameras.uci)[: int(cameras.dwCount)]


def _choose(ueye: Any, settings: CameraSettings) -> Any:
    """What the library knows of the camera that is meant."""
    for key in ("address", "device"):
        if getattr(settings, key) is not None:
            raise ConfigError(f"{settings.role} camera: ueye finds cameras by serial_number; leave {key} out")
    found = _attached(ueye)
    texts = ", ".join(f"{_text(one.FullModelName)} ({_text(one.SerNo)})" for one in found) or "none"
    wanted = settings.serial_number
    matching = [one for one in found if wanted in (None, _text(one.SerNo))]
    if not matching:
        which = "" if wanted is None else f" with serial number {wanted}"
        raise DeviceFaultError(
            f"{settings.role} camera: no uEye camera{which} found; found: {texts}; check its cable and power, and "
            "serial_number in the config"
        )
    if len(matching) > 1:
        raise ConfigError(f"{settings.role} camera: say which one with serial_number; found: {texts}")
    return matching[0]


def _text(raw: bytes) -> str:
    return raw.decode("ascii", errors="replace").strip("\0 ")

"""GenICam cameras and the frames that come from them, as the Aravis library has them."""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Callable
from ctypes import c_double, c_int, c_int64, c_size_t, c_uint, c_uint64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import s_to_us, us_to_s
from namod_ctl.devices.cameras.found import FoundCamera
from namod_ctl.devices.cameras.genicam_library import library

Bytes = NDArray[np.uint8]

STATUS_SUCCESS = 0
STATUS_NAMES = {
    -1: "unknown state",
    1: "cleared",
    2: "not all packets came in time",
    3: "packets are missing",
    4: "packet with a wrong number",
    5: "image larger than announced",
    6: "still being filled",
    7: "aborted",
    8: "not an image",
}
"""`ArvBufferStatus` of frames that are no good."""

_PACKET_SOCKET_DISABLED = 1
"""Of `ArvGvStreamOption`: receive through an ordinary socket, as users who are not root must anyhow."""

_LEAST_SOCKET_BUFFER = 1 << 20
"""Bytes; the system counts more for a small packet than it holds."""

_G_TYPE_INT = 6 << 2
"""GLib's number of the type `int` (`gtype.h`)."""

_list_lock = threading.Lock()
"""The library keeps one list of devices for the whole process."""


def _text(value: bytes | None) -> str:
    return "" if value is None else value.decode(errors="replace")


def find_devices() -> list[tuple[str, FoundCamera]]:
    """Every camera that answers within a second, with the library's own name for it.

    Raises
    ------
    ConfigError
        The library is missing.
    """
    call = library().call
    with _list_lock:
        call("arv_update_device_list")
        found = []
        for index in range(call("arv_get_n_devices")):
            vendor, model, serial, address = (
                _text(call(f"arv_get_device_{what}", index)) for what in ("vendor", "model", "serial_nbr", "address")
            )
            has_ip = call("arv_get_device_protocol", index) == b"GigEVision"
            camera = FoundCamera("genicam", vendor, model, serial, address if has_ip else "")
            found.append((_text(call("arv_get_device_id", index)), camera))
        return found


class Device:
    """An open camera. Every method raises AravisError when the camera refuses it or does not answer.

    Parameters
    ----------
    name
        IP address, or the library's name for it.
    """

    def __init__(self, name: str) -> None:
        self._call = library().call
        self._camera = self._call("arv_camera_new", name.encode())
        self._device = self._call("arv_camera_get_device", self._camera)  # belongs to the camera
        self._is_gige = bool(self._call("arv_camera_is_gv_device", self._camera))
        if self._is_gige:
            self._call("arv_camera_gv_set_stream_options", self._camera, _PACKET_SOCKET_DISABLED)

    def close(self) -> None:
        """Let go of it; nothing else may be called afterwards. Takes seconds when the camera does not answer."""
        self._call("g_object_unref", self._camera)

    @property
    def is_ours(self) -> bool:
        """False once a GigE camera has answered no heartbeat or obeys another program; costs nothing to ask."""
        return not self._is_gige or bool(self._call("arv_gv_device_is_controller", self._device))

    def check_answers(self) -> None:
        """Read something from the camera itself: the version register that both standards have at address 0."""
        version = ctypes.create_string_buffer(4)
        self._call("arv_device_read_memory", self._device, 0, len(version), version)

    def identity(self) -> tuple[str, str, str]:
        """Vendor, model and serial number."""
        vendor, model, serial = (
            _text(self._call(f"arv_camera_get_{what}", self._camera))
            for what in ("vendor_name", "model_name", "device_serial_number")
        )
        return vendor, model, serial

    def has(self, feature: str) -> bool:
        """True when the camera has that feature and it may be used now."""
        return bool(self._call("arv_camera_is_feature_available", self._camera, feature.encode()))

    def text(self, feature: str) -> str:
        """Value of an enumeration or a text."""
        return _text(self._call("arv_camera_get_string", self._camera, feature.encode()))

    def set_text(self, feature: str, value: str) -> None:
        """Choose an enumeration's entry."""
        self._call("arv_camera_set_string", self._camera, feature.encode(), value.encode())

    def switch_off(self, feature: str) -> None:
        """Set a boolean feature to false."""
        self._call("arv_camera_set_boolean", self._camera, feature.encode(), 0)

    def integer(self, feature: str) -> int:
        """Value of an integer feature."""
        return int(self._call("arv_camera_get_integer", self._camera, feature.encode()))

    def set_integer(self, feature: str, value: int) -> None:
        """Set an integer feature."""
        self._call("arv_camera_set_integer", self._camera, feature.encode(), value)

    def integer_range(self, feature: str) -> tuple[int, int, int]:
        """Lowest and highest value that an integer feature takes at present, and the step between its values."""
        low, high = c_int64(), c_int64()
        name = feature.encode()
        self._call("arv_camera_get_integer_bounds", self._camera, name, ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value, max(1, self._call("arv_camera_get_integer_increment", self._camera, name))

    def pixel_formats(self) -> list[str]:
        """Names of the formats it can be set to."""
        count = c_uint()
        names = self._call("arv_camera_dup_available_pixel_formats_as_strings", self._camera, ctypes.byref(count))
        try:
            return [_text(names[index]) for index in range(count.value)]
        finally:
            self._call("g_free", names)

    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, s."""
        low_us, high_us = self._bounds("arv_camera_get_exposure_time_bounds")
        return us_to_s(low_us), us_to_s(high_us)

    def set_exposure_s(self, exposure_s: float) -> float:
        """Set the exposure; the one that the camera says it has then, s."""
        self._call("arv_camera_set_exposure_time", self._camera, s_to_us(exposure_s))
        return us_to_s(float(self._call("arv_camera_get_exposure_time", self._camera)))

    def has_gain(self) -> bool:
        """True when its gain can be set."""
        return bool(self._call("arv_camera_is_gain_available", self._camera))

    def gain_range(self) -> tuple[float, float]:
        """Lowest and highest gain, in the camera's own unit."""
        return self._bounds("arv_camera_get_gain_bounds")

    def set_gain(self, gain: float) -> float:
        """Set the gain; the one that the camera says it has then."""
        self._call("arv_camera_set_gain", self._camera, gain)
        return float(self._call("arv_camera_get_gain", self._camera))

    def wait_for_software_trigger(self) -> None:
        """From now on make one frame per trigger command, and none else."""
        self._call("arv_camera_set_trigger", self._camera, b"Software")

    def trigger(self) -> None:
        """Begin an exposure; returns when the camera has acknowledged that."""
        self._call("arv_camera_software_trigger", self._camera)

    def start_acquisition(self) -> None:
        """Be ready for triggers."""
        self._call("arv_camera_start_acquisition", self._camera)

    def end_acquisition(self) -> None:
        """Give a running exposure up where the camera can do that, and stop delivering frames."""
        if self.has("AcquisitionAbort"):
            self._call("arv_camera_abort_acquisition", self._camera)
        self._call("arv_camera_stop_acquisition", self._camera)

    def new_stream(self) -> Stream:
        """A new way for frames to come, which knows nothing of what came on others."""
        size = int(self._call("arv_camera_get_payload", self._camera))
        stream = Stream(self._call("arv_camera_create_stream", self._camera, None, None), size)
        if self._is_gige:
            stream.reserve_socket_buffer()
        return stream

    def _bounds(self, function: str) -> tuple[float, float]:
        low, high = c_double(), c_double()
        self._call(function, self._camera, ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """What has come into a buffer that was lent to a stream.

    Attributes
    ----------
    status
        `STATUS_SUCCESS`, or a key of `STATUS_NAMES`.
    data
        Shape (bytes of the frame,); nobody else uses its memory.
    row_padding
        Bytes after each row that are no pixels.
    """

    status: int
    data: Bytes
    row_padding: int


class Stream:
    """Where frames of a camera arrive: each in memory that was lent for it, without a copy.

    Parameters
    ----------
    handle
        The library's stream, which now belongs to this object.
    frame_size
        Bytes of one frame; also an attribute.
    """

    def __init__(self, handle: int, frame_size: int) -> None:
        self._call = library().call
        self._handle = handle
        self.frame_size = frame_size
        self._lent: dict[int, Bytes] = {}
        # also when it is forgotten: the receiving thread must not write to memory that is somebody else's by then
        self._end = weakref.finalize(self, _end_stream, self._call, handle, self._lent)

    @property
    def n_lent(self) -> int:
        """Frames that there is memory for at present."""
        return len(self._lent)

    def reserve_socket_buffer(self) -> None:
        """Let the system keep a whole frame that nobody has received yet (GigE only).

        The library leaves the system's default, of which a frame that comes at the full rate of the network is lost
        whenever the computer is busy for a millisecond. `net.core.rmem_max` limits what is granted.
        """
        value = (c_uint64 * 3)()  # a GValue
        self._call("g_value_init", value, _G_TYPE_INT)
        self._call("g_value_set_int", value, max(self.frame_size, _LEAST_SOCKET_BUFFER))
        self._call("g_object_set_property", self._handle, b"socket-buffer-size", value)

    def lend(self) -> None:
        """Make room for one more frame."""
        data: Bytes = np.empty(self.frame_size, dtype=np.uint8)
        address = data.ctypes.data
        self._lent[address] = data  # until the library has given it back
        buffer = self._call("arv_buffer_new_full", data.size, address, address, None)
        self._call("arv_stream_push_buffer", self._handle, buffer)

    def take(self, timeout_s: float) -> Arrival | None:
        """The next frame, whole or not; None when none has come in time."""
        buffer = self._call("arv_stream_timeout_pop_buffer", self._handle, round(s_to_us(timeout_s)))
        if buffer is None:
            return None
        try:
            data = self._lent.pop(self._call("arv_buffer_get_user_data", buffer))
            size = c_size_t()
            self._call("arv_buffer_get_data", buffer, ctypes.byref(size))
            status = self._call("arv_buffer_get_status", buffer)
            padding_x, padding_y = c_int(), c_int()
            if status == STATUS_SUCCESS:
                self._call("arv_buffer_get_image_padding", buffer, ctypes.byref(padding_x), ctypes.byref(padding_y))
            return Arrival(status, data[: size.value], padding_x.value)
        finally:
            self._call("g_object_unref", buffer)

    def close(self) -> None:
        """End it: what is still on its way comes nowhere."""
        self._end()


def _end_stream(call: Callable[..., Any], handle: int, lent: dict[int, Bytes]) -> None:
    call("g_object_unref", handle)  # waits for the receiving thread
    lent.clear()

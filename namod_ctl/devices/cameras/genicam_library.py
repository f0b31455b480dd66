"""The Aravis library, called through ctypes: which of its functions, with which types.

So one system package is all that is needed, whatever Python runs: PyGObject, Aravis' usual way into Python, has to be
built by a C compiler or to come from the system's own Python.
Source: headers of Aravis 0.8.26 (`arvsystem.h`, `arvcamera.h`, `arvstream.h`, `arvbuffer.h`, `arvgvdevice.h`) and of
GLib; the functions are the same in all later versions 0.8, as the number in the library's name promises.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from ctypes import POINTER, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint64, c_void_p
from functools import cache
from typing import Any

from namod_ctl.core.errors import ConfigError

MISSING_LIBRARY = (
    "the library of GenICam cameras (Aravis 0.8) is not installed: install it with `apt install libaravis-0.8-0` "
    "(Debian, Ubuntu), `dnf install aravis` (Fedora) or `brew install aravis` (macOS)"
)
_FAILING: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_int)),
    "arv_camera_get_integer": (c_int64, (c_void_p, c_char_p)),
    "arv_camera_set_integer": (None, (c_void_p, c_char_p, c_int64)),
    "arv_camera_get_integer_bounds": (None, (c_void_p, c_char_p, POINTER(c_int64), POINTER(c_int64))),
    "arv_camera_get_integer_increment": (c_int64, (c_void_p, c_char_p)),
    "arv_camera_dup_available_pixel_formats_as_strings": (POINTER(c_char_p), (c_void_p, POINTER(c_uint))),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_is_gain_available": (c_int, (c_void_p,)),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_get_gain_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p)),
    "arv_camera_software_trigger": (None, (c_void_p,)),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
    "arv_camera_abort_acquisition": (None, (c_void_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_device_read_memory": (c_int, (c_void_p, c_uint64, c_uint, c_void_p)),
}
"""Functions whose last argument is where they leave an error: (type of the result, types of the other arguments)."""

_PLAIN: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_get_device_protocol": (c_char_p, (c_uint,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_buffer_new_full": (c_void_p, (c_size_t, c_void_p, c_void_p, c_void_p)),
    "arv_buffer_get_user_data": (c_void_p, (c_void_p,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_padding": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "g_value_init": (c_void_p, (c_void_p, c_size_t)),
    "g_value_set_int": (None, (c_void_p, c_int)),
    "g_object_set_property": (None, (c_void_p, c_char_p, c_void_p)),
    "g_object_unref": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
    "g_error_free": (None, (c_void_p,)),
}


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class AravisError(Exception):
    """The library, or the camera through it, refused something; its text says what."""


class _Library:
    """Aravis with the types of its functions."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        for name, (result, arguments) in _PLAIN.items():
            self._declare(name, result, arguments)
        for name, (result, arguments) in _FAILING.items():
            self._declare(name, result, (*arguments, POINTER(POINTER(_GError))))

    def _declare(self, name: str, result: Any, arguments: tuple[Any, ...]) -> None:
        function = getattr(self._library, name)
        function.restype, function.argtypes = result, arguments

    def call(self, name: str, *arguments: Any) -> Any:
        """What the function returns. Raises AravisError when it leaves an error."""
        function = getattr(self._library, name)
        if name in _PLAIN:
            return function(*arguments)
        error = POINTER(_GError)()
        result = function(*arguments, ctypes.byref(error))
        if error:
            message = (error.contents.message or b"no reason given").decode(errors="replace")
            self._library.g_error_free(error)
            raise AravisError(message)
        return result


@cache
def library() -> _Library:
    for name in ("libaravis-0.8.so.0", ctypes.util.find_library("aravis-0.8")):
        if name is None:
            continue
        try:
            loaded = ctypes.CDLL(name)
        except OSError:
            continue
        try:
            return _Library(loaded)
        except AttributeError as error:
            raise ConfigError(f"the Aravis library {name} is too old, take 0.8.26 or later: {error}") from error
    raise ConfigError(MISSING_LIBRARY)

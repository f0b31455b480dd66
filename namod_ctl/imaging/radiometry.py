"""From camera responses to relative intensities: the radiometric law of a camera.

``log10(I) = r_resp * log10(C) + r_expo * log10(T) + r_const`` (arXiv:1605.06274, section 3), with C the pixel's
response as a share of full scale and T the exposure in s; a camera may have a further r_curve * log10(C)**2. A camera
knows a few hundred or thousand responses only, so the part that depends on C is a table over all of them, and the rest
one factor of a frame.

What a pixel's response is in a colour frame: every channel goes through the law by itself, and the pixel's intensity
is the mean of its three channels' intensities. A frame whose three channels are copies of one grey frame (the files
of the original program) gives exactly what the grey frame gives. Saturation is judged channel by channel: a pixel is
saturated when any of its channels is.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw

Array = NDArray[np.float64]
Frame = NDArray[Any]
"""A frame as a camera gives it: unsigned integers of 8 or 16 bit, shape (rows, columns) or (rows, columns, 3)."""

N_COLOURS = 3


def checked_frame(frame: Frame, camera: CameraModel) -> Frame:
    """The frame of `camera`, contiguous, shape (rows, columns) or (rows, columns, 3), after a check of its kind.

    Raises
    ------
    ConfigError
        When size, type or depth are not what the camera's config says.
    """
    if frame.ndim == N_COLOURS and frame.shape[2] == 1:
        frame = frame[:, :, 0]
    is_image = frame.ndim == 2 or (frame.ndim == N_COLOURS and frame.shape[2] == N_COLOURS)
    if not is_image or frame.shape[:2] != (camera.n_rows, camera.n_columns):
        raise ConfigError(
            f"camera {camera.name!r}: a frame has the shape {frame.shape} (rows, columns, channels), but its config "
            f"says {camera.n_rows} rows and {camera.n_columns} columns, with 1 or {N_COLOURS} channels: "
            "correct n_rows and n_columns in the config, or give the frames of this camera"
        )
    if frame.dtype not in (np.uint8, np.uint16):
        raise ConfigError(
            f"camera {camera.name!r}: a frame has values of type {frame.dtype}; "
            "frames are unsigned integers of 8 or 16 bit"
        )
    if camera.full_scale_adu > np.iinfo(frame.dtype).max:
        raise ConfigError(
            f"camera {camera.name!r}: full_scale_adu = {camera.full_scale_adu:g} cannot be reached by a frame of "
            f"{8 * frame.dtype.itemsize} bit (limit {np.iinfo(frame.dtype).max}): correct it in the config"
        )
    return np.ascontiguousarray(frame)


def grey_frame(frame: Frame, saturation_adu: float) -> Frame:
    """The frame as one response per pixel, shape (rows, columns), of the same type: the mean of the channels.

    A pixel with a saturated channel keeps that channel's response, so that it still counts as saturated. This is for
    finding stars, which the method does with a grey camera; facets are measured channel by channel.
    """
    if frame.ndim == 2:
        return frame
    mean = ((frame.sum(axis=2, dtype=np.uint32) + N_COLOURS // 2) // N_COLOURS).astype(frame.dtype)
    brightest = frame.max(axis=2)
    grey: Frame = np.where(brightest >= saturation_adu, brightest, mean)
    return grey


def saturation_adu(camera: CameraModel) -> float:
    """Responses from this one upwards are saturated."""
    return camera.saturation_share * camera.full_scale_adu


def response_table(camera: CameraModel, dtype: np.dtype[Any], rest_adu: float = 0.0) -> Array:
    """C**(r_resp + r_curve log10 C) for every response a frame of that type can hold, (256,) or (65536,), read-only.

    Multiply by `exposure_factor` for intensities. No response is no intensity. Responses above full scale count as
    full scale: there the law has no meaning, and they are saturated anyway.

    Parameters
    ----------
    rest_adu
        What all responses of the frame still show without light, -100 to 1 (`dark.dark_rest_adu`).
    """
    law, n_levels = camera.law, int(np.iinfo(dtype).max) + 1
    return _response_table(law.r_resp, law.r_curve, camera.full_scale_adu, n_levels, rest_adu)


@lru_cache(maxsize=16)
def _response_table(r_resp: float, r_curve: float, full_scale_adu: float, n_levels: int, rest_adu: float) -> Array:
    share = np.minimum((np.arange(1, n_levels) - rest_adu) / full_scale_adu, 1.0)
    table = np.zeros(n_levels)
    table[1:] = share ** (r_resp if r_curve == 0.0 else r_resp + r_curve * np.log10(share))
    table.setflags(write=False)
    return table


def exposure_factor(law: RadiometricLaw, exposure_s: float) -> float:
    """T**r_expo * 10**r_const: what turns the entries of `response_table` into intensities.

    Raises
    ------
    ConfigError
        For an exposure that is no positive number.
    """
    if not (math.isfinite(exposure_s) and exposure_s > 0.0):
        raise ConfigError(f"an exposure of {exposure_s} s: exposures are positive numbers of seconds")
    return float(exposure_s**law.r_expo * 10.0**law.r_const)

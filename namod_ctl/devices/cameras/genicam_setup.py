"""The settings of a GenICam camera: made, read back, and refused when the camera has something else.

Feature names are those of the GenICam Standard Features Naming Convention 2.7, chapters 4 (image format), 5
(acquisition) and 6 (analog control); a GigE Vision or USB3 Vision camera must have Width, Height and PixelFormat.
"""

from __future__ import annotations

import math

from namod_ctl.core.errors import ConfigError
from namod_ctl.devices.cameras.genicam_aravis import Device
from namod_ctl.devices.cameras.genicam_library import AravisError
from namod_ctl.devices.cameras.pixel_formats import choose_format, full_scale_of
from namod_ctl.devices.cameras.settings import CameraSettings

AUTOMATICS = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "BalanceWhiteAuto", "GammaAuto")
"""What a camera might do on its own accord; each is "Off" afterwards where there is one."""

SWITCHES = ("GammaEnable", "AcquisitionFrameRateEnable")
"""A response that is not the sensor's, and a limit to how long an exposure may be; false afterwards."""

GAIN_TOLERANCE = 0.01
"""Cameras round a gain to their steps; a share of the value, and this much at least."""


def configure(device: Device, settings: CameraSettings, name: str) -> str:
    """Set everything but the exposure; the pixel format that the camera has then.

    Raises
    ------
    ConfigError
        The camera cannot be set so, or has silently kept something else: names camera, setting, asked and present.
    """
    try:
        pixel_format = _set_pixel_format(device, settings, name)
        _set_binning(device, settings, name)
        _set_region(device, settings, name)
        for feature in AUTOMATICS:
            if device.has(feature):
                _set_text(device, feature, "Off", name)
        for feature in SWITCHES:
            if device.has(feature):
                device.switch_off(feature)
        _set_gain(device, settings, name)
        if device.has("ExposureMode"):
            _set_text(device, "ExposureMode", "Timed", name)
        _set_text(device, "AcquisitionMode", "Continuous", name)
        device.wait_for_software_trigger()
        _check("TriggerSource", "Software", device.text("TriggerSource"), name)
    except AravisError as error:
        raise ConfigError(f"{name} cannot be set up as a camera with software trigger: {error}") from error
    return pixel_format


def _check(setting: str, asked: object, present: object, name: str) -> None:
    if asked != present:
        raise ConfigError(f"{name} did not take {setting} = {asked}: it has {present}")


def _set_text(device: Device, feature: str, value: str, name: str) -> None:
    device.set_text(feature, value)
    _check(feature, value, device.text(feature), name)


def _set_pixel_format(device: Device, settings: CameraSettings, name: str) -> str:
    offered = device.pixel_formats()
    wanted = settings.pixel_format
    if wanted is None:
        try:
            wanted = choose_format(offered, settings.full_scale_adu)
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from error
    elif wanted not in offered:
        raise ConfigError(f'{name} has no pixel_format = "{wanted}": it offers {", ".join(offered)}')
    elif full_scale_of(wanted) != settings.full_scale_adu:
        raise ConfigError(
            f'{name}: pixel_format = "{wanted}" goes to {full_scale_of(wanted):g}, but full_scale_adu = '
            f"{settings.full_scale_adu:g}: change one of them"
        )
    _set_text(device, "PixelFormat", wanted, name)
    return wanted


def _set_integer(device: Device, feature: str, key: str, value: int, name: str, highest: int | None = None) -> None:
    """Set a feature, after looking whether the camera takes the value; `highest` is a limit it may not tell."""
    low, high, step = device.integer_range(feature)
    if highest is not None:
        high = min(high, highest)
    if not low <= value <= high or (value - low) % step:
        steps = f" in steps of {step}" if step > 1 else ""
        raise ConfigError(f"{name} cannot do {key} = {value}: its {feature} goes from {low} to {high}{steps}")
    device.set_integer(feature, value)
    _check(key, value, device.integer(feature), name)


def _set_binning(device: Device, settings: CameraSettings, name: str) -> None:
    for feature in ("BinningHorizontal", "BinningVertical"):
        if device.has(feature):
            _set_integer(device, feature, "binning", settings.binning, name)
        elif settings.binning != 1:
            raise ConfigError(f"{name} cannot do binning = {settings.binning}: it has no {feature}")


def _set_region(device: Device, settings: CameraSettings, name: str) -> None:
    """Set the region of interest: first its size, as where it may lie depends on that."""
    offset_px = settings.offset_px or (None, None)
    axes = (("columns", "Width", "OffsetX"), ("rows", "Height", "OffsetY"))
    for (key, size_feature, offset_feature), size_px, wanted_px in zip(
        axes, (settings.columns, settings.rows), offset_px, strict=True
    ):
        has_offset = device.has(offset_feature)
        if has_offset:
            device.set_integer(offset_feature, device.integer_range(offset_feature)[0])
        _, widest_px, _ = device.integer_range(size_feature)
        _set_integer(device, size_feature, key, size_px, name)
        if has_offset:
            low, _, step = device.integer_range(offset_feature)
            highest = low + widest_px - size_px
            centred = low + (highest - low) // 2 // step * step
            offset = centred if wanted_px is None else wanted_px
            _set_integer(device, offset_feature, "offset_px", offset, name, highest)
        elif wanted_px:
            raise ConfigError(f"{name} cannot do offset_px = {settings.offset_px}: it has no {offset_feature}")


def _set_gain(device: Device, settings: CameraSettings, name: str) -> None:
    if not device.has_gain():
        if settings.gain is not None:
            raise ConfigError(f"{name} cannot do gain = {settings.gain:g}: it has no gain that can be set")
        return
    low, high = device.gain_range()
    gain = low if settings.gain is None else settings.gain
    if not low <= gain <= high:
        raise ConfigError(f"{name} cannot do gain = {gain:g}: it goes from {low:g} to {high:g}")
    present = device.set_gain(gain)
    if not math.isclose(present, gain, rel_tol=GAIN_TOLERANCE, abs_tol=GAIN_TOLERANCE):
        raise ConfigError(f"{name} did not take gain = {gain:g}: it has {present:g}")

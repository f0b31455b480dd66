"""From a config to the cameras of the telescope: drivers are loaded when a config asks for them, not before."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from typing import Literal

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.errors import ConfigError, DeviceFaultError, NamodError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.devices.cameras.lifeline import Lifeline
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.devices.usb_reset import reset_for

Role = Literal["star", "reflector", "psf"]

CAMERA_CLASSES = {
    "pylon": "PylonCamera",
    "genicam": "GenicamCamera",
    "ueye": "UeyeCamera",
    "alpaca": "AlpacaCamera",
    "indi": "IndiCamera",
    "opencv": "OpencvCamera",
    "folder": "FolderCamera",
}
"""By driver; each in the module of its driver's name."""


def has_cameras(config: InstrumentConfig) -> bool:
    """True when the config names the devices of both cameras, and these look at a sky.

    Raises
    ------
    ConfigError
        It names only one: half a telescope records nothing.
    """
    devices = {"star_camera": config.star_camera.device, "reflector_camera": config.reflector_camera.device}
    missing = [name for name, device in devices.items() if device is None or device.fed_by_twin]
    if len(missing) == 1:
        if devices[missing[0]] is not None:
            raise ConfigError(
                f"{missing[0]}.device: fed_by_twin = true, but the other camera looks at a sky; say it of both or of "
                "none, or take the digital twin with --twin"
            )
        raise ConfigError(
            f"{missing[0]}.device: the config names the device of the other camera only; add this one, or record the "
            "digital twin with --twin"
        )
    return not missing


def camera_settings(config: InstrumentConfig, role: Role) -> CameraSettings:
    """What the driver of that camera is told. Raises ConfigError when the config names no device for it."""
    camera = {"star": config.star_camera, "reflector": config.reflector_camera, "psf": config.psf_camera}[role]
    device = None if camera is None else camera.device
    if camera is None or device is None:
        raise ConfigError(
            f'the config names no device for the {role} camera; add [{role}_camera.device] driver = "..."'
        )
    return CameraSettings(
        role=role,
        driver=device.driver,
        columns=camera.columns,
        rows=camera.rows,
        full_scale_adu=camera.full_scale_adu,
        serial_number=camera.serial_number,
        address=device.address,
        device=device.device,
        pixel_format=device.pixel_format,
        gain=device.gain,
        offset_px=device.offset_px,
        binning=device.binning or 1,
        exposure_range_s=device.exposure_range_s,
    )


def open_driver(settings: CameraSettings, clock: MonotonicClock) -> Camera:
    """The camera itself, open and configured.

    Raises
    ------
    ConfigError
        A setting is refused, or the maker's library is missing.
    DeviceFaultError
        There is no such camera.
    """
    module = importlib.import_module(f"namod_ctl.devices.cameras.{settings.driver}_camera")
    make: Callable[[CameraSettings, MonotonicClock], Camera] = getattr(module, CAMERA_CLASSES[settings.driver])
    return make(settings, clock)


def open_camera(config: InstrumentConfig, role: Role, clock: MonotonicClock) -> Camera:
    """One camera of the config; it is opened again by itself when it gets lost. Raises what `open_driver` raises."""
    return open_again_when_lost(camera_settings(config, role), clock)


def open_again_when_lost(settings: CameraSettings, clock: MonotonicClock) -> Camera:
    """The camera, which is opened again by itself when it gets lost. Raises what `open_driver` raises."""
    reset = reset_for(settings.driver, settings.serial_number)
    return Lifeline(partial(open_driver, settings, clock), clock, reset)


def open_cameras(config: InstrumentConfig, clock: MonotonicClock) -> tuple[Camera, Camera]:
    """The star and the reflector camera of the config; both or none.

    Raises
    ------
    ConfigError, DeviceFaultError
        What is wrong with either, or with both together.
    """
    opened: dict[Role, Camera] = {}
    failed: list[NamodError] = []
    roles: tuple[Role, Role] = ("star", "reflector")
    try:
        for role in roles:
            try:
                opened[role] = open_camera(config, role, clock)
            except (ConfigError, DeviceFaultError) as error:
                failed.append(error)  # a person who mends one wants to know of the other
        if failed:
            raise type(failed[0])("\n".join(map(str, failed)))
    except BaseException:
        for camera in opened.values():
            camera.close()
        raise
    return opened["star"], opened["reflector"]

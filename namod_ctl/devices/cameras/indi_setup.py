"""Finds a camera on an INDI server and sets it up, each value read back.

Source: INDI standard properties (CCD_FRAME in pixels of the sensor, before binning).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from namod_ctl.core.errors import ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.indi_client import IndiClient, IndiProperty
from namod_ctl.devices.cameras.settings import CameraSettings

EXPOSURE, ABORT, FRAME_BLOB = "CCD_EXPOSURE", "CCD_ABORT_EXPOSURE", "CCD1"
EXPOSURE_VALUE = "CCD_EXPOSURE_VALUE"
_GAINS: Final = (("CCD_GAIN", "GAIN"), ("CCD_CONTROLS", "Gain"))
_SWITCHES: Final = (  # what a camera may have: sends its frames here, as plain FITS, of light, one at a time
    ("UPLOAD_MODE", "UPLOAD_CLIENT"),
    ("CCD_TRANSFER_FORMAT", "FORMAT_FITS"),
    ("CCD_COMPRESSION", "INDI_DISABLED"),
    ("CCD_FRAME_TYPE", "FRAME_LIGHT"),
    ("CCD_FAST_TOGGLE", "INDI_DISABLED"),
)
_IS_CCD: Final = 2  # bit of DRIVER_INTERFACE
_DEFINED_WITHIN_S: Final = 3.0
_ALL_DEFINED_S: Final = 0.5  # nothing tells that a server has listed all its devices
_CONNECTED_WITHIN_S: Final = 15.0  # cameras with coolers take their time
_TAKEN_WITHIN_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class IndiSetup:
    """A camera as it was set up.

    Attributes
    ----------
    corner
        The frame's upper left corner on the sensor (x, y), in pixels before binning.
    """

    device: str
    exposure_range_s: tuple[float, float]
    corner: tuple[int, int]


def cameras_of(client: IndiClient) -> list[str]:
    """Names of the cameras on the server."""
    return [device for device in client.devices() if _is_camera(client.find(device, "DRIVER_INFO"))]


def await_devices(client: IndiClient) -> None:
    """Return when the server has listed its devices."""
    if client.wait(client.devices, _DEFINED_WITHIN_S):
        client.wait(lambda: False, _ALL_DEFINED_S)


def set_up(client: IndiClient, settings: CameraSettings, who: str) -> IndiSetup:
    """Connect the camera and set it to `settings`.

    Raises
    ------
    ConfigError
        The camera cannot do what is asked for, or did not take it; or the config does not say which.
    DeviceFaultError
        There is no such camera, the text lists those there are; or it cannot be connected.
    """
    device = _choose(client, settings, who)
    client.send(device, "CONNECTION", {"CONNECT": "On", "DISCONNECT": "Off"})
    needed = (EXPOSURE, ABORT, FRAME_BLOB, "CCD_INFO", "CCD_FRAME", "CCD_BINNING")
    client.wait(
        lambda: (
            _has_failed(client.find(device, "CONNECTION"))
            or (
                all(client.find(device, name) for name in needed)
                and _number(client, device, "CCD_INFO", "CCD_MAX_X") > 0
            )
        ),
        _CONNECTED_WITHIN_S,
    )
    connection = client.find(device, "CONNECTION")
    if connection is None or connection.values.get("CONNECT") != "On":
        raise DeviceFaultError(f"{who}: the server cannot connect its camera: {_why(client)}")
    missing = [name for name in needed if client.find(device, name) is None]
    if missing:
        raise DeviceFaultError(f"{who}: it has no {', '.join(missing)}: {_why(client)}")
    for name, member in _SWITCHES:
        present = client.find(device, name)
        if present is not None and member in present.values:
            _set(client, device, name, {each: "On" if each == member else "Off" for each in present.values}, who)
    corner = _fix_frame(client, device, settings, who)
    _fix_gain(client, device, settings, who)
    client.enable_blobs(device, FRAME_BLOB)
    exposure = client.find(device, EXPOSURE)
    assert exposure is not None
    return IndiSetup(device, exposure.limits[EXPOSURE_VALUE], corner)


def _choose(client: IndiClient, settings: CameraSettings, who: str) -> str:
    where = f"[{settings.role}_camera.device] device"
    if settings.serial_number is not None:
        raise ConfigError(
            f'{who}: serial_number = "{settings.serial_number}": INDI does not tell serial numbers; leave it out, and '
            f"name the camera with {where}"
        )
    if settings.device is not None:
        if client.wait(lambda: client.find(settings.device or "", "CONNECTION"), _DEFINED_WITHIN_S):
            return settings.device
        raise DeviceFaultError(
            f'{who}: it has no device "{settings.device}"; it has {_in_words(client.devices())}; correct {where}'
        )
    await_devices(client)
    found = cameras_of(client)
    if not found:
        raise DeviceFaultError(
            f"{who}: it has no camera; it has {_in_words(client.devices())}; start its camera driver"
        )
    if len(found) > 1:
        raise ConfigError(f"{who}: it has several cameras: {_in_words(found)}; say which one with {where}")
    return found[0]


def _fix_frame(client: IndiClient, device: str, settings: CameraSettings, who: str) -> tuple[int, int]:
    """Set depth, binning and region of interest; the region's corner on the sensor."""
    if settings.pixel_format is not None:
        raise ConfigError(f'{who}: pixel_format = "{settings.pixel_format}": INDI cameras choose theirs; leave it out')
    bits = int(_number(client, device, "CCD_INFO", "CCD_BITSPERPIXEL"))
    if settings.full_scale_adu > 2**bits - 1:
        raise ConfigError(
            f"{who}: full_scale_adu = {settings.full_scale_adu:g}, but its pixels have {bits} bit; "
            f"set full_scale_adu = {2**bits - 1}, or less for a camera with fewer bits than it transmits"
        )
    binning = settings.binning
    sensor_x = int(_number(client, device, "CCD_INFO", "CCD_MAX_X"))
    sensor_y = int(_number(client, device, "CCD_INFO", "CCD_MAX_Y"))
    columns, rows = sensor_x // binning, sensor_y // binning
    x, y = settings.offset_px or ((columns - settings.columns) // 2, (rows - settings.rows) // 2)
    if min(x, y) < 0 or x + settings.columns > columns or y + settings.rows > rows:
        raise ConfigError(
            f"{who}: a frame of {settings.columns} x {settings.rows} pixels at ({x}, {y}) does not fit on its sensor "
            f"of {columns} x {rows} (binning {binning}); correct columns, rows or offset_px"
        )
    _set(client, device, "CCD_BINNING", {"HOR_BIN": binning, "VER_BIN": binning}, who)
    corner = (x * binning, y * binning)
    size = {"WIDTH": settings.columns * binning, "HEIGHT": settings.rows * binning}
    _set(client, device, "CCD_FRAME", {"X": corner[0], "Y": corner[1], **size}, who)
    return corner


def _fix_gain(client: IndiClient, device: str, settings: CameraSettings, who: str) -> None:
    for name, member in _GAINS:
        present = client.find(device, name)
        if present is None or member not in present.limits:
            continue
        gain = present.limits[member][0] if settings.gain is None else settings.gain
        _set(
            client, device, name, {**{each: float(value) for each, value in present.values.items()}, member: gain}, who
        )
        return
    if settings.gain is not None:
        raise ConfigError(f"{who}: gain = {settings.gain:g}, but this camera's gain cannot be set; leave it out")


def _set(client: IndiClient, device: str, name: str, members: Mapping[str, str | float], who: str) -> None:
    """Ask for these values and wait until the device has them. Raises ConfigError when it will not."""
    before = client.find(device, name)
    n_updates = -1 if before is None else before.n_updates
    for member, (lowest, highest) in ({} if before is None else before.limits).items():
        value = members.get(member, lowest)
        if lowest < highest and isinstance(value, int | float) and not lowest <= value <= highest:
            raise ConfigError(f"{who}: {name} {member} = {value:g}, but it takes {lowest:g} to {highest:g}")
    client.send(device, name, members)

    def is_answered() -> bool:
        present = client.find(device, name)
        if present is None or present.n_updates <= n_updates or present.state == "Busy":
            return False
        return present.state == "Alert" or _has(present, members)

    client.wait(is_answered, _TAKEN_WITHIN_S)
    present = client.find(device, name)
    if client.lost:
        raise DeviceFaultError(f"{who}: {client.lost} while it was set up")
    if present is None or not is_answered() or not _has(present, members):
        values = {} if present is None else dict(present.values)
        raise ConfigError(f"{who}: {name} = {dict(members)} was set, but it stays at {values}: {_why(client)}")


def _has(present: IndiProperty, members: Mapping[str, str | float]) -> bool:
    return all(
        value == present.values.get(member)
        if isinstance(value, str)
        else value == float(present.values.get(member, "nan"))
        for member, value in members.items()
    )


def _number(client: IndiClient, device: str, name: str, member: str) -> float:
    present = client.find(device, name)
    return 0.0 if present is None else float(present.values.get(member, "0"))


def _is_camera(driver_info: IndiProperty | None) -> bool:
    interface = "" if driver_info is None else driver_info.values.get("DRIVER_INTERFACE", "")
    return interface.isdecimal() and bool(int(interface) & _IS_CCD)


def _has_failed(connection: IndiProperty | None) -> bool:
    return connection is not None and connection.state == "Alert"


def _why(client: IndiClient) -> str:
    return client.lost or client.messages or "it does not say why"


def _in_words(names: list[str]) -> str:
    return ", ".join(f'"{name}"' for name in names) or "none"

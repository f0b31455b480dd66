"""Finds a camera on an Alpaca server and sets it up: what it can do, what was asked for, what it took."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from namod_ctl.core.errors import ConfigError, DeviceFaultError
from namod_ctl.devices.cameras.alpaca_http import NOT_IMPLEMENTED, AlpacaDevice, AlpacaRefusalError
from namod_ctl.devices.cameras.settings import CameraSettings

_CONNECT_TIMEOUT_S: Final = 15.0  # cameras with coolers take their time
_MOST_ADU: Final = 65535.0  # of a frame
Value = TypeVar("Value")
_GREY, _COLOUR, _RGGB = 0, 1, 2  # ASCOM's SensorType
_TILES = {(0, 0): "RG", (1, 0): "GR", (0, 1): "GB", (1, 1): "BG"}  # by the first pixel's place in the pattern


@dataclass(frozen=True, slots=True)
class AlpacaSetup:
    """A camera as it was set up.

    Attributes
    ----------
    model
        The server's name for it.
    tile
        The frame's Bayer pattern, "RG", "GR", "GB" or "BG"; None: it has none.
    values
        What was set, by the names of Alpaca's properties.
    """

    model: str
    exposure_range_s: tuple[float, float]
    can_abort: bool
    tile: str | None
    values: dict[str, Any]

    def has_changed(self, device: AlpacaDevice) -> str:
        """What is no longer as it was set, in words; empty when nothing is. Raises what requests raise."""
        for name, value in self.values.items():
            present = device.get(name.lower())
            if present != value:
                return f"its {name} is {present} where {value} was set"
        return ""


def camera_number(server: AlpacaDevice, settings: CameraSettings, who: str) -> int:
    """The device number of the camera that the config means.

    Raises
    ------
    ConfigError
        The config does not say which of several, or names none.
    DeviceFaultError
        The server has no such camera; the text lists those it has.
    """
    where = f"[{settings.role}_camera.device] device"
    if settings.device is not None and not settings.device.isdecimal():
        raise ConfigError(
            f'{where} = "{settings.device}" is no device number of Alpaca; write for example device = "0"'
        )
    if settings.device is not None and settings.serial_number is None:
        return int(settings.device)
    try:
        found = cameras_of(server)
    except AlpacaRefusalError as error:
        raise ConfigError(
            f'{who}: it has no list of its devices ({error}); say which one with {where} = "0" '
            "and leave out serial_number"
        ) from error
    chosen = [
        entry
        for entry in found
        if settings.serial_number in (None, entry.get("UniqueID"))
        and (settings.device is None or int(settings.device) == entry.get("DeviceNumber"))
    ]
    if not chosen:
        raise DeviceFaultError(
            f"{who}: it has no such camera; it has {in_words(found)}; correct {where} or serial_number"
        )
    if len(chosen) > 1:
        raise ConfigError(f"{who}: it has several cameras: {in_words(chosen)}; say which one with {where}")
    return int(chosen[0]["DeviceNumber"])


def cameras_of(server: AlpacaDevice) -> list[dict[str, Any]]:
    """The cameras in the server's list of devices; raises what requests raise."""
    return [entry for entry in server.configured_devices() if str(entry.get("DeviceType", "")).lower() == "camera"]


def in_words(cameras: list[dict[str, Any]]) -> str:
    """Cameras from a server's list, for a person."""
    entries = [
        f"number {entry.get('DeviceNumber')}: {entry.get('DeviceName')} (serial_number {entry.get('UniqueID')})"
        for entry in cameras
    ]
    return ", ".join(entries) or "none"


def set_up(device: AlpacaDevice, settings: CameraSettings, who: str) -> AlpacaSetup:
    """Connect the camera and set it to `settings`, each value read back.

    Raises
    ------
    ConfigError
        The camera cannot do what is asked for, or did not take it.
    DeviceFaultError
        It cannot be connected.
    """
    try:
        device.put("connected", _CONNECT_TIMEOUT_S, Connected=True)
        if not device.flag("connected"):
            raise DeviceFaultError(f"{who}: it was told to connect to its camera and did not: is it plugged in?")
        return _set_up_connected(device, settings, who)
    except AlpacaRefusalError as error:
        raise DeviceFaultError(f"{who}: the server refuses: {error}") from error


def _set_up_connected(device: AlpacaDevice, settings: CameraSettings, who: str) -> AlpacaSetup:
    if settings.pixel_format is not None:
        raise ConfigError(f'{who}: pixel_format = "{settings.pixel_format}": Alpaca knows none; leave it out')
    max_adu = device.quantity("maxadu")
    if max_adu - settings.full_scale_adu not in (0.0, 1.0):  # 1: some say how many values there are
        raise ConfigError(
            f"{who}: full_scale_adu = {settings.full_scale_adu:g}, but its MaxADU is {max_adu:g}; "
            f"set full_scale_adu = {min(max_adu, _MOST_ADU):g}"
        )
    binning = settings.binning
    most = int(min(device.quantity("maxbinx"), device.quantity("maxbiny")))
    if binning > most:
        raise ConfigError(f"{who}: binning = {binning}, but it bins at most {most}; choose less")
    offset_x, offset_y = _offset(device, settings, who)
    values: dict[str, Any] = {"BinX": binning, "BinY": binning}
    values |= {"NumX": settings.columns, "NumY": settings.rows, "StartX": offset_x, "StartY": offset_y}
    for name, value in values.items():
        _set(device, name, value, who)
    gain = _fix_gain(device, settings, who)
    return AlpacaSetup(
        model=str(device.get("name")),
        exposure_range_s=(float(device.quantity("exposuremin")), float(device.quantity("exposuremax"))),
        can_abort=device.flag("canabortexposure"),
        tile=_tile(device, settings, (offset_x, offset_y), who),
        values=values if gain is None else values | {"Gain": gain},
    )


def _offset(device: AlpacaDevice, settings: CameraSettings, who: str) -> tuple[int, int]:
    """The frame's upper left corner, in binned pixels."""
    columns = int(device.quantity("cameraxsize")) // settings.binning
    rows = int(device.quantity("cameraysize")) // settings.binning
    if settings.offset_px is None:
        offset = ((columns - settings.columns) // 2, (rows - settings.rows) // 2)
    else:
        offset = settings.offset_px
    if min(offset) < 0 or offset[0] + settings.columns > columns or offset[1] + settings.rows > rows:
        raise ConfigError(
            f"{who}: a frame of {settings.columns} x {settings.rows} pixels at {offset} does not fit on its sensor of "
            f"{columns} x {rows} (binning {settings.binning}); correct columns, rows or offset_px"
        )
    return offset


def _fix_gain(device: AlpacaDevice, settings: CameraSettings, who: str) -> int | None:
    """The gain that was set: the asked one, else the lowest; None for a camera that has none to set."""
    asked = None if settings.gain is None else round(settings.gain)
    if settings.gain is not None and asked != settings.gain:
        raise ConfigError(f"{who}: gain = {settings.gain:g}: the gains of Alpaca cameras are whole numbers")
    lowest = _optional(device.quantity, "gainmin")
    if lowest is None and _optional(device.get, "gains"):
        lowest = 0.0  # the number of the first in its list
    if lowest is None:
        if asked is not None:
            raise ConfigError(f"{who}: gain = {asked}, but this camera's gain cannot be set; leave it out")
        return None
    gain = int(lowest) if asked is None else asked
    _set(device, "Gain", gain, who)
    return gain


def _tile(device: AlpacaDevice, settings: CameraSettings, offset: tuple[int, int], who: str) -> str | None:
    """The Bayer pattern of the frame from its first pixel on; None when it has none."""
    sensor = _optional(device.quantity, "sensortype") or _GREY
    if sensor in (_GREY, _COLOUR):
        return None
    if sensor != _RGGB:
        raise ConfigError(f"{who}: its SensorType {sensor} (a mosaic other than red-green-green-blue) cannot be read")
    if settings.binning > 1:
        raise ConfigError(f"{who}: binning = {settings.binning} mixes the colours of its Bayer sensor; set binning = 1")
    place_x = (int(device.quantity("bayeroffsetx")) + offset[0]) % 2
    place_y = (int(device.quantity("bayeroffsety")) + offset[1]) % 2
    return _TILES[place_x, place_y]


def _set(device: AlpacaDevice, name: str, value: int, who: str) -> None:
    try:
        device.put(name.lower(), **{name: value})
    except AlpacaRefusalError as error:
        raise ConfigError(f"{who}: it refuses {name} = {value}: {error}") from error
    present = device.get(name.lower())
    if present != value:
        raise ConfigError(f"{who}: {name} = {value} was set, but it stays at {present}")


def _optional(ask: Callable[[str], Value], name: str) -> Value | None:
    """The property's value; None when the device does not have it."""
    try:
        return ask(name)
    except AlpacaRefusalError as error:
        if error.number == NOT_IMPLEMENTED:
            return None
        raise

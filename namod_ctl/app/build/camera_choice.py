"""The one camera that a command works with: of the config, of the twin, or named by driver and serial number."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np

from namod_ctl.app.build.bench_sky import twin_equipment
from namod_ctl.app.build.cameras import CAMERA_CLASSES, Role, open_again_when_lost, open_camera
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.core.units import deg_to_rad
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.settings import TwinSettings

DEFAULT_CONFIG = "fact"
DEFAULT_SIZE = "1024x768"
TWIN_SEED = 1
UNKNOWN_STAR_PX = 8.0
"""Diameter of a star in a camera of which no config tells; `cycle.focus` finds stars of other sizes from there."""

_ADDRESSES = ("alpaca", "genicam")
_ONLY_ADDRESSES = ("indi", "opencv", "folder")
"""Drivers that find their cameras by an address; the others know serial numbers only."""
_SIZE = re.compile(r"([0-9]{2,5})x([0-9]{2,5})")


@dataclass(frozen=True, slots=True)
class ChosenCamera:
    """An open camera, and what is known of it.

    Attributes
    ----------
    model
        Of the config; without one a linear camera whose plate scale means nothing.
    star_size_rad
        Diameter of a star in it.
    has_plate_scale
        Angles mean something.
    """

    camera: Camera
    model: CameraModel
    star_size_rad: float
    clock: MonotonicClock
    has_plate_scale: bool


@contextmanager
def open_chosen(
    name: str, config: str | None, size: str, full_scale_adu: float, *, is_twin: bool
) -> Iterator[ChosenCamera]:
    """The camera "star" or "reflector" (of the config or its twin), or "driver:serial number"; closed in the end.

    Parameters
    ----------
    size, full_scale_adu
        Of the frames of a camera that no config describes.

    Raises
    ------
    ConfigError, DeviceFaultError
        There is no such camera.
    """
    with ExitStack() as stack:
        if ":" not in name:
            chosen = _of_config(stack, name, config, is_twin=is_twin)
        elif is_twin or config is not None:
            raise ConfigError(
                f"camera {name}: a driver and its camera need neither --config nor --twin; leave them out"
            )
        else:
            chosen = _of_driver(name, size, full_scale_adu)
        stack.callback(chosen.camera.close)
        yield chosen


def _of_config(stack: ExitStack, name: str, config: str | None, *, is_twin: bool) -> ChosenCamera:
    roles: dict[str, Role] = {"star": "star", "reflector": "reflector"}
    if name not in roles:
        raise ConfigError(
            f"camera {name!r}: write star or reflector for those of the config, or driver:serial-number such as "
            "pylon:21979447; namod-ctl devices lists what is there"
        )
    loaded = load_config(config or DEFAULT_CONFIG)
    instrument = build_instrument(loaded)
    model, device = instrument.star_camera, loaded.star_camera.device
    if name == "reflector":
        model, device = instrument.reflector_camera, loaded.reflector_camera.device
    if is_twin or (device is not None and device.fed_by_twin):
        twin = build_twin(loaded, TwinSettings(), TWIN_SEED)
        both = stack.enter_context(twin_equipment(loaded, twin))()
        camera, other = both.star_camera, both.reflector_camera
        if name == "reflector":
            camera, other = other, camera
        other.close()
        return ChosenCamera(camera, model, instrument.star_size_rad, twin.clock, True)
    clock = SystemMonotonicClock()
    return ChosenCamera(open_camera(loaded, roles[name], clock), model, instrument.star_size_rad, clock, True)


def _of_driver(name: str, size: str, full_scale_adu: float) -> ChosenCamera:
    driver, _, which = name.partition(":")
    if driver not in CAMERA_CLASSES:
        raise ConfigError(f"camera {name!r}: there is no driver {driver!r}; there are {', '.join(CAMERA_CLASSES)}")
    match = _SIZE.fullmatch(size)
    if match is None:
        raise ConfigError(f"--size {size}: write columns x rows, such as {DEFAULT_SIZE}")
    columns, rows = int(match[1]), int(match[2])
    has_address = driver in _ONLY_ADDRESSES or (driver in _ADDRESSES and any(mark in which for mark in ":/."))
    address, _, device = which.partition("#") if has_address else ("", "", "")
    clock = SystemMonotonicClock()
    settings = CameraSettings(
        role="star",
        driver=driver,
        columns=columns,
        rows=rows,
        full_scale_adu=full_scale_adu,
        serial_number=None if has_address or not which else which,
        address=address or None,
        device=device or None,
    )
    model = CameraModel(
        name=name,
        n_columns=columns,
        n_rows=rows,
        plate_scale_rad=deg_to_rad(1.0),
        axis_pixel=np.array([columns / 2.0, rows / 2.0]),
        axis_is_calibrated=False,
        orientation=CameraOrientation(0.0, False),
        law=RadiometricLaw(1.0, -1.0, 0.0),
        full_scale_adu=full_scale_adu,
    )
    camera = open_again_when_lost(settings, clock)
    return ChosenCamera(camera, model, deg_to_rad(UNKNOWN_STAR_PX), clock, False)

"""The twin's sky in front of a maker's cameras: real libraries and drivers work on pictures that the twin has made.

A camera of the bench is a twin's camera and an emulated one of a maker's library. What the twin's camera sees is
written into a file, the library's camera reads it when it is triggered, and the frame comes back through the library
and our driver. So a whole campaign runs through them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.cameras import Role, camera_settings
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import Camera, Exposure
from namod_ctl.cycle.record import Equipment
from namod_ctl.devices.cameras.lifeline import Lifeline
from namod_ctl.devices.cameras.pylon_camera import PylonCamera
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.twin.twin import Twin

HURRY = 100.0
"""The twin's exposures take so much longer than those of the library's camera, which is told and makes the hundredth
part: light comes from the twin alone, there the exposure only lets time pass, and a night is to be over in minutes."""
PICTURE_FULL_SCALE_ADU = 255.0
EMULATED_CAMERAS = "2"

_NAMES = ("sky.bmp", "sky_again.bmp")
"""The library reads a picture anew only when it goes on to another name (pypylon 26.9); both are the same file."""


class FedCamera:
    """A camera that sees what a twin's camera sees.

    Parameters
    ----------
    twin_camera
        Makes the picture, with the exposure asked for, and knows the time.
    camera
        Is shown the picture; its frame is what counts.
    folder
        From which `camera` takes its pictures.
    """

    def __init__(self, twin_camera: Camera, camera: Camera, folder: Path) -> None:
        self._twin_camera, self._camera = twin_camera, camera
        self._picture = folder / _NAMES[0]
        self._unfinished = folder.with_suffix(".part")

    @property
    def name(self) -> str:
        """Of the camera, not of the twin's."""
        return f"{self._camera.name} under the twin's sky"

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """What both cameras can do."""
        shortest_s, longest_s = self._camera.exposure_range_s
        twin_shortest_s, twin_longest_s = self._twin_camera.exposure_range_s
        return max(shortest_s * HURRY, twin_shortest_s), min(longest_s * HURRY, twin_longest_s)

    def start(self, exposure_s: float) -> None:
        """Begin an exposure on the twin's clock. Raises LimitError, DeviceFaultError."""
        self._twin_camera.start(exposure_s)

    def fetch(self, timeout_s: float) -> Exposure:
        """The frame of the picture that the twin's camera made, with the twin's times.

        Raises CommunicationError, DeviceFaultError: those of the twin's faults as well as of the real driver.
        """
        seen = self._twin_camera.fetch(timeout_s)
        show(seen.image, self._picture, self._unfinished)
        self._camera.start(seen.exposure_s / HURRY)
        frame = self._camera.fetch(timeout_s)
        return Exposure(frame.image, seen.exposure_s, seen.mid_exposure_s, frame.frame_id)

    def close(self) -> None:
        """Close both."""
        self._twin_camera.close()
        self._camera.close()


@contextmanager
def twin_equipment(config: InstrumentConfig, twin: Twin) -> Iterator[Callable[[], Equipment]]:
    """What opens the equipment of a recording on a twin, anew for each, as recordings close their cameras.

    The cameras are the twin's own, or where the config says `fed_by_twin` those of a maker's library. These are opened
    here for a first time, so that nothing is begun with cameras that cannot be used, and again by themselves when they
    get lost.

    Raises
    ------
    ConfigError
        A camera does not take a setting, or its library is missing.
    DeviceFaultError
        There is no such camera.
    """
    with TemporaryDirectory(prefix="namod_bench_") as folder:

        def open_equipment() -> Equipment:
            return _open(config, twin, Path(folder))

        tried = open_equipment()
        tried.star_camera.close()
        tried.reflector_camera.close()
        yield open_equipment


def show(image: NDArray[np.unsignedinteger[Any]], picture: Path, unfinished: Path) -> None:
    """Put an image of 8 bit where a camera takes its pictures from, at once: `unfinished` is its name before."""
    _, data = cv2.imencode(".bmp", image)
    unfinished.write_bytes(data.tobytes())
    unfinished.replace(picture)


def _open(config: InstrumentConfig, twin: Twin, folder: Path) -> Equipment:
    star = _bench_camera(config, "star", twin.star_camera, twin, folder)
    try:
        reflector = _bench_camera(config, "reflector", twin.reflector_camera, twin, folder)
    except BaseException:
        star.close()
        raise
    return Equipment(star, reflector, twin.clock, twin.wall_clock)


def _bench_camera(config: InstrumentConfig, role: Role, twin_camera: Camera, twin: Twin, folder: Path) -> Camera:
    section = config.star_camera if role == "star" else config.reflector_camera
    if section.device is None or not section.device.fed_by_twin:
        return twin_camera
    settings = camera_settings(config, role)
    if settings.full_scale_adu != PICTURE_FULL_SCALE_ADU:
        raise ConfigError(
            f"{role}_camera: full_scale_adu = {settings.full_scale_adu:g}; the twin's pictures are shown to cameras "
            f"with {PICTURE_FULL_SCALE_ADU:g} only"
        )
    own = folder / role
    own.mkdir(exist_ok=True)
    (own / _NAMES[1]).unlink(missing_ok=True)
    (own / _NAMES[1]).symlink_to(_NAMES[0])
    show(np.zeros((settings.rows, settings.columns), dtype=np.uint8), own / _NAMES[0], own.with_suffix(".part"))
    return FedCamera(twin_camera, Lifeline(partial(_fed_pylon_camera, settings, own), twin.clock), own)


def _fed_pylon_camera(settings: CameraSettings, folder: Path) -> PylonCamera:
    os.environ.setdefault("PYLON_CAMEMU", EMULATED_CAMERAS)
    camera = PylonCamera(settings, SystemMonotonicClock())
    try:
        camera.show_pictures(folder)
    except BaseException:
        camera.close()
        raise
    return camera

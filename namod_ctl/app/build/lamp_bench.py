"""A camera of the config before a lamp: with a person who moves it, or the twin's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from namod_ctl.app.build.cameras import open_camera
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.schema import RecordingSection
from namod_ctl.calibration.lamp.lamp_series import Placement
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.cycle.lamp_recording import LampBench
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.twin.lamp import LampSettings, TwinLamp
from namod_ctl.twin.settings import REFLECTOR_CAMERA, STAR_CAMERA

TWIN_SEED = 1
TWIN_DISTANCE_ERROR_M = 0.002
"""How well the twin's person sets distances: as with a tape measure."""

MIDDLE_DISTANCE_M, MIDDLE_SHARE, MIDDLE_EXPOSURE_S = 1.5, 0.8, 0.15
"""The twin's lamp is so bright that at this distance this exposure leads to this share of full scale."""

N_COLOURS = 3


@dataclass(frozen=True, slots=True)
class CameraAtBench:
    """An open camera, who handles its lamp, and the exposures it can make."""

    camera: Camera
    clock: MonotonicClock
    bench: LampBench
    model: CameraModel
    exposure_range_s: tuple[float, float]


class Person:
    """Somebody at the bench, told what to do by `ask`, which returns when it is done."""

    def __init__(self, ask: Callable[[str], None]) -> None:
        self._ask = ask
        self._is_capped = False

    def cap(self) -> None:
        """Return when the cap is on."""
        self._ask("Put the cap on the lens, lights off.")
        self._is_capped = True

    def place(self, placement: Placement) -> None:
        """Return when the lamp stands there."""
        cap = "Take the cap off, put the diffuser before the lens. " if self._is_capped else ""
        self._is_capped = False
        what = f"{placement.words} from the diffuser" if placement.distance_m is not None else placement.words
        self._ask(f"{cap}Lamp: {what}.")


class _TwinPerson:
    """The same of the twin."""

    def __init__(self, lamp: TwinLamp) -> None:
        self._lamp = lamp

    def cap(self) -> None:
        self._lamp.cap()

    def place(self, placement: Placement) -> None:
        if placement.distance_m is not None:
            self._lamp.place(placement.distance_m)
        else:
            self._lamp.set_level(placement.level)


def camera_model_of(config: InstrumentConfig, role: str) -> CameraModel:
    """What the config, with its calibrations, says of the camera "star_camera" or "reflector_camera"."""
    instrument = build_instrument(config)
    return instrument.star_camera if role == "star_camera" else instrument.reflector_camera


@contextmanager
def camera_at_bench(
    config: InstrumentConfig, role: str, ask: Callable[[str], None], *, is_twin: bool
) -> Iterator[CameraAtBench]:
    """The camera of that role, closed in the end.

    Raises
    ------
    ConfigError, DeviceFaultError
        There is no such camera.
    """
    model = camera_model_of(config, role)
    if is_twin:
        lamp = twin_lamp(model, role)
        yield CameraAtBench(lamp, lamp.clock, _TwinPerson(lamp), model, _useful_range(config, lamp))
        return
    section = config.star_camera if role == "star_camera" else config.reflector_camera
    if section.device is not None and section.device.fed_by_twin:
        raise ConfigError(
            f"{role}.device: fed_by_twin = true: this camera sees the twin's sky and no lamp; rehearse with --twin"
        )
    clock = SystemMonotonicClock()
    camera = open_camera(config, "star" if role == "star_camera" else "reflector", clock)
    try:
        yield CameraAtBench(camera, clock, Person(ask), model, _useful_range(config, camera))
    finally:
        camera.close()


def twin_lamp(model: CameraModel, role: str, seed: int = TWIN_SEED) -> TwinLamp:
    """The twin's bench with a camera like that, whose true law is the one of its config."""
    law = model.law
    at_middle = (
        law.r_resp * np.log10(MIDDLE_SHARE)
        + law.r_curve * np.log10(MIDDLE_SHARE) ** 2
        + law.r_expo * np.log10(MIDDLE_EXPOSURE_S)
        + law.r_const
    )
    lamp = LampSettings(
        intensity_at_1m=float(10.0**at_middle) * MIDDLE_DISTANCE_M**2,
        distance_error_m=TWIN_DISTANCE_ERROR_M,
        drift_share_per_hour=0.02,
        cosmic_rays_per_s=1.0,
    )
    settings, n_channels = (STAR_CAMERA, 1) if role == "star_camera" else (REFLECTOR_CAMERA, N_COLOURS)
    return TwinLamp(model, settings, lamp, law, seed, n_channels)


def _useful_range(config: InstrumentConfig, camera: Camera) -> tuple[float, float]:
    """Exposures that a recording may ask for and the camera can make."""
    shortest_s, longest_s = camera.exposure_range_s
    wanted = recording_range_s(config)
    found = max(shortest_s, wanted[0]), min(longest_s, wanted[1])
    if found[0] >= found[1]:
        raise ConfigError(
            f"{camera.name}: makes exposures from {shortest_s:g} to {longest_s:g} s, recordings take {wanted[0]:g} to "
            f"{wanted[1]:g} s; correct recording.shortest_exposure_s and longest_exposure_s"
        )
    return found


def recording_range_s(config: InstrumentConfig) -> tuple[float, float]:
    """Exposures that recordings take."""
    recording = config.recording or RecordingSection()
    return recording.shortest_exposure_s, recording.longest_exposure_s

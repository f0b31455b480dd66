"""A night for the recorder in a few milliseconds: two small cameras, a star that wanders, time that is told.

It shares no code with the twin. Responses follow the published radiometric laws, solved here for the response.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from frames import SIGMA_PX, exposed, gaussian_light
from imaging_instruments import REFLECTOR_CAMERA, STAR_CAMERA, hexagon, instrument, resized
from numpy.typing import NDArray

from namod_ctl.core.errors import NamodError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle.record import Equipment
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.run import RunStore

Array = NDArray[np.float64]

STAR = resized(STAR_CAMERA, 320, 240)
REFLECTOR = resized(REFLECTOR_CAMERA, 160, 120)
FACETS = {1: hexagon(40.3, 40.2, 22.0), 2: hexagon(110.3, 40.2, 22.0), 5: hexagon(75.3, 85.2, 22.0)}
FACET_THETA_RAD = {1: (0.0005, 0.0), 2: (-0.0005, 0.0005), 5: (0.0, -0.0007)}
PSF_RAD = math.radians(0.06)
TELESCOPE = instrument(STAR, REFLECTOR, FACETS)
STAR_NEEDS_S, REFLECTOR_NEEDS_S = 0.04, 0.2
FIRST_MOMENT = datetime(2026, 11, 22, 21, 0, tzinfo=UTC)


def response_adu(camera: CameraModel, needed_s: float, intensity: float, exposure_s: float) -> float:
    """Response to light of that intensity, where light of 1 makes 80 % of full scale in `needed_s`."""
    law = camera.law
    log_full = law.r_resp * math.log10(0.8) + law.r_expo * math.log10(needed_s)
    return 255.0 * 10.0 ** ((log_full + math.log10(intensity) - law.r_expo * math.log10(exposure_s)) / law.r_resp)


class FakeClock:
    """Passes when somebody waits; `setbacks` are (moment, by how much) of the wall clock."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.setbacks: list[tuple[float, float]] = []

    def monotonic_s(self) -> float:
        return self.now_s

    def wait_s(self, duration_s: float) -> None:
        self.now_s += duration_s

    def now(self) -> datetime:
        back_s = sum(by_s for moment_s, by_s in self.setbacks if self.now_s >= moment_s)
        return FIRST_MOMENT + timedelta(seconds=self.now_s - back_s)


Fault = Callable[[float], NamodError | None]


@dataclass
class FakeCamera:
    """Renders what was exposed; `fault` may raise at a moment, `edit` change a frame or its number."""

    role: str
    clock: FakeClock
    render: Callable[[float, float, np.random.Generator], NDArray[np.uint8]]
    exposure_range_s: tuple[float, float] = (1e-3, 3.0)
    fault: Fault = lambda time_s: None
    edit: Callable[[Exposure], Exposure] = lambda exposure: exposure
    n_frames: int = 0
    started: list[tuple[float, float]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"fake {self.role} camera"

    def start(self, exposure_s: float) -> None:
        if error := self.fault(self.clock.now_s):
            raise error
        self.started.append((self.clock.now_s, exposure_s))

    def fetch(self, timeout_s: float) -> Exposure:
        start_s, exposure_s = self.started[-1]
        self.clock.now_s = max(self.clock.now_s, start_s + exposure_s)
        if error := self.fault(self.clock.now_s):
            raise error
        rng = np.random.default_rng([len(self.role), self.n_frames])
        image = self.render(start_s + exposure_s / 2.0, exposure_s, rng)
        self.n_frames += 1
        return self.edit(Exposure(image, exposure_s, start_s + exposure_s / 2.0, self.n_frames))

    def close(self) -> None:
        pass


def wandering(time_s: float) -> Array:
    """A slow circle of 0.1 deg, 0.01 deg per second."""
    return math.radians(0.1) * np.array([math.cos(0.1 * time_s), math.sin(0.1 * time_s)])


class Night:
    """The equipment of one recording, and the truth about it."""

    def __init__(
        self, theta_of: Callable[[float], Array] = wandering, star_of: Callable[[float], float] = lambda t: 1.0
    ):
        self.clock = FakeClock()
        self.theta_of, self.star_of = theta_of, star_of
        self.star = FakeCamera("star", self.clock, self._star_frame)
        self.reflector = FakeCamera("reflector", self.clock, self._reflector_frame)

    @property
    def equipment(self) -> Equipment:
        return Equipment(self.star, self.reflector, self.clock, self.clock)

    def _star_frame(self, time_s: float, exposure_s: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        x, y = STAR.pixel_of_theta(self.theta_of(time_s))
        height = response_adu(STAR, STAR_NEEDS_S, max(self.star_of(time_s), 1e-9), exposure_s)
        light = np.minimum(height * gaussian_light((240, 320), float(x), float(y), SIGMA_PX), 1e4)
        return np.asarray(exposed(light, rng, offset_adu=3.0), dtype=np.uint8)

    def _reflector_frame(self, time_s: float, exposure_s: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        light = np.zeros((120, 160))
        for facet_id, centre in FACET_THETA_RAD.items():
            distance = float(np.hypot(*(self.theta_of(time_s) - centre)))
            share = self.star_of(time_s) * math.exp(-0.5 * (distance / PSF_RAD) ** 2)
            left, top = FACETS[facet_id].min(axis=0).astype(int)
            right, bottom = FACETS[facet_id].max(axis=0).astype(int) + 2
            light[top:bottom, left:right] = response_adu(REFLECTOR, REFLECTOR_NEEDS_S, max(share, 1e-9), exposure_s)
        frame = exposed(np.minimum(light, 1e4), rng, offset_adu=3.0)
        return np.asarray(np.repeat(frame[:, :, None], 3, axis=2), dtype=np.uint8)


def new_run(path: Path, clock: FakeClock) -> RunStore:
    return RunStore.create(path, tuple(FACETS), json.dumps({"telescope": {"name": "TEST"}}), "a fake night", clock)


def with_frame_id(exposure: Exposure, frame_id: int) -> Exposure:
    return replace(exposure, frame_id=frame_id)

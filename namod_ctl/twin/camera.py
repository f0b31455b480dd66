"""A camera of the twin, a `core.interfaces.Camera`: keeps the time of exposures, and has the faults of cameras."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Image, Sensor

Render = Callable[[float, float, np.random.Generator], Image]
"""From start (s), exposure (s) and a random generator to the image."""

MIN_TORN_SHARE, MAX_TORN_SHARE = 0.2, 0.9


class TwinCamera:
    """Renders what was exposed when it is fetched.

    Start all cameras before fetching from any: fetching lets time pass, on the clock they share. `begin` is called when
    an exposure begins.

    Attributes
    ----------
    n_frames
        Frames so far, with those that got lost; seeds the noise of the next, together with its time.
    """

    def __init__(
        self,
        role: str,
        sensor: Sensor,
        clock: ManualClock,
        update: Callable[[float], None],
        render: Render,
        faults: FaultPlan,
        seed: int,
        begin: Callable[[], None] | None = None,
    ) -> None:
        self._role = role
        self._sensor = sensor
        self._clock = clock
        self._update = update
        self._render = render
        self._faults = faults
        self._seed = seed
        self._begin = begin
        self.n_frames = 0
        self._running: tuple[float, float] | None = None

    @property
    def name(self) -> str:
        """Role and model."""
        return f"{self._role} camera of the twin ({self._sensor.camera.name})"

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera can make."""
        return self._sensor.settings.exposure_range_s

    def start(self, exposure_s: float) -> None:
        """Begin an exposure now; a running one is given up. Raises LimitError, DeviceFaultError."""
        now_s = self._clock.monotonic_s()
        self._refuse_lost(now_s)
        shortest_s, longest_s = self.exposure_range_s
        if not shortest_s <= exposure_s <= longest_s:
            raise LimitError(
                f"{self.name}: an exposure of {exposure_s:g} s was asked for; "
                f"it makes {shortest_s:g} to {longest_s:g} s"
            )
        if self._begin is not None:
            self._begin()
        step_s = self._sensor.settings.exposure_step_s
        self._running = (now_s, max(round(exposure_s / step_s), 1) * step_s)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for on the twin's clock. Raises CommunicationError, DeviceFaultError."""
        if self._running is None:
            raise CommunicationError(f"{self.name}: no exposure was begun; start one before fetching it")
        start_s, exposure_s = self._running
        self._running = None
        end_s = start_s + exposure_s
        latency_s = self._sensor.settings.latency_s
        self.n_frames += 1
        # with the time: another session counts its frames from 1 again, and must not repeat the noise of the first
        rng = generator(self._seed, f"frame of the {self._role} camera at {start_s:.6f} s", self.n_frames)
        if self._happens("dropped_frame", end_s, rng) or latency_s > timeout_s:
            self._update(end_s + timeout_s)
            self._refuse_lost(end_s + timeout_s)
            raise CommunicationError(f"{self.name}: no frame within {timeout_s:g} s of the exposure's end; try again")
        self._update(end_s + latency_s)
        self._refuse_lost(end_s + latency_s)
        torn = self._happens("torn_frame", end_s, rng)
        if torn and any(fault.value("is_reported") for fault in self._faults.active("torn_frame", end_s, self._role)):
            raise CommunicationError(f"{self.name}: frame {self.n_frames} arrived incomplete; try again")
        image = self._render(start_s, exposure_s, rng)
        hot = self._faults.active("hot_pixels", start_s, self._role)
        more = [(fault.number, int(fault.value("count")), fault.value("adu_per_s")) for fault in hot]
        self._sensor.shine_hot(image, exposure_s, more)
        if torn:  # what did not arrive keeps the buffer's zeros
            image[int(image.shape[0] * rng.uniform(MIN_TORN_SHARE, MAX_TORN_SHARE)) :] = 0
        return Exposure(image, exposure_s, start_s + exposure_s / 2.0, self.n_frames)

    def close(self) -> None:
        """Give up a running exposure."""
        self._running = None

    def _happens(self, name: str, time_s: float, rng: np.random.Generator) -> bool:
        """Does a fault that befalls a share of all frames befall this one?"""
        chance = rng.random()  # drawn in any case: a fault elsewhere in time must not change other frames
        return any(chance < fault.value("share") for fault in self._faults.active(name, time_s, self._role))

    def _refuse_lost(self, time_s: float) -> None:
        if self._faults.active("camera_lost", time_s, self._role):
            self._running = None
            raise DeviceFaultError(f"{self.name}: does not answer; check its cable and power")

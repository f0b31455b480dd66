"""The twin's lamp: one camera on a bench before a diffuser that a lamp lights, or with its cap on.

What the lamp, the person who moves it and the sensor really do is known exactly here, and to nobody else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import CommunicationError, LimitError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Floats, Image, Sensor
from namod_ctl.twin.settings import CameraSettings

N_SHADES = 64
"""Steps of the light from the middle of the field to its rim."""
TINTS = (0.85, 1.15, 1.0)
"""Light of the lamp in the channels blue, green, red; their mean is 1."""
MANY_PIXELS = 200_000
"""Larger frames share one drawing of noise, shifted at random: it is what takes the time."""
FAINTEST = 1e-30
"""Intensity that stands for none."""
COSMIC_RAY_ADU = (40.0, 250.0)
SECONDS_PER_MOVE = 60.0


@dataclass(frozen=True, slots=True)
class LampSettings:
    """The lamp and its surroundings.

    Attributes
    ----------
    intensity_at_1m
        In the unit of the camera's true law.
    flicker_share
        Standard deviation of its light from frame to frame.
    drift_share_per_hour
        Growth of its light.
    level_error_share
        Standard deviation of the true light of a placement about what the person believes.
    distance_error_m
        The same of the distance.
    distance_offset_m
        True distances are larger by this than what the person believes, all of them.
    radius_share
        Radius of the lit disc as a share of the image's height; None lights the whole field.
    fall_off_share
        Loss of light from the middle of the field to its corner.
    dark_rate_adu_per_s
        Dark current of every pixel.
    cosmic_rays_per_s
        Over the whole sensor.
    """

    intensity_at_1m: float = 30.0
    flicker_share: float = 0.003
    drift_share_per_hour: float = 0.0
    level_error_share: float = 0.0
    distance_error_m: float = 0.0
    distance_offset_m: float = 0.0
    radius_share: float | None = None
    fall_off_share: float = 0.1
    dark_rate_adu_per_s: float = 0.0
    cosmic_rays_per_s: float = 0.0


class LampSensor(Sensor):
    """A sensor whose law may be curved."""

    def response(self, intensity: Floats, exposure_s: float) -> Floats:
        """Mean response in adu above the black level, not limited by saturation; any shape."""
        law = self.law
        light = np.log10(np.maximum(intensity, FAINTEST)) - law.r_expo * math.log10(exposure_s) - law.r_const
        # The root of r_curve x^2 + r_resp x = light that is light / r_resp without a curve.
        root = np.sqrt(np.maximum(law.r_resp**2 + 4.0 * law.r_curve * light, 0.0))
        adu: Floats = self.camera.full_scale_adu * 10.0 ** (2.0 * light / (law.r_resp + root))
        return adu


class TwinLamp:
    """A camera before the lamp, a `core.interfaces.Camera`; who has it moves the lamp with `place` and `cap`.

    `law` is the true law; the camera's own is what a config believes. The lamp's place is off by its errors, drawn anew
    with every placement.
    """

    def __init__(
        self,
        camera: CameraModel,
        settings: CameraSettings,
        lamp: LampSettings,
        law: RadiometricLaw,
        seed: int,
        n_channels: int = 1,
    ) -> None:
        self.clock = ManualClock()
        self._sensor = LampSensor(camera, settings, f"lamp {camera.name}", seed)
        self._sensor.law = law
        self._lamp, self._seed = lamp, seed
        self._shade = _shade_of_pixels(camera, lamp.radius_share)
        self._tints = np.array(TINTS if n_channels > 1 else (1.0,))
        self._n_frames = self._n_placements = 0
        self._light = 0.0
        self._running: tuple[float, float] | None = None
        shape = (camera.n_rows, camera.n_columns, n_channels)
        self._noise: NDArray[np.float32] | None = None
        if math.prod(shape) > MANY_PIXELS:
            rng = generator(seed, f"noise before the lamp of {camera.name}")
            self._noise = rng.standard_normal(2 * math.prod(shape), dtype=np.float32)
        self._shape = shape

    @property
    def name(self) -> str:
        """What it is, and its model."""
        return f"lamp bench of the twin ({self._sensor.camera.name})"

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera can make."""
        return self._sensor.settings.exposure_range_s

    def cap(self) -> None:
        """Put the cap on the lens."""
        self.clock.wait_s(SECONDS_PER_MOVE)
        self._light = 0.0

    def place(self, distance_m: float) -> None:
        """Put the lamp so far from the diffuser, as well as a person can."""
        rng = self._moved()
        true_m = distance_m + self._lamp.distance_offset_m + self._lamp.distance_error_m * rng.standard_normal()
        self._light = self._lamp.intensity_at_1m / true_m**2 * self._level_error(rng)

    def set_level(self, level: float) -> None:
        """Let so much of the lamp's light at 1 m through."""
        self._light = self._lamp.intensity_at_1m * level * self._level_error(self._moved())

    def start(self, exposure_s: float) -> None:
        """Begin an exposure now; a running one is given up. Raises LimitError."""
        shortest_s, longest_s = self.exposure_range_s
        if not shortest_s <= exposure_s <= longest_s:
            raise LimitError(f"{self.name}: makes exposures of {shortest_s:g} to {longest_s:g} s, not {exposure_s:g} s")
        step_s = self._sensor.settings.exposure_step_s
        self._running = (self.clock.monotonic_s(), max(round(exposure_s / step_s), 1) * step_s)

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last. Raises CommunicationError."""
        if self._running is None:
            raise CommunicationError(f"{self.name}: no exposure was begun; start one before fetching it")
        (start_s, exposure_s), self._running = self._running, None
        self._n_frames += 1
        rng = generator(self._seed, f"frame before the lamp of {self._sensor.camera.name}", self._n_frames)
        self.clock.advance_to_s(start_s + exposure_s + self._sensor.settings.latency_s)
        middle_s = start_s + exposure_s / 2.0
        drift = math.exp(self._lamp.drift_share_per_hour * middle_s / 3600.0)
        flicker = 1.0 + self._lamp.flicker_share * rng.standard_normal()
        image = self._exposed(self._light * drift * flicker, exposure_s, rng)
        self._sensor.shine_hot(image, exposure_s, [])
        self._hit_by_cosmic_rays(image, exposure_s, rng)
        return Exposure(image[:, :, 0] if len(self._tints) == 1 else image, exposure_s, middle_s, self._n_frames)

    def close(self) -> None:
        """Give up a running exposure."""
        self._running = None

    def _moved(self) -> np.random.Generator:
        self.clock.wait_s(SECONDS_PER_MOVE)
        self._n_placements += 1
        return generator(self._seed, f"placement of the lamp of {self._sensor.camera.name}", self._n_placements)

    def _level_error(self, rng: np.random.Generator) -> float:
        return 1.0 + self._lamp.level_error_share * float(rng.standard_normal())

    def _exposed(self, light: float, exposure_s: float, rng: np.random.Generator) -> Image:
        """A frame (rows, columns, channels) of that intensity in the middle of the field."""
        settings = self._sensor.settings
        shades = 1.0 - self._lamp.fall_off_share * np.arange(N_SHADES) / (N_SHADES - 1)
        lit = np.append(shades, 0.0)[:, None] * self._tints * light  # the last shade is none
        mean = np.minimum(self._sensor.response(lit, exposure_s), 4.0 * self._sensor.camera.full_scale_adu)
        mean += self._lamp.dark_rate_adu_per_s * exposure_s
        sigma = self._sensor.noise_adu(mean).astype(np.float32)
        level = (mean + settings.black_level_adu).astype(np.float32)
        if self._noise is None:
            noise = rng.standard_normal(self._shape, dtype=np.float32)
        else:
            first = int(rng.integers(self._noise.size - math.prod(self._shape)))
            noise = self._noise[first : first + math.prod(self._shape)].reshape(self._shape)
        adu = level[self._shade] + sigma[self._shade] * noise
        return np.asarray(np.clip(np.rint(adu), 0.0, self._sensor.camera.full_scale_adu), dtype=self._sensor.dtype)

    def _hit_by_cosmic_rays(self, image: Image, exposure_s: float, rng: np.random.Generator) -> None:
        for _ in range(int(rng.poisson(self._lamp.cosmic_rays_per_s * exposure_s))):
            row, column = rng.integers(image.shape[0]), rng.integers(image.shape[1])
            n_long = int(rng.integers(1, 5))
            track = image[row, column : column + n_long].astype(np.float64) + rng.uniform(*COSMIC_RAY_ADU)
            image[row, column : column + n_long] = np.minimum(track, self._sensor.camera.full_scale_adu)


def _shade_of_pixels(camera: CameraModel, radius_share: float | None) -> NDArray[np.intp]:
    """Which shade every pixel has, shape (rows, columns); `N_SHADES` outside of the lit disc."""
    rows, columns = np.mgrid[: camera.n_rows, : camera.n_columns]
    middle_row, middle_column = (camera.n_rows - 1) / 2.0, (camera.n_columns - 1) / 2.0
    distance2 = (rows - middle_row) ** 2 + (columns - middle_column) ** 2
    shade = np.rint(distance2 / distance2.max() * (N_SHADES - 1)).astype(np.intp)
    if radius_share is not None:
        shade[distance2 > (radius_share * camera.n_rows) ** 2] = N_SHADES
    return np.asarray(shade, dtype=np.intp)

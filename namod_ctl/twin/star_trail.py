"""A star that trails over a telescope whose drive stands still: spherical triangles, and the air that lifts the star.

Source of the refraction: Saemundsson, Sky & Telescope 72 (1986) 70, as in Meeus, Astronomical Algorithms, ch. 16.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_deg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import CameraSettings
from namod_ctl.twin.sky import SIDEREAL_RAD_PER_S, LightTrack
from namod_ctl.twin.star_frame import StarFrames

Array = NDArray[np.float64]

SCALE_HEIGHT_M = 8434.0
MEAN_TEMPERATURE_K, TEMPERATURE_K = 283.0, 283.15
MAX_STEPS = 200


@dataclass(frozen=True, slots=True)
class TrailScene:
    """One star over one telescope, at time 0 in the middle of its trail.

    Attributes
    ----------
    hour_angle_rad
        Of the star at time 0; positive west of the meridian.
    miss_rad
        (x, y) of the telescope frame: where the star stands at time 0. The drive stopped there.
    altitude_m
        Of the site; None for a telescope without air.
    time_jitter_s
        Standard deviation of the times that frames are said to be of.
    clock_rate
        Seconds that the clock counts per true second.
    wind_rad
        Standard deviation per axis of how the wind shakes the telescope from frame to frame.
    magnitude
        Of the star.
    cloud_share
        Chance that a cloud hides the star in a frame.
    drive_rate
        Share of the sky's turn that the drive follows: 0 for one that is stopped, 1 for one that tracks.
    companion
        (x, y) in rad and difference of magnitudes of a second star that trails along.
    """

    latitude_rad: float
    declination_rad: float
    hour_angle_rad: float
    miss_rad: tuple[float, float] = (0.0, 0.0)
    altitude_m: float | None = 2200.0
    time_jitter_s: float = 0.0
    clock_rate: float = 1.0
    wind_rad: float = 0.0
    magnitude: float = 0.5
    cloud_share: float = 0.0
    drive_rate: float = 0.0
    companion: tuple[float, float, float] | None = None

    def horizontal_rad(self, time_s: Array) -> tuple[Array, Array]:
        """Apparent altitude, and azimuth from north over east, of the star at these times."""
        hour_angle = self.hour_angle_rad + SIDEREAL_RAD_PER_S * (1.0 - self.drive_rate) * time_s
        sin_lat, cos_lat = math.sin(self.latitude_rad), math.cos(self.latitude_rad)
        sin_dec, cos_dec = math.sin(self.declination_rad), math.cos(self.declination_rad)
        altitude = np.arcsin(sin_lat * sin_dec + cos_lat * cos_dec * np.cos(hour_angle))
        azimuth = np.arctan2(-cos_dec * np.sin(hour_angle), sin_dec * cos_lat - cos_dec * np.cos(hour_angle) * sin_lat)
        if self.altitude_m is not None:
            altitude = altitude + _refraction_rad(altitude, self.altitude_m)
        return altitude, azimuth

    def theta_rad(self, time_s: Array) -> Array:
        """Direction of the star in the telescope frame, shape (n, 2), at these times (n,); wind not included."""
        (altitude_0,), (azimuth_0,) = self.horizontal_rad(np.zeros(1))
        axis_altitude, axis_azimuth = _pointing_rad(float(altitude_0), float(azimuth_0), self.miss_rad)
        return _seen_from(axis_altitude, axis_azimuth, *self.horizontal_rad(time_s))


def _refraction_rad(altitude: Array, site_m: float) -> Array:
    degrees = rad_to_deg(altitude)
    minutes = 1.02 / np.tan(deg_to_rad(degrees + 10.3 / (degrees + 5.11)))
    pressure = math.exp(-site_m / SCALE_HEIGHT_M)  # relative to that of the formula
    lifted: Array = arcmin_to_rad(minutes * pressure * (MEAN_TEMPERATURE_K / TEMPERATURE_K))
    return lifted


def _seen_from(axis_altitude: float, axis_azimuth: float, altitude: Array, azimuth: Array) -> Array:
    """Theta (n, 2) of places in the sky for a telescope that points there: the gnomonic projection's formulae."""
    turn = azimuth - axis_azimuth
    depth = np.sin(altitude) * math.sin(axis_altitude) + np.cos(altitude) * math.cos(axis_altitude) * np.cos(turn)
    right = np.cos(altitude) * np.sin(turn)
    up = np.sin(altitude) * math.cos(axis_altitude) - np.cos(altitude) * math.sin(axis_altitude) * np.cos(turn)
    theta: Array = np.column_stack([-np.arctan(right / depth), np.arctan(up / depth)])
    return theta


def _pointing_rad(altitude: float, azimuth: float, miss_rad: tuple[float, float]) -> tuple[float, float]:
    """Where the telescope points (altitude, azimuth) when it sees that place at `miss_rad`, by iteration."""
    axis = np.array([altitude, azimuth])
    for _ in range(20):
        theta = _seen_from(axis[0], axis[1], np.array([altitude]), np.array([azimuth]))[0]
        off = theta - miss_rad
        axis += (off[1], -off[0] / math.cos(axis[0]))
    return float(axis[0]), float(axis[1])


@dataclass(frozen=True, slots=True)
class TrailFrame:
    """A frame, and what time it is said to be of (middle of the exposure, s)."""

    exposure: Exposure
    time_s: float


class TrailTwin:
    """The star camera of such a telescope; `camera` is as it truly is."""

    def __init__(
        self, scene: TrailScene, camera: CameraModel, star_size_rad: float, settings: CameraSettings, seed: int
    ) -> None:
        self.scene, self.camera = scene, camera
        self._seed = seed
        self._settings = settings
        self._sensor = Sensor(camera, settings, "star", seed)
        self._frames = StarFrames(self._sensor, star_size_rad, seed)

    def frames(self, time_s: Array, exposure_s: float) -> Iterator[TrailFrame]:
        """A frame for every time (middle of the exposure)."""
        for number, middle_s in enumerate(time_s):
            rng = generator(self._seed, "star trail", number)
            wind_rad = self.scene.wind_rad * rng.standard_normal(2)
            told_s = self.scene.clock_rate * middle_s + self.scene.time_jitter_s * rng.standard_normal()
            is_hidden = rng.random() < self.scene.cloud_share
            image = self._frames.render(
                [] if is_hidden else self._lights(float(middle_s), exposure_s, wind_rad),
                1.0,
                (self._settings.background_share, np.zeros(2)),
                exposure_s,
                rng,
            )
            self._sensor.shine_hot(image, exposure_s, [])
            yield TrailFrame(Exposure(image, exposure_s, float(middle_s), number), float(told_s))

    def _lights(self, middle_s: float, exposure_s: float, wind_rad: Array) -> list[LightTrack]:
        way_rad = SIDEREAL_RAD_PER_S * exposure_s
        n_steps = min(max(math.ceil(way_rad / self._frames.step_rad), 1), MAX_STEPS)
        theta = self.scene.theta_rad(middle_s + exposure_s * ((np.arange(n_steps) + 0.5) / n_steps - 0.5)) + wind_rad
        intensity = np.full(n_steps, 10.0 ** (-0.4 * self.scene.magnitude))
        lights = [LightTrack(theta, intensity, 0.0)]
        if self.scene.companion is not None:
            x_rad, y_rad, fainter_mag = self.scene.companion
            lights.append(LightTrack(theta + np.array([x_rad, y_rad]), intensity * 10.0 ** (-0.4 * fainter_mag), 0.0))
        return lights

"""Trails of stars for tests: astropy says where the star is seen, and a lens of our own puts it into an image.

Nothing here is the package's: neither the way over the sky nor the projection.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import astropy.units as u
import numpy as np
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils.iers import conf

DEG = np.pi / 180.0
MDEG = DEG / 1000.0
ROQUE = (28.76, -17.89, 2200.0)
"""Latitude, longitude in deg, height in m."""


@dataclass(frozen=True)
class Lens:
    """What the camera truly is."""

    scale_rad: float = 2.437 * 1.003 * MDEG
    rotation_rad: float = 2.0 * DEG
    is_mirrored: bool = False
    k1: float = 0.4
    size: tuple[int, int] = (2560, 1920)
    axis_px: tuple[float, float] = (1280.0, 960.0)

    @property
    def centre(self):
        return (np.array(self.size) - 1) / 2.0

    def pixel(self, theta_rad):
        """Where directions (n, 2) of the telescope frame are seen (n, 2)."""
        left_is_plus_x = np.array([-1.0 if self.is_mirrored else 1.0, 1.0])
        cosine, sine = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        x, y = theta_rad.T
        upright = np.column_stack([cosine * x + sine * y, -sine * x + cosine * y]) * left_is_plus_x / self.scale_rad
        bent = lambda v: v * (1.0 + self.k1 * self.scale_rad**2 * np.sum(v**2, axis=-1, keepdims=True))  # noqa: E731
        target = upright * [1.0, -1.0] + bent(np.array([self.axis_px]) - self.centre)
        offset = target
        for _ in range(60):  # a fixed point, which contracts for lenses like these
            offset = target / (1.0 + self.k1 * self.scale_rad**2 * np.sum(offset**2, axis=-1, keepdims=True))
        return offset + self.centre


def theta_of_sky(altitude_rad, azimuth_rad, axis_altitude_rad, axis_azimuth_rad):
    """Telescope-frame directions (n, 2) by dot products with the telescope's axes in east, north, up."""

    def unit(altitude, azimuth):
        return np.stack(
            [np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)], axis=-1
        )

    axis = unit(axis_altitude_rad, axis_azimuth_rad)
    up = unit(axis_altitude_rad + np.pi / 2.0, axis_azimuth_rad)
    left = np.cross(up, axis)
    star = unit(altitude_rad, azimuth_rad)
    depth = star @ axis
    return np.column_stack([np.arctan(star @ left / depth), np.arctan(star @ up / depth)])


def seen_by_astropy(ra_deg, dec_deg, begun: datetime, time_s):
    """Apparent altitude and azimuth (n,), rad, at Roque de los Muchachos, and the times of day."""
    utc = [begun + timedelta(seconds=float(t)) for t in time_s]
    pressure = 1013.25 * np.exp(-ROQUE[2] / 8430.0) * u.hPa
    with (
        conf.set_temp("auto_download", False),
        conf.set_temp("auto_max_age", None),
        conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        place = EarthLocation.from_geodetic(ROQUE[1] * u.deg, ROQUE[0] * u.deg, ROQUE[2] * u.m)
        frame = AltAz(
            obstime=Time(utc), location=place, pressure=pressure, temperature=10 * u.deg_C, relative_humidity=0.5,
            obswl=0.55 * u.um,
        )  # fmt: skip
        star = SkyCoord(ra_deg * u.deg, dec_deg * u.deg).transform_to(frame)
        return star.alt.rad, star.az.rad, utc


def ideal_theta(declination_rad, time_s, miss_rad=(0.003, -0.004), turn_rad=0.7):
    """A star's way without air, over a telescope that stands turned somehow: rotations by matrices."""
    angle = -7.292115e-5 * time_s
    star = np.column_stack(
        [
            np.cos(declination_rad) * np.cos(angle),
            np.cos(declination_rad) * np.sin(angle),
            np.full(len(angle), np.sin(declination_rad)),
        ]
    )
    z = np.array([np.cos(declination_rad + miss_rad[1]), miss_rad[0], np.sin(declination_rad + miss_rad[1])])
    z /= np.linalg.norm(z)
    y = np.array([0.0, 0.0, 1.0]) - z * z[2]
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    x, y = np.cos(turn_rad) * x + np.sin(turn_rad) * y, -np.sin(turn_rad) * x + np.cos(turn_rad) * y
    return np.column_stack([np.arctan((star @ x) / (star @ z)), np.arctan((star @ y) / (star @ z))])


BEGUN = datetime(2026, 11, 22, 2, 0, tzinfo=UTC)

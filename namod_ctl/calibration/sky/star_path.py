"""Where a star really stands at the times of frames, as seen from a telescope that stands still."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.sky.observed_sky import (
    AIR_CELSIUS,
    AIR_HUMIDITY,
    LOWEST_ALTITUDE_RAD,
    SCALE_HEIGHT_M,
    SEA_LEVEL_HPA,
    WAVELENGTH_UM,
    Site,
)
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_deg

Array = NDArray[np.float64]

EARTH_RATE_RAD_PER_S = 7.292115146706979e-5
"""Turn of the Earth against the stars; IERS Conventions 2010, equation 5.15."""

REFRACTION_SHRINKS, REFRACTION_UNCERTAINTY = 4.5e-4, 2.5e-4
"""Relative: the air makes every angle in the sky smaller; 2.8e-4 times the air pressure in units of that at sea level
near the zenith and for horizontal angles everywhere, divided by cos^2 of the zenith distance for vertical ones. Without
site and time: the middle of what is possible down to 60 deg from the zenith, and its spread."""
GIVEN_DECLINATION_UNCERTAINTY_RAD = deg_to_rad(0.003)
"""Of a declination that a person gives to two or three decimals."""
CURVATURE_OF_AIR_RAD, CURVATURE_OF_KNOWN_AIR_RAD = deg_to_rad(0.25), deg_to_rad(0.05)
"""What refraction bends a trail by, as a change of declination: up to 0.25 deg at 60 deg from the zenith, nothing known
taken out; and what is left when it was."""

REFRACTION_NEAR_ZENITH, AIR_UNCERTAINTY = 2.8e-4, 0.05
"""Relative shrinking at the zenith at sea level, and by which share weather changes it."""
UNIX_EPOCH_JD, S_PER_DAY = 2440587.5, 86400.0


@dataclass(frozen=True, slots=True, eq=False)
class StarPath:
    """A star's directions on the ground.

    Attributes
    ----------
    direction
        Shape (n, 3). Unit vectors in a right-handed frame that stands on the ground, at the times of the frames.
    pole
        Shape (3,). Celestial north pole in that frame.
    declination_rad
        Of the star, of date.
    has_zenith
        The axes point north, west and to the zenith, and refraction is in the directions. Otherwise the third axis is
        the pole, the others lie anywhere on the equator, and refraction is in the rate only.
    rate_uncertainty
        Relative, of the star's apparent rate.
    curvature_uncertainty_rad
        As one of the declination.
    """

    direction: Array
    pole: Array
    declination_rad: float
    has_zenith: bool
    rate_uncertainty: float
    curvature_uncertainty_rad: float

    def moved_towards_pole(self, offset_rad: float) -> Array:
        """Directions (n, 3) of a star whose declination is larger by `offset_rad`."""
        towards = self.pole - (self.direction @ self.pole)[:, None] * self.direction
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        moved: Array = math.cos(offset_rad) * self.direction + math.sin(offset_rad) * towards
        return moved


def path_of_declination(time_s: Array, declination_rad: float) -> StarPath:
    """The path of a star of that declination (of date), when nobody knows where the telescope stands or looks."""
    angle = -EARTH_RATE_RAD_PER_S * (1.0 - REFRACTION_SHRINKS) * (time_s - time_s.mean())
    cosine = math.cos(declination_rad)
    direction = np.column_stack(
        [cosine * np.cos(angle), cosine * np.sin(angle), np.full(len(angle), math.sin(declination_rad))]
    )
    of_declination = abs(math.tan(declination_rad)) * GIVEN_DECLINATION_UNCERTAINTY_RAD
    return StarPath(
        direction=direction,
        pole=np.array([0.0, 0.0, 1.0]),
        declination_rad=declination_rad,
        has_zenith=False,
        rate_uncertainty=math.hypot(REFRACTION_UNCERTAINTY, of_declination),
        curvature_uncertainty_rad=CURVATURE_OF_AIR_RAD,
    )


def apparent_path(utc: Sequence[datetime], right_ascension_rad: float, declination_rad: float, site: Site) -> StarPath:
    """The path of a star of that ICRS place (proper motion included) over the site, at these times of day.

    Precession, nutation, aberration and refraction are in it (ERFA). The air is that of `observed_sky`.

    Raises
    ------
    ConfigError
        The star is too low, or below the horizon, at one of these times.
    """
    import erfa  # astropy's own routines; only who needs them waits for them

    pressure_hpa = SEA_LEVEL_HPA * math.exp(-site.altitude_m / SCALE_HEIGHT_M)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # leap seconds to come
        azimuth, zenith, *_ = erfa.atco13(
            right_ascension_rad, declination_rad, 0.0, 0.0, 0.0, 0.0,
            UNIX_EPOCH_JD, np.array([moment.timestamp() / S_PER_DAY for moment in utc]), 0.0,
            site.longitude_rad, site.latitude_rad, site.altitude_m, 0.0, 0.0,
            pressure_hpa, AIR_CELSIUS, AIR_HUMIDITY, WAVELENGTH_UM,
        )  # fmt: skip
    lowest_rad = math.pi / 2.0 - float(zenith.max())
    if lowest_rad < LOWEST_ALTITUDE_RAD:
        raise ConfigError(
            f"the star stands at an altitude of {rad_to_deg(lowest_rad):.1f} deg then (at least "
            f"{rad_to_deg(LOWEST_ALTITUDE_RAD):.1f} are needed): it is another star, or the times (UTC) or [site] are "
            "wrong"
        )
    horizontal = np.sin(zenith)
    return StarPath(
        direction=np.column_stack([horizontal * np.cos(azimuth), -horizontal * np.sin(azimuth), np.cos(zenith)]),
        pole=np.array([math.cos(site.latitude_rad), 0.0, math.sin(site.latitude_rad)]),
        declination_rad=place_of_date(utc[0], right_ascension_rad, declination_rad, site)[1],
        has_zenith=True,
        rate_uncertainty=AIR_UNCERTAINTY * REFRACTION_NEAR_ZENITH / math.sin(lowest_rad) ** 2,
        curvature_uncertainty_rad=CURVATURE_OF_KNOWN_AIR_RAD,
    )


def place_of_date(utc: datetime, right_ascension_rad: float, declination_rad: float, site: Site) -> tuple[float, float]:
    """Hour angle over the site (positive to the west) and declination, rad, of a star of that ICRS place at that time.

    Precession, nutation and aberration are in it, refraction is not.
    """
    import erfa

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        day = utc.timestamp() / S_PER_DAY  # a minute between TT and UTC is nothing to precession
        right_ascension, declination, _ = erfa.atci13(
            right_ascension_rad, declination_rad, 0.0, 0.0, 0.0, 0.0, UNIX_EPOCH_JD, day
        )
        hour_angle = float(erfa.era00(UNIX_EPOCH_JD, day)) + site.longitude_rad - float(right_ascension)
    return math.remainder(hour_angle, math.tau), float(declination)

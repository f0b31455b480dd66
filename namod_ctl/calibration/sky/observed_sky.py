"""Where stars are seen: catalogue places carried to a moment and a site, with all that bends and turns them.

Directions are unit vectors in a right-handed frame whose longitude grows to the left of a person who looks at the sky
with the pole up: the handedness of the telescope frame, where +x is to the left and +y up. Without time and site that
is ICRS (longitude is right ascension, latitude declination). With both it is the horizon's: x to the north, y to the
west, z to the zenith, so latitude is altitude and longitude the negative azimuth, as seen through the air.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.sky.star_catalogue import StarCatalogue

Array = NDArray[np.float64]

_UNIX_EPOCH_JD = 2440587.5
_J2000_JD = 2451545.0
_S_PER_DAY = 86400.0
_DAYS_PER_YEAR = 365.25

SEA_LEVEL_HPA, SCALE_HEIGHT_M = 1013.25, 8430.0
"""Of the air: its pressure at a site follows from the altitude within 2 %, which is 6e-6 of the plate scale."""
AIR_CELSIUS, AIR_HUMIDITY, WAVELENGTH_UM = 10.0, 0.5, 0.55
"""10 degrees of error are 3.5 % of the refraction, 1e-5 of the plate scale."""

LOWEST_ALTITUDE_RAD = math.asin(0.1)
"""Closer to the horizon the air's refraction is not known well enough."""


@dataclass(frozen=True, slots=True)
class Site:
    """Where the telescope stands: geodetic latitude, longitude (east positive), altitude above the sea."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float


def julian_year(moment: datetime) -> float:
    """The moment as a year with a fraction."""
    return 2000.0 + (_julian_date(moment) - _J2000_JD) / _DAYS_PER_YEAR


def observed_directions(catalogue: StarCatalogue, moment: datetime, site: Site) -> Array:
    """Unit vectors, shape (n_stars, 3), in the horizon's frame; NaN for stars below `LOWEST_ALTITUDE_RAD`.

    Proper motion, aberration, light deflection, precession, nutation, the turning Earth, refraction (ERFA). UT1 is
    taken to be UTC: the difference is below 0.9 s by definition and belongs to the uncertainty of the time.
    """
    import erfa  # astropy's own routines, a third of a second of loading

    icrs = catalogue.directions(julian_year(moment))
    ra_rad, dec_rad = np.arctan2(icrs[:, 1], icrs[:, 0]) % (2.0 * math.pi), np.arcsin(np.clip(icrs[:, 2], -1.0, 1.0))
    pressure_hpa = SEA_LEVEL_HPA * math.exp(-site.altitude_m / SCALE_HEIGHT_M)
    air = (pressure_hpa, AIR_CELSIUS, AIR_HUMIDITY, WAVELENGTH_UM)
    place = (site.longitude_rad, site.latitude_rad, site.altitude_m)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # leap seconds to come: part of the time's uncertainty
        # The same as atco13, but what depends on the moment and the site alone is worked out once, not for every star.
        earth, _ = erfa.apco13(_julian_date(moment), 0.0, 0.0, *place, 0.0, 0.0, *air)
        azimuth_rad, zenith_rad, *_ = erfa.atioq(*erfa.atciqz(ra_rad, dec_rad, earth), earth)
    horizontal = np.sin(zenith_rad)
    up = np.cos(zenith_rad)
    seen = np.stack([horizontal * np.cos(azimuth_rad), -horizontal * np.sin(azimuth_rad), up], axis=-1)
    seen[up < math.sin(LOWEST_ALTITUDE_RAD)] = np.nan
    return np.asarray(seen, dtype=np.float64)


def _julian_date(moment: datetime) -> float:
    return _UNIX_EPOCH_JD + moment.timestamp() / _S_PER_DAY

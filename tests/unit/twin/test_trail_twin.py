"""The twin's trailing star against astropy's sky."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, HADec, SkyCoord
from astropy.time import Time
from astropy.utils.iers import conf

from namod_ctl.twin.star_trail import TrailScene

ARCSEC = math.pi / 180.0 / 3600.0
BEGUN = datetime(2026, 11, 22, 2, 0, tzinfo=UTC)
LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 28.76, -17.89, 2200.0


@pytest.fixture(autouse=True)
def offline():
    with (
        conf.set_temp("auto_download", False),
        conf.set_temp("auto_max_age", None),
        conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        yield


def astropys(star, moments, pressure=0.0 * u.hPa):
    place = EarthLocation.from_geodetic(LONGITUDE_DEG * u.deg, LATITUDE_DEG * u.deg, HEIGHT_M * u.m)
    air = {"pressure": pressure, "temperature": 10 * u.deg_C, "obswl": 0.55 * u.um, "relative_humidity": 0.0}
    seen = star.transform_to(AltAz(obstime=Time(moments), location=place, **(air if pressure > 0 * u.hPa else {})))
    return seen.alt.rad, seen.az.rad


@pytest.mark.parametrize("star", [(78.634, -8.202), (113.65, 31.89), (37.95, 75.0)])
@pytest.mark.parametrize("hours", [0.0, 1.5])
@pytest.mark.parametrize("has_air", [False, True])
def test_way_over_the_sky_is_astropys(star, hours, has_air):
    place = EarthLocation.from_geodetic(LONGITUDE_DEG * u.deg, LATITUDE_DEG * u.deg, HEIGHT_M * u.m)
    star = SkyCoord(*star, unit="deg")
    moment = BEGUN + timedelta(hours=hours)
    seen = star.transform_to(HADec(obstime=Time(moment), location=place))
    scene = TrailScene(math.radians(LATITUDE_DEG), seen.dec.rad, seen.ha.rad, altitude_m=HEIGHT_M if has_air else None)
    time_s = np.linspace(-600.0, 600.0, 7)
    pressure = (1010.0 * math.exp(-HEIGHT_M / 8434.0) if has_air else 0.0) * u.hPa
    altitude, azimuth = astropys(star, [moment + timedelta(seconds=float(t)) for t in time_s], pressure)
    assert altitude.min() > math.radians(15.0)  # lower, no formula of the refraction is good enough
    twins_altitude, twins_azimuth = scene.horizontal_rad(time_s)
    off = np.stack([twins_altitude - altitude, np.cos(altitude) * np.sin(twins_azimuth - azimuth)])
    # aberration and refraction change by less than that in 10 minutes; and the formula of the air is good to 4 arcsec
    assert np.abs(off - off.mean(axis=1, keepdims=True)).max() < 0.5 * ARCSEC
    assert np.abs(off).max() < (6.0 if has_air else 1.0) * ARCSEC


def test_axes_of_the_telescope_frame():
    """A star that culminates in the south moves to the west, which is the right of who looks there: towards -x."""
    scene = TrailScene(math.radians(28.76), math.radians(-10.0), 0.0, altitude_m=None)
    before, now, after = scene.theta_rad(np.array([-60.0, 0.0, 60.0]))
    assert np.abs(now).max() < 1e-9
    assert after[0] < 0.0 < before[0]
    assert after[0] == pytest.approx(-math.cos(math.radians(10.0)) * 60.0 * 15.041 * ARCSEC, rel=1e-3)
    # it is highest now
    assert max(before[1], after[1]) < 0.0
    # and one that stands below the axis has a negative y
    low = TrailScene(math.radians(28.76), math.radians(-10.0), 0.0, (0.01, -0.02), altitude_m=None)
    assert low.theta_rad(np.zeros(1))[0] == pytest.approx((0.01, -0.02), abs=1e-9)

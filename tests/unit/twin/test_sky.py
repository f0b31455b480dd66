"""The sky against astropy and published formulas; lights that come and go."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import angular_separation

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.twin.faults import FaultPlan
from namod_ctl.twin.settings import FaultSpec, SkySettings, TelescopeSettings
from namod_ctl.twin.sky import CATALOGUE, Sky
from namod_ctl.twin.telescope import Telescope

STEP_RAD = 1e-4


def sky(settings: SkySettings | None = None, *faults: FaultSpec) -> Sky:
    plan = FaultPlan()
    for fault in faults:
        plan.inject(fault)
    telescope = TelescopeSettings()
    return Sky(settings or SkySettings(), telescope, Telescope(telescope, plan, 1), plan, 1)


def light_at(a_sky: Sky, time_s: float) -> float:
    """Intensity of the reference star."""
    tracks = a_sky.tracks(time_s, time_s + 0.01, STEP_RAD, 10)
    return float(tracks[0].intensity.mean()) if tracks else 0.0


@pytest.mark.parametrize("time_s", [0.0, 3600.0])
def test_zenith_distance_is_the_angle_between_star_and_zenith(time_s: float) -> None:
    settings = SkySettings()
    star = CATALOGUE["Vega"]
    sidereal = settings.sidereal_time_rad + 2.0 * np.pi * time_s / 86164.0905
    expected = angular_separation(
        sidereal * u.rad, settings.latitude_rad * u.rad, star.right_ascension_rad * u.rad, star.declination_rad * u.rad
    )
    assert sky().zenith_distance_rad(time_s) == pytest.approx(expected.to_value(u.rad), abs=1e-6)


def test_extinction_follows_the_air_mass() -> None:
    clear, hazy = sky(SkySettings(extinction_mag=0.0)), sky(SkySettings(extinction_mag=0.3))
    air_mass = 1.0 / np.cos(clear.zenith_distance_rad(0.0))
    magnitudes = -2.5 * np.log10(light_at(hazy, 0.0) / light_at(clear, 0.0))
    assert magnitudes == pytest.approx(0.3 * air_mass, rel=1e-3)
    assert light_at(clear, 0.0) == pytest.approx(10 ** (-0.4 * 0.03), rel=1e-9)  # Vega's magnitude


def test_scintillation_is_youngs() -> None:
    """At 1 m, 60 s, zenith and sea level: 0.09 * 100^(-2/3) / sqrt(120) = 3.8e-4 (Dravins et al. 1998)."""
    zenith = SkySettings(latitude_rad=CATALOGUE["Vega"].declination_rad, altitude_m=0.0)
    at_zenith = SkySettings(
        latitude_rad=zenith.latitude_rad, altitude_m=0.0, sidereal_time_rad=CATALOGUE["Vega"].right_ascension_rad
    )
    rng = np.random.default_rng(1)
    factors = np.array([sky(at_zenith).scintillation(0.0, 60.0, 1.0, rng) for _ in range(2000)])
    assert factors.std() == pytest.approx(3.8e-4, rel=0.06)
    assert factors.mean() == pytest.approx(1.0, abs=1e-4)


def test_the_star_changes_in_mid_run_after_a_slew_without_light() -> None:
    changing = sky(SkySettings(star_changes=((100.0, "Arcturus"),), extinction_mag=0.0))
    assert [changing.star_name(t) for t in (0.0, 99.9, 100.0)] == ["Vega", "Vega", "Arcturus"]
    assert light_at(changing, 105.0) == 0.0
    assert light_at(changing, 115.0) == pytest.approx(10 ** (0.4 * 0.04), rel=1e-9)


@pytest.mark.parametrize(
    ("settings", "text"),
    [(SkySettings(reference_star="Vulcan"), "Vulcan"), (SkySettings(reference_star="Sirius"), "zenith")],
)
def test_a_star_that_cannot_be_seen_is_refused(settings: SkySettings, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        sky(settings)


def test_clouds_take_up_to_their_factor_and_no_more() -> None:
    clear = light_at(sky(), 0.0)
    cloudy = sky(None, FaultSpec("clouds", params={"factor": 30.0, "period_s": 20.0}))
    shares = np.array([light_at(cloudy, t) for t in np.linspace(0.0, 200.0, 400)]) / clear
    assert shares.min() == pytest.approx(1 / 30, rel=0.1)
    assert shares.max() == pytest.approx(1.0, rel=0.05)
    assert np.abs(np.diff(np.log(shares))).max() < np.log(30.0) / 2  # they drift, they do not switch


def test_a_satellite_crosses_the_field_once() -> None:
    passing = sky(None, FaultSpec("satellite", start_s=10.0, duration_s=4.0))
    assert len(passing.tracks(9.0, 9.5, STEP_RAD, 100)) == 1
    early, late = (passing.tracks(t, t + 0.1, STEP_RAD, 100)[1] for t in (10.5, 13.0))
    assert len(early.intensity) > 10  # it moves a milliradian, in steps of a tenth
    flown = np.linalg.norm(late.theta_rad.mean(axis=0) - early.theta_rad.mean(axis=0))
    assert rad_to_deg(float(flown)) == pytest.approx(0.6 * 2.5, rel=0.05)


def test_jupiter_is_a_disc() -> None:
    jupiter = sky(SkySettings(reference_star="Jupiter"))
    assert jupiter.tracks(0.0, 0.01, STEP_RAD, 10)[0].diameter_rad == pytest.approx(deg_to_rad(42.0 / 3600.0))


def test_planets_hardly_scintillate() -> None:
    """Behind a lens of 37 mm Jupiter's 42 arcsec, 2 m wide at 10 km, count: (2 m / 37 mm)^(2/3) = 14 times less."""
    highest = {
        name: SkySettings(reference_star=name, latitude_rad=star.declination_rad, sidereal_time_rad=right_ascension)
        for name, star in CATALOGUE.items()
        if (right_ascension := star.right_ascension_rad) and name in ("Vega", "Jupiter")
    }
    sigma = {}
    for name, settings in highest.items():
        rng = np.random.default_rng(1)
        sigma[name] = np.std([sky(settings).scintillation(0.0, 0.01, 0.037, rng) for _ in range(1000)])
    assert sigma["Vega"] / sigma["Jupiter"] == pytest.approx((2.04 / 0.037) ** (2 / 3), rel=0.1)

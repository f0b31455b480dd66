"""The sky: which lights stand where, how bright, and what the air between does to them.

Intensities are relative to a star of magnitude 0 above the atmosphere; directions are telescope-frame Theta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import arcsec_to_rad, deg_to_rad, m_to_cm, rad_to_deg
from namod_ctl.twin.faults import Fault, FaultPlan
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import SkySettings, TelescopeSettings
from namod_ctl.twin.telescope import Telescope

Array = NDArray[np.float64]

SIDEREAL_RAD_PER_S = math.tau / 86164.1
"""Turn of the Earth against the stars."""

MAX_ZENITH_DISTANCE_RAD = deg_to_rad(80.0)
SCALE_HEIGHT_M = 8000.0
CLOUD_TONES = 4
BLINK_SHARE = 0.2
"""Of the period: how long an aircraft's flash lasts."""
N_MOTION_SAMPLES = 9
DAYLIGHT_SHARE, MAX_RISE = 1e6, 50.0
"""A day's sky in a pixel, as a share of a magnitude 0 star's brightest: twilight does not rise for ever."""
SCINTILLATION_HEIGHT_M = 10_000.0
"""Where the air is that makes stars scintillate in long exposures: around the tropopause."""


@dataclass(frozen=True, slots=True)
class CatalogueStar:
    """A reference star: magnitude in V, position of J2000, diameter of a disc that is no point."""

    magnitude: float
    right_ascension_rad: float
    declination_rad: float
    diameter_rad: float = 0.0


def _star(magnitude: float, hours: float, declination_deg: float, diameter_arcsec: float = 0.0) -> CatalogueStar:
    return CatalogueStar(
        magnitude, deg_to_rad(15.0 * hours), deg_to_rad(declination_deg), arcsec_to_rad(diameter_arcsec)
    )


CATALOGUE: Mapping[str, CatalogueStar] = {
    # Source: the Bright Star Catalogue, 5th edition (V, J2000), rounded.
    "Sirius": _star(-1.46, 6.752, -16.72),
    "Arcturus": _star(-0.04, 14.261, 19.18),
    "Vega": _star(0.03, 18.616, 38.78),
    "Capella": _star(0.08, 5.278, 46.00),
    "Rigel": _star(0.12, 5.242, -8.20),
    "Procyon": _star(0.38, 7.655, 5.22),
    "Betelgeuse": _star(0.50, 5.919, 7.41),
    "Altair": _star(0.77, 19.846, 8.87),
    "Aldebaran": _star(0.85, 4.599, 16.51),
    "Antares": _star(0.96, 16.490, -26.43),
    "Spica": _star(0.98, 13.420, -11.16),
    "Pollux": _star(1.14, 7.755, 28.03),
    "Deneb": _star(1.25, 20.690, 45.28),
    "Regulus": _star(1.35, 10.140, 11.97),
    "Polaris": _star(2.02, 2.530, 89.26),
    "Mizar": _star(2.27, 13.399, 54.93),
    "Megrez": _star(3.31, 12.257, 57.03),
    # A planet wanders: a place of opposition, typical brightness and disc.
    "Jupiter": _star(-2.5, 17.5, -22.5, diameter_arcsec=42.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class LightTrack:
    """One light during one exposure: equally long steps.

    `theta_rad` (n_steps, 2), `intensity` (n_steps,), behind the atmosphere, and the diameter of a disc. Frames show a
    disc as the gaussian of its variance: behind a lens that blurs a point to 0.025 deg, Jupiter's 0.012 deg differ from
    that by less than 0.2 % of the peak.
    """

    theta_rad: Array
    intensity: Array
    diameter_rad: float


class Sky:
    """Lights as functions of time alone."""

    def __init__(
        self,
        settings: SkySettings,
        telescope_settings: TelescopeSettings,
        telescope: Telescope,
        faults: FaultPlan,
        seed: int,
    ) -> None:
        self._settings = settings
        self._telescope = telescope
        self._telescope_settings = telescope_settings
        self._faults = faults
        self._seed = seed
        changes = sorted(settings.star_changes)
        self._star_starts_s = np.array([0.0, *(time_s for time_s, _ in changes)])
        self._star_names = [settings.reference_star, *(name for _, name in changes)]
        for name, start_s in zip(self._star_names, self._star_starts_s, strict=True):
            if name not in CATALOGUE:
                raise ConfigError(f"there is no reference star {name!r} in the catalogue; there are: {_names()}")
            zenith_rad = float(self._zenith_distance(CATALOGUE[name], np.array([start_s]))[0])
            if zenith_rad > MAX_ZENITH_DISTANCE_RAD:
                raise ConfigError(
                    f"star {name!r} stands {rad_to_deg(zenith_rad):.0f} deg from the zenith at {start_s:g} s; "
                    f"at most {rad_to_deg(MAX_ZENITH_DISTANCE_RAD):.0f} deg are possible: "
                    "take another star or sidereal_time_rad"
                )

    def star_name(self, time_s: float) -> str:
        """The star that the telescope follows."""
        return self._star_names[self._star_index(time_s)]

    def zenith_distance_rad(self, time_s: float) -> float:
        """Zenith distance of the telescope, which points at its star."""
        return float(self._zenith_distance(CATALOGUE[self.star_name(time_s)], np.array([time_s]))[0])

    def tracks(self, start_s: float, end_s: float, step_rad: float, max_steps: int) -> list[LightTrack]:
        """All lights from `start_s` to `end_s`, in steps of at most `step_rad` (unless that makes too many)."""
        coarse_s = np.linspace(start_s, end_s, N_MOTION_SAMPLES)
        tracks = []
        for number, light in enumerate(self._lights(coarse_s)):
            way_rad = float(np.linalg.norm(np.diff(light.theta_rad, axis=0), axis=1).sum())
            n_steps = min(max(math.ceil(way_rad / step_rad), 1), max_steps)
            times_s = start_s + (end_s - start_s) * (np.arange(n_steps) + 0.5) / n_steps
            track = self._lights(times_s)[number]
            if track.intensity.any():
                tracks.append(track)
        return tracks

    def background(self, time_s: float) -> tuple[float, Array]:
        """Light that faults add to every pixel, as a share of a magnitude 0 star's brightest, and its slope.

        The slope (2,) is the further share from one edge of the image to the other, along telescope x and y.
        """
        level, slope = 0.0, np.zeros(2)
        for fault in self._faults.active("moonlight", time_s):
            level += fault.value("level_share")
            angle = fault.value("angle_rad")
            slope += fault.value("gradient_share") * np.array([math.cos(angle), math.sin(angle)])
        for fault in self._faults.active("twilight", time_s):
            rise = (time_s - fault.start_s) / fault.value("rise_s")
            level += min(fault.value("level_share") * math.exp(min(rise, MAX_RISE)), DAYLIGHT_SHARE)
        return level, slope

    def scintillation(self, start_s: float, exposure_s: float, diameter_m: float, rng: np.random.Generator) -> float:
        """Factor by which a star is brighter in one exposure through an opening of that diameter.

        A planet scintillates less: the shadows in the air that its disc averages over, `SCINTILLATION_HEIGHT_M` away,
        are as wide as the disc is there, as if the opening were that wide: 2 m for Jupiter.

        Source: Young's formula, as in Dravins et al., PASP 110 (1998) 610: sigma = 0.09 D^(-2/3) X^1.75
        exp(-h / 8 km) / sqrt(2 T), D in cm, T in s; for discs Young, Applied Optics 8 (1969) 869.
        """
        zenith_rad = self.zenith_distance_rad(start_s)
        height_m = SCINTILLATION_HEIGHT_M * float(_air_mass(zenith_rad))
        diameter_m = math.hypot(diameter_m, CATALOGUE[self.star_name(start_s)].diameter_rad * height_m)
        sigma = 0.09 * m_to_cm(diameter_m) ** (-2.0 / 3.0) * _air_mass(zenith_rad) ** 1.75
        sigma *= math.exp(-self._settings.altitude_m / SCALE_HEIGHT_M) / math.sqrt(2.0 * exposure_s)
        sigma *= self._settings.scintillation
        return math.exp(sigma * rng.standard_normal() - sigma**2 / 2.0)

    def _star_index(self, time_s: float) -> int:
        return int(np.searchsorted(self._star_starts_s, time_s, side="right")) - 1

    def _lights(self, times_s: Array) -> list[LightTrack]:
        star_theta = self._telescope.star_theta(times_s)
        index = self._star_index(float(times_s[0]))
        star = CATALOGUE[self._star_names[index]]
        brightness = self._transmission(times_s, star)
        magnitude_0 = _intensity(star.magnitude)
        is_slewing = (index > 0) & (times_s - self._star_starts_s[index] < self._telescope_settings.slew_s)
        in_field = np.where(is_slewing, 0.0, brightness)
        lights = [LightTrack(star_theta, magnitude_0 * in_field, star.diameter_rad)]
        start_s, end_s = float(times_s[0]), float(times_s[-1])
        for fault in self._faults.of("second_star"):
            if fault.touches(start_s, end_s + 1e-9):
                offset = np.array([fault.value("offset_x_rad"), fault.value("offset_y_rad")])
                intensity = magnitude_0 * _intensity(fault.value("fainter_mag")) * in_field
                lights.append(LightTrack(star_theta + offset, intensity * _lasts(fault, times_s), 0.0))
        flyers = [*self._faults.of("satellite"), *self._faults.of("aircraft")]
        return lights + [
            self._flyer(fault, times_s, star_theta, brightness)
            for fault in flyers
            if fault.touches(start_s, end_s + 1e-9)
        ]

    def _flyer(self, fault: Fault, times_s: Array, star_theta: Array, brightness: Array) -> LightTrack:
        """A light on a straight line past the star; half a field (2 s of flight) before it at the fault's start."""
        angle = fault.value("angle_rad")
        along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        flown_rad = fault.value("speed_rad_per_s") * (times_s - fault.start_s - 2.0)
        theta = star_theta + fault.value("miss_rad") * across + flown_rad[:, None] * along
        intensity = _intensity(fault.value("magnitude")) * brightness * _lasts(fault, times_s)
        if "blink_s" in fault.params:
            is_flash = (times_s - fault.start_s) / fault.value("blink_s") % 1.0 < BLINK_SHARE
            intensity = intensity * np.where(is_flash, 4.0, 0.4)
        return LightTrack(theta, intensity, 0.0)

    def _transmission(self, times_s: Array, star: CatalogueStar) -> Array:
        """Share of the light that the atmosphere and its clouds let through."""
        zenith_rad = self._zenith_distance(star, times_s)
        share = 10.0 ** (-0.4 * self._settings.extinction_mag * _air_mass(zenith_rad))
        for fault in self._faults.of("clouds"):
            rng = generator(self._seed, "clouds", fault.number)
            rate = math.tau / fault.value("period_s") * rng.uniform(0.5, 2.0, CLOUD_TONES)
            phase = rng.uniform(0.0, math.tau, CLOUD_TONES)
            thickness = np.sin(rate * (times_s[:, None] - fault.start_s) + phase).mean(axis=1) / 0.7
            opacity = np.clip(0.5 + thickness, 0.0, 1.0) * _lasts(fault, times_s)
            share = share * fault.value("factor") ** -opacity
        for fault in self._faults.of("clouds_total"):
            share = share * (1.0 - _lasts(fault, times_s))
        return np.asarray(share, dtype=np.float64)

    def _zenith_distance(self, star: CatalogueStar, times_s: Array) -> Array:
        s = self._settings
        hour_angle = s.sidereal_time_rad + SIDEREAL_RAD_PER_S * times_s - star.right_ascension_rad
        cosine = math.sin(s.latitude_rad) * math.sin(star.declination_rad) + math.cos(s.latitude_rad) * math.cos(
            star.declination_rad
        ) * np.cos(hour_angle)
        distance: Array = np.arccos(np.clip(cosine, -1.0, 1.0))
        return distance


def _names() -> str:
    return ", ".join(CATALOGUE)


def _intensity(magnitude: float) -> float:
    return float(10.0 ** (-0.4 * magnitude))


def _lasts(fault: Fault, times_s: Array) -> Array:
    return ((times_s >= fault.start_s) & (times_s < fault.end_s)).astype(np.float64)


def _air_mass(zenith_rad: Array | float) -> Array | float:
    """Plane-parallel air; below 80 deg from the zenith good to 3 %, and finite beyond."""
    return 1.0 / np.maximum(np.cos(zenith_rad), 0.1)

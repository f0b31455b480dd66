"""Fields of stars in the star camera: a sky of its own, a lens that bends, and what looks like a star but is none.

The sky here is worked out with formulae of the textbook: precession of IAU 1976, aberration from the sun's longitude,
sidereal time, refraction of a thin plane-parallel air. The lens is gnomonic with Brown's radial distortion. Nothing of
this is shared with what it tests.

Sources: J. Meeus, Astronomical Algorithms (2nd ed.), chapters 12, 21, 22, 23, 25; W. M. Smart, Spherical Astronomy,
section 35; D. C. Brown 1966, Photogrammetric Engineering 32, 444.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import arcsec_to_rad, deg_to_rad
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Image, Sensor
from namod_ctl.twin.sky import LightTrack
from namod_ctl.twin.star_frame import StarFrames

Array = NDArray[np.float64]

J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
DAYS_PER_CENTURY = 36525.0
ABERRATION_RAD = arcsec_to_rad(20.4955)
REFRACTION_RAD, REFRACTION_CUBED_RAD = arcsec_to_rad(58.29), arcsec_to_rad(-0.067)
"""Times tan and tan^3 of the zenith distance as seen, at 1013.25 hPa and 10 degrees Celsius (Smart)."""
AIR_SCALE_HEIGHT_M = 8430.0

BRIGHTEST_OF_FAINT_MAG, FAINTEST_MAG = 6.5, 8.5
STARS_PER_MAG = 10.0**0.47
"""So many times more stars are there to a limit one magnitude fainter (6.5 to 8.5: 8 900, 26 000, 77 000 in all)."""
STARS_TO_6_5 = 8900.0
LEAST_STRETCH = 0.2
"""Of an image in the direction outwards, by a lens that bends."""
_FIXED_POINT_STEPS = 30


@dataclass(frozen=True, slots=True)
class FieldCatalogue:
    """Stars as the caller gives them: right ascension and declination (J2000, of date's motion), magnitudes in V."""

    ra_rad: Array
    dec_rad: Array
    magnitude: Array


@dataclass(frozen=True, slots=True)
class Lens:
    """The true star camera.

    Attributes
    ----------
    plate_scale_rad
        Angle of one pixel where the lens's axis is.
    rotation_rad, is_mirrored
        As in `optics.coordinates.CameraOrientation`, about the telescope's axis.
    centre_pixel, axis_pixel
        Where the lens's axis and the telescope's axis meet the image, (x, y).
    brown_k1, brown_k2
        r' = r (1 + k1 r^2 + k2 r^4), r the tangent of the angle from the lens's axis.
    """

    plate_scale_rad: float
    rotation_rad: float
    is_mirrored: bool
    centre_pixel: tuple[float, float]
    axis_pixel: tuple[float, float]
    brown_k1: float = 0.0
    brown_k2: float = 0.0


@dataclass(frozen=True, slots=True)
class Watch:
    """When, from where and whither: the telescope's axis points at azimuth (north over east) and altitude as seen."""

    moment: datetime
    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    azimuth_rad: float
    elevation_rad: float


def seen_from_site(catalogue: FieldCatalogue, watch: Watch) -> Array:
    """Unit vectors (n, 3) of the stars as seen through the air: north, east, up."""
    days = (watch.moment - J2000).total_seconds() / 86400.0
    centuries = days / DAYS_PER_CENTURY
    cos_dec = np.cos(catalogue.dec_rad)
    place = np.stack(
        [cos_dec * np.cos(catalogue.ra_rad), cos_dec * np.sin(catalogue.ra_rad), np.sin(catalogue.dec_rad)], axis=-1
    )
    nutation, equinoxes_rad = _nutation(centuries)
    place = place @ (nutation @ _precession(centuries)).T + _velocity_of_earth(centuries)
    place /= np.linalg.norm(place, axis=-1, keepdims=True)
    sidereal_rad = deg_to_rad(280.46061837 + 360.98564736629 * days) + equinoxes_rad + watch.longitude_rad
    cosine, sine = math.cos(sidereal_rad), math.sin(sidereal_rad)
    # Towards the meridian's equator point, east, north pole.
    south = place[:, 0] * cosine + place[:, 1] * sine
    east = -place[:, 0] * sine + place[:, 1] * cosine
    lat = watch.latitude_rad
    up = south * math.cos(lat) + place[:, 2] * math.sin(lat)
    north = -south * math.sin(lat) + place[:, 2] * math.cos(lat)
    return _refracted(np.stack([north, east, up], axis=-1), watch.altitude_m)


def _precession(centuries: float) -> Array:
    """Matrix (3, 3) from the equator of J2000 to that of date (Lieske 1977; Meeus, chapter 21)."""
    t = centuries
    zeta = arcsec_to_rad(2306.2181 * t + 0.30188 * t**2 + 0.017998 * t**3)
    z = arcsec_to_rad(2306.2181 * t + 1.09468 * t**2 + 0.018203 * t**3)
    theta = arcsec_to_rad(2004.3109 * t - 0.42665 * t**2 - 0.041833 * t**3)

    def about_pole(angle: float) -> Array:
        return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])

    about_node = np.array(
        [[math.cos(theta), 0.0, -math.sin(theta)], [0.0, 1.0, 0.0], [math.sin(theta), 0.0, math.cos(theta)]]
    )
    matrix: Array = about_pole(z) @ about_node @ about_pole(zeta)
    return matrix


def _nutation(centuries: float) -> tuple[Array, float]:
    """Matrix (3, 3) from the mean equator of date to the true one, and the equation of the equinoxes, rad.

    The two largest terms, good to 0.5 arcsec (Meeus, chapter 22).
    """
    node = deg_to_rad(125.04452 - 1934.136261 * centuries)
    sun = deg_to_rad(280.4665 + 36000.7698 * centuries)
    obliquity = deg_to_rad(23.439291 - 0.0130042 * centuries)
    longitude = arcsec_to_rad(-17.20 * math.sin(node) - 1.32 * math.sin(2.0 * sun))
    oblique = arcsec_to_rad(9.20 * math.cos(node) + 0.57 * math.cos(2.0 * sun))
    x, y = longitude * math.cos(obliquity), longitude * math.sin(obliquity)
    matrix = np.array([[1.0, -x, -y], [x, 1.0, -oblique], [y, oblique, 1.0]])
    return matrix, x


def _velocity_of_earth(centuries: float) -> Array:
    """In units of light's, on a circle about the sun, equator of date (Meeus, chapters 23 and 25)."""
    anomaly = deg_to_rad(357.52911 + 35999.05029 * centuries)
    longitude = deg_to_rad(280.46646 + 36000.76983 * centuries + 1.9146 * math.sin(anomaly))
    obliquity = deg_to_rad(23.439291 - 0.0130042 * centuries)
    sideways = -math.cos(longitude)
    return ABERRATION_RAD * np.array(
        [math.sin(longitude), sideways * math.cos(obliquity), sideways * math.sin(obliquity)]
    )


def _refracted(direction: Array, altitude_m: float) -> Array:
    """Directions lifted by the air; what is below a tenth of a radian stays where it is."""
    air = math.exp(-altitude_m / AIR_SCALE_HEIGHT_M)
    true_zenith = np.arccos(np.clip(direction[:, 2], -1.0, 1.0))
    is_up = direction[:, 2] > 0.1
    seen = np.where(is_up, true_zenith, 0.0)
    for _ in range(4):
        tangent = np.tan(seen)
        lift = air * (REFRACTION_RAD * tangent + REFRACTION_CUBED_RAD * tangent**3)
        seen = np.where(is_up, true_zenith - lift, 0.0)
    sideways = np.where(is_up, np.sin(seen) / np.maximum(np.sin(true_zenith), 1e-12), 1.0)
    return np.column_stack([direction[:, :2] * sideways[:, None], np.where(is_up, np.cos(seen), direction[:, 2])])


def image_of_directions(direction: Array, watch: Watch, lens: Lens) -> Array:
    """Pixels (n, 2), (x, y), of directions (n, 3) north, east, up; NaN for those not in front of the camera."""
    azimuth, elevation = watch.azimuth_rad, watch.elevation_rad
    axis = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    above = np.array(
        [-math.sin(elevation) * math.cos(azimuth), -math.sin(elevation) * math.sin(azimuth), math.cos(elevation)]
    )
    in_telescope = direction @ np.stack([left, above, axis], axis=-1)
    # Turned back by the camera's rotation about the telescope's axis.
    cosine, sine = math.cos(lens.rotation_rad), math.sin(lens.rotation_rad)
    x = in_telescope[:, 0] * cosine + in_telescope[:, 1] * sine
    y = -in_telescope[:, 0] * sine + in_telescope[:, 1] * cosine
    columns, rows = -x if lens.is_mirrored else x, -y
    seen = np.stack([columns, rows, in_telescope[:, 2]], axis=-1) @ _tilt_of_lens(lens).T
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = np.where(seen[:, 2:] > 0.5, seen[:, :2] / seen[:, 2:], np.nan)
    r2 = np.sum(flat**2, axis=1, keepdims=True)
    flat[(r2 > _largest_r2(lens))[:, 0]] = np.nan
    bent = flat * (1.0 + lens.brown_k1 * r2 + lens.brown_k2 * r2**2)
    pixels: Array = bent / lens.plate_scale_rad + np.array(lens.centre_pixel)
    return pixels


def _largest_r2(lens: Lens) -> float:
    """The lens ends where Brown's formula, farther out, would soon turn back to the centre."""
    roots = np.roots([5.0 * lens.brown_k2, 3.0 * lens.brown_k1, 1.0 - LEAST_STRETCH])
    ends = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
    return min(ends, default=math.inf)


def _tilt_of_lens(lens: Lens) -> Array:
    """The shortest turn (3, 3) that brings the telescope's axis to where the lens shows it, in the camera's axes."""
    offset = (np.array(lens.axis_pixel) - np.array(lens.centre_pixel)) * lens.plate_scale_rad
    flat = offset.copy()
    for _ in range(_FIXED_POINT_STEPS):
        r2 = float(flat @ flat)
        flat = offset / (1.0 + lens.brown_k1 * r2 + lens.brown_k2 * r2**2)
    x, y, z = np.array([flat[0], flat[1], 1.0]) / math.sqrt(1.0 + float(flat @ flat))
    share = 1.0 / (1.0 + z)
    return np.array([[1.0 - x * x * share, -x * y * share, x], [-x * y * share, 1.0 - y * y * share, y], [-x, -y, z]])


def faint_stars(seed: int) -> FieldCatalogue:
    """Stars from 6.5 to 8.5, which no bright-star catalogue holds, anywhere in the sky."""
    rng = generator(seed, "faint stars")
    n = round(STARS_TO_6_5 * (STARS_PER_MAG ** (FAINTEST_MAG - BRIGHTEST_OF_FAINT_MAG) - 1.0))
    share = rng.random(n) * (STARS_PER_MAG ** (FAINTEST_MAG - BRIGHTEST_OF_FAINT_MAG) - 1.0)
    magnitude = BRIGHTEST_OF_FAINT_MAG + np.log(1.0 + share) / math.log(STARS_PER_MAG)
    return FieldCatalogue(rng.uniform(0.0, math.tau, n), np.arcsin(rng.uniform(-1.0, 1.0, n)), magnitude)


@dataclass(frozen=True, slots=True)
class FalseStar:
    """Hot pixels close together: they look like a star of that magnitude, and stay where they are."""

    x_px: float
    y_px: float
    magnitude: float


Transmission = Callable[[Array], Array]
"""Share of light (n,) that clouds let through at pixels (n, 2)."""


def clear(pixel: Array) -> Array:
    """No clouds."""
    return np.ones(len(pixel))


class StarFieldCamera:
    """Exposures of fields of stars.

    `camera` is as the config describes it: size and radiometric law; its geometry counts for nothing.
    """

    def __init__(self, camera: CameraModel, sensor: Sensor, lens: Lens, star_size_rad: float, seed: int) -> None:
        self._camera, self._sensor, self._lens, self._seed = camera, sensor, lens, seed
        self._frames = StarFrames(sensor, star_size_rad, seed)
        self._n_frames = 0

    def expose(
        self,
        catalogues: tuple[FieldCatalogue, ...],
        watch: Watch,
        exposure_s: float,
        false_stars: tuple[FalseStar, ...] = (),
        transmission: Transmission = clear,
    ) -> Image:
        """A tracked exposure, in the middle of which `watch` is true."""
        rng = generator(self._seed, "noise of star fields", self._n_frames)
        self._n_frames += 1
        pixels, intensities = [], []
        for catalogue in catalogues:
            pixel = image_of_directions(seen_from_site(catalogue, watch), watch, self._lens)
            size = np.array([self._camera.n_columns, self._camera.n_rows])
            inside = np.flatnonzero(((pixel > -100.0) & (pixel < size + 100.0)).all(axis=1))
            pixels.append(pixel[inside])
            intensities.append(10.0 ** (-0.4 * catalogue.magnitude[inside]) * transmission(pixel[inside]))
        pixels.append(np.array([(star.x_px, star.y_px) for star in false_stars]).reshape(-1, 2))
        intensities.append(np.array([10.0 ** (-0.4 * star.magnitude) for star in false_stars]))
        theta = self._camera.theta_of_pixel(np.concatenate(pixels))
        tracks = [
            LightTrack(at[None], np.array([intensity]), 0.0)
            for at, intensity in zip(theta, np.concatenate(intensities), strict=True)
        ]
        sky = (self._sensor.settings.background_share, np.zeros(2))
        image = self._frames.render(tracks, 1.0, sky, exposure_s, rng)
        self._sensor.shine_hot(image, exposure_s, [])
        return image

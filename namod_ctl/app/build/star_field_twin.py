"""The twin's star camera before a field of stars, for rehearsals of `namod-ctl calibrate star-field`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.sky.observed_sky import Site, julian_year, observed_directions
from namod_ctl.calibration.sky.star_catalogue import StarCatalogue
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.instrument import Instrument
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_field import FalseStar, FieldCatalogue, Lens, StarFieldCamera, Watch, faint_stars

EVENING = datetime(2026, 8, 15, 20, tzinfo=UTC)
STEP = timedelta(minutes=20)
N_STEPS = 72
LOWEST_RAD, HIGHEST_RAD = deg_to_rad(30.0), deg_to_rad(65.0)

N_FALSE_STARS, FALSE_MAGNITUDES = 3, (3.5, 6.0)
SCALE_SPREAD, ROTATION_SPREAD_RAD = 0.01, deg_to_rad(1.0)
CENTRE_SPREAD_PX, BROWN_K1_SPREAD, BROWN_K2_SPREAD = 15.0, 1.5, 20.0
"""How the true camera differs from the config's: as much as makes a calibration worth the trouble."""


@dataclass(frozen=True, slots=True, eq=False)
class TwinField:
    """Frames of the twin, when they were taken, and the truth."""

    images: list[NDArray[np.unsignedinteger[Any]]]
    moment: datetime
    lens: Lens


def twin_star_field(
    instrument: Instrument,
    catalogue: StarCatalogue,
    site: Site,
    target: int,
    n_frames: int,
    exposure_s: float,
    seed: int,
) -> TwinField:
    """Frames of the field around a star of the catalogue, at a moment when it stands at a good height.

    Raises
    ------
    ConfigError
        It never does, at this site.
    """
    camera = instrument.star_camera
    rng = generator(seed, "star camera before a field of stars")
    moment, direction = _good_moment(catalogue, site, target)
    lens = Lens(
        plate_scale_rad=camera.plate_scale_rad * (1.0 + SCALE_SPREAD * float(rng.standard_normal())),
        rotation_rad=camera.orientation.rotation_rad + ROTATION_SPREAD_RAD * float(rng.standard_normal()),
        is_mirrored=camera.orientation.is_mirrored,
        centre_pixel=(
            (camera.n_columns - 1) / 2.0 + CENTRE_SPREAD_PX * float(rng.standard_normal()),
            (camera.n_rows - 1) / 2.0 + CENTRE_SPREAD_PX * float(rng.standard_normal()),
        ),
        axis_pixel=(float(camera.axis_pixel[0]), float(camera.axis_pixel[1])),
        brown_k1=BROWN_K1_SPREAD * float(rng.standard_normal()),
        brown_k2=BROWN_K2_SPREAD * float(rng.standard_normal()),
    )
    watch = Watch(
        moment,
        site.latitude_rad,
        site.longitude_rad,
        site.altitude_m,
        azimuth_rad=math.atan2(-direction[1], direction[0]),
        elevation_rad=math.asin(direction[2]),
    )
    places = rng.uniform((0.1, 0.1), (0.9, 0.9), (N_FALSE_STARS, 2)) * (camera.n_columns, camera.n_rows)
    magnitudes = rng.uniform(*FALSE_MAGNITUDES, N_FALSE_STARS)
    false_stars = tuple(
        FalseStar(float(x), float(y), float(mag)) for (x, y), mag in zip(places, magnitudes, strict=True)
    )
    eyes = StarFieldCamera(
        camera, Sensor(camera, STAR_CAMERA, "star camera", seed), lens, instrument.star_size_rad, seed
    )
    seen = catalogue.directions(julian_year(moment))
    bright = FieldCatalogue(np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2]), catalogue.v_mag)
    sky = (bright, faint_stars(seed))
    return TwinField([eyes.expose(sky, watch, exposure_s, false_stars) for _ in range(n_frames)], moment, lens)


def _good_moment(catalogue: StarCatalogue, site: Site, target: int) -> tuple[datetime, NDArray[np.float64]]:
    for step in range(N_STEPS):
        moment = EVENING + step * STEP
        direction = observed_directions(catalogue, moment, site)[target]
        if math.sin(LOWEST_RAD) < direction[2] < math.sin(HIGHEST_RAD):
            return moment, direction
    raise ConfigError("the field never stands at a good height at this site: name another star with --near")

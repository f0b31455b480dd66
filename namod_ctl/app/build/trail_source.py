"""What stars a series of frames shows, and when: from stored frames, from the star camera itself, or from a twin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np

from namod_ctl.app.build.camera_choice import ChosenCamera
from namod_ctl.app.build.frame_series import HOW_TO, FrameSeries, Image
from namod_ctl.app.views.camera_views import Watch
from namod_ctl.calibration.geometry.trail_frames import TrailSpot, trail_spots
from namod_ctl.calibration.sky.observed_sky import Site
from namod_ctl.calibration.sky.star_path import place_of_date
from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.camera_model import CameraModel, Distortion
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.twin.randomness import generator
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_trail import TrailScene, TrailTwin

TWIN_LATITUDE_RAD = deg_to_rad(28.76)
TWIN_FRAMES = 60
TWIN_EXPOSURE_S = 0.05
TWIN_HALF_FIELD = 0.42
"""Of the shorter side of the image: how far the twin's star goes from the middle."""
TWIN_LONGEST_S = 3600.0
TWIN_JITTER_S = 0.02
TWIN_LOW_RAD, TWIN_HIGH_RAD = deg_to_rad(30.0), deg_to_rad(80.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What could be stars in one frame.

    Attributes
    ----------
    time_s
        Middle of the exposure.
    utc, rough_utc
        As in `SeriesFrame`.
    image
        Only of the first frame; a single one may hold a streak.
    """

    name: str
    exposure_s: float
    time_s: float
    utc: datetime | None
    rough_utc: datetime | None
    spots: tuple[TrailSpot, ...]
    image: Image | None


def stored_sightings(series: FrameSeries, camera: CameraModel, star_size_rad: float) -> Iterator[Sighting]:
    """Of every frame with a time, in the order in which they are stored; `series.problems` tells of the others.

    Raises
    ------
    ConfigError
        No frame has a time, or a frame is of another camera.
    """
    n_seen, n_timed = 0, 0
    for frame in series.frames():
        n_seen += 1
        if frame.time_s is None:
            series.problems.append(f"{frame.name}: tells no time (to a fraction of a second)")
            if n_seen > 1 or not math.isfinite(frame.exposure_s):
                continue
        n_timed += frame.time_s is not None
        try:
            spots = trail_spots(frame.image, camera, star_size_rad, frame.exposure_s)
        except ConfigError as error:
            raise ConfigError(f"{frame.name}: {error}") from None
        except DataQualityError as error:
            series.problems.append(f"{frame.name}: {error}")
            continue
        time_s = math.nan if frame.time_s is None else frame.time_s
        image = frame.image if n_seen == 1 else None
        yield Sighting(frame.name, frame.exposure_s, time_s, frame.utc, frame.rough_utc, tuple(spots), image)
    if n_seen > 1 and not n_timed:
        raise ConfigError(f"none of {n_seen} frames tells the time of its exposure; {HOW_TO}")


def live_sightings(chosen: ChosenCamera, clock: Clock, duration_s: float, every_s: float) -> Iterator[Sighting]:
    """Of frames that the camera takes from now on, one after `every_s`."""
    watch = Watch(chosen, None)
    begun_s = chosen.clock.monotonic_s()
    # The camera's clock as time of day: both are read once, so that no setting of the day's clock bends the series.
    zero = clock.now() - timedelta(seconds=begun_s)
    next_s = begun_s
    for number, look in enumerate(watch.looks()):
        now_s = chosen.clock.monotonic_s()
        if now_s - begun_s > duration_s:
            return
        if look.exposure is None:
            continue
        exposure = look.exposure
        try:
            spots = trail_spots(exposure.image, chosen.model, chosen.star_size_rad, exposure.exposure_s)
        except DataQualityError:
            spots = []  # counts as a frame without a star
        utc = zero + timedelta(seconds=exposure.mid_exposure_s)
        yield Sighting(
            f"frame {number + 1}", exposure.exposure_s, exposure.mid_exposure_s, utc, utc, tuple(spots), None
        )
        next_s = max(next_s + every_s, chosen.clock.monotonic_s())
        chosen.clock.wait_s(next_s - chosen.clock.monotonic_s())


@dataclass(frozen=True, slots=True, eq=False)
class TrailRehearsal:
    """A twin whose star camera is not quite as the config says, and where it looks."""

    twin: TrailTwin
    true_camera: CameraModel
    begun: datetime

    def sightings(self, camera: CameraModel, star_size_rad: float) -> Iterator[Sighting]:
        """Of the twin's frames, measured with what the config says of the camera."""
        field_rad = camera.plate_scale_rad * min(camera.n_columns, camera.n_rows)
        half_s = TWIN_HALF_FIELD * field_rad / (math.cos(self.twin.scene.declination_rad) * math.tau / 86164.1)
        half_s = min(half_s, TWIN_LONGEST_S)
        times_s = np.linspace(-half_s, half_s, TWIN_FRAMES)
        for number, frame in enumerate(self.twin.frames(times_s, TWIN_EXPOSURE_S)):
            spots = trail_spots(frame.exposure.image, camera, star_size_rad, TWIN_EXPOSURE_S)
            utc = self.begun + timedelta(seconds=frame.time_s)
            yield Sighting(f"frame {number + 1}", TWIN_EXPOSURE_S, frame.time_s, utc, utc, tuple(spots), None)


def rehearse_trail(
    instrument: Instrument, clock: Clock, seed: int, place_rad: tuple[float, float] | float, site: Site | None
) -> TrailRehearsal:
    """The twin for a star of that ICRS place, over the site at the next good hour; or of that declination, anywhere.

    Raises
    ------
    ConfigError
        The star does not rise high enough there.
    """
    rng = generator(seed, "true geometry of the star camera")
    camera = instrument.star_camera
    orientation = camera.orientation
    turned_rad = orientation.rotation_rad + deg_to_rad(float(rng.normal(0.0, 0.5)))
    middle = np.array([camera.n_columns - 1, camera.n_rows - 1]) / 2.0
    known = camera.distortion or Distortion(middle, 0.0)
    true_camera = replace(
        camera,
        plate_scale_rad=camera.plate_scale_rad * (1.0 + float(rng.normal(0.0, 0.003))),
        orientation=CameraOrientation(turned_rad, orientation.is_mirrored),
        distortion=replace(known, k1_per_rad2=known.k1_per_rad2 + float(rng.uniform(-0.6, 0.3))),
    )
    begun = clock.now()
    if isinstance(place_rad, float):
        latitude_rad, hour_angle_rad, declination_rad, altitude_m = TWIN_LATITUDE_RAD, -0.5, place_rad, 0.0
        if site is not None:
            latitude_rad, altitude_m = site.latitude_rad, site.altitude_m
    else:
        assert site is not None
        latitude_rad, altitude_m = site.latitude_rad, site.altitude_m
        begun, hour_angle_rad, declination_rad = _good_hour(begun, place_rad, site)
    scene = TrailScene(
        latitude_rad=latitude_rad,
        declination_rad=declination_rad,
        hour_angle_rad=hour_angle_rad,
        miss_rad=(float(rng.normal(0.0, 0.004)), float(rng.normal(0.0, 0.004))),
        altitude_m=altitude_m,
        time_jitter_s=TWIN_JITTER_S,
    )
    return TrailRehearsal(
        TrailTwin(scene, true_camera, instrument.star_size_rad, STAR_CAMERA, seed), true_camera, begun
    )


def _good_hour(begun: datetime, place_rad: tuple[float, float], site: Site) -> tuple[datetime, float, float]:
    """The next full hour from now at which the star stands at a good height, its hour angle and declination then."""
    for hours in range(24):
        moment = begun + timedelta(hours=hours)
        hour_angle_rad, declination_rad = place_of_date(moment, *place_rad, site)
        sine = math.sin(site.latitude_rad) * math.sin(declination_rad) + math.cos(site.latitude_rad) * math.cos(
            declination_rad
        ) * math.cos(hour_angle_rad)
        if TWIN_LOW_RAD < math.asin(sine) < TWIN_HIGH_RAD:
            return moment, hour_angle_rad, declination_rad
    raise ConfigError("this star never stands between 30 and 80 deg of altitude at [site]: take another one")

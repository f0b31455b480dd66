"""From pixels to the geometry: frames of the twin's star camera, good ones and bad ones."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from star_field_rig import CAMERA, CATALOGUE, FAINT, SITE, STAR_SIZE_RAD, inside, rich_scene

from namod_ctl.calibration.geometry.field_geometry import Hint, Watch, solve_field
from namod_ctl.calibration.geometry.star_field import field_of_frames, stars_of_frame
from namod_ctl.calibration.sky.observed_sky import julian_year, observed_directions
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import deg_to_rad, mdeg_to_rad
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_field import FalseStar, StarFieldCamera

FALSE_STARS = (FalseStar(400.3, 500.7, 4.5), FalseStar(1900.2, 300.1, 5.5), FalseStar(1111.0, 1500.5, 6.0))


def eyes_of(case, seed):
    return StarFieldCamera(CAMERA, Sensor(CAMERA, STAR_CAMERA, "star camera", seed), case.lens, STAR_SIZE_RAD, seed)


def frames_of(case, seed, n=1, exposure_s=1.0, **options):
    options.setdefault("false_stars", FALSE_STARS)
    eyes = eyes_of(case, seed)
    return [eyes.expose((case.catalogue(), FAINT), case.watch, exposure_s, **options) for _ in range(n)]


def field_of(frames, names=None):
    found = [stars_of_frame(frame, CAMERA, STAR_SIZE_RAD) for frame in frames]
    return field_of_frames(found, names or [f"{number}.fits" for number in range(len(frames))], CAMERA)


def test_geometry_of_frames_with_false_stars_is_right():
    """Three hot spots as wide as stars, hot pixels, fainter stars, noise, a lens that bends; solved blind."""
    case = rich_scene(np.random.default_rng(31), 8)
    field = field_of(frames_of(case, 31, n=2))
    geometry = solve_field(field.stars, CATALOGUE, CAMERA, STAR_SIZE_RAD, Watch(case.watch.moment, SITE))
    plate = geometry.match.fit.plate
    assert plate.is_mirrored == case.lens.is_mirrored
    error = abs(plate.plate_scale_rad - case.lens.plate_scale_rad)
    assert error < min(mdeg_to_rad(0.0005), 4.0 * geometry.plate_scale_uncertainty_rad)
    turn = abs(np.angle(np.exp(1j * (geometry.rotation_rad - case.lens.rotation_rad))))
    assert turn < min(deg_to_rad(0.01), 4.0 * geometry.rotation_uncertainty_rad)
    # None of the false stars is taken for one.
    places = np.array([(star.x_px, star.y_px) for star in FALSE_STARS])
    matched = field.stars.pixel[geometry.match.seen]
    assert np.linalg.norm(matched[:, None] - places[None], axis=2).min() > 5.0


def test_centres_are_as_good_as_said():
    case = rich_scene(np.random.default_rng(32), 10)
    stars = stars_of_frame(frames_of(case, 32)[0], CAMERA, STAR_SIZE_RAD).stars
    places = case.pixels(case.catalogue())
    places = places[inside(places)]
    apart = stars.pixel[stars.is_exact][:, None] - places[None]
    nearest = np.argmin(np.linalg.norm(apart, axis=2), axis=1)
    offset = apart[np.arange(len(nearest)), nearest]
    same = np.linalg.norm(offset, axis=1) < 1.0
    assert same.sum() >= 8
    pulls = offset[same] / stars.error_px[stars.is_exact][same, None]
    assert 0.4 < np.sqrt(np.mean(pulls**2)) < 2.0  # fainter stars that nobody knows of lie beside some


def test_drifting_field_is_that_of_the_mean_direction():
    case = rich_scene(np.random.default_rng(33), 10)
    turned = replace(case.watch, azimuth_rad=case.watch.azimuth_rad + 8.0 * mdeg_to_rad(2.437))
    middle = replace(case.watch, azimuth_rad=case.watch.azimuth_rad + 4.0 * mdeg_to_rad(2.437))
    eyes = eyes_of(case, 33)
    frames = [eyes.expose((case.catalogue(),), watch, 1.0) for watch in (case.watch, turned)]
    field = field_of(frames)
    places = replace(case, watch=middle).pixels(case.catalogue())
    places = places[inside(places)]
    apart = np.linalg.norm(field.stars.pixel[field.stars.is_exact][:, None] - places[None], axis=2).min(axis=1)
    assert np.median(apart) < 0.05
    assert np.linalg.norm(field.drift_px[0] - field.drift_px[1]) > 2.0


def test_clouds_leave_too_few_stars():
    case = rich_scene(np.random.default_rng(34), 6)
    frames = frames_of(case, 34, transmission=lambda pixel: np.full(len(pixel), 2e-4), false_stars=())
    with pytest.raises(DataQualityError, match="clouds"):
        field_of(frames)


def test_different_fields_are_told():
    rng = np.random.default_rng(35)
    one, other = rich_scene(rng, 8), rich_scene(rng, 8)
    frames = [frames_of(case, 35)[0] for case in (one, one, other)]
    with pytest.raises(DataQualityError, match=r"same field: c\.fits shows other stars than a\.fits"):
        field_of(frames, ["a.fits", "b.fits", "c.fits"])


def test_streaks_are_told():
    """The drive stood still for some seconds."""
    case = rich_scene(np.random.default_rng(36), 8)
    eyes = eyes_of(case, 36)
    steps = [
        eyes.expose(
            (case.catalogue(),), replace(case.watch, moment=case.watch.moment + timedelta(seconds=4.0 * step)), 0.6
        )
        for step in range(6)
    ]
    with pytest.raises(DataQualityError, match="trail"):
        field_of([np.maximum.reduce(steps)])


def test_bright_sky_is_told():
    frame = np.full((CAMERA.n_rows, CAMERA.n_columns), 255, dtype=np.uint8)
    with pytest.raises(DataQualityError, match="expose shorter"):
        stars_of_frame(frame, CAMERA, STAR_SIZE_RAD)


def test_frame_of_another_camera_is_told():
    with pytest.raises(ConfigError, match="rows"):
        stars_of_frame(np.zeros((768, 1024), dtype=np.uint8), CAMERA, STAR_SIZE_RAD)


def test_saturated_stars_are_recognized_but_not_measured():
    case = rich_scene(np.random.default_rng(37), 9)
    field = field_of(frames_of(case, 37, exposure_s=3.0))
    assert field.n_saturated >= 1
    middle = observed_directions(CATALOGUE, case.watch.moment, SITE) @ case.direction
    hint = Hint(CATALOGUE.directions(julian_year(case.watch.moment))[np.nanargmax(middle)], deg_to_rad(4.0))
    geometry = solve_field(field.stars, CATALOGUE, CAMERA, STAR_SIZE_RAD, Watch(case.watch.moment, SITE), hint)
    assert not field.stars.is_exact[geometry.match.seen].all()
    assert field.stars.is_exact[geometry.match.seen[geometry.match.is_measured]].all()

"""A lens that bends, calibrated by a star field and used through a config: Theta of every place is the true one.

The twin's lens is Brown's on a sky of its own (`namod_ctl.twin.star_field`), which shares no formula with the camera
model. Its stars are given without errors, and seen through the twin's own air: what is left is the chain itself.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from star_field_rig import CAMERA, CATALOGUE, INSTRUMENT, SITE, SIZE_PX, STAR_SIZE_RAD, rich_scene, seen_stars

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.calibration_files import write_calibration
from namod_ctl.app.commands.calibrate import star_field
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.geometry import field_geometry, plate_solution
from namod_ctl.calibration.geometry.field_geometry import Watch, solve_field
from namod_ctl.twin.star_field import image_of_directions, seen_from_site

ERROR_PX = 1e-4
"""What is put in beforehand about lenses must weigh nothing here."""


def true_directions(scene):
    """Of the catalogue's stars, north, west, up, by the twin's own sky."""
    return seen_from_site(scene.catalogue(), scene.watch) * (1.0, -1.0, 1.0)


def directions_of_theta(theta, watch):
    """North, east, up of places in the telescope frame: +y to larger altitude, +x to the left of who looks out."""
    azimuth, altitude = watch.azimuth_rad, watch.elevation_rad
    out = np.array([math.cos(altitude) * math.cos(azimuth), math.cos(altitude) * math.sin(azimuth), math.sin(altitude)])
    up = np.array(
        [-math.sin(altitude) * math.cos(azimuth), -math.sin(altitude) * math.sin(azimuth), math.cos(altitude)]
    )
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    found = out + np.tan(theta[:, :1]) * left + np.tan(theta[:, 1:]) * up
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", [1])
def test_theta_of_the_whole_image(seed, tmp_path, monkeypatch):
    rng = np.random.default_rng(seed)
    scene = rich_scene(rng, 12)
    monkeypatch.setattr(plate_solution, "LEAST_ERROR_PX", ERROR_PX)
    monkeypatch.setattr(field_geometry, "observed_directions", lambda *_: true_directions(scene))
    stars = seen_stars(rng, scene, error_px=1e-9, n_false=0, faintest_mag=6.6, catalogues=(scene.catalogue(),))
    found = solve_field(stars, CATALOGUE, CAMERA, STAR_SIZE_RAD, Watch(scene.watch.moment, SITE))

    given = star_field._Input([], [], scene.watch.moment, SITE, "stars of the twin")
    out = tmp_path / "geometry.json"
    write_calibration(out, star_field._calibration(found, load_config("fact"), given, 365.0))
    config = tmp_path / "mine.toml"
    config.write_text(f'extends = "fact"\n[star_camera]\ncalibrations = ["{out.name}"]\n')
    camera = build_instrument(load_config(str(config))).star_camera

    half_rad = 0.5 * CAMERA.plate_scale_rad * float(np.hypot(*SIZE_PX))
    theta = np.stack(np.meshgrid(*[np.linspace(-half_rad, half_rad, 61)] * 2), axis=-1).reshape(-1, 2)
    pixel = image_of_directions(directions_of_theta(theta, scene.watch), scene.watch, scene.lens)
    is_in = np.all((pixel > 0.0) & (pixel < SIZE_PX - 1.0), axis=1)
    assert is_in.sum() > 1000
    spread_px = np.ptp(pixel[is_in], axis=0) / SIZE_PX
    assert spread_px.min() > 0.95
    np.testing.assert_allclose(camera.theta_of_pixel(pixel[is_in]), theta[is_in], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(camera.pixel_of_theta(theta[is_in]), pixel[is_in], rtol=0.0, atol=0.03)
    # without the calibration it would be far off
    before = INSTRUMENT.star_camera.theta_of_pixel(pixel[is_in])
    assert float(np.abs(before - theta[is_in]).max()) > 1e-4

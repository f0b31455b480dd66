"""`namod-ctl calibrate star-field` as a crew calls it: frames in, one calibration out, or none."""

from __future__ import annotations

import sys
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from astropy.io import fits
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).parents[1] / "calibration"))

from star_field_rig import CAMERA, CATALOGUE, STAR_SIZE_RAD, rich_scene

from namod_ctl.app.commands.calibrate.star_field import star_field
from namod_ctl.app.config.calibrations import read_calibration
from namod_ctl.calibration.sky.observed_sky import julian_year
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import rad_to_deg, rad_to_mdeg
from namod_ctl.twin.sensor import Sensor
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_field import StarFieldCamera

SITE = "28.76,-17.89,2200"


def call(*arguments):
    """What the command prints; its errors come through."""
    app = typer.Typer()
    app.command()(star_field)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Two FITS frames and a PNG of a field; the scene; right ascension and declination of the field, in words."""
    case = rich_scene(np.random.default_rng(41), 9)
    eyes = StarFieldCamera(CAMERA, Sensor(CAMERA, STAR_CAMERA, "star camera", 41), case.lens, STAR_SIZE_RAD, 41)
    folder = tmp_path_factory.mktemp("night")
    for number in range(2):
        image = eyes.expose((case.catalogue(),), case.watch, 1.0)
        hdu = fits.PrimaryHDU(image)
        hdu.header["EXPTIME"] = 1.0
        start = case.watch.moment + timedelta(seconds=number - 1.0)
        hdu.header["DATE-OBS"] = start.strftime("%Y-%m-%dT%H:%M:%S.%f")
        hdu.writeto(folder / f"{number}.fits")
    cv2.imwrite(str(folder / "alone.png"), image)
    pixel = case.pixels(case.catalogue())
    middle = int(np.nanargmin(np.linalg.norm(pixel - CAMERA.axis_pixel, axis=1)))
    place = CATALOGUE.directions(julian_year(case.watch.moment))[middle]
    ra_deg, dec_deg = np.degrees(np.arctan2(place[1], place[0])) % 360.0, np.degrees(np.arcsin(place[2]))
    return folder, case, f"{ra_deg:.3f},{dec_deg:.3f}"


def test_fits_frames_with_site(night, tmp_path):
    folder, case, near = night
    out = tmp_path / "geometry.json"
    frames = sorted(folder.glob("*.fits"))
    text = call(*frames, "--site", SITE, "--near", near, "--out", out)
    found = read_calibration(out)
    true_scale = rad_to_mdeg(case.lens.plate_scale_rad)
    assert abs(found.plate_scale_mdeg_per_px - true_scale) < 0.0005
    assert abs(found.plate_scale_mdeg_per_px - true_scale) < 4.0 * found.plate_scale_uncertainty_mdeg_per_px
    turn = found.rotation_deg - rad_to_deg(case.lens.rotation_rad)
    assert abs((turn + 180.0) % 360.0 - 180.0) < 0.01
    assert found.mirrored == case.lens.is_mirrored
    assert found.distortion is not None
    assert found.camera == "star_camera"
    assert f'calibrations = ["{out}"]' in text
    assert f"altitude {rad_to_deg(case.watch.elevation_rad):.1f}" in text
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="exists"):
        call(*frames, "--near", near, "--out", out)


def test_picture_without_time_is_limited(night, tmp_path):
    folder, _, near = night
    out = tmp_path / "geometry.json"
    text = call(folder / "alone.png", "--site", SITE, "--near", near, "--out", out)
    found = read_calibration(out)
    assert found.verdict == "limited"
    assert found.rotation_deg is None
    assert found.plate_scale_uncertainty_mdeg_per_px > 0.0005
    assert "give --time" in text


def test_twin_says_what_it_is(tmp_path):
    out = tmp_path / "geometry.json"
    text = call("--twin", "--near", "Shedar", "--out", out)
    assert "Rehearsal" in text
    assert "The twin's truth" in text
    assert read_calibration(out).serial_number.startswith("twin")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--twin"),
        (["FRAME", "--time", "yesterday"], "--time yesterday"),
        (["FRAME", "--site", "28.76"], "--site 28.76"),
        (["FRAME", "--site", "91,0,0"], "--site 91"),
        (["FRAME", "--near", "Vegga"], "did you mean Vega"),
        (["FRAME", "--near", "18h,38"], "--near 18h,38"),
        (["missing.fits"], "no such file"),
        (["FRAME", "--twin"], "--twin makes its own frames"),
    ],
)
def test_bad_input_writes_no_file(night, tmp_path, arguments, message):
    folder, _, _ = night
    out = tmp_path / "geometry.json"
    given = [folder / "alone.png" if argument == "FRAME" else argument for argument in arguments]
    with pytest.raises(ConfigError, match=message):
        call(*given, "--out", out)
    assert not out.exists()


def test_the_picture_never_takes_the_place_of_the_calibration(tmp_path):
    with pytest.raises(ConfigError, match=r"end it with \.json"):
        call("--twin", "--out", tmp_path / "geometry.png")
    assert not list(tmp_path.iterdir())


def test_wrong_place_is_refused(night, tmp_path):
    folder, _, near = night
    ra_deg, dec_deg = (float(text) for text in near.split(","))
    with pytest.raises(DataQualityError, match="--near"):
        call(
            folder / "alone.png",
            "--near",
            f"{(ra_deg + 180.0) % 360.0},{-dec_deg}",
            "--out",
            tmp_path / "geometry.json",
        )
    assert list(tmp_path.iterdir()) == []


def test_frames_of_a_long_time_are_refused(night, tmp_path):
    folder, case, near = night
    late = tmp_path / "late.fits"
    with fits.open(folder / "0.fits") as opened:
        opened[0].header["DATE-OBS"] = (case.watch.moment + timedelta(minutes=5)).strftime("%Y-%m-%dT%H:%M:%S.%f")
        opened.writeto(late)
    with pytest.raises(ConfigError, match="one right after the other"):
        call(folder / "0.fits", late, "--near", near, "--out", tmp_path / "geometry.json")

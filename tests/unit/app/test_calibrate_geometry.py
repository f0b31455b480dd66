"""`namod-ctl calibrate trail`, `chessboard` and `axis` as a crew calls them: files in, one calibration out, or none."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from astropy.io import fits
from typer.testing import CliRunner

from namod_ctl.app.build.camera_choice import DEFAULT_SIZE, open_chosen
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.trail_source import live_sightings
from namod_ctl.app.commands.calibrate.axis import axis
from namod_ctl.app.commands.calibrate.chessboard import chessboard
from namod_ctl.app.commands.calibrate.trail import trail
from namod_ctl.app.config.calibrations import read_calibration
from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.records import Record
from namod_ctl.core.units import mdeg_to_rad
from namod_ctl.store.run import RunStore
from namod_ctl.twin.chessboard import Board, draw_poses, lens_of, render_board
from namod_ctl.twin.settings import STAR_CAMERA
from namod_ctl.twin.star_trail import TrailScene, TrailTwin

SMALL = """
extends = "{fact}"
[star_camera]
columns = 640
rows = 480
plate_scale_mdeg_per_px = 6.0
star_diameter_deg = 0.04
rotation_deg = 0.0
[reflector_camera]
columns = 360
rows = 270
plate_scale_mdeg_per_px = 40.0
"""
SITE = """
[site]
latitude_deg = 28.76
longitude_deg = -17.89
altitude_m = 2200.0
"""
SCENE = TrailScene(0.502, 0.35, -0.3, (0.002, -0.003), magnitude=1.0)
BEGUN = datetime(2026, 11, 22, 2, 0, tzinfo=UTC)


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL.format(fact=builtin_folder() / "mini_fact.toml"))
    return str(path)


def call(function, *arguments):
    """What the command prints; its errors come through."""
    app = typer.Typer()
    app.command()(function)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def frames_of(config, scene=SCENE, n=16, half_s=280.0, exposure_s=0.1):
    instrument = build_instrument(load_config(config))
    true = replace(instrument.star_camera, plate_scale_rad=1.003 * instrument.star_camera.plate_scale_rad)
    twin = TrailTwin(scene, true, instrument.star_size_rad, replace(STAR_CAMERA, n_hot_pixels=50), 1)
    return list(twin.frames(np.linspace(-half_s, half_s, n), exposure_s))


def write_fits(folder: Path, frames, names=None, fraction=True):
    """As a foreign program does it: DATE-OBS is the beginning of the exposure, in UTC."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        start = BEGUN + timedelta(seconds=frame.time_s - frame.exposure.exposure_s / 2.0)
        hdu = fits.PrimaryHDU(frame.exposure.image)
        hdu.header["EXPTIME"] = frame.exposure.exposure_s
        hdu.header["DATE-OBS"] = start.strftime("%Y-%m-%dT%H:%M:%S.%f" if fraction else "%Y-%m-%dT%H:%M:%S")
        hdu.writeto(folder / (f"{number:03d}.fits" if names is None else names[number]))
    return folder


def test_trail_of_foreign_fits_files_in_any_order(config, tmp_path):
    frames = frames_of(config)
    names = [f"{number * 7 % 16:03d}.fits" for number in range(16)]
    folder = write_fits(tmp_path / "night", frames, names)
    (folder / "cut.fits").write_bytes((folder / "000.fits").read_bytes()[:5000])
    out = tmp_path / "geometry.json"
    text = call(trail, folder, "--declination-deg", np.degrees(SCENE.declination_rad), "--config", config, "--out", out)
    calibration = read_calibration(out)
    off = abs(calibration.plate_scale_mdeg_per_px - 6.018)
    assert off < 3.0 * calibration.plate_scale_uncertainty_mdeg_per_px < 0.02
    assert calibration.camera == "star_camera"
    assert calibration.mirrored is False
    assert calibration.rotation_deg is None
    assert "missing [site]" in text
    assert "cut.fits" in text
    assert f'calibrations = ["{out}"]' in text
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="exists"):
        call(trail, folder, "--declination-deg", 20, "--config", config, "--out", out)


def test_trail_out_of_a_run(config, tmp_path):
    loaded = load_config(config)
    with RunStore.create(tmp_path / "run", (1,), loaded.to_json(), "test", SystemClock()) as store:
        for number, frame in enumerate(frames_of(config)):
            store.add_frame(number, "star_camera", frame.exposure.image)
            none = np.full(1, np.nan)
            store.append(
                [
                    Record(
                        number, "", np.full(2, np.nan), np.nan, np.nan, none, none, 0.1, 0.1,
                        star_mid_exposure_s=5000.0 + frame.time_s,
                    )
                ]
            )  # fmt: skip
    declination = np.degrees(SCENE.declination_rad)
    text = call(trail, tmp_path / "run", "--declination-deg", declination, "--config", config)
    assert "6.01" in text
    assert "Nothing was written" in text


def test_rehearsal_over_a_site_tells_rotation_and_its_truth(config, tmp_path):
    with_site = tmp_path / "site.toml"
    with_site.write_text(Path(config).read_text() + SITE)
    out = tmp_path / "twin.json"
    text = call(trail, "--twin", "--seed", 3, "--star", "Aldebaran", "--config", with_site, "--out", out)
    calibration = read_calibration(out)
    truth = text.split("The twin's truth: ")[1]
    true_scale, true_rotation = float(truth.split()[0]), float(truth.split("rotation ")[1].split()[0])
    off = abs(calibration.plate_scale_mdeg_per_px - true_scale)
    assert off < 3.5 * calibration.plate_scale_uncertainty_mdeg_per_px
    assert calibration.rotation_deg == pytest.approx(true_rotation, abs=0.01)
    assert calibration.serial_number == "twin, seed 3"


def test_one_long_exposure_is_a_limited_calibration(config, tmp_path):
    instrument = build_instrument(load_config(config))
    settings = replace(STAR_CAMERA, exposure_at_mag0_s=40.0, n_hot_pixels=0)
    (frame,) = TrailTwin(SCENE, instrument.star_camera, instrument.star_size_rad, settings, 1).frames(
        np.zeros(1), 240.0
    )
    image = tmp_path / "streak.png"
    cv2.imwrite(str(image), frame.exposure.image)
    image.with_suffix(".json").write_text(json.dumps({"exposure_s": 240.0}))
    out = tmp_path / "geometry.json"
    declination = np.degrees(SCENE.declination_rad)
    call(trail, image, "--declination-deg", declination, "--config", config, "--out", out)
    calibration = read_calibration(out)
    assert calibration.verdict == "limited"
    assert calibration.method == "star streak"
    assert calibration.plate_scale_mdeg_per_px == pytest.approx(6.0, abs=0.01)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (["--twin", "--star", "Jupiter"], ConfigError, "moves among the stars"),
        (["--twin", "--star", "Nobody"], ConfigError, "is called"),
        (["--twin", "--declination-deg", "20", "--star", "Vega"], ConfigError, "one of"),
        (["FRAMES"], ConfigError, "say which star"),
        (["FRAMES", "--declination-deg", "95"], ConfigError, "must lie between"),
        (["FRAMES", "--twin"], ConfigError, "--twin makes frames"),
        (["EMPTY", "--declination-deg", "20"], ConfigError, "no frame in this folder"),
        (["nowhere", "--declination-deg", "20"], ConfigError, "no such file"),
        (["ONE", "--declination-deg", "20"], DataQualityError, "no streak"),
        (["SECONDS", "--declination-deg", "20"], ConfigError, "time of its exposure"),
        (["SMALL", "--declination-deg", "20"], ConfigError, "640"),
        (["DARK", "--declination-deg", "20"], DataQualityError, "seen in 0 of 4"),
        (["FRAMES", "--declination-deg", "55"], DataQualityError, "another star"),
    ],
)
def test_bad_input_writes_no_trail(config, tmp_path, options, error, words):
    folder = tmp_path / "in"
    match options[0]:
        case "EMPTY":
            folder.mkdir()
        case "ONE":
            write_fits(folder, frames_of(config, n=1))
        case "SECONDS":
            write_fits(folder, frames_of(config, n=3), fraction=False)
        case "SMALL":
            frames = frames_of(config, n=3)
            write_fits(folder, [replace(f, exposure=replace(f.exposure, image=f.exposure.image[::2])) for f in frames])
        case "DARK":
            write_fits(folder, frames_of(config, replace(SCENE, cloud_share=1.0), n=4))
        case "FRAMES":
            write_fits(folder, frames_of(config, n=10))
    known = [str(folder) if option.isupper() else option for option in options]
    out = tmp_path / "geometry.json"
    with pytest.raises(error, match=words):
        call(trail, *known, "--config", config, "--out", out)
    assert not out.exists()
    assert not out.with_suffix(".png").exists()


def board_files(folder: Path, camera, n=7):
    folder.mkdir()
    rng = np.random.default_rng(4)
    board = Board((9, 6), 0.03)
    for number, pose in enumerate(draw_poses(board, camera, n, 5)):
        image = render_board(board, pose, lens_of(camera), (camera.n_columns, camera.n_rows), rng)
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def test_chessboards_of_the_reflector_camera(config, tmp_path):
    camera = build_instrument(load_config(config)).reflector_camera
    true = replace(camera, plate_scale_rad=1.02 * camera.plate_scale_rad)
    folder = board_files(tmp_path / "boards", true)
    cv2.imwrite(str(folder / "wall.png"), np.full((270, 360), 100, np.uint8))
    out = tmp_path / "reflector.json"
    text = call(chessboard, folder, "--camera", "reflector", "--config", config, "--out", out)
    calibration = read_calibration(out)
    assert calibration.camera == "reflector_camera"
    assert calibration.rotation_deg is None
    assert calibration.mirrored is None
    off = abs(mdeg_to_rad(calibration.plate_scale_mdeg_per_px) - true.plate_scale_rad)
    assert off < 3.0 * mdeg_to_rad(calibration.plate_scale_uncertainty_mdeg_per_px)
    assert "wall.png: shows no board" in text
    assert out.with_suffix(".png").exists()


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (["BOARDS", "--corners", "9by6"], ConfigError, "such as 9x6"),
        (["BOARDS", "--camera", "moon"], ConfigError, "choose star or reflector"),
        (["BOARDS", "--camera", "star"], ConfigError, "choose the right --camera"),
        (["BOARDS", "--camera", "reflector", "--corners", "12x9"], DataQualityError, "count the corners"),
        (["BOARDS", "--camera", "reflector"], DataQualityError, "at least 6"),
        ([], ConfigError, "give FRAMES"),
    ],
)
def test_bad_input_writes_no_lens(config, tmp_path, options, error, words):
    if options:
        board_files(tmp_path / "boards", build_instrument(load_config(config)).reflector_camera, n=2)
    known = [str(tmp_path / "boards") if option == "BOARDS" else option for option in options]
    out = tmp_path / "lens.json"
    with pytest.raises(error, match=words):
        call(chessboard, *known, "--config", config, "--out", out)
    assert not out.exists()


def held_files(folder: Path, config, x_px, y_px, n=8, wander_px=0.3):
    camera = build_instrument(load_config(config)).star_camera
    folder.mkdir()
    rng = np.random.default_rng(int(x_px))
    y, x = np.mgrid[: camera.n_rows, : camera.n_columns].astype(float)
    for number in range(n):
        at_x, at_y = rng.normal((x_px, y_px), wander_px)
        light = 150.0 * np.exp(-0.5 * ((x - at_x) ** 2 + (y - at_y) ** 2) / 2.8**2) + rng.normal(3.0, 1.0, x.shape)
        cv2.imwrite(str(folder / f"{number}.png"), np.clip(np.rint(light), 0, 255).astype(np.uint8))
    return folder


def test_axis_of_held_stars_over_zenith(config, tmp_path):
    low, high = (held_files(tmp_path / name, config, 330.0 + x, 231.0) for name, x in (("low", 0.0), ("high", 12.0)))
    out = tmp_path / "axis.json"
    text = call(
        axis, "--held", low, "--zenith-deg", 20, "--held", high, "--zenith-deg", 60, "--config", config, "--out", out
    )
    calibration = read_calibration(out)
    assert calibration.axis_px == pytest.approx((336.0, 231.0), abs=0.4)
    assert [row[0] for row in calibration.over_zenith] == pytest.approx([20.0, 60.0])
    assert [row[1] for row in calibration.over_zenith] == pytest.approx([330.0, 342.0], abs=0.5)
    assert calibration.verdict == "limited"
    assert calibration.covariance_px2[0][0] > 30.0
    assert "the axis moves" in text
    assert out.with_suffix(".png").exists()


def test_axis_of_one_held_star(config, tmp_path):
    out = tmp_path / "axis.json"
    call(axis, "--held", held_files(tmp_path / "held", config, 330.0, 231.0), "--config", config, "--out", out)
    calibration = read_calibration(out)
    assert calibration.verdict == "good"
    assert calibration.over_zenith == ()
    for value, true, k in ((calibration.axis_px[0], 330.0, 0), (calibration.axis_px[1], 231.0, 1)):
        assert abs(value - true) < 4.0 * calibration.covariance_px2[k][k] ** 0.5


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ([], ConfigError, "--run RUN"),
        (["--held", "HELD", "--twin"], ConfigError, "one of the three"),
        (["--held", "HELD", "--zenith-deg", "20", "--zenith-deg", "30"], ConfigError, "2 times for 1"),
        (["--held", "HELD", "--zenith-deg", "120"], ConfigError, "between 0 and 90"),
        (["--held", "FEW"], DataQualityError, "at least 5"),
        (["--held", "WANDERS"], DataQualityError, "not held"),
        (["--held", "EMPTY"], ConfigError, "no frame"),
        (["--run", "EMPTY"], ConfigError, "no run"),
    ],
)
def test_bad_input_writes_no_axis(config, tmp_path, options, error, words):
    folder = tmp_path / "in"
    if "EMPTY" in options:
        folder.mkdir()
    elif "FEW" in options:
        held_files(folder, config, 330.0, 231.0, n=3)
    elif "WANDERS" in options:
        held_files(folder, config, 330.0, 231.0, wander_px=40.0)
    else:
        held_files(folder, config, 330.0, 231.0, n=5)
    known = [str(folder) if option.isupper() else option for option in options]
    out = tmp_path / "axis.json"
    with pytest.raises(error, match=words):
        call(axis, *known, "--config", config, "--out", out)
    assert not out.exists()


def test_live_frames_carry_the_time_of_day(config):
    with open_chosen("star", config, DEFAULT_SIZE, 255.0, is_twin=True) as chosen:
        seen = list(live_sightings(chosen, SystemClock(), duration_s=40.0, every_s=5.0))
    assert 6 <= len(seen) <= 9
    steps_s = np.diff([sighting.time_s for sighting in seen])
    assert steps_s == pytest.approx(5.0, abs=0.5)
    told_s = [(b.utc - a.utc).total_seconds() for a, b in itertools.pairwise(seen)]
    assert told_s == pytest.approx(steps_s, abs=1e-5)
    assert sum(len(sighting.spots) == 1 for sighting in seen) >= 5

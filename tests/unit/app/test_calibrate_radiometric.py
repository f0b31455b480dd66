"""`namod-ctl calibrate radiometric` and `dark` on stored frames of the twin's lamp, and on bad input."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from astropy.io import fits
from typer.testing import CliRunner, Result

from namod_ctl.app.build import lamp_bench
from namod_ctl.app.build.lamp_bench import Person, camera_model_of, twin_lamp
from namod_ctl.app.commands.calibrate.dark import dark
from namod_ctl.app.commands.calibrate.radiometric import radiometric
from namod_ctl.app.config.calibration_schema import DarkCalibration, RadiometricCalibration
from namod_ctl.app.config.calibrations import read_calibration
from namod_ctl.app.config.instrument import load_config
from namod_ctl.calibration.lamp.lamp_series import at_distance
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.twin.lamp import TwinLamp

COLUMNS, ROWS = 96, 72
DISTANCES_M = (0.5, 1.0, 2.0, 4.0, 1.5, 0.7)
EXPOSURES_S = tuple(float(t) for t in np.geomspace(0.001, 1.5, 12))
FIRST = datetime(2026, 11, 22, 21, 0, 0, tzinfo=UTC)

Rows = list[dict[str, str]]


@pytest.fixture(scope="module")
def config_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "small.toml"
    path.write_text(f'extends = "fact"\n[star_camera]\ncolumns = {COLUMNS}\nrows = {ROWS}\naxis_px = [48.0, 36.0]\n')
    return path


def _lamp(config_path: Path) -> TwinLamp:
    return twin_lamp(camera_model_of(load_config(config_path), "star_camera"), "star_camera", 7)


def _write(folder: Path, config_path: Path, *, is_fits: bool) -> None:
    """A series as somebody else's program might have stored it."""
    lamp = _lamp(config_path)
    rows: Rows = []

    def expose(exposure_s: float, row: dict[str, str]) -> None:
        lamp.start(exposure_s)
        taken = lamp.fetch(2.0)
        name = f"frame_{len(rows):04d}.{'fits' if is_fits else 'png'}"
        if is_fits:
            start = FIRST + timedelta(seconds=taken.mid_exposure_s - taken.exposure_s / 2.0)
            header = fits.Header({"EXPTIME": taken.exposure_s, "DATE-OBS": start.isoformat().replace("+00:00", "")})
            fits.writeto(folder / name, taken.image, header)
            rows.append({"file": name, **row})
        else:
            cv2.imwrite(str(folder / name), taken.image)
            rows.append({"file": name, "exposure_s": f"{taken.exposure_s:.6g}", **row})

    lamp.cap()
    for exposure_s in (0.001, 0.1, 1.5):
        for _ in range(3):
            expose(exposure_s, {"distance_m": "", "is_dark": "1"})
    for distance_m in DISTANCES_M:
        lamp.place(distance_m)
        for exposure_s in (*EXPOSURES_S[::-1], *EXPOSURES_S):
            expose(exposure_s, {"distance_m": f"{distance_m:g}", "is_dark": "0"})
    _write_rows(folder, rows)


def _write_rows(folder: Path, rows: Rows) -> None:
    with (folder / "series.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _rows(folder: Path) -> Rows:
    with (folder / "series.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory, config_path: Path) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    _write(folder, config_path, is_fits=False)
    return folder


@pytest.fixture
def changed(pictures: Path, tmp_path: Path) -> Callable[[Callable[[dict[str, str]], dict[str, str] | None]], Path]:
    """Makes a folder of links to the pictures with other rows; None leaves one out."""

    def change(new_row: Callable[[dict[str, str]], dict[str, str] | None]) -> Path:
        folder = tmp_path / "changed"
        folder.mkdir()
        rows = [row for old in _rows(pictures) if (row := new_row(dict(old))) is not None]
        for row in rows:
            if not (folder / row["file"]).exists():
                (folder / row["file"]).symlink_to(pictures / row["file"])
        _write_rows(folder, rows)
        return folder

    return change


def run(command: Callable[..., None], config_path: Path, *arguments: str | Path) -> Result:
    app = typer.Typer(add_completion=False)
    app.command()(command)
    return CliRunner().invoke(app, ["star", "--config", str(config_path), *map(str, arguments)])


def refused(result: Result, match: str) -> None:
    assert isinstance(result.exception, (ConfigError, DataQualityError)), result.output
    assert match in str(result.exception)


def test_pictures_make_a_calibration(pictures: Path, config_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "star.json"
    result = run(radiometric, config_path, "--frames", pictures, "--out", out, "--distance-error-mm", "1")
    assert result.exit_code == 0, result.output
    calibration = read_calibration(out)
    assert isinstance(calibration, RadiometricCalibration)
    law, error = calibration.law, np.sqrt(np.diag(np.array(calibration.covariance)))
    assert law.name == "three_parameter"
    assert abs(law.r_resp - 1.20) < 3.5 * error[0] < 0.05
    assert abs(law.r_expo + 1.23) < 3.5 * error[1] < 0.05
    assert calibration.verdict == "good"
    assert "1 m" in calibration.intensity_unit
    assert any("seconds" in remark for remark in calibration.remarks)
    assert out.with_suffix(".png").stat().st_size > 20_000
    refused(run(radiometric, config_path, "--frames", pictures, "--out", out), "the file exists")


def test_fits_files_tell_exposures_and_times(config_path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    _write(folder, config_path, is_fits=True)
    out = tmp_path / "star.json"
    assert run(radiometric, config_path, "--frames", folder, "--out", out).exit_code == 0
    law = json.loads(out.read_text())["law"]
    assert law["r_expo"] / law["r_resp"] == pytest.approx(-1.23 / 1.20, abs=0.003)
    shortest = _rows(folder)[20]["file"]
    with fits.open(folder / shortest, mode="update") as file:
        file[0].header["EXPTIME"] *= 1000.0
    refused(run(radiometric, config_path, "--frames", folder, "--out", out, "--force"), "milliseconds beside seconds")


def test_milliseconds_called_seconds(changed: Callable[..., Path], config_path: Path, tmp_path: Path) -> None:
    folder = changed(lambda row: row | {"exposure_s": f"{1000.0 * float(row['exposure_s']):g}"})
    out = tmp_path / "star.json"
    refused(run(radiometric, config_path, "--frames", folder, "--out", out), "milliseconds or microseconds")
    assert not out.exists()
    assert run(radiometric, config_path, "--frames", folder, "--out", out, "--exposure-unit", "ms").exit_code == 0
    assert out.exists()


def test_bad_folders_are_refused(changed: Callable[..., Path], config_path: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(run(radiometric, config_path, "--frames", empty), "holds no frames")
    refused(run(radiometric, config_path, "--frames", tmp_path / "none"), "does not exist")
    refused(run(dark, config_path, "--frames", empty), "holds no frames")
    folder = changed(lambda row: row | {"is_dark": "perhaps"} if row["file"] == "frame_0003.png" else row)
    refused(run(radiometric, config_path, "--frames", folder), "series.csv, line 5: is_dark = 'perhaps'")
    (folder / "series.csv").unlink()
    refused(run(radiometric, config_path, "--frames", folder), "is missing")


def test_frames_of_another_camera(changed: Callable[..., Path], config_path: Path) -> None:
    folder = changed(lambda row: row)
    other = folder / "frame_0100.png"
    other.unlink()
    cv2.imwrite(str(other), np.zeros((480, 640), np.uint8))
    refused(run(radiometric, config_path, "--frames", folder), "has 640 x 480 pixel, the camera of the config 96 x 72")
    cv2.imwrite(str(other), np.zeros((ROWS, COLUMNS, 3), np.uint8))
    refused(run(radiometric, config_path, "--frames", folder), "several cameras or modes")


def test_only_saturated_frames(changed: Callable[..., Path], config_path: Path) -> None:
    def saturated(row: dict[str, str]) -> dict[str, str] | None:
        is_bright = float(row["exposure_s"]) > 0.9 and row["distance_m"] in ("0.5", "1", "0.7")
        return row if is_bright or row["is_dark"] == "1" else None

    refused(run(radiometric, config_path, "--frames", changed(saturated)), "all frames of the lamp are saturated")


def test_one_level_tells_the_ratio_only(changed: Callable[..., Path], config_path: Path, tmp_path: Path) -> None:
    folder = changed(lambda row: row if row["distance_m"] in ("2", "") else None)
    out = tmp_path / "star.json"
    refused(run(radiometric, config_path, "--frames", folder, "--out", out), "only r_expo / r_resp can be told")
    result = run(radiometric, config_path, "--frames", folder, "--out", out, "--free-levels")
    assert result.exit_code == 0
    assert "r_expo / r_resp = -1.0" in result.output
    assert not out.exists()


def test_two_frames_only(changed: Callable[..., Path], config_path: Path) -> None:
    folder = changed(lambda row: row if row["file"] in ("frame_0020.png", "frame_0050.png") else None)
    refused(run(radiometric, config_path, "--frames", folder), "2 frames of the lamp are too few")


def test_without_dark_frames_it_is_limited(changed: Callable[..., Path], config_path: Path, tmp_path: Path) -> None:
    folder = changed(lambda row: row if row["is_dark"] == "0" else None)
    out = tmp_path / "star.json"
    assert run(radiometric, config_path, "--frames", folder, "--out", out).exit_code == 0
    calibration = read_calibration(out)
    assert calibration.verdict == "limited"
    assert any("dark frames" in remark for remark in calibration.remarks)


def test_dark_frames_of_the_series(pictures: Path, config_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "dark.json"
    result = run(dark, config_path, "--frames", pictures, "--out", out)
    assert result.exit_code == 0, result.output
    calibration = read_calibration(out)
    assert isinstance(calibration, DarkCalibration)
    assert calibration.bias_adu == pytest.approx(0.0, abs=0.1)
    assert calibration.read_noise_adu == pytest.approx(0.6, abs=0.05)
    assert len(calibration.hot_pixels) > 30


def test_frames_of_the_lamp_are_no_dark_frames(changed: Callable[..., Path], config_path: Path, tmp_path: Path) -> None:
    folder = changed(lambda row: row | {"is_dark": "1"} if row["is_dark"] == "1" or row["distance_m"] == "4" else None)
    out = tmp_path / "dark.json"
    result = run(dark, config_path, "--frames", folder, "--out", out)
    assert isinstance(result.exception, DataQualityError)
    assert not out.exists()


def test_cap_that_was_forgotten(changed: Callable[..., Path], config_path: Path) -> None:
    def lit(row: dict[str, str]) -> dict[str, str] | None:
        is_early = row["distance_m"] == "4" and float(row["exposure_s"]) > 0.05
        return row | {"is_dark": "1"} if is_early else row

    result = run(radiometric, config_path, "--frames", changed(lit))
    refused(result, "put the cap on")


def test_rehearsal_on_the_twin(config_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "star.json"
    result = run(radiometric, config_path, "--twin", "--out", out, "--distances", "0.5,1,2,4,3")
    assert result.exit_code == 0, result.output
    assert "Rehearsal" in result.output
    assert read_calibration(out).serial_number == "twin, seed 1"
    refused(run(radiometric, config_path, "--twin", "--distances", "1,1"), "at least two different")
    refused(run(radiometric, config_path, "--distances", "1,2"), "names no device")


def test_guided_series_at_the_keyboard(config_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera is the twin's; whoever sits at the keyboard does what the program says, and nothing else."""
    lamp = _lamp(config_path)
    told: list[str] = []

    def obey(prompt: str) -> str:
        told.append(prompt)
        if "cap on" in prompt:
            lamp.cap()
        else:
            lamp.place(float(prompt.split("Lamp: ")[1].split(" m ")[0]))
        return ""

    monkeypatch.setattr("builtins.input", obey)
    monkeypatch.setattr(lamp_bench, "open_camera", lambda *_: lamp)
    monkeypatch.setattr(lamp_bench, "SystemMonotonicClock", lambda: lamp.clock)
    out = tmp_path / "star.json"
    result = run(radiometric, config_path, "--out", out, "--distances", "0.5,0.8,1.3,2,3.2,5")
    assert result.exit_code == 0, result.output
    assert len(told) == 8
    calibration = read_calibration(out)
    assert calibration.serial_number is None
    assert isinstance(calibration, RadiometricCalibration)
    assert calibration.law.r_resp == pytest.approx(1.20, abs=0.015)
    assert calibration.law.r_expo == pytest.approx(-1.23, abs=0.015)


def test_person_is_told_what_to_do() -> None:
    told: list[str] = []
    person = Person(told.append)
    person.cap()
    person.place(at_distance(1.4))
    person.place(at_distance(2.0))
    assert "cap on" in told[0]
    assert told[1:] == [
        "Take the cap off, put the diffuser before the lens. Lamp: 1.4 m from the diffuser.",
        "Lamp: 2 m from the diffuser.",
    ]
    assert math.isclose(at_distance(2.0).level, 0.25)

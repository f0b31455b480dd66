"""`namod-ctl psf`: files in, table, JSON and picture out; wrong input is told and writes nothing."""

import json
import math
import re
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).parents[1] / "imaging"))

from spot_frames import SHAPE, elliptic, frame_of

from namod_ctl.app.build import psf_camera
from namod_ctl.app.build.sky_campaign import psf_camera_name
from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import InstrumentConfig, builtin_folder, load_config
from namod_ctl.core.errors import ConfigError, DataQualityError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure

PSF_CAMERA = """
extends = "{base}"
[psf_camera]
model = "DMK 33UX"
serial_number = "0815"
columns = 300
rows = 240
plate_scale_mdeg_per_px = 1.05
full_scale_adu = 255.0
saturation_share = 0.98
"""


def run(*arguments):
    return CliRunner().invoke(app, ["psf", *map(str, arguments)], env={"COLUMNS": "160"})


def config_file(tmp_path, more="", base="mini_fact"):
    path = tmp_path / "with_screen.toml"
    path.write_text(PSF_CAMERA.format(base=builtin_folder() / f"{base}.toml") + more)
    return path


@pytest.fixture
def folder(tmp_path):
    frames = tmp_path / "screen"
    frames.mkdir()
    for number in range(3):
        light = 120.0 * elliptic(140.0 + 4.0 * number, 120.0, 9.0, 6.0, 0.3)
        frame = frame_of(light, np.random.default_rng(number))
        if number < 2:
            cv2.imwrite(str(frames / f"{number}.png"), frame)
        else:
            hdu = fits.PrimaryHDU(frame)
            hdu.header["EXPTIME"] = 0.1
            hdu.writeto(frames / f"{number}.fits")
    return frames


def test_folder_of_frames(folder, tmp_path):
    out = tmp_path / "psf"
    result = run(folder, "--plate-scale-mdeg", 1.05, "--out", out)
    assert result.exit_code == 0, result.output
    found = json.loads((out / "psf.json").read_text())
    assert found["schema"] == "namod-psf/1"
    assert found["n_images"] == 3
    assert [image["name"] for image in found["images"]] == ["0.png", "1.png", "2.fits"]
    scale_arcmin = 1.05e-3 * 60.0
    assert found["a_sigma_arcmin2"] == pytest.approx(math.pi * 54.0 * scale_arcmin**2, rel=0.02)
    assert found["ellipse"]["sigma_long_arcmin"] == pytest.approx(9.0 * scale_arcmin, rel=0.02)
    assert found["drift_px"] == pytest.approx([8.0, 0.0], abs=0.2)
    assert found["containment"]["r80"]["mm"] is None  # nobody told the focal length
    assert cv2.imread(str(out / "psf.png")).shape[1] > 1000
    assert "A_sigma" in result.output


def test_config_gives_scale_focal_length_and_serial_number(folder, tmp_path):
    result = run(folder, "--config", config_file(tmp_path), "--out", tmp_path / "psf")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "psf" / "psf.json").read_text())
    assert found["camera"] == {"model": "DMK 33UX", "serial_number": "0815", "plate_scale_mdeg_per_px": 1.05}
    r80 = found["containment"]["r80"]
    focal_length_mm = 1000.0 * load_config("mini_fact").telescope.focal_length_m
    assert r80["mm"] == pytest.approx(math.radians(r80["arcmin"] / 60.0) * focal_length_mm)


def test_frames_that_cannot_be_used_are_told_and_left_out(folder):
    cv2.imwrite(str(folder / "3.png"), frame_of(np.zeros(SHAPE), np.random.default_rng(5)))
    (folder / "4.png").write_bytes(b"no picture")
    result = run(folder, "--plate-scale-mdeg", 1.05)
    assert result.exit_code == 0, result.output
    assert "3 images" in result.output
    assert "left out: 3.png: no star" in result.output
    assert "4.png" in result.output
    assert "nothing was written" in result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "say where the images come from"),
        (["{folder}", "--twin"], "say where the images come from"),
        (["{folder}"], "--plate-scale-mdeg 1.05"),
        (["{folder}", "--config", "mini_fact"], "no \\[psf_camera\\]"),
        (["{folder}/none", "--plate-scale-mdeg", "1.05"], "no such file"),
        (["--live"], "--config"),
        (["--live", "--config", "mini_fact"], "no \\[psf_camera\\]"),
        (["--live", "--config", "{config}"], "no device"),
        (["{folder}", "--config", "{config}", "--full-scale", "255"], "full_scale_adu"),
        (["--twin", "--plate-scale-mdeg", "1.05"], "stored frames"),
    ],
)
def test_wrong_input(folder, tmp_path, arguments, words):
    config = config_file(tmp_path)
    out = tmp_path / "psf"
    filled = [argument.format(folder=folder, config=config) for argument in arguments]
    result = run(*filled, "--out", out)
    assert isinstance(result.exception, ConfigError)
    assert re.search(words, str(result.exception))
    assert not out.exists()


def test_frames_of_two_cameras_are_refused(folder):
    cv2.imwrite(str(folder / "9.png"), np.zeros((100, 120), dtype=np.uint8))
    result = run(folder, "--plate-scale-mdeg", 1.05)
    assert isinstance(result.exception, ConfigError)
    assert "one camera" in str(result.exception)


def test_no_frame_with_a_star(tmp_path):
    cv2.imwrite(str(tmp_path / "dark.png"), frame_of(np.zeros(SHAPE), np.random.default_rng(5)))
    result = run(tmp_path / "dark.png", "--plate-scale-mdeg", 1.05, "--out", tmp_path / "psf")
    assert isinstance(result.exception, DataQualityError)
    assert "dark.png: no star" in str(result.exception)
    assert not (tmp_path / "psf").exists()


def test_twelve_bits_in_a_file_of_sixteen(tmp_path):
    light = 6000.0 * elliptic(140.0, 120.0, 9.0, 6.0, 0.3)
    frame = frame_of(light, np.random.default_rng(1), bits=12, electrons_per_adu=1.0)
    cv2.imwrite(str(tmp_path / "saturated.png"), frame)
    result = run(tmp_path / "saturated.png", "--plate-scale-mdeg", 1.05)
    assert isinstance(result.exception, DataQualityError)
    assert "cameras of 12 bit saturate" in str(result.exception)
    result = run(tmp_path / "saturated.png", "--plate-scale-mdeg", 1.05, "--full-scale", 4095)
    assert "saturated" in str(result.exception)


def test_older_results_are_kept(folder, tmp_path):
    (tmp_path / "psf.json").write_text("older")
    result = run(folder, "--plate-scale-mdeg", 1.05, "--out", tmp_path)
    assert isinstance(result.exception, ConfigError)
    assert (tmp_path / "psf.json").read_text() == "older"
    assert run(folder, "--plate-scale-mdeg", 1.05, "--out", tmp_path, "--force").exit_code == 0


def test_twin(tmp_path):
    more = "n_frames = 2\n"
    text = config_file(tmp_path, more).read_text().replace("columns = 300", "columns = 640").replace("240", "480")
    (tmp_path / "with_screen.toml").write_text(text.replace("1.05", "3.0"))
    result = run("--twin", "--config", tmp_path / "with_screen.toml", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "rehearsal" in result.output
    truth = float(result.output.split("A_sigma is ")[1].split()[0])
    row = next(line for line in result.output.splitlines() if "A_sigma, arcmin2" in line)
    assert float(row.split("│")[2]) == pytest.approx(truth, rel=0.02)


class ScreenCamera:
    """A driver that shows a spot as bright as its exposure is long."""

    name = "psf camera (a test's)"
    exposure_range_s = (0.001, 3.0)

    def __init__(self):
        self.n_frames, self.is_closed = 0, False

    def start(self, exposure_s):
        self.exposure_s = exposure_s

    def fetch(self, timeout_s):
        self.n_frames += 1
        light = min(1500.0 * self.exposure_s, 500.0) * elliptic(150.0, 120.0, 9.0, 7.0, 0.3)
        frame = frame_of(light, np.random.default_rng(self.n_frames))
        return Exposure(frame, self.exposure_s, time.monotonic(), self.n_frames)

    def close(self):
        self.is_closed = True


def test_live(tmp_path, monkeypatch):
    camera = ScreenCamera()
    monkeypatch.setattr(psf_camera, "open_camera", lambda config, role, clock: camera)
    config = config_file(tmp_path, 'n_frames = 3\n[psf_camera.device]\ndriver = "opencv"\naddress = "2"\n')
    result = run("--live", "--config", config, "--out", tmp_path / "psf")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "psf" / "psf.json").read_text())
    assert found["n_images"] == 3
    assert found["a_sigma_arcmin2"] == pytest.approx(math.pi * 63.0 * (1.05e-3 * 60.0) ** 2, rel=0.02)
    assert camera.is_closed


def test_a_campaign_begins_without_its_psf_camera(tmp_path, monkeypatch):
    def lost(config, role, clock):
        raise DeviceFaultError("there is no such camera")

    monkeypatch.setattr(psf_camera, "open_camera", lost)
    config = load_config(config_file(tmp_path, '[psf_camera.device]\ndriver = "opencv"\naddress = "2"\n'))
    told = []
    assert psf_camera_name(config, told.append) == []
    assert "goes on without it: there is no such camera" in told[0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("exposure_s = -1.0\n", "psf_camera.exposure_s"),
        ("n_frames = 0\n", "psf_camera.n_frames"),
        ("focus = 3\n", "psf_camera.focus"),
        ('[psf_camera.device]\ndriver = "pylon"\nfed_by_twin = true\n', "of its own"),
        ('[psf_camera.device]\ndriver = "pylon"\npixel_format = "Mono7"\n', "psf_camera.device.pixel_format"),
        ('calibrations = ["none.json"]\n', "psf_camera.calibrations"),
    ],
)
def test_config_is_checked(tmp_path, more, words):
    with pytest.raises(ConfigError, match=words):
        load_config(config_file(tmp_path, more))


def test_same_device_as_another_camera(tmp_path):
    devices = "".join(
        f'[{camera}.device]\ndriver = "opencv"\naddress = "{address}"\n'
        for camera, address in (("psf_camera", 1), ("star_camera", 0), ("reflector_camera", 1))
    )
    path = config_file(tmp_path, devices)
    path.write_text(path.read_text().replace('serial_number = "0815"\n', ""))
    with pytest.raises(ConfigError, match=r"psf_camera\.device and reflector_camera\.device are the same"):
        load_config(path)


def test_config_is_kept_whole(tmp_path):
    config = load_config(config_file(tmp_path))
    assert InstrumentConfig.from_json(config.to_json(), "stored") == config

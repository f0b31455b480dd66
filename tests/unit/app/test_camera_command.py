"""`namod-ctl camera`: one camera at the bench, here the twin's, an emulated one, and such that misbehave."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner, Result

import namod_ctl.app.commands.camera as command
from namod_ctl.app.build.camera_choice import ChosenCamera, open_chosen
from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import builtin_folder
from namod_ctl.app.views.camera_views import LOST, Watch, dropped_text, focus_line, write_frame
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError, NamodError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.cycle.focus import FocusReading

SMALL = """
extends = "mini_fact.toml"
[star_camera]
columns = 640
rows = 480
plate_scale_mdeg_per_px = 9.75
[reflector_camera]
columns = 256
rows = 192
plate_scale_mdeg_per_px = 240.0
"""


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "small.toml"
    path.write_text(SMALL.replace("mini_fact.toml", str(builtin_folder() / "mini_fact.toml")))
    return str(path)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "LINE_EVERY_S", 0.0)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["camera", *arguments], env={"COLUMNS": "200"})


def test_snap_tells_how_bright_and_writes_what_it_saw(config: str, tmp_path: Path) -> None:
    png, fit = tmp_path / "star.png", tmp_path / "star.fits"
    told = run("snap", "star", "--twin", "--config", config, "--out", str(png))
    assert told.exit_code == 0, told.output
    image = cv2.imread(str(png), cv2.IMREAD_UNCHANGED)
    assert image.shape == (480, 640)
    brightest = int(re.search(r"brightest (\d+) of 255", told.output)[1])
    assert 0.2 * 255 <= brightest < 0.98 * 255  # chosen by the exposure law
    assert brightest <= image.max()
    width_px, width_arcmin = map(float, re.search(r"a star, ([\d.]+) px, ([\d.]+) arcmin", told.output).groups())
    assert width_arcmin == pytest.approx(width_px * 9.75e-3 * 60.0, abs=0.1)
    again = run("snap", "star", "--twin", "--config", config, "--exposure", "0.02", "--out", str(fit))
    assert "exposure 0.02 s" in again.output
    with fits.open(fit) as file:
        assert file[0].data.shape == (480, 640)
        assert file[0].data.dtype == np.uint8
        assert file[0].header["EXPTIME"] == pytest.approx(0.02)
    assert isinstance(run("snap", "star", "--twin", "--config", config, "--out", str(fit)).exception, ConfigError)
    assert run("snap", "star", "--twin", "--config", config, "--out", str(fit), "--force").exit_code == 0


def test_live_and_focus_and_check(config: str) -> None:
    live = run("live", "reflector", "--twin", "--config", config, "--frames", "5")
    assert live.exit_code == 0, live.output
    assert len([line for line in live.output.splitlines() if line.startswith("exposure")]) == 5
    assert "5 frames" in live.output
    assert "none was lost" in live.output
    focus = run("focus", "star", "--twin", "--config", config, "--frames", "4")
    assert focus.exit_code == 0, focus.output
    assert focus.output.count("█") > 20
    assert "best so far" in focus.output
    check = run("check", "star", "--twin", "--config", config)
    assert check.exit_code == 0, check.output
    assert "follows its exposure" in check.output
    dark = run("check", "reflector", "--twin", "--config", config)
    assert dark.exit_code in (0, 3), dark.output  # the star may light no facet at the moment


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["snap", "moon"], "star or reflector"),
        (["snap", "nikon:1"], "pylon"),
        (["snap", "pylon:1", "--size", "big"], "columns x rows"),
        (["snap", "pylon:1", "--twin"], "leave them out"),
        (["snap", "star"], "device"),  # the config names none
        (["snap", "star", "--twin", "--out", "x.jpg"], ".png or .fits"),
        (["snap", "star", "--twin", "--out", "/no/such/folder/x.png"], "does not exist"),
    ],
)
def test_what_cannot_be_meant_is_said(arguments: list[str], said: str) -> None:
    failed = run(*arguments).exception
    assert isinstance(failed, NamodError)
    assert said in str(failed)


class Wrapped:
    """The twin's camera with something done to it."""

    def __init__(self, chosen: ChosenCamera) -> None:
        self._camera = chosen.camera
        self.name, self.exposure_range_s = chosen.camera.name, chosen.camera.exposure_range_s
        self.n = 0

    def start(self, exposure_s: float) -> None:
        self._camera.start(exposure_s)

    def fetch(self, timeout_s: float) -> Exposure:
        return self.changed(self._camera.fetch(timeout_s))

    def changed(self, exposure: Exposure) -> Exposure:
        self.n += 1
        if self.n == 2:
            raise CommunicationError("no frame came")
        if self.n == 3:
            raise DeviceFaultError("lost 1 s ago; attempt 1 of 6")
        if self.n == 5:
            self._kept = exposure
        return replace(self._kept, frame_id=6) if self.n == 6 else exposure

    def close(self) -> None:
        self._camera.close()


def test_a_watch_goes_on_through_lost_frames_and_counts_them(config: str) -> None:
    with open_chosen("star", config, "", 255.0, is_twin=True) as chosen:
        wrapped = replace(chosen, camera=Wrapped(chosen))
        watch = Watch(wrapped, None)
        looks = [look for look, _ in zip(watch.looks(), range(7), strict=False)]
    assert [look.exposure is None for look in looks] == [False, True, True, False, False, True, False]
    assert "attempt 1 of 6" in looks[2].trouble
    assert "same noise" in looks[5].trouble
    assert dropped_text(watch.dropped) == f"2 {LOST}, 1 repeated"


def test_check_refuses_a_camera_that_does_not_obey(config: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Deaf(Wrapped):
        def start(self, exposure_s: float) -> None:
            self._asked_s = exposure_s
            self._camera.start(0.02)

        def changed(self, exposure: Exposure) -> Exposure:
            return replace(exposure, exposure_s=self._asked_s)

    @contextmanager
    def deaf(*arguments: object, **options: bool) -> Iterator[ChosenCamera]:
        with open_chosen(*arguments, **options) as chosen:
            yield replace(chosen, camera=Deaf(chosen))

    monkeypatch.setattr(command, "open_chosen", deaf)
    told = run("check", "star", "--twin", "--config", config)
    assert told.exit_code == 1, told.output
    assert "does not follow its exposure setting" in told.output


def test_bars_are_short_when_the_star_is_sharp() -> None:
    bars = [
        focus_line(FocusReading(px, 1e-4, 0.5), 4.0, "", has_plate_scale=False).count("█")
        for px in (4.0, 8.0, 16.0, 99.0)
    ]
    assert bars == [10, 20, 40, 40]
    assert "no star" in focus_line(FocusReading(math.nan, math.nan, math.nan, "cloud"), 4.0, "", has_plate_scale=True)


@pytest.mark.parametrize(("dtype", "shape"), [(np.uint16, (20, 30)), (np.uint8, (20, 30, 3)), (np.uint16, (20, 30, 3))])
def test_files_keep_every_bit(tmp_path: Path, dtype: type, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    exposure = Exposure(image, 0.1, 1.0, 7)
    write_frame(tmp_path / "x.png", exposure, "a camera")
    write_frame(tmp_path / "x.fits", exposure, "a camera \u00e9")
    assert np.array_equal(cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_UNCHANGED), image)
    data = fits.getdata(tmp_path / "x.fits")
    assert np.array_equal(data if image.ndim == 2 else np.moveaxis(data, 0, 2)[:, :, ::-1], image)


def test_ctrl_c_ends_a_watch_in_order(config: str) -> None:
    code = "import sys; from namod_ctl.app.cli import main; main()"
    arguments = [sys.executable, "-u", "-c", code, "camera", "live", "star", "--twin", "--config", config]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(3):
            assert process.stdout.readline().startswith("exposure")
        process.send_signal(signal.SIGINT)
        started_s = time.monotonic()
        output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "frames," in output
    assert errors == ""
    assert time.monotonic() - started_s < 10.0


def on_an_emulated_camera(*arguments: str) -> subprocess.CompletedProcess[str]:
    if find_spec("pypylon") is None:
        pytest.skip("pypylon is not installed: pip install 'namod-ctl[pylon]'")
    code = "from namod_ctl.app.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, "camera", *arguments],
        env=os.environ | {"PYLON_CAMEMU": "2"},
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )


def test_a_camera_by_its_driver_and_number() -> None:
    done = on_an_emulated_camera("snap", "pylon:0815-0001", "--exposure", "0.01", "--size", "640x480")
    assert done.returncode == 0, done.stderr
    assert "0815-0001" in done.stdout
    assert "640 x 480 pixel, grey, 8 bit" in done.stdout


def test_a_camera_of_the_bench_sees_the_twins_sky_through_its_makers_library() -> None:
    done = on_an_emulated_camera("check", "star", "--config", "bench_pylon")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Basler Emulation" in done.stdout
    assert "follows its exposure setting" in done.stdout


def test_the_makers_emulated_camera_does_not_follow_its_exposure_and_is_found_out() -> None:
    """It shows a test picture that is the same at every exposure."""
    done = on_an_emulated_camera("check", "pylon:0815-0000", "--size", "640x480")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "does not follow its exposure setting" in done.stdout
    assert "grew 1.00 times" in done.stdout

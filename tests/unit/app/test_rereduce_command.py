"""A run re-reduced with newer calibrations: both results stay, and what changed is what the calibrations changed."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_night import FACET_IDS, SEED, SETTINGS, small_config, small_twin
from typer.testing import CliRunner

from namod_ctl.app.alignment_files import read_alignment
from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.twin import instrument_on_twin
from namod_ctl.app.build.twin_note import note_twin, noted_twin
from namod_ctl.app.calibration_files import new_header, write_calibration
from namod_ctl.app.cli import app
from namod_ctl.app.config.calibration_schema import DarkCalibration, GeometryCalibration
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.rereduction import recalibrated_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_mdeg
from namod_ctl.cycle.record import Equipment, Recorder, StopRule
from namod_ctl.store.run import RunStore

N_RECORDS = 60
STRETCH = 1.05


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A run with frames and one without, of the same records."""
    folder = tmp_path_factory.mktemp("night")
    config = small_config()
    twin = small_twin(config)
    settings = replace(build_record_settings(config), pace_s=twin.telescope.pass_s / N_RECORDS, keep_frames=True)
    with RunStore.create(folder / "framed", FACET_IDS, config.to_json(), "twin", twin.wall_clock) as run:
        note_twin(run, SETTINGS, SEED)
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        Recorder(equipment, instrument_on_twin(config), run, settings).record(StopRule(n_records=N_RECORDS))
        records = run.records()
    with RunStore.create(folder / "bare", FACET_IDS, config.to_json(), "twin", SystemClock()) as run:
        run.append(records)
    return folder


def geometry(path: Path, **changes) -> Path:
    camera = small_config().star_camera
    header = new_header(camera, "star_camera", SystemClock(), source="by hand") | changes
    calibration = GeometryCalibration(
        kind="geometry",
        plate_scale_mdeg_per_px=STRETCH * camera.plate_scale_mdeg_per_px,
        plate_scale_uncertainty_mdeg_per_px=0.001,
        residual_rms_px=0.1,
        method="by hand",
        n_points=2,
        **header,
    )
    write_calibration(path, calibration)
    return path


def dark(path: Path) -> Path:
    header = new_header(small_config().star_camera, "star_camera", SystemClock(), source="cap on")
    calibration = DarkCalibration(
        kind="dark",
        bias_adu=0.0,
        rate_adu_per_s=0.0,
        read_noise_adu=0.6,
        fixed_pattern_adu=0.0,
        hot_pixels=(),
        **header,
    )
    write_calibration(path, calibration)
    return path


def rereduce(*arguments):
    return CliRunner().invoke(app, ["rereduce", *map(str, arguments)])


def fingerprint(folder: Path) -> dict[str, str]:
    passing = ("-wal", "-shm")  # SQLite's own, of whoever reads the run
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(passing))
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.parametrize("name", ["framed", "bare"])
def test_directions_stretch_with_the_plate_scale_and_the_old_run_stays(night, tmp_path, name):
    before = fingerprint(night / name)
    out = tmp_path / "new"
    result = rereduce(night / name, "--calibration", geometry(tmp_path / "geometry.json"), "--out", out)
    assert result.exit_code == 0, result.output
    assert "A_sigma now" in result.output
    assert fingerprint(night / name) == before
    with RunStore.open(night / name) as old, RunStore.open(out) as new:
        axis_moves_nothing = np.array([r.theta_rad for r in old.records() if r.reject_reason is None])
        theta = np.array([r.theta_rad for r in new.records() if r.reject_reason is None])
        config = InstrumentConfig.from_json(new.config_json, "new")
        assert noted_twin(new) == noted_twin(old)
    # measured anew, the star's windows follow the plate scale: 1e-3 px at most
    np.testing.assert_allclose(theta, STRETCH * axis_moves_nothing, atol=5e-8)
    assert rad_to_mdeg(instrument_on_twin(config).star_camera.plate_scale_rad) == pytest.approx(STRETCH * 2.437)
    assert read_alignment(out).n_records == N_RECORDS
    assert (out / "rereduction.txt").read_text() in result.output


def test_without_frames_what_only_frames_can_follow_is_refused(night, tmp_path):
    result = rereduce(night / "bare", "--calibration", dark(tmp_path / "dark.json"), "--out", tmp_path / "new")
    assert isinstance(result.exception, ConfigError)
    assert "no frames were kept" in str(result.exception)
    assert "dark level" in str(result.exception)
    assert not (tmp_path / "new").exists()
    assert rereduce(night / "framed", "--calibration", tmp_path / "dark.json", "--out", tmp_path / "new").exit_code == 0


def test_foreign_and_expired_calibrations_are_refused_unless_accepted(night, tmp_path):
    foreign = geometry(tmp_path / "foreign.json", model="another camera")
    old = {"made_utc": "2001-01-01T00:00:00+00:00", "valid_until_utc": "2002-01-01T00:00:00+00:00"}
    expired = geometry(tmp_path / "expired.json", **old)
    with RunStore.open(night / "bare") as run:
        config = InstrumentConfig.from_json(run.config_json, "run")
    for path, word in ((foreign, "foreign"), (expired, "expired")):
        result = rereduce(night / "bare", "--calibration", path, "--out", tmp_path / "new")
        assert isinstance(result.exception, ConfigError)
        assert f"--accept {word}" in str(result.exception)
        assert not (tmp_path / "new").exists()
        accepted = recalibrated_config(config, [path], (word,), SystemClock().now())
        assert instrument_on_twin(accepted).star_camera.plate_scale_rad > 0.0


def test_wrong_words_are_refused(night, tmp_path):
    path = geometry(tmp_path / "g.json")
    for arguments, words in (
        (("--calibration", path, "--accept", "anything"), "must be expired or foreign"),
        (("--calibration", path, "--out", night / "bare"), "is the run itself"),
        (("--calibration", tmp_path / "absent.json"), "no such calibration file"),
        (("--calibration", path, "--calibration", path), "a second geometry calibration"),
    ):
        result = rereduce(night / "bare", *arguments)
        assert isinstance(result.exception, ConfigError)
        assert words in str(result.exception)
    assert not (night / "bare-rereduced").exists()

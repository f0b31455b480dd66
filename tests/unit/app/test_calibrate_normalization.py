"""`namod-ctl calibrate normalization` on small runs on disk: what it writes, says and refuses."""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from namod_ctl.app.calibration_files import new_header, write_calibration
from namod_ctl.app.cli import main
from namod_ctl.app.config.calibration_schema import GeometryCalibration
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.report.of_run import run_report
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.records import Record, RejectReason
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.store.run import RunStore

FACET_IDS = (2, 3, 4, 5, 12, 13)  # of FACT's 30
N_RECORDS = 240
REGION_RAD = deg_to_rad(0.1)
PER_MAGNITUDE = -0.069  # the paper's slope, arXiv:1605.06274
FILES = {"normalization.json", "normalization.png"}


def records(slope, magnitude, noise=0.03, radius_rad=REGION_RAD):
    """Gaussian facets of 1.5 arcmin under a star of these magnitudes (n,), and responses with that slope."""
    rng = np.random.default_rng(4)
    n = len(magnitude)
    radius, angle = radius_rad * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    theta = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    centres = rng.normal(0, arcmin_to_rad(1.0), (len(FACET_IDS), 2))
    distance = np.linalg.norm(theta[:, None] - centres, axis=2)
    response = np.exp(-0.5 * (distance / arcmin_to_rad(1.5)) ** 2) * rng.lognormal(0, noise, distance.shape)
    response *= (1.0 + slope) ** magnitude[:, None]
    true = 10.0 ** (-0.4 * magnitude)
    star = true * rng.lognormal(0, noise, n)
    nothing = np.full(len(FACET_IDS), np.nan)
    for i in range(n):
        intensity = true[i] * response[i] + 1e-4 * rng.lognormal(0, 0.3, len(FACET_IDS))
        yield Record(i + 1, f"n{i}", theta[i], np.nan, star[i], intensity, nothing, np.nan, np.nan)


def store_run(folder, content):
    with RunStore.create(folder, FACET_IDS, load_config("fact").to_json(), "test", SystemClock()) as store:
        store.append(content)
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three stars, two magnitudes between the extremes, and cameras like the paper's."""
    magnitude = np.repeat([0.0, 2.0, 1.0], N_RECORDS // 3)
    return store_run(tmp_path_factory.mktemp("recorded") / "RUN", list(records(PER_MAGNITUDE, magnitude)))


@pytest.fixture
def run(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "RUN")


@pytest.fixture
def namod_ctl(monkeypatch, capsys):
    """The program, called as from the command line; returns exit code and all that was said."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["namod-ctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        said = capsys.readouterr()
        return int(caught.value.code or 0), " ".join((said.out + said.err).split())

    return call


def is_untouched(run: Path) -> bool:
    return not FILES & {path.name for path in run.iterdir()}


def test_the_paper_s_slope_is_measured_drawn_and_explained(run, namod_ctl):
    code, said = namod_ctl("calibrate", "normalization", run)
    assert code == 0, said
    assert "per magnitude" in said
    assert "do not match" in said
    assert "calibrate radiometric" in said
    found = json.loads((run / "normalization.json").read_text())
    assert found["schema"] == "namod-normalization/1"
    assert found["verdict"] == "imperfect"
    error = found["slope_percent_per_magnitude"] - 100.0 * PER_MAGNITUDE
    assert abs(error) < 3.0 * found["slope_percent_per_magnitude_uncertainty"] < 3.0
    assert found["slope_percent_per_decade"] > 0.0, "responses grow with the light"
    assert len(found["records"]["index"]) == len(found["records"]["magnitude"])
    image = cv2.imread(str(run / "normalization.png"))
    assert image is not None
    assert image.shape[0] > 600


def test_reconstruct_takes_it_out_and_says_so(run, namod_ctl):
    code, said = namod_ctl("reconstruct", run)
    assert code == 0, said
    assert "the self-calibration has taken it out" in said
    remarks = json.loads((run / "alignment.json").read_text())["remarks"]
    assert any(remark.startswith("self-calibration") for remark in remarks)


def test_reconstruct_leaves_it_where_it_is_told_to(run, namod_ctl):
    code, said = namod_ctl("reconstruct", run, "--no-self-calibration")
    assert code == 0, said
    assert "still in the responses" in said
    remarks = json.loads((run / "alignment.json").read_text())["remarks"]
    assert not any(remark.startswith("self-calibration") for remark in remarks)
    document, _ = run_report(run)
    assert f"namod-ctl reconstruct {run.name} --no-self-calibration" in str(document)


def test_the_report_keeps_what_was_taken_out(run, namod_ctl):
    code, said = namod_ctl("reconstruct", run)
    assert code == 0, said
    document, _ = run_report(run)
    assert "--no-self-calibration" not in str(document)


def test_rereduce_leaves_it_where_it_is_told_to(run, tmp_path, namod_ctl):
    section = load_config("fact").star_camera
    geometry = GeometryCalibration(
        kind="geometry",
        plate_scale_mdeg_per_px=section.plate_scale_mdeg_per_px,
        plate_scale_uncertainty_mdeg_per_px=0.001,
        residual_rms_px=0.1,
        method="by hand",
        n_points=2,
        **new_header(section, "star_camera", SystemClock(), source="by hand"),
    )
    write_calibration(tmp_path / "geometry.json", geometry)
    for name, switch in (("on", "--self-calibration"), ("off", "--no-self-calibration")):
        out = tmp_path / name
        code, said = namod_ctl("rereduce", run, "--calibration", tmp_path / "geometry.json", "--out", out, switch)
        assert code == 0, said
        remarks = json.loads((out / "alignment.json").read_text())["remarks"]
        assert any(remark.startswith("self-calibration") for remark in remarks) == (name == "on")


def test_a_lamp_in_steps(tmp_path, namod_ctl):
    """All records in one direction: the same command; no error, no slope."""
    magnitude = np.repeat(np.linspace(0.0, 4.0, 9), 6)
    run = store_run(tmp_path / "RUN", list(records(0.0, magnitude, noise=0.01, radius_rad=1e-9)))
    code, said = namod_ctl("calibrate", "normalization", run)
    assert code == 0, said
    found = json.loads((run / "normalization.json").read_text())
    assert found["verdict"] == "good"
    assert abs(found["slope_percent_per_magnitude"]) < 0.3


def test_a_steady_star_is_refused(tmp_path, namod_ctl):
    run = store_run(tmp_path / "RUN", list(records(PER_MAGNITUDE, np.zeros(N_RECORDS))))
    code, said = namod_ctl("calibrate", "normalization", run)
    assert code == 2
    assert "mag only" in said
    assert "clouds" in said
    assert is_untouched(run)


def test_a_run_without_records_is_refused(tmp_path, namod_ctl):
    rejected = [
        replace(record, star_intensity=math.nan, reject_reason=RejectReason.NO_STAR, detail="nothing there")
        for record in records(0.0, np.zeros(3))
    ]
    for name, content in (("EMPTY", []), ("REJECTED", rejected)):
        run = store_run(tmp_path / name, content)
        code, said = namod_ctl("calibrate", "normalization", run)
        assert code == 2
        assert "no record of this run counts" in said
        assert is_untouched(run)


def test_one_lit_facet_is_refused(tmp_path, namod_ctl):
    magnitude = np.repeat(np.linspace(0.0, 4.0, 9), 6)
    one = [
        replace(record, facet_intensity=record.facet_intensity * np.array([1.0, 0, 0, 0, 0, 0]))
        for record in records(PER_MAGNITUDE, magnitude, radius_rad=1e-9)
    ]
    run = store_run(tmp_path / "RUN", one)
    code, said = namod_ctl("calibrate", "normalization", run)
    assert code == 2
    assert "1 facets" in said
    assert is_untouched(run)


def test_records_without_intensities_are_refused(run, tmp_path, namod_ctl):
    """As the response maps of the original program are imported: every star has the intensity 1."""
    flat = [
        replace(record, star_intensity=1.0, facet_intensity=record.facet_intensity / record.star_intensity)
        for record in records(PER_MAGNITUDE, np.zeros(N_RECORDS))
    ]
    maps = store_run(tmp_path / "MAPS", flat)
    code, said = namod_ctl("calibrate", "normalization", maps)
    assert code == 2
    assert "response maps" in said
    assert is_untouched(maps)


def test_no_run_at_all(tmp_path, namod_ctl):
    code, said = namod_ctl("calibrate", "normalization", tmp_path / "NONE")
    assert code == 2
    assert "no run" in said

"""`namod-ctl reconstruct` on a small run on disk: what it writes, says and refuses."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from astropy.table import QTable

from namod_ctl.app.alignment_files import read_alignment
from namod_ctl.app.cli import main
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.records import Record, RejectReason
from namod_ctl.store.run import RunStore

DEG = np.pi / 180.0
ARCMIN = DEG / 60.0
FACET_IDS = (2, 3, 4, 5, 12, 13)  # of FACT's 30
DEAD = 5
N_RECORDS = 250
N_REJECTED = 3
WRITTEN = {
    "alignment.json",
    "facets.ecsv",
    "report.txt",
    "psf_maps.png",
    "exposure_map.png",
    "psf_sum.png",
}


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def namod_ctl(monkeypatch, capsys):
    """The program, called as from the command line."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["namod-ctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return Done(int(caught.value.code or 0), *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def centres_rad():
    return np.random.default_rng(3).normal(0, 4 * ARCMIN, (len(FACET_IDS), 2))


def records_of(centres_rad, n=N_RECORDS):
    """Gaussian facets of 1.5 arcmin, a scan of 0.25 deg radius, and a star that is never equally bright."""
    rng = np.random.default_rng(4)
    radius, angle = 0.25 * DEG * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    theta = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    distance = np.linalg.norm(theta[:, None] - centres_rad, axis=2)
    response = np.exp(-0.5 * (distance / (1.5 * ARCMIN)) ** 2) * rng.lognormal(0, 0.05, distance.shape)
    response += 1e-3 * np.abs(rng.normal(1, 0.3, distance.shape))
    response[:, FACET_IDS.index(DEAD)] = 0.0
    star = rng.uniform(0.3, 3.0, n)
    nothing = np.full(len(FACET_IDS), np.nan)
    for i in range(n):
        yield Record(i + 1, f"n{i}", theta[i], np.nan, star[i], star[i] * response[i], nothing, np.nan, np.nan)
    for i in range(n, n + N_REJECTED):
        yield Record(
            i + 1,
            f"n{i}",
            np.full(2, np.nan),
            np.nan,
            np.nan,
            nothing,
            nothing,
            np.nan,
            np.nan,
            RejectReason.NO_STAR,
            "nothing there",
        )


def store_run(folder, records):
    with RunStore.create(folder, FACET_IDS, load_config("fact").to_json(), "test", SystemClock()) as store:
        store.append(records)
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, centres_rad):
    """A run that is never touched; tests work on copies."""
    return store_run(tmp_path_factory.mktemp("recorded") / "RUN", list(records_of(centres_rad)))


@pytest.fixture
def run(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "RUN")


def test_everything_is_written_and_true(run, namod_ctl, centres_rad):
    done = namod_ctl("reconstruct", run, "--halves")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in run.iterdir()} >= WRITTEN

    alignment = json.loads((run / "alignment.json").read_text())
    assert (alignment["schema"], alignment["estimator"]) == ("namod-alignment/1", "robust")
    assert (alignment["n_records"], alignment["n_used"]) == (N_RECORDS, N_RECORDS)
    facets = {facet["id"]: facet for facet in alignment["facets"]}
    assert tuple(facets) == FACET_IDS
    for facet_id, centre in zip(FACET_IDS, centres_rad, strict=True):
        facet = facets[facet_id]
        if facet_id == DEAD:
            assert facet["theta_x_deg"] is None
            assert facet["flags"] == ["NO_SIGNAL"]
            continue
        found = np.array([facet["theta_x_deg"], facet["theta_y_deg"]]) * DEG
        # dozens of records within 1.5 arcmin of the centre: a tenth of the width is safe
        np.testing.assert_allclose(found, centre, atol=0.3 * ARCMIN)
        assert facet["width_major_deg"] * DEG == pytest.approx(1.5 * ARCMIN, rel=0.2)

    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    assert len(table) == len(FACET_IDS)
    for name in ("psf_maps.png", "exposure_map.png", "psf_sum.png"):
        picture = cv2.imread(str(run / name))
        assert picture is not None
        assert picture.std() > 1.0, f"{name} is blank"
    assert (run / "report.txt").read_text().strip() in done.stdout
    assert "Even against odd records" in done.stdout
    with RunStore.open(run) as store:
        kept = store.latest_estimate()
    assert kept is not None
    assert json.loads(kept) == alignment
    assert read_alignment(run).estimator == "robust"


def test_the_report_is_for_people(run, namod_ctl):
    assert namod_ctl("reconstruct", run).returncode == 0
    report = (run / "report.txt").read_text()
    assert f"{len(FACET_IDS)} facets, {N_RECORDS} records" in report
    for words in (
        "A_sigma",
        "limit of mirrors without figure errors (ray-traced)",
        "predicted after correction",
        "this run does not have",
        "no estimate",
    ):
        assert words in report
    assert "NO_SIGNAL" in report
    assert "nan" not in report.lower()


def test_instructions_of_an_older_estimate_are_removed_and_that_is_said(run, namod_ctl):
    assert "older reconstruction" not in namod_ctl("reconstruct", run).stdout
    (run / "instructions.csv").write_text("facet_id\n")
    done = namod_ctl("reconstruct", run)
    assert "of an older reconstruction and are removed" in done.stdout
    assert not (run / "instructions.csv").exists()


def test_a_second_estimate_replaces_the_files(run, namod_ctl):
    assert namod_ctl("reconstruct", run, "--estimator", "cog").returncode == 0
    assert namod_ctl("reconstruct", run, "--estimator", "brightest", "--bin-size-deg", "0.02").returncode == 0
    assert json.loads((run / "alignment.json").read_text())["estimator"] == "brightest"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--estimator", "median"), ("--estimator", "median", "robust")),
        (("--bin-size-deg", "0"), ("--bin-size-deg", "0.0005")),
        (("--bin-size-deg", "-1"), ("--bin-size-deg",)),
        (("--bin-size-deg", "nan"), ("--bin-size-deg",)),
        (("--bin-size-deg", "wide"), ("--bin-size-deg",)),
    ],
    ids=str,
)
def test_wrong_options_are_named(run, namod_ctl, arguments, words):
    done = namod_ctl("reconstruct", run, *arguments)
    assert done.returncode == 2
    for word in words:
        assert word in done.stderr
    assert not WRITTEN & {path.name for path in run.iterdir()}


def test_a_folder_that_is_no_run(tmp_path, namod_ctl):
    for folder in (tmp_path, tmp_path / "nothing"):
        done = namod_ctl("reconstruct", folder)
        assert done.returncode == 2
        assert str(folder) in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("n", "word"), [(0, "0 records"), (9, "9 records")])
def test_too_few_records(tmp_path, namod_ctl, centres_rad, n, word):
    run = store_run(tmp_path / "RUN", list(records_of(centres_rad))[:n])
    done = namod_ctl("reconstruct", run)
    assert done.returncode == 2
    assert word in done.stderr
    assert not WRITTEN & {path.name for path in run.iterdir()}


def test_a_dark_run(tmp_path, namod_ctl, centres_rad):
    records = list(records_of(centres_rad))[:30]
    for record in records:
        record.facet_intensity[:] = 0.0
    done = namod_ctl("reconstruct", store_run(tmp_path / "RUN", records))
    assert done.returncode == 2
    assert "no facet responded" in done.stderr

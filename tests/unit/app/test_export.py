"""`instruct` and `export` on a run on disk: what they write, and what they refuse."""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from astropy.table import QTable
from output_samples import alignment_of, facet_alignment, tripod, unknown_facet

from namod_ctl.app.alignment_files import write_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.cli import main
from namod_ctl.app.commands.export import estimated_normals
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.records import Record
from namod_ctl.store.facet_lists import read_mars
from namod_ctl.store.frames import REFLECTOR_CAMERA
from namod_ctl.store.run import RunStore


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
def fact():
    return load_config("fact")


@pytest.fixture
def run(tmp_path, fact):
    """A run of FACT with its estimates: mostly good ones, one without signal, one unreliable."""
    instrument = build_instrument(fact)
    ids = instrument.reflector.ids
    RunStore.create(tmp_path / "RUN", ids, fact.to_json(), "test", SystemClock()).close()
    rng = np.random.default_rng(8)
    facets = [facet_alignment(i, rng.normal(0, 0.1, 2), mount=instrument.mounts[i]) for i in ids]
    facets[2] = unknown_facet(ids[2])
    facets[5] = facet_alignment(ids[5], flags=FacetFlag.UNRELIABLE)
    write_alignment(tmp_path / "RUN", alignment_of(facets, facets_not_in_run=()))
    return tmp_path / "RUN"


def test_mars_file_gives_the_tilts_back(run, fact, tmp_path, namod_ctl):
    out = tmp_path / "as_found.txt"
    done = namod_ctl("export", run, "--format", "mars", "--out", out)
    assert done.returncode == 0, done.stderr
    reflector = build_instrument(fact).reflector
    assert f"facets {reflector.ids[2]}" in done.stderr
    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    theta_rad = np.column_stack([table["theta_x"].to_value("rad"), table["theta_y"].to_value("rad")])
    axis_rad = np.deg2rad([0.01, -0.02])
    found = read_mars(out)
    assert [facet.id for facet in found.facets] == list(reflector.ids)
    normals = found.normals / found.normals[:, 2:]
    aligned = reflector.aligned_normals()
    # a unit normal n + (t_x, t_y, 0), up to its length, shows its tilt relative to n_z
    tilt_rad = normals[:, :2] * aligned[:, 2:] - aligned[:, :2]
    expected_rad = (theta_rad - axis_rad) / 2
    expected_rad[2] = 0.0
    np.testing.assert_allclose(tilt_rad, expected_rad, atol=1e-9)


def test_an_aligned_facet_is_not_tilted(fact):
    reflector = build_instrument(fact).reflector
    axis_deg = (0.01, -0.02)
    normals, unknown = estimated_normals(reflector, alignment_of([facet_alignment(i, axis_deg) for i in reflector.ids]))
    np.testing.assert_allclose(normals, reflector.aligned_normals(), atol=1e-15)
    assert unknown == ()


@pytest.mark.parametrize(("form", "name"), [("ecsv", "ascii.ecsv"), ("fits", "fits")])
def test_tables(run, tmp_path, form, name, namod_ctl):
    out = tmp_path / f"table.{form}"
    done = namod_ctl("export", run, "--format", form, "--out", out)
    assert done.returncode == 0, done.stderr
    table = QTable.read(out, format=name)
    expected = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(table["theta_x"].to_value("deg"), expected["theta_x"].to_value("deg"))
    assert list(table["facet_id"]) == list(expected["facet_id"])


def test_a_file_is_replaced_only_when_forced(run, tmp_path, namod_ctl):
    out = tmp_path / "out.txt"
    out.write_text("precious")
    refused = namod_ctl("export", run, "--format", "mars", "--out", out)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert out.read_text() == "precious"
    assert namod_ctl("export", run, "--format", "mars", "--out", out, "--force").returncode == 0
    assert "nx ny nz" in out.read_text()


def test_instruct_writes_list_picture_and_sheets(run, tmp_path, namod_ctl):
    image = tmp_path / "reflector.png"
    cv2.imwrite(str(image), np.full((911, 1215, 3), 90, np.uint8))  # same shape, another size than the camera's
    out = tmp_path / "out"
    out.mkdir()
    done = namod_ctl("instruct", run, "--image", image, "--out", out)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((out / "instructions.csv").read_text().splitlines()))
    assert len(rows) == 30
    assert [row["bolt_1_deg"] == "" for row in rows] == [n in (2, 5) for n in range(30)]
    table = QTable.read(run / "facets.ecsv", format="ascii.ecsv")
    assert int(rows[0]["bolt_2_deg"]) == round(table["bolt_2_turn"][0].value)
    picture = cv2.imread(str(out / "instructions.png"))
    assert picture.shape[1] % 1215 == 0
    assert (out / "instructions.pdf").read_bytes().startswith(b"%PDF")
    assert "Do not turn facet" in done.stdout
    assert not (run / "instructions.csv").exists()


def test_instruct_without_a_picture(run, namod_ctl):
    assert namod_ctl("instruct", run).returncode == 0
    assert (run / "instructions.png").exists()


def test_instruct_lays_the_runs_own_frames_over_each_other(run, fact, namod_ctl):
    camera = build_instrument(fact).reflector_camera
    with RunStore.open(run, read_only=False) as store:
        frame = np.zeros((camera.n_rows, camera.n_columns, 3), np.uint8)
        frame[:20, :20] = (0, 0, 200)  # OpenCV's order: red
        store.add_frame(0, REFLECTOR_CAMERA, frame)
        store.append([record(0, len(store.facet_ids))])
    assert namod_ctl("instruct", run).returncode == 0
    corner = cv2.imread(str(run / "instructions.png"))[10, 10]
    np.testing.assert_allclose(corner, (0, 0, 200), atol=3)


def record(index, n_facets):
    nan = np.full(n_facets, np.nan)
    return Record(index, "", np.zeros(2), np.nan, 1.0, nan, nan, np.nan, np.nan)


def no_picture(tmp_path):
    (tmp_path / "bad.png").write_bytes(b"this is no PNG")
    return ["--image", tmp_path / "bad.png"], "no picture"


def missing_picture(tmp_path):
    return ["--image", tmp_path / "none.png"], "cannot be read"


def cropped_picture(tmp_path):
    cv2.imwrite(str(tmp_path / "wide.png"), np.zeros((720, 1280, 3), np.uint8))
    return ["--image", tmp_path / "wide.png"], "1280 x 720"


def missing_folder(tmp_path):
    return ["--out", tmp_path / "nowhere"], "does not exist"


@pytest.mark.parametrize("fault", [no_picture, missing_picture, cropped_picture, missing_folder])
def test_bad_input_is_named_and_nothing_is_written(run, tmp_path, fault, namod_ctl):
    arguments, words = fault(tmp_path)
    done = namod_ctl("instruct", run, *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("**/instructions.*"))


@pytest.mark.parametrize("command", [["instruct"], ["export", "--format", "ecsv", "--out", "table.ecsv"]])
def test_a_run_that_was_not_reconstructed(run, command, namod_ctl):
    (run / "alignment.json").unlink()
    done = namod_ctl(command[0], run, *command[1:])
    assert done.returncode == 2
    assert "namod-ctl reconstruct" in done.stderr


def test_an_alignment_of_another_telescope(run, namod_ctl):
    write_alignment(run, alignment_of([facet_alignment(999)]))
    done = namod_ctl("instruct", run)
    assert done.returncode == 2
    assert "999" in done.stderr


def test_the_turns_are_those_of_the_mount(fact):
    """The samples' tripod is FACT's, so the tests above speak of the real mount."""
    mount = build_instrument(fact).mounts[13]
    np.testing.assert_allclose(mount.legs_m, tripod().legs_m, atol=1e-12)
    assert mount.pitch_m_per_turn == pytest.approx(1e-3)

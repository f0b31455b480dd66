"""Import of response maps: FACT's own of May 2014, read a second time by other means, and everything wrong in a map."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.errors import ConfigError, NamodError
from namod_ctl.store.response_maps import HEADER, parse_response_map, pixel_grid_step_rad
from namod_ctl.store.run import RunStore

FACT_MAPS = Path(__file__).resolve().parents[4] / "shared" / "data" / "fact_2014" / "response_maps"
ROWS = [(0.1, -0.2, 0.5), (0.0, 0.3, 0.0), (-0.1, 0.2, 2.5e-7)]


def run_import(folder: Path, out: Path, *options: str) -> str:
    """What the command prints; its error is raised."""
    result = CliRunner().invoke(app, ["import", "maps", str(folder), "--out", str(out), *options])
    if isinstance(result.exception, NamodError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def map_text(rows: list[tuple[float, float, float]]) -> str:
    return "\n".join([HEADER, *(f"{x},{y},{r}" for x, y, r in rows)]) + "\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Maps of three facets of FACT."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for facet_id in (2, 3, 13):
        rows = [(x, y, r * facet_id) for x, y, r in ROWS]
        (folder / f"mirror_ID{facet_id}_response_map.csv").write_text(map_text(rows))
    return folder


@pytest.mark.skipif(not FACT_MAPS.is_dir(), reason="FACT's response maps of 2014 are not on this computer")
def test_fact_2014(tmp_path: Path) -> None:
    output = run_import(FACT_MAPS, tmp_path / "run")
    with RunStore.open(tmp_path / "run") as run:
        records, facet_ids = run.records(), run.facet_ids
        assert json.loads(run.config_json)["telescope"]["name"] == "FACT"
    assert len(facet_ids) == 29
    order = [facet.id for facet in load_config("fact").facets]
    assert sorted(facet_ids, key=order.index) == list(facet_ids)
    for column, facet_id in enumerate(facet_ids):
        with (FACT_MAPS / f"mirror_ID{facet_id}_response_map.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        assert len(lines) == len(records) == 300
        for record, line in zip(records, lines, strict=True):
            assert record.facet_intensity[column] / record.star_intensity == float(
                line["normalized_mirror_response [1]"]
            )
            assert np.rad2deg(record.theta_rad) == pytest.approx(
                [float(line["dir_X [deg]"]), float(line["dir_Y [deg]"])], rel=1e-14
            )
    assert [record.index for record in records] == list(range(300))
    assert records[0].label == "line 2"
    assert all(record.reject_reason is None for record in records)
    assert np.isnan([record.star_exposure_s for record in records]).all()
    # the files' numbers are multiples of 2.4275 mdeg (0.218478 deg = 90, 0.0145652 deg = 6, -0.276739 = -114 pixel)
    step_deg = 0.218478 / 90
    assert np.rad2deg(records[0].theta_uncertainty_rad) == pytest.approx(step_deg / np.sqrt(12), rel=1e-5)
    assert "300 accepted, 0 rejected" in output
    assert "0.0024275 deg" in output


def test_facets_without_a_map_are_named(folder: Path, tmp_path: Path) -> None:
    output = run_import(folder, tmp_path / "run")
    with RunStore.open(tmp_path / "run") as run:
        assert sorted(run.facet_ids) == [2, 3, 13]
        facet_13 = run.facet_ids.index(13)
        assert run.records()[0].facet_intensity[facet_13] == 6.5
        assert np.isnan(run.records()[0].theta_uncertainty_rad)  # three directions prove no grid
    without = output.partition("without data: ")[2].splitlines()[0].split(", ")
    assert len(without) == 27
    assert "13" not in without


def _append(text: str) -> object:
    return lambda file: file.write_text(file.read_text() + text)


def _replace(old: str, new: str) -> object:
    return lambda file: file.write_text(file.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_replace("dir_X [deg]", "dir_X [rad]"), "line 1: the header"),
        (_replace(HEADER + "\n", ""), "line 1: the header"),
        (lambda file: file.write_text(""), "line 1: the header"),
        (lambda file: file.write_text(HEADER + "\n"), "no records"),
        (lambda file: file.write_text(file.read_text()[:-3]), "line 4: .*line break"),
        (_append("0.1,0.2\n"), "line 5: 2 columns"),
        (_append("0.1,0.2,3,4\n"), "line 5: 4 columns"),
        (_append("\n"), "line 5: 1 columns"),
        (_replace("0.1,-0.2,1.5", "0.1,-0.2,nan"), "line 2: .*not finite"),
        (_replace("0.1,-0.2,1.5", "0.1,-0.2,-1.5"), "line 2: .*negative"),
        (_replace("0.1,-0.2,1.5", "inf,-0.2,1.5"), "line 2: .*not finite"),
        (_replace("0.1,-0.2,1.5", "0.1,-0.2,1e999"), "line 2: .*not finite"),
        (_replace("0.1,-0.2,1.5", "0.1,-0.2,bright"), "line 2: 'bright' is not a number"),
        (_replace("0.1,-0.2,1.5", "0.1,-0.2,"), "line 2: '' is not a number"),
        (_replace("0.1,-0.2,1.5", "10.5,-0.2,1.5"), "line 2: .*limit 10 deg"),
        (_append("0.1,0.2,3\n"), "has 4 records.*_ID.*_response_map.csv has 3"),
        (_replace("0.0,0.3", "0.0,0.31"), "line 3: the direction .*_ID.*_response_map.csv"),
        (lambda file: file.write_bytes(b"\xff\xfe\x00"), "not a text file"),
        (lambda file: (file.unlink(), file.mkdir()), "cannot be read"),
    ],
)
def test_a_wrong_map_is_refused_with_file_and_line(folder: Path, tmp_path: Path, damage: object, words: str) -> None:
    assert callable(damage)
    damage(folder / "mirror_ID3_response_map.csv")
    with pytest.raises(ConfigError, match=words) as raised:
        run_import(folder, tmp_path / "run")
    assert "mirror_ID3_response_map.csv" in str(raised.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["maps"]


def test_folders_that_are_none(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for path, words in (
        (tmp_path / "empty", "no response maps"),
        (tmp_path / "nothing", "no such folder"),
        (folder / "mirror_ID3_response_map.csv", "is a file"),
    ):
        with pytest.raises(ConfigError, match=words):
            run_import(path, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_facets_that_are_unknown_or_twice_there(folder: Path, tmp_path: Path) -> None:
    stray = folder / "mirror_ID777_response_map.csv"
    stray.write_text(map_text(ROWS))
    with pytest.raises(ConfigError, match=r"does not know: \[777\]; it has \[.*13.*\]"):
        run_import(folder, tmp_path / "run")
    stray.rename(folder / "mirror_ID03_response_map.csv")
    with pytest.raises(ConfigError, match="facet 3 has another map"):
        run_import(folder, tmp_path / "run")
    (folder / "mirror_ID03_response_map.csv").rename(folder / "mirror_IDx_response_map.csv")
    with pytest.raises(ConfigError, match="no facet id"):
        run_import(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_bad_map_does_not_cost_the_old_run(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    run_import(folder, out)
    with pytest.raises(ConfigError, match="exists"):
        run_import(folder, out)
    file = folder / "mirror_ID3_response_map.csv"
    sound = file.read_text()
    file.write_text(sound[:-3])
    with pytest.raises(ConfigError, match="line break"):
        run_import(folder, out, "--force")
    with RunStore.open(out) as run:
        assert len(run.records()) == 3
    for path in folder.iterdir():
        path.write_text(map_text(ROWS[:2]))
    run_import(folder, out, "--force")
    with RunStore.open(out) as run:
        assert len(run.records()) == 2
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["maps", "run"]


def test_windows_line_ends_are_fine(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert "3 records" in run_import(folder, tmp_path / "run")


@given(st.text(max_size=200), st.booleans())
def test_any_text_parses_or_is_refused(text: str, with_header: bool) -> None:
    try:
        rows = parse_response_map(f"{HEADER}\n{text}" if with_header else text, "the file")
    except ConfigError as error:
        message = str(error)
    else:
        message = "the file"
        assert rows.shape[1] == 3
        assert np.isfinite(rows).all()
        assert (rows[:, 2] >= 0).all()
    assert message.startswith("the file")


directions = st.floats(-10, 10, allow_nan=False)


@given(st.lists(st.tuples(directions, directions, st.floats(0, 1e300)), min_size=1, max_size=20))
def test_every_map_is_read_as_written(rows: list[tuple[float, float, float]]) -> None:
    assert parse_response_map(map_text(rows), "the file").tolist() == [list(row) for row in rows]


@given(st.integers(0, 1000), st.floats(0.992, 1.008), st.integers(10, 300))
def test_a_grid_of_pixels_is_recognised(seed: int, scale: float, n_records: int) -> None:
    rng = np.random.default_rng(seed)
    pixel = rng.integers(-160, 161, (n_records, 2))
    printed = [[float(f"{value:.6g}") for value in row] for row in pixel * 0.002437 * scale]
    step = pixel_grid_step_rad(np.deg2rad(printed), np.deg2rad(0.002437))
    assert step == pytest.approx(np.deg2rad(0.002437 * scale), rel=1e-4)


@given(st.integers(0, 1000), st.integers(8, 300))
def test_no_grid_is_seen_where_there_is_none(seed: int, n_records: int) -> None:
    theta = np.random.default_rng(seed).uniform(-7e-3, 7e-3, (n_records, 2))
    assert pixel_grid_step_rad(theta, np.deg2rad(0.002437)) is None

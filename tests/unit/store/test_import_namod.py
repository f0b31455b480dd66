"""Import of a folder of the original program: one whose truth is known, and everything that can be wrong."""

from __future__ import annotations

import json
import os
from pathlib import Path

import namod_files
import numpy as np
import pytest
from namod_files import FACET_IDS_AS_WRITTEN, STAMP, TrueRecord, int_file, reflector_cfg, write_folder
from PIL import Image
from typer.testing import CliRunner

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.cli import app
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.core.errors import ConfigError, NamodError, StoreError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.store.run import RunStore

N_RECORDS = 6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "night"


@pytest.fixture
def truth(folder: Path) -> list[TrueRecord]:
    return write_folder(folder, N_RECORDS)


def run_import(folder: Path, out: Path, *options: str) -> str:
    """What the command prints; its error is raised."""
    result = CliRunner().invoke(app, ["import", "namod", str(folder), "--out", str(out), "--jobs", "1", *options])
    if isinstance(result.exception, NamodError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def records_of(out: Path) -> list[Record]:
    with RunStore.open(out) as run:
        return run.records()


def assert_same_records(a: list[Record], b: list[Record]) -> None:
    """Bit by bit."""
    assert len(a) == len(b)
    for left, right in zip(a, b, strict=True):
        for name in Record.__slots__:
            x, y = getattr(left, name), getattr(right, name)
            if isinstance(x, np.ndarray | float):
                assert np.asarray(x).tobytes() == np.asarray(y).tobytes(), (left.label, name)
            else:
                assert x == y


def test_measures_what_was_drawn(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    output = run_import(folder, tmp_path / "run")

    with RunStore.open(tmp_path / "run") as run:
        records, facet_ids = run.records(), run.facet_ids
        assert run.telescope == "FACT"
    assert sorted(facet_ids) == sorted(FACET_IDS_AS_WRITTEN)
    assert f"{N_RECORDS} accepted, 0 rejected" in output
    for record, true in zip(records, truth, strict=True):
        assert record.label == true.prefix
        assert record.reject_reason is None, record.detail
        # a star of 5 px width and a noise of 0.5 of 180 adu: a few hundredths of a pixel
        error_px = (np.rad2deg(record.theta_rad) - true.theta_deg) / namod_files.STAR_DEG_PER_PX
        assert np.abs(error_px).max() < 0.1
        assert np.rad2deg(record.theta_uncertainty_rad) < 0.1 * namod_files.STAR_DEG_PER_PX
        # sky noise and whole adus change the wings' contribution by some percent
        assert record.star_intensity == pytest.approx(true.star_intensity(), rel=0.05)
        expected = [true.facet_intensity(facet_id) for facet_id in facet_ids]
        assert record.facet_intensity == pytest.approx(expected, rel=1e-9)
        assert record.facet_saturated_share.tolist() == [0.0] * len(facet_ids)
        assert record.star_exposure_s == pytest.approx(true.star_exposure_ms / 1e3)
        assert record.reflector_exposure_s == pytest.approx(true.reflector_exposure_ms / 1e3)


def test_facets_are_in_the_order_of_the_config(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    run_import(folder, tmp_path / "run")
    with RunStore.open(tmp_path / "run") as run:
        config_order = [facet["id"] for facet in json.loads(run.config_json)["reflector"]["facets"]]
        assert run.facet_ids == tuple(facet_id for facet_id in config_order if facet_id in FACET_IDS_AS_WRITTEN)


def test_the_stored_config_stands_alone_and_has_the_folders_values(
    folder: Path, truth: list[TrueRecord], tmp_path: Path
) -> None:
    run_import(folder, tmp_path / "run")
    with RunStore.open(tmp_path / "run") as run:
        instrument = build_instrument(InstrumentConfig.from_json(run.config_json, "the run"))
    assert instrument.star_camera.plate_scale_rad == pytest.approx(np.deg2rad(namod_files.STAR_DEG_PER_PX))
    assert (instrument.star_camera.n_columns, instrument.star_camera.n_rows) == (320, 240)
    law = instrument.reflector_camera.law
    assert (law.r_resp, law.r_expo, law.r_const) == namod_files.REFLECTOR_LAW
    assert instrument.mounts[3].pitch_m_per_turn == pytest.approx(0.00125)
    assert np.hypot(*instrument.mounts[3].legs_m.T) == pytest.approx(0.25)
    assert np.arctan2(*instrument.mounts[3].legs_m[0][::-1]) == pytest.approx(np.deg2rad(30.0))
    assert instrument.mounts[2].legs_m[0] == pytest.approx([0.25, 0.0])
    assert sorted(instrument.facet_polygons_px) == sorted(FACET_IDS_AS_WRITTEN)
    assert instrument.facet_polygons_px[5].tolist() == [list(corner) for corner in namod_files.polygon(5)]


def test_two_processes_give_what_one_gives(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    run_import(folder, tmp_path / "one")
    run_import(folder, tmp_path / "two", "--jobs", "2")
    assert_same_records(records_of(tmp_path / "one"), records_of(tmp_path / "two"))


def test_records_are_ordered_by_number_and_stamp(folder: Path, tmp_path: Path) -> None:
    write_folder(folder, 2, first=9)
    write_folder(folder, 1, stamp="20140519_0100")
    run_import(folder, tmp_path / "run")
    labels = [record.label for record in records_of(tmp_path / "run")]
    assert labels == ["20140519_0100_sccan_0", f"{STAMP}_sccan_9", f"{STAMP}_sccan_10"]


def _cut(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _flip_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(bytes(data))


def _resize(path: Path) -> None:
    Image.fromarray(np.zeros((64, 64), dtype=np.uint8)).save(path)


def _deepen(path: Path) -> None:
    Image.fromarray(np.zeros((240, 320), dtype=np.uint16)).save(path)


DAMAGES = [
    ("_star.png", Path.unlink, RejectReason.FILE_MISSING, "is missing"),
    ("_reflector.png", Path.unlink, RejectReason.FILE_MISSING, "is missing"),
    ("_star.info", Path.unlink, RejectReason.FILE_MISSING, "is missing"),
    ("_reflector.int", Path.unlink, RejectReason.FILE_MISSING, "is missing"),
    (".cfg", Path.unlink, RejectReason.FILE_MISSING, "is missing"),
    ("_star.png", _cut, RejectReason.FILE_CORRUPT, "cut off"),
    ("_star.png", _flip_a_bit, RejectReason.FILE_CORRUPT, "damaged"),
    ("_reflector.png", lambda path: path.write_text("no image"), RejectReason.FILE_CORRUPT, "no PNG"),
    ("_reflector.png", lambda path: path.write_bytes(b""), RejectReason.FILE_CORRUPT, "empty"),
    ("_reflector.png", _resize, RejectReason.FILE_CORRUPT, "64 x 64"),
    ("_star.png", _deepen, RejectReason.FILE_CORRUPT, "16 bits"),
    ("_star.info", _cut, RejectReason.FILE_CORRUPT, "line"),
    ("_star.info", lambda path: path.write_bytes(b"\xff\xfe"), RejectReason.FILE_CORRUPT, "text"),
    (
        "_star.info",
        lambda path: path.write_text("sccan_image = { };"),
        RejectReason.FILE_CORRUPT,
        "exposure_time_in_ms",
    ),
    (
        "_star.info",
        lambda path: path.write_text("sccan_image = { exposure_time_in_ms = -3.0; };"),
        RejectReason.FILE_CORRUPT,
        "above 0",
    ),
    (
        "_star.int",
        lambda path: path.write_text(int_file(0.006, namod_files.STAR_LAW)),
        RejectReason.FILE_CORRUPT,
        "differs",
    ),
    (".cfg", _cut, RejectReason.FILE_CORRUPT, "line"),
]


def test_a_bad_file_costs_its_record_and_no_other(folder: Path, tmp_path: Path) -> None:
    truth = write_folder(folder, len(DAMAGES) + 2)
    for true, (suffix, damage, _, _) in zip(truth[1:], DAMAGES, strict=False):
        damage(folder / f"{true.prefix}{suffix}")

    output = run_import(folder, tmp_path / "run")

    records = records_of(tmp_path / "run")
    assert [record.label for record in records] == [true.prefix for true in truth]
    assert [record.reject_reason for record in (records[0], records[-1])] == [None, None]
    for record, (suffix, _, reason, words) in zip(records[1:], DAMAGES, strict=False):
        assert record.reject_reason is reason, (suffix, record.detail)
        assert f"{record.label}{suffix}" in record.detail
        assert words in record.detail
        assert np.isnan(record.facet_intensity).all()
    n_missing = sum(reason is RejectReason.FILE_MISSING for _, _, reason, _ in DAMAGES)
    assert f"2 accepted, {len(DAMAGES)} rejected" in output
    assert f"{n_missing} FILE_MISSING" in output
    assert f"{truth[1].prefix}_star.png is missing" in output


def test_a_record_without_a_star_is_named(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    dark = rng.normal(10, 1, (240, 320)).round().astype(np.uint8)
    Image.fromarray(dark).save(folder / f"{truth[2].prefix}_star.png")
    output = run_import(folder, tmp_path / "run")
    assert "1 NO_STAR" in output
    assert truth[2].prefix in output
    assert records_of(tmp_path / "run")[2].reject_reason is RejectReason.NO_STAR


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("reflector : {", "line 1"),
        (reflector_cfg().replace("mirrors = (", "mirrors = "), "line"),
        (reflector_cfg().replace("tripod_radius_in_m = 0.25;", ""), "tripod_radius_in_m is missing"),
        (reflector_cfg().replace("tripod_radius_in_m = 0.25", "tripod_radius_in_m = 295.0"), "radius_m"),
        (reflector_cfg().replace("_per_revolution = 0.00125", "_per_revolution = -1.0"), "above 0"),
        (reflector_cfg().replace("ID = 3;", 'ID = "3";'), "ID"),
        (reflector_cfg(ids=(2, 3, 3)), "facet 3 appears twice"),
        (reflector_cfg(ids=(2, 777)), "777"),
        (reflector_cfg(ids=()), "empty"),
        (reflector_cfg(p3="{ x = 1; y = 2; }, { x = 5; y = 5; }"), "facet 3"),
        (reflector_cfg(p3="{ x = 1; y = 2; }, { x = 5; y = 5; }, { x = 400; y = 9; }"), "facet 3"),
        (reflector_cfg(p3="{x=10;y=10;}, {x=50;y=50;}, {x=50;y=10;}, {x=10;y=50;}"), "facet 3"),
        (reflector_cfg(p5="{ x = 1; y = 2; }, { x = 5; }, { x = 40; y = 9; }"), "y is missing"),
    ],
)
def test_a_wrong_map_of_the_facets_stops_the_import(
    folder: Path, truth: list[TrueRecord], tmp_path: Path, text: str, words: str
) -> None:
    (folder / "reflector.cfg").write_text(text)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=words) as raised:
        run_import(folder, tmp_path / "run")
    assert "reflector.cfg" in str(raised.value)
    assert sorted(tmp_path.iterdir()) == before


def test_a_closed_polygon_is_the_open_one(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    run_import(folder, tmp_path / "open")
    corners = [*namod_files.polygon(3), namod_files.polygon(3)[0]]
    closed = ", ".join(f"{{ x = {x}; y = {y}; }}" for x, y in corners)
    (folder / "reflector.cfg").write_text(reflector_cfg(p3=closed))
    run_import(folder, tmp_path / "closed")
    assert_same_records(records_of(tmp_path / "open"), records_of(tmp_path / "closed"))


def test_folders_that_are_none(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        run_import(tmp_path / "nothing", tmp_path / "run")
    with pytest.raises(ConfigError, match="is a file"):
        run_import(folder / "reflector.cfg", tmp_path / "run")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ConfigError, match=r"reflector\.cfg: is missing"):
        run_import(empty, tmp_path / "run")
    (empty / "reflector.cfg").write_text(reflector_cfg())
    with pytest.raises(ConfigError, match="no records"):
        run_import(empty, tmp_path / "run")
    for file in folder.glob("*_star.int"):
        file.unlink()
    with pytest.raises(ConfigError, match="star camera"):
        run_import(folder, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_frames_are_kept_when_asked(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    run_import(folder, tmp_path / "lean")
    assert not list((tmp_path / "lean" / "frames").iterdir())
    (folder / f"{truth[1].prefix}_star.png").unlink()
    run_import(folder, tmp_path / "full", "--keep-frames", "all")
    with RunStore.open(tmp_path / "full") as run:
        for index, true in enumerate(truth):
            if index == 1:
                with pytest.raises(StoreError, match="not kept"):
                    run.frame(index, "reflector_camera")
                continue
            for camera in ("star", "reflector"):
                drawn = np.asarray(Image.open(folder / f"{true.prefix}_{camera}.png"))
                assert np.array_equal(run.frame(index, f"{camera}_camera"), drawn)  # grey, so no order of channels


def _interrupt(monkeypatch: pytest.MonkeyPatch, folder: Path, out: Path, n_done: int, *options: str) -> None:
    """Start an import and break it, as Ctrl-C does, after `n_done` records."""
    appended = []
    append = RunStore.append

    def append_or_stop(self: RunStore, records: list[Record]) -> None:
        if len(appended) == n_done:
            raise KeyboardInterrupt
        append(self, records)
        appended.append(1)

    with monkeypatch.context() as patch:
        patch.setattr(RunStore, "append", append_or_stop)
        result = CliRunner().invoke(app, ["import", "namod", str(folder), "--out", str(out), "--jobs", "1", *options])
    assert result.exit_code == 130
    assert "--resume" in result.output or n_done == 0


def test_resume_gives_the_same_run(
    folder: Path, truth: list[TrueRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_import(folder, tmp_path / "whole")
    out = tmp_path / "run"
    _interrupt(monkeypatch, folder, out, 2)
    assert not out.exists()
    with pytest.raises(ConfigError, match="--resume"):
        RunStore.open(out)
    with pytest.raises(ConfigError, match="--resume"):
        run_import(folder, out)
    run_import(folder, out, "--resume")
    assert_same_records(records_of(tmp_path / "whole"), records_of(out))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["night", "run", "whole"]


def test_resume_refuses_a_folder_that_changed(
    folder: Path, truth: list[TrueRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    _interrupt(monkeypatch, folder, out, 3)
    with pytest.raises(ConfigError, match="--keep-frames none"):
        run_import(folder, out, "--resume", "--keep-frames", "all")
    file = folder / f"{truth[1].prefix}_star.info"
    text, status = file.read_text(), file.stat()
    file.write_text(text.replace("12.5", "12.6"))
    with pytest.raises(ConfigError, match=f"{truth[1].prefix}.cfg: a file of this record changed"):
        run_import(folder, out, "--resume")
    file.write_text(text)
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    (folder / "reflector.cfg").write_text(reflector_cfg(ids=(2, 3)))
    with pytest.raises(ConfigError, match="another config"):
        run_import(folder, out, "--resume")
    (folder / "reflector.cfg").write_text(reflector_cfg())
    write_folder(folder, 1, stamp="20140519_0100")  # would come first
    with pytest.raises(ConfigError, match="records now differ"):
        run_import(folder, out, "--resume")
    for path in folder.glob("20140519*"):
        path.unlink()
    added = write_folder(folder, 1, first=N_RECORDS, seed=5)  # comes last: welcome
    run_import(folder, out, "--resume")
    assert [record.label for record in records_of(out)] == [true.prefix for true in [*truth, *added]]


def test_resume_without_anything_to_resume(folder: Path, truth: list[TrueRecord], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no unfinished import"):
        run_import(folder, tmp_path / "run", "--resume")


def test_an_old_run_is_there_until_the_new_one_is_complete(
    folder: Path, truth: list[TrueRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    run_import(folder, out)
    old = records_of(out)
    write_folder(folder, N_RECORDS + 1, seed=9)
    with pytest.raises(ConfigError, match="--force"):
        run_import(folder, out)
    _interrupt(monkeypatch, folder, out, 2, "--force")
    assert_same_records(records_of(out), old)
    run_import(folder, out, "--force", "--resume")
    assert len(records_of(out)) == N_RECORDS + 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["night", "run"]


def test_an_import_stopped_before_its_first_record_leaves_nothing(
    folder: Path, truth: list[TrueRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _interrupt(monkeypatch, folder, tmp_path / "run", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["night"]

"""The run on disk: what goes in comes out, and everything that can be wrong with it is said in words."""

from __future__ import annotations

import json
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.store import database
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_lock import recording_lock

FACET_IDS = (12, 3, 40)
CONFIG = json.dumps({"telescope": {"name": "TEST"}, "more": [1.5, "ä"]})


class ManualClock:
    def __init__(self) -> None:
        self.time = datetime(2026, 11, 22, 4, 0, tzinfo=UTC)

    def now(self) -> datetime:
        self.time += timedelta(seconds=1)
        return self.time


def make_record(index: int, reason: RejectReason | None = None, detail: str = "") -> Record:
    rng = np.random.default_rng(index)
    share = rng.random(len(FACET_IDS))
    share[1] = np.nan
    return Record(
        index=index,
        label=f"stamp_sccan_{index}",
        theta_rad=rng.normal(size=2) * 1e-3 if reason is None else np.full(2, np.nan),
        theta_uncertainty_rad=float(rng.random()) * 1e-5,
        star_intensity=float(rng.random()) if reason is None else float("nan"),
        facet_intensity=rng.random(len(FACET_IDS)) * 1e-300,  # as small as doubles get: every bit must survive
        facet_saturated_share=share,
        star_exposure_s=0.1,
        reflector_exposure_s=float("nan"),
        reject_reason=reason,
        detail=detail,
    )


def assert_same(a: Record, b: Record) -> None:
    for name in Record.__slots__:
        left, right = getattr(a, name), getattr(b, name)
        if isinstance(left, np.ndarray | float):
            assert np.asarray(left).tobytes() == np.asarray(right).tobytes(), name
        else:
            assert left == right, name


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


@pytest.fixture
def run(path: Path) -> RunStore:
    return RunStore.create(path, FACET_IDS, CONFIG, "a test", ManualClock())


def test_records_come_back_bit_by_bit(path: Path, run: RunStore) -> None:
    # given out of order, with every reason there is
    records = [make_record(2), make_record(0)]
    records += [make_record(10 + n, reason, f"why: {reason}") for n, reason in enumerate(RejectReason)]
    with run:
        run.append(records)
        run.append([make_record(1)])
    with RunStore.open(path) as reopened:
        found = reopened.records()
        assert reopened.facet_ids == FACET_IDS
        assert reopened.config_json == CONFIG
        assert reopened.source == "a test"
        assert reopened.telescope == "TEST"
        assert reopened.created_utc == "2026-11-22T04:00:01+00:00"
        assert reopened.labels() == [(record.index, record.label) for record in found]
    expected = sorted([*records, make_record(1)], key=lambda record: record.index)
    assert len(found) == len(expected)
    for left, right in zip(found, expected, strict=True):
        assert_same(left, right)


def test_an_empty_run_has_no_records(run: RunStore) -> None:
    with run:
        assert run.records() == []
        assert run.latest_estimate() is None


def test_anybody_can_read_responses_with_plain_sql(path: Path, run: RunStore) -> None:
    record = make_record(7)
    with run:
        run.append([record])
    connection = sqlite3.connect(path / "run.sqlite")
    rows = connection.execute("SELECT facet_id, intensity, saturated_share FROM responses WHERE record_index = 7")
    found = {facet_id: (intensity, share) for facet_id, intensity, share in rows}
    assert found[12] == (record.facet_intensity[0], record.facet_saturated_share[0])
    assert found[3] == (record.facet_intensity[1], None)
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    connection.close()


def test_appending_is_all_or_nothing(path: Path, run: RunStore) -> None:
    with run:
        run.append([make_record(0)])
        with pytest.raises(StoreError, match="another program"):
            run.append([make_record(1), make_record(0)])
        assert [index for index, _ in run.labels()] == [0]
        run.append([make_record(1)])


def test_arrays_that_do_not_fit_are_a_bug(run: RunStore) -> None:
    record = make_record(0)
    object.__setattr__(record, "facet_intensity", np.zeros(2))
    with run, pytest.raises(ValueError, match="do not fit"):
        run.append([record])


def test_estimates_are_a_history(path: Path, run: RunStore) -> None:
    clock = ManualClock()
    with run:
        run.save_estimate("cog", '{"n": 1}', clock)
        run.save_estimate("robust", '{"n": 2}', clock)
    with RunStore.open(path) as reopened:
        assert reopened.latest_estimate() == '{"n": 2}'
    connection = sqlite3.connect(path / "run.sqlite")
    assert connection.execute("SELECT count(*) FROM estimates").fetchone() == (2,)
    connection.close()


def test_notes(path: Path, run: RunStore) -> None:
    with run:
        run.set_note("a", "1")
        run.set_note("a", "2")
        assert run.note("a") == "2"
    with RunStore.open(path) as reopened:
        assert reopened.note("a") == "2"
        assert reopened.note("telescope") is None


def test_frames_are_lossless_files_of_a_common_format(path: Path, run: RunStore) -> None:
    rng = np.random.default_rng(5)
    grey = rng.integers(0, 256, (30, 40), dtype=np.uint8)
    colour = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    with run:
        run.add_frame(3, "star_camera", grey)
        run.add_frame(3, "reflector_camera", colour)
        assert np.array_equal(run.frame(3, "star_camera"), grey)
        assert np.array_equal(run.frame(3, "reflector_camera"), colour)
    files = sorted((path / "frames").iterdir())
    assert [file.name for file in files] == ["000003_reflector_camera.png", "000003_star_camera.png"]
    assert np.array_equal(np.asarray(Image.open(files[1])), grey)
    assert np.array_equal(np.asarray(Image.open(files[0]))[:, :, ::-1], colour)  # OpenCV's order is blue first


def test_frames_of_more_than_8_bits_are_kept_to_the_last_one(path: Path, run: RunStore) -> None:
    deep = np.random.default_rng(5).integers(0, 65_536, (30, 40), dtype=np.uint16)
    with run:
        run.add_frame(0, "star_camera", deep)
        found = run.frame(0, "star_camera")
    assert found.dtype == np.uint16
    assert np.array_equal(found, deep)
    assert np.array_equal(np.asarray(Image.open(path / "frames" / "000000_star_camera.png")), deep)


def test_a_frame_that_changed_is_not_trusted(path: Path, run: RunStore) -> None:
    with run:
        run.add_frame(0, "star_camera", np.zeros((8, 8), dtype=np.uint8))
        file = path / "frames" / "000000_star_camera.png"
        Image.fromarray(np.ones((8, 8), dtype=np.uint8)).save(file)  # a sound PNG, but another
        with pytest.raises(StoreError, match="has changed"):
            run.frame(0, "star_camera")
        file.unlink()
        with pytest.raises(StoreError, match="000000_star_camera"):
            run.frame(0, "star_camera")
        with pytest.raises(StoreError, match="not kept"):
            run.frame(1, "star_camera")


def test_nothing_is_overwritten_without_force(path: Path, run: RunStore, tmp_path: Path) -> None:
    with run:
        run.append([make_record(0)])
    with pytest.raises(ConfigError, match="--force"):
        RunStore.create(path, FACET_IDS, CONFIG, "b", ManualClock())
    with RunStore.open(path) as old:
        assert len(old.records()) == 1
    with RunStore.create(path, (1, 2), CONFIG, "b", ManualClock(), force=True) as new:
        assert new.records() == []
        assert new.facet_ids == (1, 2)
    assert [entry.name for entry in tmp_path.iterdir()] == ["RUN"]


@pytest.mark.parametrize("force", [False, True])
def test_what_is_no_run_is_never_replaced(tmp_path: Path, force: bool) -> None:
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter_1.tex").write_text("years of work")
    file = tmp_path / "file"
    file.write_text("x")
    for path in (thesis, file, tmp_path / "no" / "folder"):
        with pytest.raises(ConfigError, match=path.name):
            RunStore.create(path, FACET_IDS, CONFIG, "", ManualClock(), force=force)
    assert (thesis / "chapter_1.tex").read_text() == "years of work"
    assert file.read_text() == "x"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "thesis"]


def test_force_takes_an_empty_folder(path: Path) -> None:
    path.mkdir()
    with pytest.raises(ConfigError, match="exists"):
        RunStore.create(path, FACET_IDS, CONFIG, "", ManualClock())
    RunStore.create(path, FACET_IDS, CONFIG, "", ManualClock(), force=True).close()
    assert (path / "run.sqlite").is_file()


def test_no_run_at_the_path(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(ConfigError, match=r"run\.sqlite is missing"):
            RunStore.open(path)


def _newer(file: Path) -> None:
    connection = sqlite3.connect(file)
    connection.execute(f"PRAGMA user_version = {database.SCHEMA_VERSION + 1}")
    connection.close()


def _of_another_program(file: Path) -> None:
    file.unlink()
    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE t (x)")
    connection.close()


def _without_meta(file: Path) -> None:
    connection = sqlite3.connect(file)
    connection.execute("DELETE FROM meta WHERE key = 'config_json'")
    connection.commit()
    connection.close()


def _without_a_response(file: Path) -> None:
    connection = sqlite3.connect(file)
    connection.execute("DELETE FROM responses WHERE facet_id = 3 AND record_index = 5")
    connection.commit()
    connection.close()


def _with_a_new_reason(file: Path) -> None:
    connection = sqlite3.connect(file)
    connection.execute("UPDATE records SET reject_reason = 'comet' WHERE record_index = 5")
    connection.commit()
    connection.close()


def _overwritten(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[4096:] = b"\xa5" * (len(data) - 4096)  # all pages but the first
    file.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_newer, "update namod-ctl"),
        (_of_another_program, "not a run"),
        (_without_meta, "config_json is missing"),
        (_without_a_response, "damaged"),
        (_with_a_new_reason, "comet"),
        (_overwritten, "damaged"),
        (lambda file: file.write_text("no database, just text " * 50), "no SQLite file"),
        (lambda file: file.write_bytes(file.read_bytes()[:6000]), "damaged"),
        (lambda file: file.write_bytes(b""), "not a run"),
    ],
)
def test_a_damaged_run_is_said_to_be(path: Path, run: RunStore, damage: object, words: str) -> None:
    with run:
        run.append([make_record(index) for index in range(200)])
    assert callable(damage)
    damage(path / "run.sqlite")
    with pytest.raises(StoreError, match=words) as raised, RunStore.open(path) as reopened:
        reopened.records()
    assert str(path) in str(raised.value)


def test_a_run_opened_to_read_is_not_written(path: Path, run: RunStore) -> None:
    run.close()
    with RunStore.open(path) as reopened, pytest.raises(StoreError, match="opened to read only"):
        reopened.append([make_record(0)])


def test_readers_and_the_writer_do_not_hinder_each_other(path: Path, run: RunStore) -> None:
    with run, RunStore.open(path) as reader:
        run.append([make_record(0)])
        assert len(reader.records()) == 1
        run.append([make_record(1)])
        assert len(reader.records()) == 2


def test_a_second_writer_waits_and_then_complains(path: Path, run: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    run.close()
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.05)
    other = sqlite3.connect(path / "run.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with RunStore.open(path, read_only=False) as writer:
        with pytest.raises(StoreError, match="another program holds the run"):
            writer.append([make_record(0)])
        other.execute("ROLLBACK")
        writer.append([make_record(0)])
    other.close()


def test_a_run_that_was_moved_away_takes_nothing_until_it_is_back(path: Path, run: RunStore) -> None:
    """SQLite itself goes on writing into a file that no path leads to."""
    away = path.with_name("AWAY")
    with run:
        run.append([make_record(0)])
        path.rename(away)
        with pytest.raises(StoreError, match="GONE") as refused:
            run.append([make_record(1)])
        assert isinstance(refused.value.__cause__, FileNotFoundError)
        for write in (run.check_in_place, lambda: run.set_note("a", "b")):
            with pytest.raises(StoreError, match="GONE"):
                write()
        away.rename(path)
        run.append([make_record(1)])
    with RunStore.open(path) as reopened:
        assert len(reopened.records()) == 2


def test_a_run_in_whose_place_another_stands_takes_nothing(path: Path, run: RunStore) -> None:
    with run:
        RunStore.create(path, FACET_IDS, CONFIG, "another", ManualClock(), force=True).close()
        with pytest.raises(StoreError, match="REPLACED"):
            run.append([make_record(1)])
        with pytest.raises(StoreError, match="REPLACED"):
            run.add_frame(1, "star_camera", np.zeros((4, 4), dtype=np.uint8))
    with RunStore.open(path) as other:
        assert other.source == "another"
        assert other.records() == []
    assert not list((path / "frames").iterdir())


def test_one_program_at_a_time_records_into_a_run(path: Path, run: RunStore) -> None:
    run.close()
    with recording_lock(path):
        with pytest.raises(ConfigError, match="another program"), recording_lock(path):
            pass
        RunStore.open(path).close()  # reading is free
    with recording_lock(path):
        pass

"""What other programs see of a recording while it runs: its status and its newest pictures, in the run's folder."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_night import TELESCOPE, Night, new_run
from hypothesis import given
from hypothesis import strategies as st
from recorded_night import SETTINGS, bits, record_night

from namod_ctl.core.errors import ConfigError, DeviceFaultError, StoreError
from namod_ctl.core.records import Record
from namod_ctl.cycle import live_status
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.live_status import EVERY_S, HEARTBEAT_S, NOTE_LIVE, LiveNote, LiveStatus
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import Recorder, StopRule
from namod_ctl.cycle.replay import replayable_records
from namod_ctl.store.database import connect_existing
from namod_ctl.store.live_pictures import LIVE_FOLDER, live_picture, live_pictures
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_tail import RunTail

ALL_THE_TIME = -1.0


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def status_of(path: Path) -> LiveStatus:
    """As another program reads it."""
    with RunTail(path) as tail:
        text = tail.note(NOTE_LIVE)
    assert text is not None
    status = LiveStatus.from_json(text)
    assert status is not None
    return status


def watch(path: Path, night: Night, stop: StopRule, look: Callable[[Progress], None]) -> list[Record]:
    with new_run(path, night.clock) as store:
        Recorder(night.equipment, TELESCOPE, store, SETTINGS).record(stop, look)
        return store.records()


def test_a_finished_recording_says_what_was_wanted_and_why_it_ended(path: Path) -> None:
    night = Night(star_of=lambda time_s: 0.02 if time_s % 6.0 > 3.0 else 1.0)  # pairs are taken again
    _, recorder, _ = record_night(path, night, 30)
    status = status_of(path)
    assert status.n_wanted == 30
    assert "are there" in status.ended
    assert status.waits_for == ""
    assert status.region_radius_rad == SETTINGS.region_radius_rad
    assert status.exposure_limits_s == {"star": (1e-3, 3.0), "reflector": (1e-3, 3.0)}
    retaken = recorder.progress().source.dropped
    assert retaken
    assert status.dropped == retaken


def test_while_a_camera_is_lost_others_read_what_to_do(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_status, "EVERY_S", ALL_THE_TIME)
    night = Night()
    lost = DeviceFaultError("fake star camera: does not answer")
    night.star.fault = lambda time_s: lost if time_s > 5.0 else None
    seen: list[LiveStatus] = []
    with new_run(path, night.clock) as store:
        recorder = Recorder(night.equipment, TELESCOPE, store, SETTINGS)

        def look(progress: Progress) -> None:
            if progress.warning:
                seen.append(status_of(path))
                recorder.ask_to_stop()

        recorder.record(StopRule(), look)
    assert "cable and power" in seen[0].warning
    assert "does not answer" in seen[0].trouble
    assert seen[0].dropped[DropCause.CAMERA_LOST] >= 10
    assert "that can be used" in seen[0].waits_for
    assert "by hand" in status_of(path).ended


def test_a_full_disk_is_said_where_it_can_be(path: Path) -> None:
    night = Night()
    seen: list[LiveStatus] = []

    def full(records: list[Record], notes: object = None) -> None:
        if records[0].index == 3 and not seen:
            raise StoreError("run.sqlite: the disk is full") from OSError(errno.ENOSPC, "no space")
        put(records, notes)  # type: ignore[arg-type]

    def look(progress: Progress) -> None:
        if progress.is_halted:
            seen.append(status_of(path))

    with new_run(path, night.clock) as store:
        put, store.append = store.append, full  # type: ignore[method-assign,assignment]
        Recorder(night.equipment, TELESCOPE, store, replace(SETTINGS, store_retry_s=0.0)).record(
            StopRule(n_records=6), look
        )
    assert "NOTHING IS RECORDED" in seen[0].warning
    assert seen[0].is_halted
    assert seen[0].waits_for == "the disk"
    assert not status_of(path).is_halted


def test_a_recording_that_breaks_off_says_why(path: Path) -> None:
    night = Night()
    night.reflector.edit = lambda exposure: replace(exposure, image=exposure.image[:-8])  # of another camera
    with new_run(path, night.clock) as store, pytest.raises(ConfigError):
        Recorder(night.equipment, TELESCOPE, store, SETTINGS).record(StopRule(n_records=5))
    assert "broke off" in status_of(path).ended
    assert "reflector" in status_of(path).ended


def test_records_do_not_depend_on_how_often_the_status_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rarely, _, _ = record_night(tmp_path / "rarely", Night(), 25)
    monkeypatch.setattr(live_status, "EVERY_S", ALL_THE_TIME)
    monkeypatch.setattr(live_status, "PICTURE_EVERY_S", ALL_THE_TIME)
    often, _, _ = record_night(tmp_path / "often", Night(), 25)
    assert [bits(record) for record in often] == [bits(record) for record in rarely]


class Book:
    """A run that counts its notes, and a clock beside it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.said = LiveStatus(400, 0.01)
        self.n_passing = 0
        self.note = LiveNote(self, lambda: self.now_s)

    def set_note(self, key: str, text: str, *, is_passing: bool = False) -> None:
        assert is_passing  # it costs no fsync
        self.n_passing += 1

    def status(self) -> LiveStatus:
        return self.said


@pytest.mark.parametrize("records_per_s", [0.3, 3.0, 50.0])
def test_it_is_written_at_most_twice_a_second_and_with_records_where_they_are_many(records_per_s: float) -> None:
    book, next_record_s, n_with_records = Book(), 100.0, 0
    for tick in range(6000):
        book.now_s = 100.0 + 0.01 * tick
        book.said = replace(book.said, n_frames_missed=tick)  # something new every time
        if book.now_s >= next_record_s:
            next_record_s += 1.0 / records_per_s
            n_with_records += len(book.note.with_record(book.status))
        book.note.tell(book.status)
    n_written = book.n_passing + n_with_records
    assert 0.9 * 60.0 / EVERY_S <= n_written <= 60.0 / EVERY_S + 1
    if records_per_s == 50.0:
        assert n_with_records > 0.4 * n_written


def test_when_nothing_changes_it_only_shows_that_somebody_is_there() -> None:
    book = Book()
    for tick in range(6000):
        book.now_s = 0.01 * tick
        book.said = replace(book.said, elapsed_s=book.now_s, rate_per_min=1.0 / (1.0 + book.now_s))
        book.note.tell(book.status)
    assert book.n_passing == pytest.approx(60.0 / HEARTBEAT_S, abs=1)


numbers = st.floats(allow_nan=False)
estimates = st.builds(LiveEstimate, st.integers(0), numbers, st.integers(), st.tuples(st.integers(), st.integers()))
statuses = st.builds(
    LiveStatus,
    n_wanted=st.none() | st.integers(0),
    region_radius_rad=numbers,
    exposure_limits_s=st.dictionaries(st.sampled_from(["star", "reflector"]), st.tuples(numbers, numbers)),
    longest_now_s=numbers,
    dropped=st.dictionaries(st.sampled_from(DropCause), st.integers(0)),
    trouble=st.text(st.characters(exclude_categories=["Cs"])),
    warning=st.text(st.characters(exclude_categories=["Cs"])),
    is_halted=st.booleans(),
    estimate=st.none() | estimates.map(lambda e: replace(e, a_sigma_rad2=1.0, a_sigma_uncertainty_rad2=math.inf)),
)


@given(statuses)
def test_what_is_written_is_what_is_read(status: LiveStatus) -> None:
    assert LiveStatus.from_json(status.to_json()) == status


@given(st.text() | st.sampled_from(["{}", "null", "[1]", '{"n_wanted": "many", "region_radius_rad": 1}']))
def test_what_another_version_wrote_is_nothing(text: str) -> None:
    assert LiveStatus.from_json(text) is None


def test_the_pictures_are_those_of_the_newest_record_and_no_frames(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_status, "PICTURE_EVERY_S", ALL_THE_TIME)
    n_files: list[int] = []
    night = Night()
    records = watch(
        path, night, StopRule(n_records=15), lambda progress: n_files.append(len(list((path / LIVE_FOLDER).iterdir())))
    )
    newest = records[-1]
    assert max(n_files) == 2
    assert live_pictures(path) == {"star_camera": newest.index, "reflector_camera": newest.index}
    data = live_picture(path, newest.index, "star_camera")
    assert data is not None
    picture = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), dtype=np.float64)
    assert picture.shape == (240, 320)
    row, column = np.unravel_index(int(cv2.GaussianBlur(picture, (9, 9), 0).argmax()), picture.shape)
    assert np.hypot(*(TELESCOPE.star_camera.pixel_of_theta(newest.theta_rad) - (column, row))) < 1.5
    # brightened by a square root: the star at 80 % of full scale, the camera's offset of 3 adu at 28
    assert picture[row, column] == pytest.approx(255 * math.sqrt(0.8), abs=20)
    assert np.median(picture) == pytest.approx(255 * math.sqrt(3 / 255), abs=4)
    with RunStore.open(path) as run:
        assert run.frame_files("star_camera") == {}
        with pytest.raises(ConfigError, match="no frames were kept"):
            replayable_records(run)
    with RunTail(path) as tail:
        assert tail.latest_frames() == {"star_camera": newest.index, "reflector_camera": newest.index}


def test_kept_frames_need_no_pictures_beside_them(path: Path) -> None:
    records, _, _ = record_night(path, Night(), 5, replace(SETTINGS, keep_frames=True))
    assert not (path / LIVE_FOLDER).exists()
    with RunTail(path) as tail:
        assert tail.latest_frames() == {"star_camera": records[-1].index, "reflector_camera": records[-1].index}


def test_an_old_run_has_no_status_and_opens(path: Path) -> None:
    record_night(path, Night(), 5)
    connection = connect_existing(path / "run.sqlite", read_only=False)
    connection.execute("DELETE FROM meta WHERE key = 'note.record.live'")
    connection.close()
    with RunTail(path) as tail:
        assert tail.note(NOTE_LIVE) is None
        assert len(tail.new_records()) == 5
        tail.rewind()
        assert len(tail.new_records()) == 5

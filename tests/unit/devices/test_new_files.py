"""New files of a folder: whatever programs do to old ones, and however they write new ones."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from namod_ctl.devices.cameras.new_files import LOOK_AT_ALL_EVERY_S, SETTLED_S, NewFiles


def is_frame(name: str) -> bool:
    return name.endswith(".fits") and not name.startswith(".")


class Folder:
    """A folder that is watched, on a clock that is told."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.now_s = 0.0
        for number in range(3):
            self.write(f"old_{number}.fits", b"old")
        self.files = NewFiles(path, is_frame)

    def write(self, name: str, data: bytes) -> None:
        (self.path / name).write_bytes(data)

    def begin(self) -> None:
        """A new moment, from which on the file system's clock has gone on."""
        mark = self.path / ".mark"
        mark.write_bytes(b"")
        self.files.begin(mark)
        probe = self.path / ".probe"
        probe.write_bytes(b"")
        while probe.stat().st_ctime_ns <= mark.stat().st_ctime_ns:
            probe.write_bytes(b"")

    def new(self) -> list[str]:
        """What is new and has settled when nothing is touched any more."""
        self.now_s += LOOK_AT_ALL_EVERY_S
        self.files.settled(self.now_s)
        self.now_s += SETTLED_S
        return [name for name, _ in self.files.settled(self.now_s)]


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def test_nothing_is_new_until_something_comes(folder: Folder) -> None:
    folder.begin()
    assert folder.new() == []
    folder.write("new.fits", b"new")
    folder.write(".new.fits", b"unfinished")
    folder.write("new.txt", b"of no interest")
    assert folder.new() == ["new.fits"]
    folder.files.dismiss("new.fits")
    assert folder.new() == []


def test_the_oldest_comes_first(folder: Folder) -> None:
    folder.begin()
    for name in ("c.fits", "a.fits", "b.fits"):
        folder.write(name, b"new")
        before_ns = (folder.path / name).stat().st_ctime_ns
        while (folder.path / ".probe").stat().st_ctime_ns <= before_ns:
            folder.write(".probe", b"")
    assert folder.new() == ["c.fits", "a.fits", "b.fits"]


def test_a_name_that_is_used_again_is_new(folder: Folder) -> None:
    folder.begin()
    folder.write("old_0.fits", b"in its place")
    folder.write(".aside", b"renamed over it")
    (folder.path / ".aside").rename(folder.path / "old_1.fits")
    assert sorted(folder.new()) == ["old_0.fits", "old_1.fits"]


def test_what_backups_and_people_do_to_old_files_makes_them_no_newer(folder: Folder) -> None:
    folder.begin()
    folder.path.joinpath("old_0.fits").chmod(0o600)
    os.link(folder.path / "old_1.fits", folder.path / ".backup")
    folder.path.joinpath("old_2.fits").read_bytes()
    assert folder.new() == []


def test_what_came_before_the_moment_is_old(folder: Folder) -> None:
    folder.write("late.fits", b"came while nobody looked")
    folder.write("old_0.fits", b"was overwritten then")
    folder.begin()
    assert folder.new() == []
    folder.begin()
    assert folder.new() == []


def test_what_was_being_written_at_the_moment_is_old_when_it_is_done(folder: Folder) -> None:
    with (folder.path / "late.fits").open("wb") as file:
        file.write(b"its exposure ended before")
        file.flush()
        folder.begin()
        file.write(b" the moment")
    assert folder.new() == []
    folder.write("late.fits", b"but now it is another one")
    assert folder.new() == ["late.fits"]


def test_a_file_renamed_over_one_that_nobody_looked_at_is_new(folder: Folder) -> None:
    folder.write("latest.fits", b"late")
    folder.begin()
    folder.write(".aside", b"new")
    (folder.path / ".aside").rename(folder.path / "latest.fits")
    assert folder.new() == ["latest.fits"]


def test_a_file_that_changes_has_not_settled(folder: Folder) -> None:
    folder.begin()
    with (folder.path / "new.fits").open("wb") as file:
        for _ in range(5):
            file.write(b"more")
            file.flush()
            folder.now_s += LOOK_AT_ALL_EVERY_S
            assert folder.files.settled(folder.now_s) == []
    settled_from_s = folder.now_s
    folder.now_s += SETTLED_S
    assert folder.files.settled(folder.now_s) == [("new.fits", settled_from_s)]


def test_a_folder_that_is_gone_is_told(folder: Folder) -> None:
    folder.begin()
    shutil.rmtree(folder.path)
    with pytest.raises(FileNotFoundError):
        folder.files.settled(1.0)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["write", "rename", "remove", "chmod", "begin"]), st.integers(0, 3)), max_size=12
    )
)
def test_new_is_what_was_written_since_the_last_moment(tmp_path: Path, steps: list[tuple[str, int]]) -> None:
    path = tmp_path / "frames"
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    folder = Folder(path)
    folder.begin()
    expected: set[str] = set()
    for number, (step, which) in enumerate(steps):
        name = f"old_{which}.fits"
        if step == "begin":
            for seen in folder.new():  # somebody has waited for a frame until then
                folder.files.dismiss(seen)
            folder.begin()
            expected.clear()
        elif step == "remove":
            (path / name).unlink(missing_ok=True)
            expected.discard(name)
        elif step == "chmod" and (path / name).exists():
            (path / name).chmod(0o600)
        elif step in ("write", "rename"):
            target = ".aside" if step == "rename" else name
            folder.write(target, b"frame" * (number + 2))
            if step == "rename":
                (path / target).rename(path / name)
            expected.add(name)
    assert set(folder.new()) == expected

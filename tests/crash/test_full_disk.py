"""A disk that is full: said in words with exit code 2, nothing half written, nothing old lost."""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from namod_files import write_folder
from typer.testing import CliRunner

from namod_ctl.app.commands.imports import app
from namod_ctl.core.errors import NamodError
from namod_ctl.store.response_maps import HEADER
from namod_ctl.store.run import RunStore

FACET_IDS = (2, 3, 4, 5, 6, 7)


def write_maps(folder: Path, n_records: int) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(2)
    theta = rng.uniform(-0.3, 0.3, (n_records, 2))
    for facet_id in FACET_IDS:
        lines = [f"{x:.6g},{y:.6g},{r:.6g}" for (x, y), r in zip(theta, rng.random(n_records), strict=True)]
        (folder / f"mirror_ID{facet_id}_response_map.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    return folder


def call(*arguments: str) -> tuple[int, str]:
    """Exit code and message."""
    result = CliRunner().invoke(app, list(arguments))
    if isinstance(result.exception, NamodError):  # what the program's main function makes 2 of
        return 2, str(result.exception)
    return result.exit_code, result.output


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    if shutil.which("mount") is None:
        pytest.skip("needs the program mount")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"mounting a small disk needs privileges: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_file_that_may_not_grow(tmp_path: Path) -> None:
    maps = write_maps(tmp_path / "maps", 3000)
    arguments = ["import", "maps", str(maps), "--out", str(tmp_path / "run")]
    done = subprocess.run(
        [sys.executable, "-c", "from namod_ctl.app.cli import main; main()", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)),
        check=False,
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "run.sqlite" in done.stderr
    assert "disk full" in done.stderr or "disk is full" in done.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["maps"]


def test_maps_on_a_full_disk(small_disk: Path, tmp_path: Path) -> None:
    out = small_disk / "run"
    small, large = write_maps(tmp_path / "small", 20), write_maps(tmp_path / "large", 5000)
    assert call("maps", str(small), "--out", str(out))[0] == 0
    code, errors = call("maps", str(large), "--out", str(out), "--force")
    assert code == 2
    assert "disk is full" in errors
    assert [entry.name for entry in small_disk.iterdir()] == ["run"]
    with RunStore.open(out) as run:
        assert len(run.records()) == 20


def test_frames_on_a_full_disk_are_resumed_when_there_is_room(small_disk: Path, tmp_path: Path) -> None:
    out, n_records = small_disk / "run", 30
    write_folder(tmp_path / "night", n_records)
    command = ["namod", str(tmp_path / "night"), "--out", str(out), "--jobs", "1", "--keep-frames", "all"]
    code, errors = call(*command)
    assert code == 2
    assert "space" in errors
    assert not out.exists()
    with RunStore.open(small_disk / "run.partial") as run:
        n_done = len(run.records())
    assert 0 < n_done < n_records

    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    assert call(*command, "--resume")[0] == 0
    with RunStore.open(out) as run:
        assert len(run.records()) == n_records
        for index in range(n_records):
            run.frame(index, "star_camera")
    assert [entry.name for entry in small_disk.iterdir()] == ["run"]

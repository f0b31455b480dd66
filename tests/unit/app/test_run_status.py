"""`namod-ctl status RUN`: what another terminal is told of a recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_night import small_config
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.core.clock import SystemClock
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.recording_control import RecordingControl
from namod_ctl.store.run import RunStore


def told(path: Path, *options: str) -> str:
    result = CliRunner().invoke(app, ["status", str(path), *options])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "NIGHT"
    config = small_config()
    with RunStore.create(
        path, [facet.id for facet in config.facets], config.to_json(), "recorded", SystemClock()
    ) as store:
        status = LiveStatus(
            n_wanted=300, region_radius_rad=0.01, rate_per_min=42.0, trouble="no star", waits_for="the next pair"
        )
        store.set_note(NOTE_LIVE, status.to_json())
    return path


def test_while_it_is_recorded(run: Path) -> None:
    with RecordingControl(run, lambda: None):
        text = told(run)
        data = json.loads(told(run, "--json"))
    for words in ("0 of 300 wanted, 42 per minute", "Trouble: no star", "Waits:   for the next pair", "namod-ctl stop"):
        assert words in text
    assert (data["schema"], data["is_recorded"], data["n_wanted"]) == ("namod-run-status/1", True, 300)


def test_after_it_was_killed_nothing_is_waited_for(run: Path) -> None:
    text = told(run)
    assert "nobody records into it" in text
    assert "without a word" in text
    assert "Waits:" not in text
    assert f"namod-ctl reconstruct {run}" in text


def test_when_it_has_ended_it_is_told_why(run: Path) -> None:
    with RunStore.open(run, read_only=False) as store:
        store.set_note(NOTE_LIVE, LiveStatus(n_wanted=None, region_radius_rad=0.01, ended="300 records").to_json())
    text = told(run)
    assert "Ended:   300 records" in text
    assert "without a word" not in text


def test_a_run_that_was_never_recorded_here(tmp_path: Path) -> None:
    config = small_config()
    ids = [facet.id for facet in config.facets]
    with RunStore.create(tmp_path / "RUN", ids, config.to_json(), "imported", SystemClock()):
        pass
    text = told(tmp_path / "RUN")
    assert "imported" in text
    assert "0 records" in text
    assert "Ended" not in text

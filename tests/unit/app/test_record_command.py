"""`namod-ctl record` as a person calls it: refusals in words, and a short recording of the twin."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from namod_ctl.app.commands.record import record
from namod_ctl.core.errors import NamodError
from namod_ctl.store.run import RunStore

app = typer.Typer()
app.command()(record)


def call(*arguments: object) -> tuple[int, str]:
    """Exit code and message."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if isinstance(result.exception, NamodError):  # what the program's main function makes 2 of
        return 2, str(result.exception)
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def twin_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("night") / "RUN"
    code, output = call("--twin", "--out", path, "--records", 4, "--seed", 3, "--every", 0, "--keep-frames", "all")
    assert code == 0, output
    assert "4 records count" in output
    return path


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "--out"),
        (["--out", "{new}", "--until-uncertainty", "0.3"], "0.3arcmin"),
        (["--out", "{new}", "--until-uncertainty", "-1arcmin"], "positive"),
        (["--out", "{new}", "--append", "{run}"], "--append"),
        (["--out", "{run}"], "exists"),
        (["--out", "{run}", "--replay", "{run}"], "stays as it is"),
        (["--replay", "{run}"], "--out"),
        (["--out", "{new}", "--replay", "{run}", "--config", "fact"], "--replay"),
        (["--append", "{run}", "--seed", "4"], "seed 3"),
        (["--append", "{run}", "--config", "mini_fact"], "another config"),
        (["--append", "{new}"], "no run"),
        (["--out", "{new}", "--config", "no_such"], "no such config"),
    ],
)
def test_what_cannot_be_done_is_refused(twin_run: Path, tmp_path: Path, arguments: list[str], named: str) -> None:
    new = tmp_path / "NEW"
    code, output = call(*[argument.format(run=twin_run, new=new) for argument in arguments])
    assert code == 2
    assert named in output
    assert not new.exists()


def test_without_the_flag_it_says_that_this_is_the_twin(tmp_path: Path) -> None:
    code, output = call("--out", tmp_path / "RUN", "--records", 1, "--every", 0)
    assert code == 0
    assert "twin, not a sky" in output
    with RunStore.open(tmp_path / "RUN") as run:
        assert "twin" in run.source


def test_a_replayed_twin_is_the_same_run(twin_run: Path, tmp_path: Path) -> None:
    code, output = call("--replay", twin_run, "--out", tmp_path / "AGAIN")
    assert code == 0
    assert "all frames are replayed" in output
    with RunStore.open(twin_run) as run, RunStore.open(tmp_path / "AGAIN") as again:
        assert [repr(record) for record in again.records()] == [repr(record) for record in run.records()]


def test_a_telescope_without_a_map_of_facets_can_be_recorded(tmp_path: Path) -> None:
    code, output = call("--out", tmp_path / "RUN", "--config", "mini_fact", "--records", 2, "--every", 0)
    assert code == 0, output

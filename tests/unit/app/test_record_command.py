"""`namod-ctl record` as a person calls it: refusals in words, and a short recording of the twin."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from namod_ctl.app.build.twin import build_twin, load_twin_settings
from namod_ctl.app.build.twin_note import noted_twin
from namod_ctl.app.commands.record import record
from namod_ctl.app.config.instrument import builtin_folder, load_config
from namod_ctl.app.views.recording_view import TerminalView
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import NamodError, StoreError
from namod_ctl.cycle.control import Request, RequestKind, send
from namod_ctl.cycle.progress import Progress
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_lock import recording_lock
from namod_ctl.twin.settings import TwinSettings

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
        (["--out", "{run}"], "--append"),
        (["--out", "{run}", "--replay", "{run}"], "stays as it is"),
        (["--replay", "{run}"], "--out"),
        (["--out", "{new}", "--replay", "{run}", "--config", "fact"], "--replay"),
        (["--out", "{new}", "--replay", "{run}", "--twin-settings", "twin.toml"], "--replay"),
        (["--out", "{new}", "--twin-settings", "no_such.toml"], "no such file"),
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


MOON = "[reflector]\nmisalignment_arcmin = 2.0\n[[faults]]\nname = 'moonlight'\nparams = {level_share = 0.01}\n"


def test_the_twin_of_a_file_is_noted_and_goes_on(tmp_path: Path) -> None:
    """What was recorded does not depend on the file any more: neither on its text nor on its being there."""
    moon, other, out = tmp_path / "moon.toml", tmp_path / "other.toml", tmp_path / "RUN"
    moon.write_text(MOON)
    other.write_text(MOON.replace("0.01", "0.02"))
    code, output = call("--out", out, "--twin-settings", moon, "--records", 1, "--every", 0)
    assert code == 0, output
    with RunStore.open(out) as run:
        assert "moon.toml" in run.source
        noted = noted_twin(run)
    assert noted == (load_twin_settings(moon), 1)
    code, output = call("--append", out, "--twin-settings", other, "--records", 2, "--every", 0)
    assert code == 2
    assert "another twin" in output
    assert "faults" in output
    same = tmp_path / "same.toml"
    moon.rename(same)
    for arguments in ([], ["--twin-settings", same]):
        code, output = call("--append", out, *arguments, "--records", 2, "--every", 0)
        assert code == 0, output
    with RunStore.open(out) as run:
        assert noted_twin(run) == noted


def test_a_run_that_knows_its_seed_only_is_of_the_default_twin(tmp_path: Path) -> None:
    with RunStore.create(tmp_path / "RUN", (1,), '{"telescope": {}}', "", SystemClock()) as run:
        assert noted_twin(run) is None
        run.set_note("record.twin_seed", "3")
        assert noted_twin(run) == (TwinSettings(), 3)
        run.set_note("record.twin_settings", '{"sky": {"wind": 1}}')
        with pytest.raises(StoreError, match="wind"):
            noted_twin(run)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[sky]\nreference_star = 'Sirius'", "Sirius"),
        ("[sky]\nreference_star = 'Nemesis'", "catalogue"),
        ("[telescope]\nspeed = 3\n[sky]\nwind = 1", "telescope.speed"),
        ("[telescope]\nspeed = 3\n[sky]\nwind = 1", "sky.wind"),
    ],
)
def test_a_twin_that_cannot_be_is_refused_with_its_file(text: str, named: str, tmp_path: Path) -> None:
    file, new = tmp_path / "twin.toml", tmp_path / "NEW"
    file.write_text(text)
    code, output = call("--out", new, "--twin-settings", file)
    assert code == 2
    assert "twin.toml" in output
    assert named in output
    assert not new.exists()


def test_the_rough_night_that_comes_with_the_program_is_rough() -> None:
    settings = load_twin_settings(builtin_folder() / "twin" / "rough_night.toml")
    assert {"clouds", "clouds_total", "satellite", "moonlight"} <= {fault.name for fault in settings.faults}
    twin = build_twin(load_config("fact"), settings, 1)
    assert [twin.sky.star_name(time_s) for time_s in (0.0, 1385.0)] == ["Vega", "Deneb"]


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


@pytest.mark.parametrize("option", ["--minutes", "--every", "--region-radius-deg"])
@pytest.mark.parametrize("value", ["inf", "nan", "1e12"])
def test_numbers_without_sense_are_refused(tmp_path: Path, option: str, value: str) -> None:
    code, output = call("--out", tmp_path / "NEW", option, value)
    assert code == 2
    assert option in output
    assert not (tmp_path / "NEW").exists()


def test_force_does_not_replace_a_run_that_is_being_recorded(twin_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "RUN"
    shutil.copytree(twin_run, run)
    with recording_lock(run):
        code, output = call("--twin", "--out", run, "--force", "--records", 1)
    assert code == 2
    assert "another program records into this run" in output
    with RunStore.open(run) as store:
        assert len(store.records()) >= 4


def test_append_and_force_contradict_each_other(twin_run: Path) -> None:
    code, output = call("--append", twin_run, "--force", "--records", 9)
    assert code == 2
    assert "--force" in output


def test_a_run_that_is_not_there_can_be_recorded(tmp_path: Path) -> None:
    code, output = call("--append", tmp_path / "NOPE", "--records", 9)
    assert code == 2
    assert "record --out" in output


def test_two_recorders_do_not_share_a_run(twin_run: Path) -> None:
    with recording_lock(twin_run):
        code, output = call("--append", twin_run, "--records", 9)
    assert code == 2
    assert "another program" in output


def copied(run: Path, to: Path) -> Path:
    return Path(shutil.copytree(run, to))


def test_a_replay_says_which_records_it_leaves_out(twin_run: Path, tmp_path: Path) -> None:
    run = copied(twin_run, tmp_path / "COPY")
    with sqlite3.connect(run / "run.sqlite") as connection:
        connection.execute("DELETE FROM frames WHERE record_index = 1")
    connection.close()
    code, output = call("--replay", run, "--out", tmp_path / "AGAIN")
    assert code == 0
    assert "1 of its records without frames left out" in output


def test_a_replay_that_fails_leaves_nothing_and_replaces_nothing(twin_run: Path, tmp_path: Path) -> None:
    run, old = copied(twin_run, tmp_path / "COPY"), copied(twin_run, tmp_path / "OLD")
    (run / "frames" / "000002_star_camera.png").write_bytes(b"torn")
    code, output = call("--replay", run, "--out", tmp_path / "AGAIN")
    assert code == 2
    assert "000002_star_camera" in output
    assert call("--replay", run, "--out", old, "--force")[0] == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["COPY", "OLD"]
    with RunStore.open(old) as kept:
        assert "twin" in kept.source


def test_a_recording_is_ended_from_another_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, asked = tmp_path / "RUN", []

    def show(view: TerminalView, progress: Progress, *, now: bool = False) -> None:
        if progress.n_accepted == 2 and not asked:
            asked.append(send(run, Request(kind=RequestKind.STOP), SystemClock()))

    monkeypatch.setattr(TerminalView, "show", show)
    code, output = call("--twin", "--out", run, "--config", "mini_fact", "--records", 50, "--every", 0)
    assert code == 0
    assert "stopped by hand" in output
    answer = asked[0].answer()
    assert answer is not None
    assert answer.is_accepted
    with RunStore.open(run) as store:
        assert 2 <= len(store.records()) < 10

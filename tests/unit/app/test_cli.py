"""What the program says to those who do not know it yet, or who mistype."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from namod_ctl.app.cli import app


def all_commands() -> list[list[str]]:
    """Every command that does something, by its words."""
    root = typer.main.get_command(app)
    found = []

    def walk(group, words):
        context = typer.Context(group)
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            if hasattr(command, "list_commands"):
                walk(command, [*words, name])
            else:
                found.append([*words, name])

    walk(root, [])
    return found


@pytest.mark.parametrize("words", all_commands(), ids=" ".join)
def test_every_command_explains_itself_with_an_example(words):
    result = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert result.exit_code == 0, result.output
    assert f"Example: namod-ctl {' '.join(words)}" in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("typed", "meant"), [("recrod", "'record'"), ("reprot", "'report'"), ("alig", "'align'"), ("xyzzy", "--help")]
)
def test_a_mistyped_command_is_answered_with_the_one_that_was_meant(typed, meant):
    result = CliRunner().invoke(app, [typed])
    assert result.exit_code == 2
    assert meant in result.output


def test_a_newcomer_on_a_terminal_is_told_three_things_to_try():
    master, slave = pty.openpty()
    code = "from namod_ctl.app.cli import main; main()"
    with subprocess.Popen([sys.executable, "-c", code], stdout=slave, stderr=slave, stdin=slave) as process:
        os.close(slave)
        text = b""
        while True:
            try:
                chunk = os.read(master, 4096)
            except OSError:  # the other end is closed
                break
            text += chunk
            if not chunk:
                break
        assert process.wait() == 0
    os.close(master)
    for words in (b"namod-ctl align", b"namod-ctl record --twin", b"namod-ctl --help"):
        assert words in text
    assert b"Usage" not in text


def test_a_program_that_asks_for_nothing_gets_the_help():
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 0
    assert "Usage" in result.output


def test_the_tab_key_completes_commands_that_are_imported_on_demand():
    code = "from namod_ctl.app.cli import app; app(prog_name='namod-ctl')"
    environment = os.environ | {
        "_NAMOD_CTL_COMPLETE": "complete_bash", "COMP_WORDS": "namod-ctl reco", "COMP_CWORD": "1"
    }  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert set(done.stdout.split()) == {"record", "reconstruct"}

"""`namod-ctl actuators` as a person calls it."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner, Result

from namod_ctl.app.cli import app
from namod_ctl.app.views.actuator_tables import legs_named
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError

LEGS = [Leg(13, 0), Leg(13, 1), Leg(13, 2), Leg(31, 0), Leg(31, 1)]


def called(*arguments: str, answer: str | None = None) -> Result:
    return CliRunner().invoke(app, ["actuators", *arguments], input=answer, env={"COLUMNS": "160"})


def test_names_of_legs() -> None:
    assert legs_named(["31", "13.2", "31.1"], LEGS) == (Leg(31, 0), Leg(31, 1), Leg(13, 1))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("13.4", "legs 13.1, 13.2, 13.3"),
        ("13.0", "legs 13.1, 13.2, 13.3"),
        ("14", "facets 13, 31"),
        ("13-2", "such as 13.2"),
        ("", "such as 13.2"),
    ],
)
def test_names_that_are_none_are_refused(name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        legs_named([name], LEGS)


@pytest.mark.parametrize("config", ["fact_actuated", "fact_zaber", "mst_actuated"])
def test_the_list_has_every_drive_in_a_line_of_80_columns(config: str) -> None:
    result = CliRunner().invoke(app, ["actuators", "list", "--twin", "--config", config], env={"COLUMNS": "80"})
    assert result.exit_code == 0
    drives = [line for line in result.output.splitlines() if line[0].isdigit() and "stands" in line]
    assert f"{len(drives)} of {len(drives)} drives ready to move" in result.output
    assert len(drives) == len({line.split()[0] for line in drives}) == (172 if config == "mst_actuated" else 90)
    assert max(map(len, drives)) <= 80
    assert all("twin/" in line for line in drives)


def test_the_list_says_once_what_all_drives_are() -> None:
    result = called("list", "--twin")
    assert result.output.count("TMCM-6110") == 1
    assert "facets 0, 2 to 7, 10 to 13, 15 to 19, 21 to 27, 29 to 35 legs 1 to 3" in result.output


def test_a_jog_asks_first_and_moves_by_what_was_said() -> None:
    result = called("jog", "13.2", "--by-mm", "-0.06", "--twin", answer="y\n")
    assert result.exit_code == 0
    assert result.output.index("-0.0600") < result.output.index("Go on?") < result.output.index("arrived")


def test_without_a_yes_nothing_moves() -> None:
    result = called("move", "13", "--to-mm", "0.3", "--twin", answer="n\n")
    assert result.exit_code == 1
    assert "arrived" not in result.output


@pytest.mark.parametrize("arguments", [("jog", "13.2", "--by-mm", "0.1"), ("home", "13"), ("selftest", "13")])
def test_where_nobody_can_answer_it_is_told_what_to_write(arguments: tuple[str, ...]) -> None:
    result = called(*arguments, "--twin", answer="")
    assert isinstance(result.exception, ConfigError)
    assert "--yes" in str(result.exception)
    assert "arrived" not in result.output


def test_what_is_beyond_the_limits_is_refused_with_the_numbers() -> None:
    result = called("move", "13.1", "--to-mm", "7.0", "--twin", "--yes")
    assert result.exit_code == 1
    assert "refused" in result.output
    assert "arrived" not in result.output


def test_what_is_refused_is_told_before_anybody_is_asked() -> None:
    result = called("jog", "13.1", "--by-mm", "50", "--twin", answer="")
    assert result.exit_code == 1  # the answer is not missed, as there is no question
    assert "Go on?" not in result.output
    assert "50.0000 mm is more than the" in result.output
    assert "cycle" not in result.output
    assert "nothing was moved" in result.output


def test_home_stop_and_selftest() -> None:
    home = called("home", "13.1", "--twin", "--yes")
    assert (home.exit_code, "homed" in home.output) == (0, True)
    stop = called("stop", "--twin")
    assert (stop.exit_code, stop.output.count("stands at")) == (0, 90)
    selftest = called("selftest", "13.1", "--twin", "--yes")
    assert selftest.exit_code == 0
    assert "1 of 1 leg passed" in selftest.output
    assert "44" in selftest.output  # of its bus, watched


def test_all_or_names_but_not_neither() -> None:
    for arguments in (("home", "--twin", "--yes"), ("home", "13", "--all", "--twin", "--yes")):
        result = called(*arguments)
        assert isinstance(result.exception, ConfigError)
        assert "--all" in str(result.exception)


def test_lines_that_are_not_there_are_named_with_a_remedy() -> None:
    result = called("stop", "--config", "fact_actuated")
    assert isinstance(result.exception, ConfigError)
    assert "were not stopped" in str(result.exception)
    assert "south" in str(result.exception)
    assert "north" in str(result.exception)


def test_an_instrument_without_actuators_says_so() -> None:
    result = called("list", "--config", "fact", "--twin")
    assert isinstance(result.exception, ConfigError)
    assert "[actuators]" in str(result.exception)

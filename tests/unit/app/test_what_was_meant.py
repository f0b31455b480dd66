"""What a person is told who named a campaign, or a folder that is not there, where a run was to be named."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console
from small_night import small_config
from typer.testing import CliRunner

from namod_ctl.app.cli import app
from namod_ctl.app.reconstruction_report import area_text
from namod_ctl.app.views.align_view import cycle_table
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import arcmin2_to_rad2
from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle
from namod_ctl.store.run import RunStore


def make_run(path: Path) -> None:
    config = small_config()
    RunStore.create(path, [facet.id for facet in config.facets], config.to_json(), "made", SystemClock()).close()


def refusal(*arguments: str) -> str:
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, ConfigError), result.output
    return str(result.exception)


@pytest.mark.parametrize("command", ["instruct", "reconstruct", "compare"])
def test_a_campaign_names_its_runs(tmp_path: Path, command: str) -> None:
    campaign = tmp_path / "CAMPAIGN"
    CampaignStore.create(campaign, small_config().to_json(), "made", SystemClock()).close()
    other = [str(tmp_path / "OTHER"), "--out", str(tmp_path)] if command == "compare" else []
    words = [command, str(campaign), *other]
    assert refusal(*words).startswith(f"{campaign}: this is a campaign; it has no run yet")
    for number in (1, 2):
        make_run(campaign / f"cycle_0{number}")
    assert f"its runs are {campaign / 'cycle_01'}, {campaign / 'cycle_02'}" in refusal(*words)


def test_a_slip_of_the_finger_is_seen(tmp_path: Path) -> None:
    make_run(tmp_path / "NIGHT")
    assert f"did you mean {tmp_path / 'NIGHT'}?" in refusal("reconstruct", str(tmp_path / "NIHGT"))
    assert "did you mean" not in refusal("reconstruct", str(tmp_path / "elsewhere"))


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (69.63, 7.41, "69.6 +- 7.4 arcmin2"),
        (5.5021, 0.0131, "5.502 +- 0.013 arcmin2"),
        (5.5021, 0.00996, "5.502 +- 0.010 arcmin2"),
        (120.4, 14.6, "120 +- 15 arcmin2"),
        (99.44, 9.97, "99 +- 10 arcmin2"),
        (5.38, 0.0, "5.4 arcmin2"),
    ],
)
def test_an_uncertainty_has_two_significant_digits(value: float, uncertainty: float, text: str) -> None:
    assert area_text(AreaOfPsf(float(arcmin2_to_rad2(value)), float(arcmin2_to_rad2(uncertainty)))) == text


def test_what_a_stopped_campaign_did_not_measure_is_a_dash() -> None:
    nan = float("nan")
    console = Console(file=StringIO(), width=120)
    console.print(cycle_table([Cycle(1, "cycle_01", 0, nan, nan, nan, nan, None, "")]))
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    assert "nan" not in shown
    assert " - " in shown

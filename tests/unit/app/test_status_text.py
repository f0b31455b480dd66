"""What `status` and the campaign's summary tell a person: the whole decision, and many legs in few lines."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from small_night import small_config
from typer.testing import CliRunner

from namod_ctl.app.campaign_report import summary_text
from namod_ctl.app.cli import app
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.units import arcmin2_to_rad2
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle

DECISION = "correct: 61.03 +- 0.78 arcmin2; a correction promises 6.67 +- 0.01 arcmin2, which is worth the motion"
STOPPED = "not begun: somebody pressed stop"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stopped in the middle of a correction: 87 legs of 29 facets have not begun, one has a fault."""
    path = tmp_path_factory.mktemp("night") / "CAMPAIGN"
    with CampaignStore.create(path, small_config().to_json(), "made", SystemClock()) as store:
        store.add_transition("idle", "awaiting_operator", "wait", "sheets: are written")
        number = store.begin_cycle()
        rad2 = [float(arcmin2_to_rad2(area)) for area in (61.03, 0.78, 6.67, 5.39)]
        store.save_cycle(Cycle(number, f"cycle_{number:02d}", 400, *rad2, None, DECISION))
        orders = [MoveOrder(Leg(facet_id, k), 0.0, 1e-4) for facet_id in range(1, 31) for k in range(3)]
        for order, order_id in zip(orders, store.order(number, orders), strict=True):
            if order.leg == Leg(7, 1):
                store.result(order_id, MoveResult(order, MoveOutcome.OFF_TARGET, 5e-5, "it stands elsewhere"))
            elif order.leg.facet_id != 9:
                store.result(order_id, MoveResult(order, MoveOutcome.STOPPED, 0.0, STOPPED))
            else:
                store.result(order_id, MoveResult(order, MoveOutcome.ARRIVED, 1e-4))
        for facet_id in (2, 3, 4):
            store.add_event("refused", f"facet {facet_id}: too far", {"facet_id": facet_id, "why": "too far"})
    return path


def test_many_stopped_legs_are_one_line(campaign: Path) -> None:
    text = CliRunner().invoke(app, ["status", str(campaign)]).output
    lines = [line for line in text.splitlines() if line.startswith("Not where they should be")]
    assert sorted(lines) == [
        "Not where they should be: facet 7 leg 2: off target; it stands elsewhere",
        f"Not where they should be: facets 1 to 6, 8, 10 to 30 legs 1 to 3; facet 7 legs 1, 3: stopped; {STOPPED}",
    ]
    assert "Refused: facets 2 to 4: too far" in text


def test_the_decision_is_told_whole(campaign: Path) -> None:
    assert DECISION in CliRunner().invoke(app, ["status", str(campaign)], env={"COLUMNS": "80"}).output


def test_what_happened_is_told_without_arrows_and_fractions_of_seconds(campaign: Path) -> None:
    text = CliRunner().invoke(app, ["status", str(campaign)]).output
    assert re.search(r"^  \d{4}-\d\d-\d\d \d\d:\d\d:\d\d  awaiting operator: sheets: are written$", text, re.MULTILINE)
    assert "->" not in text


def test_the_summary_can_be_read_by_people(campaign: Path) -> None:
    with CampaignStore.open(campaign) as store:
        text = summary_text(store)
    assert "cycle 1: 61.03 ± 0.78, from 400 records" in text
    assert DECISION in text
    assert re.search(r"\d\d:\d\d:\d\d UTC  awaiting operator: people turn bolts\n +why: sheets: are written\n", text)
    assert "facets 2, 3, 4: too far" in text
    assert not re.search(r"\d\.\d{6}|\+00:00|->", text)

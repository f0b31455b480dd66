"""The state machine's table: complete, drawn in the docs, and nothing but its transitions is possible."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from transitions import MachineError

from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.machine import FINAL, STATES, TRANSITIONS, CampaignMachine, diagram

PAGE = Path(__file__).parents[3] / "docs" / "state_machine.md"


def test_the_page_in_docs_shows_this_table() -> None:
    text = PAGE.read_text()
    assert diagram() in text
    assert all(f"| `{state}` | {meaning} |" in text for state, meaning in STATES.items())


def test_every_state_can_be_reached_and_every_working_state_can_be_left_for_held() -> None:
    reached = {"idle"}
    for _ in STATES:
        reached |= {t.destination for t in TRANSITIONS if reached & set(t.sources)}
    assert reached == set(STATES)
    held_from = next(t.sources for t in TRANSITIONS if t.trigger == "hold")
    assert set(held_from) == set(STATES) - FINAL


def test_the_campaign_knows_what_to_do_in_every_state_that_is_not_final() -> None:
    assert all(hasattr(Campaign, f"_in_{state}") for state in STATES if state not in FINAL)


@given(st.lists(st.sampled_from(sorted({t.trigger for t in TRANSITIONS})), max_size=30))
def test_only_the_table_leads_anywhere_and_every_step_is_journaled_first(triggers: list[str]) -> None:
    journal: list[tuple[str, str, str]] = []
    machine = CampaignMachine("idle", lambda source, trigger, to, reason: journal.append((source, trigger, to)))
    for trigger in triggers:
        before, n = machine.state, len(journal)
        known = [t for t in TRANSITIONS if t.trigger == trigger and before in t.sources]
        if known:
            machine.fire(trigger, "")
            assert journal[n:] == [(before, trigger, known[0].destination)]
            assert machine.state == known[0].destination
        else:
            with pytest.raises(MachineError):
                machine.fire(trigger, "")
            assert (machine.state, len(journal)) == (before, n)


def test_a_step_that_cannot_be_journaled_is_not_made() -> None:
    def fail(source: str, trigger: str, to: str, reason: str) -> None:
        raise OSError("disk full")

    machine = CampaignMachine("idle", fail)
    with pytest.raises(OSError, match="disk full"):
        machine.fire("start", "")
    assert machine.state == "idle"

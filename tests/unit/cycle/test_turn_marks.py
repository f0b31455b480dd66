"""Marks of turned bolts: the same words whether the campaign's program takes them or nobody runs it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from namod_ctl.app.alignment_files import alignment_from_json, alignment_to_json
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings, Outside, View
from namod_ctl.cycle.control import Answer, Request, RequestKind, SentRequest, send
from namod_ctl.cycle.correct_by_hand import ManualCorrector
from namod_ctl.cycle.record import Equipment, RecordSettings
from namod_ctl.cycle.turn_marks import mark, unmark
from namod_ctl.store.campaign import CampaignStore

ASKED = {3: (5.0, 0.0, -5.0), 13: (15.0, -5.0, 0.0), 31: (10.0, 0.0, 0.0)}


def awaiting(path: Path, state: str = "awaiting_operator") -> CampaignStore:
    """A campaign whose people were asked to turn bolts of three facets."""
    store = CampaignStore.create(path, "{}", "a test", SystemClock())
    store.ask_turns(store.begin_cycle(), ASKED)
    store.add_transition("instructing", state, "wait", "sheets are written")
    return store


class Crew(View):
    """Sends one request at a time, keeps what is answered, and stops the campaign in the end."""

    def __init__(self, campaign: Path, requests: Sequence[Request]) -> None:
        self._campaign, self._to_send = campaign, [*requests, Request(kind=RequestKind.STOP)]
        self._sent: SentRequest | None = None
        self.answers: list[Answer] = []

    def wait(self) -> None:
        if self._sent is not None:
            answer = self._sent.answer()
            assert answer is not None
            self.answers.append(answer)
        self._sent = send(self._campaign, self._to_send.pop(0), SystemClock())


def answered(store: CampaignStore, requests: Sequence[Request]) -> tuple[list[Answer], list[tuple[int, ...]]]:
    """What a running campaign says to each, and which turns its people (or their twin) were told of."""
    told: list[tuple[int, ...]] = []
    instrument = build_instrument(load_config("mini_fact"))
    corrector = ManualCorrector(
        store, instrument, lambda run, alignment: "", 0.05, lambda facet_id, turns: told.append((facet_id,))
    )
    crew = Crew(store.path, requests)
    settings = CampaignSettings(RecordSettings())
    outside = Outside(_nothing_is_recorded, alignment_to_json, alignment_from_json, lambda run, result: None)
    campaign = Campaign(store, instrument, corrector, outside, settings, SystemClock(), StopSwitch(), crew)
    assert campaign.run() == "held"
    return crew.answers, told


def _nothing_is_recorded() -> Equipment:
    raise AssertionError("people turn bolts")


def said_to_nobody(store: CampaignStore, request: Request) -> Answer:
    """What the command line answers while no program runs."""
    try:
        text = (mark if request.kind is RequestKind.DONE else unmark)(store, request.facet_ids)
    except ConfigError as error:
        return Answer(is_accepted=False, text=str(error))
    return Answer(is_accepted=True, text=text)


def done(*facet_ids: int) -> Request:
    return Request(kind=RequestKind.DONE, facet_ids=facet_ids)


def not_done(*facet_ids: int) -> Request:
    return Request(kind=RequestKind.NOT_DONE, facet_ids=facet_ids)


def test_answers_do_not_depend_on_whether_the_campaign_runs(tmp_path: Path) -> None:
    requests = [done(13), done(77), done(13, 77), not_done(77), done(13), not_done(3), not_done(13), done(3, 31)]
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with awaiting(tmp_path / "a" / "CAMPAIGN") as running, awaiting(tmp_path / "b" / "CAMPAIGN") as resting:
        while_running, _ = answered(running, requests)
        while_resting = [said_to_nobody(resting, request) for request in requests]
        assert [turns.is_done for turns in running.turns()] == [True, False, True]
        assert running.turns() == resting.turns()
        journals = [
            [(event.kind, event.data["facet_ids"]) for event in store.events() if event.kind in ("done", "not_done")]
            for store in (running, resting)
        ]
    assert [answer.text.replace("/a/", "/b/") for answer in while_running] == [each.text for each in while_resting]
    accepted = [answer.is_accepted for answer in while_running]
    assert accepted == [each.is_accepted for each in while_resting]
    assert accepted == [True, False, False, False, True, True, True, True]
    for i in (1, 2, 3):
        assert "of facet 77; in cycle 1 turns were asked for of facets 3, 13, 31" in while_running[i].text
    assert while_running[0].text == "1 facet marked as done: 13; 2 to go: 3, 31"
    assert while_running[6].text == "1 facet not done after all: 13; 3 to go: 3, 13, 31"
    assert journals[0] == journals[1] == [("done", [13]), ("not_done", [13]), ("done", [3, 31])]


def test_a_mark_that_is_made_again_turns_no_bolt_again(tmp_path: Path) -> None:
    """The twin's people turned it when it was marked first; taking a mark back says something, and turns nothing."""
    with awaiting(tmp_path / "CAMPAIGN") as store:
        _, told = answered(store, [done(13), not_done(13), done(13), done(3)])
    assert told == [(13,), (3,)]


def test_the_last_mark_lets_the_campaign_go_on_and_none_can_be_taken_back(tmp_path: Path) -> None:
    with awaiting(tmp_path / "CAMPAIGN") as store:
        assert mark(store, "all") == "3 facets marked as done: 3, 13, 31; all are done"
        assert "3 to go" in unmark(store, "all")  # nobody has gone on yet
        mark(store, "all")
        store.add_transition("awaiting_operator", "recording", "done", "all facets are marked as done")
        with pytest.raises(ConfigError, match="has gone on"):
            unmark(store, [13])
        store.begin_cycle()
        store.add_transition("recording", "held", "hold", "stopped")
        with pytest.raises(ConfigError, match="has gone on"):
            unmark(store, "all")
        assert all(turns.is_done for turns in store.turns())


@pytest.mark.parametrize("say", [mark, unmark])
def test_nothing_to_mark_before_anybody_was_asked(tmp_path: Path, say: object) -> None:
    with CampaignStore.create(tmp_path / "CAMPAIGN", "{}", "a test", SystemClock()) as store:
        assert callable(say)
        with pytest.raises(ConfigError, match="nobody was asked"):
            say(store, "all")

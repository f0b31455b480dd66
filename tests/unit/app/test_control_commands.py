"""`status`, `stop`, `pause` and the others, against a campaign that somebody works on, or nobody."""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from dashboard_samples import new_run

from namod_ctl.app.cli import main
from namod_ctl.app.commands import control
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.units import arcmin2_to_rad2
from namod_ctl.cycle.control import OF_FACETS, ControlBox, Request, RequestKind
from namod_ctl.cycle.recording_control import RecordingControl
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle


@dataclass(frozen=True)
class Done:
    code: int
    out: str
    err: str


Call = Callable[..., Done]


@pytest.fixture
def namod_ctl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """The program, called as from the command line."""

    def call(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["namod-ctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_info:
            main()
        captured = capsys.readouterr()
        return Done(int(exit_info.value.code or 0), captured.out, captured.err)

    return call


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Two cycles: the second has refused a facet, and lost a leg; bolts of two facets are to be turned."""
    path = tmp_path / "CAMPAIGN"
    with CampaignStore.create(path, "{}", "a test", SystemClock()) as store:
        first, second = store.begin_cycle(), store.begin_cycle()
        areas = [arcmin2_to_rad2(area) for area in (62.0, 1.5, 7.1, 5.7)]
        store.save_cycle(Cycle(first, "cycle_01", 400, *areas, decision="correct"))
        store.save_cycle(Cycle(second, "cycle_02", 380, arcmin2_to_rad2(14.8), decision=""))
        store.add_transition("reconstructing", "previewing", "correct", "far away")
        store.add_event("refused", "facet 7", {"cycle": first, "facet_id": 7, "leg": None, "why": "was unreliable"})
        store.add_transition("reconstructing", "previewing", "correct", "nearer")
        why = {"cycle": second, "facet_id": 44, "leg": None, "why": "its drive reports a fault"}
        store.add_event("refused", "facet 44", why)
        orders = [MoveOrder(Leg(13, leg), 0.0, 1e-3) for leg in range(3)]
        ids = store.order(second, orders)
        store.result(ids[0], MoveResult(orders[0], MoveOutcome.ARRIVED, 1e-3))
        store.result(ids[1], MoveResult(orders[1], MoveOutcome.LOST, math.nan, "no answer"))
        store.ask_turns(second, {13: (5.0, 0.0, -5.0), 31: (10.0, 0.0, 0.0)})
    return path


@contextmanager
def at_work(path: Path, answer: Callable[[ControlBox, Request], None] | None) -> Iterator[list[Request]]:
    """Somebody who holds the campaign and looks for requests; `answer` None: who never looks."""
    taken: list[Request] = []
    is_over = threading.Event()

    def work(box: ControlBox) -> None:
        while not is_over.wait(0.005):
            for request in box.poll():
                taken.append(request)
                if answer is not None:
                    answer(box, request)

    with CampaignStore.open(path, read_only=False):
        worker = threading.Thread(target=work, args=(ControlBox(path),)) if answer is not None else None
        if worker is not None:
            worker.start()
        try:
            yield taken
        finally:
            is_over.set()
            if worker is not None:
                worker.join(10.0)


def say_ok(box: ControlBox, request: Request) -> None:
    box.answer(request, f"so be it: {request.kind}")


def set_state(path: Path, state: str) -> None:
    with CampaignStore.open(path, read_only=False) as store:
        store.add_transition("checking", state, "test", f"to be {state}")


@pytest.mark.parametrize("kind", [kind for kind in RequestKind if kind not in OF_FACETS])
def test_requests_reach_who_is_at_work(namod_ctl: Call, campaign: Path, kind: RequestKind) -> None:
    with at_work(campaign, say_ok) as taken:
        result = namod_ctl(kind.value, campaign)
    assert (result.code, result.out) == (0, f"so be it: {kind}\n")
    assert [request.kind for request in taken] == [kind]


def test_a_refusal_is_exit_code_2(namod_ctl: Call, campaign: Path) -> None:
    with at_work(campaign, lambda box, request: box.answer(request, "nothing is previewed", is_accepted=False)):
        result = namod_ctl("approve", campaign)
    assert (result.code, result.out) == (2, "")
    assert "nothing is previewed" in result.err


@pytest.mark.parametrize("command", ["stop", "pause", "resume", "approve", "refuse"])
def test_nobody_is_running(namod_ctl: Call, campaign: Path, command: str) -> None:
    result = namod_ctl(command, campaign)
    assert result.code == 2
    assert "nobody is running" in result.err
    assert "namod-ctl status" in result.err
    assert list((campaign / "control").iterdir()) == []


def test_somebody_who_does_not_look(namod_ctl: Call, campaign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A request to approve is withdrawn, so that nothing moves later; one to stop stays."""
    monkeypatch.setattr(control, "PATIENCE_S", 0.1)
    with at_work(campaign, None):
        result = namod_ctl("approve", campaign)
        assert result.code == 2
        assert f"process {os.getpid()} has not looked" in result.err
        assert list((campaign / "control").iterdir()) == []
        result = namod_ctl("stop", campaign)
        assert result.code == 2
        assert "emergency stop" in result.err
        assert [request.kind for request in ControlBox(campaign).poll()] == [RequestKind.STOP]


def test_taken_without_a_word(namod_ctl: Call, campaign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "PATIENCE_S", 0.2)
    with at_work(campaign, lambda box, request: None):
        result = namod_ctl("pause", campaign)
    assert (result.code, result.out) == (0, "Taken: pause.\n")


def test_done_goes_to_who_is_at_work(namod_ctl: Call, campaign: Path) -> None:
    with at_work(campaign, say_ok) as taken:
        assert namod_ctl("done", campaign, "--facet", "31, 13,31").code == 0
        assert namod_ctl("done", campaign, "--all").code == 0
        assert namod_ctl("done", campaign, "--facet", "13, 2 to 4,31-32").code == 0  # as status prints them
    assert [request.facet_ids for request in taken] == [(31, 13), "all", (13, 2, 3, 4, 31, 32)]
    with CampaignStore.open(campaign) as store:  # to mark them is the business of who is at work
        assert [turns.is_done for turns in store.turns()] == [False, False]


def test_done_without_anybody(namod_ctl: Call, campaign: Path) -> None:
    result = namod_ctl("done", campaign, "--facet", "31")
    assert (result.code, result.out) == (0, "1 facet marked as done: 31; 1 to go: 13\n")
    result = namod_ctl("done", campaign, "--facet", "13,77")
    assert result.code == 2
    assert "of facet 77" in result.err
    result = namod_ctl("done", campaign, "--all")
    assert result.code == 0
    assert "1 facet marked as done: 13; all are done" in result.out
    assert f"align --resume {campaign}" in result.out
    with CampaignStore.open(campaign) as store:
        assert [event.data["facet_ids"] for event in store.events() if event.kind == "done"] == [[31], [13]]


def test_marks_are_taken_back_without_anybody_until_the_campaign_has_gone_on(namod_ctl: Call, campaign: Path) -> None:
    set_state(campaign, "awaiting_operator")
    namod_ctl("done", campaign, "--all")
    result = namod_ctl("done", campaign, "--undo", "--facet", "13")
    assert (result.code, result.out) == (0, "1 facet not done after all: 13; 1 to go: 13\n")
    assert "of facet 77" in namod_ctl("done", campaign, "--undo", "--facet", "77").err
    with CampaignStore.open(campaign) as store:
        assert [event.data["facet_ids"] for event in store.events() if event.kind == "not_done"] == [[13]]
        assert [turns.is_done for turns in store.turns()] == [False, True]
    set_state(campaign, "recording")
    result = namod_ctl("done", campaign, "--undo", "--facet", "31")
    assert result.code == 2
    assert "has gone on" in result.err


def test_undo_goes_to_who_is_at_work(namod_ctl: Call, campaign: Path) -> None:
    with at_work(campaign, say_ok) as taken:
        assert namod_ctl("done", campaign, "--undo", "--facet", "31").code == 0
    assert [(request.kind, request.facet_ids) for request in taken] == [(RequestKind.NOT_DONE, (31,))]


def test_a_recording_is_stopped_by_its_folder(namod_ctl: Call, tmp_path: Path) -> None:
    with new_run(tmp_path / "RUN"):
        pass
    result = namod_ctl("stop", tmp_path / "RUN")
    assert result.code == 2
    assert "nobody records" in result.err
    is_asked, is_over = threading.Event(), threading.Event()

    def record() -> None:
        with RecordingControl(tmp_path / "RUN", is_asked.set) as box:
            is_ready.set()
            while not is_over.wait(0.005):
                box.look()

    is_ready = threading.Event()
    recorder = threading.Thread(target=record)
    recorder.start()
    try:
        assert is_ready.wait(10.0)
        result = namod_ctl("stop", tmp_path / "RUN")
    finally:
        is_over.set()
        recorder.join(10.0)
    assert result.code == 0
    assert "stopping" in result.out
    assert is_asked.is_set()
    assert not (tmp_path / "RUN" / "control").exists()


@pytest.mark.parametrize("arguments", [[], ["--facet", "13", "--all"], ["--facet", "13;31"], ["--facet", ""]])
def test_done_that_says_nothing(namod_ctl: Call, campaign: Path, arguments: list[str]) -> None:
    result = namod_ctl("done", campaign, *arguments)
    assert result.code == 2
    assert "--facet 13,31" in result.err or "such as 13,31" in result.err


def test_release_without_anybody(namod_ctl: Call, campaign: Path) -> None:
    result = namod_ctl("release", campaign)
    assert result.code == 2
    assert "its state is previewing" in result.err
    set_state(campaign, "held")
    assert namod_ctl("release", campaign).code == 0
    with CampaignStore.open(campaign) as store:
        last = store.last_transition()
        assert last is not None
        assert (last.data["from"], last.data["to"], last.data["trigger"]) == ("held", "idle", "release")
    assert namod_ctl("release", campaign).code == 2


def test_status_for_a_program(namod_ctl: Call, campaign: Path) -> None:
    set_state(campaign, "awaiting_operator")
    with at_work(campaign, say_ok):
        result = namod_ctl("status", campaign, "--json")
    assert (result.code, result.err) == (0, "")
    standing = json.loads(result.out)
    assert standing["schema"] == "namod-status/1"
    assert (standing["state"], standing["reason"]) == ("awaiting_operator", "to be awaiting_operator")
    assert (standing["is_running"], standing["process"]) == (True, os.getpid())
    assert "namod-ctl done" in standing["next"]
    first, second = standing["cycles"]
    assert first["a_sigma_arcmin2"] == pytest.approx(
        {"now": 62.0, "now_uncertainty": 1.5, "predicted_after_correction": 7.1, "limit": 5.7}
    )
    assert second["a_sigma_arcmin2"]["now"] == pytest.approx(14.8)
    assert second["a_sigma_arcmin2"]["predicted_after_correction"] is None
    assert standing["refused_facets"] == {"44": "its drive reports a fault"}
    assert [(leg["facet_id"], leg["leg"], leg["outcome"]) for leg in standing["legs_not_arrived"]] == [
        (13, 2, "lost"),
        (13, 3, "unknown"),
    ]
    assert (standing["turns_to_do"], standing["turns_done"]) == ([13, 31], [])
    assert standing["events"][-1]["kind"] == "transition"


def test_status_for_a_person(namod_ctl: Call, campaign: Path) -> None:
    set_state(campaign, "correcting")
    text = namod_ctl("status", campaign).out
    for words in (
        "State:   correcting (drives move)",
        "Running: no",
        f"align --resume {campaign}",
        "62.00 +- 1.50",
        "14.80",
        "Refused: facet 44: its drive reports a fault",
        "facet 13 leg 2: lost; no answer",
        "0 of 2 facets done; to do: 13, 31",
        "correcting: to be correcting",
    ):
        assert words in text
    set_state(campaign, "held")
    assert f"namod-ctl release {campaign}" in namod_ctl("status", campaign).out


def test_the_campaign_that_changed_last(
    namod_ctl: Call, campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "OTHER"
    CampaignStore.create(other, "{}", "another", SystemClock()).close()
    (tmp_path / "no_campaign").mkdir()
    for changed, unchanged in ((other, campaign), (campaign, other)):
        os.utime(unchanged / "campaign.sqlite", ns=(10**18, 10**18))
        os.utime(changed / "campaign.sqlite", ns=(10**18 + 10**9, 10**18 + 10**9))
        result = namod_ctl("status", "--json")
        assert result.err == f"Campaign {changed.name}.\n"
        assert json.loads(result.out)["campaign"] == str(changed)
    monkeypatch.chdir(other)
    assert json.loads(namod_ctl("status", "--json").out)["campaign"] == str(other)
    monkeypatch.chdir(tmp_path / "no_campaign")
    result = namod_ctl("stop")
    assert result.code == 2
    assert "there is no campaign in this folder" in result.err
    result = namod_ctl("stop", tmp_path)
    assert result.code == 2
    assert "there is no campaign here" in result.err

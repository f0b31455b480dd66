"""What the page refuses, and that what it is asked for reaches the campaign as it was asked."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from dashboard_samples import EVIL, TOKEN, new_campaign, new_run, record
from starlette.testclient import TestClient

from namod_ctl.app.dashboard.feed import Feed
from namod_ctl.app.dashboard.guard import MAX_BODY_BYTES, Rules, is_own_host
from namod_ctl.app.dashboard.server import build_app, page_files
from namod_ctl.cycle.control import ControlBox, Request, RequestKind
from namod_ctl.cycle.recording_control import RecordingControl
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME

HOST = "127.0.0.1:8765"
GOOD = {"origin": f"http://{HOST}", "x-namod-token": TOKEN, "content-type": "application/json"}
STOP = json.dumps({"kind": "stop"})


@contextlib.contextmanager
def served(path: Path, rules: Rules | None = None) -> Iterator[TestClient]:
    app = build_app(Feed(path), rules or Rules(TOKEN, is_loopback=True))
    with TestClient(app, base_url=f"http://{HOST}") as client:
        yield client


class Worker:
    """Stands for the process that works on the campaign: takes requests and answers them."""

    def __init__(self, store: CampaignStore) -> None:
        self.taken: list[Request] = []
        self._box = ControlBox(store.path)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> Worker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._is_over.wait(0.01):
            for request in self._box.poll():
                self.taken.append(request)
                self._box.answer(request, f"heard {request.kind}", is_accepted=request.kind is not RequestKind.REFUSE)


@pytest.fixture
def campaign(tmp_path: Path) -> Iterator[CampaignStore]:
    with new_campaign(tmp_path / "C") as store:
        yield store


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"x-namod-token": None}, 401),
        ({"x-namod-token": ""}, 401),
        ({"x-namod-token": TOKEN[:-1]}, 401),
        ({"x-namod-token": TOKEN + "x"}, 401),
        ({"origin": None}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "http://127.0.0.1:9999"}, 403),
        ({"origin": f"https://{HOST}"}, 403),
        ({"origin": f"http://{HOST}.evil.example"}, 403),
        ({"host": "evil.example"}, 421),
        ({"host": "evil.example:8765", "origin": "http://evil.example:8765"}, 421),  # DNS rebinding
        ({"content-type": "text/plain"}, 415),  # what a form of another site can send
        ({"content-type": "application/x-www-form-urlencoded"}, 415),
    ],
)
def test_command_of_a_stranger_is_refused_and_reaches_nobody(
    campaign: CampaignStore, change: dict[str, str | None], status: int
) -> None:
    headers = {name: value for name, value in (GOOD | change).items() if value is not None}
    with served(campaign.path) as client, Worker(campaign) as worker:
        answer = client.post("/command", content=STOP, headers=headers)
    assert answer.status_code == status
    assert not worker.taken


def test_command_with_the_token_reaches_the_campaign(campaign: CampaignStore) -> None:
    with served(campaign.path) as client, Worker(campaign) as worker:
        answer = client.post("/command", content=STOP, headers=GOOD)
        refused = client.post("/command", content=json.dumps({"kind": "refuse"}), headers=GOOD)
        step = campaign.events()[-1].id
        marks = [{"kind": kind, "facets": [3, 7], "step": step} for kind in ("done", "not_done")]
        marked = [client.post("/command", json=mark, headers=GOOD).status_code for mark in marks]
        stale = client.post("/command", json=marks[0] | {"step": step - 1}, headers=GOOD)
    assert (answer.status_code, answer.json()["text"]) == (200, "heard stop")
    assert refused.status_code == 409
    assert marked == [200, 200]
    assert stale.status_code == 409  # the page showed another cycle's sheet
    kinds = [(request.kind, request.facet_ids) for request in worker.taken]
    asked = [(RequestKind.DONE, (3, 7)), (RequestKind.NOT_DONE, (3, 7))]
    assert kinds == [(RequestKind.STOP, ()), (RequestKind.REFUSE, ()), *asked]


def test_approval_holds_for_the_preview_that_was_seen_and_no_other(campaign: CampaignStore) -> None:
    campaign.add_transition("recording", "reconstructing", "recorded", "")
    campaign.add_transition("reconstructing", "previewing", "correct", "")
    seen = campaign.add_transition("previewing", "awaiting_approval", "ask", "90 legs would move")
    approve = {"kind": "approve", "step": seen}
    with served(campaign.path) as client, Worker(campaign) as worker:
        assert client.post("/command", json=approve, headers=GOOD).status_code == 200
        campaign.add_transition("awaiting_approval", "previewing", "changed", "a drive was moved")
        campaign.add_transition("previewing", "awaiting_approval", "ask", "other legs would move")
        assert client.post("/command", json=approve, headers=GOOD).status_code == 409
    assert len(worker.taken) == 1


def test_page_of_a_campaign_that_was_replaced_can_stop_the_new_one_and_nothing_else(campaign: CampaignStore) -> None:
    seen = campaign.add_transition("previewing", "awaiting_approval", "ask", "90 legs would move")
    database = campaign.path / CAMPAIGN_DATABASE_NAME
    with served(campaign.path) as client, Worker(campaign) as worker:
        shutil.copyfile(database, database.with_name("other"))
        database.with_name("other").replace(database)
        assert client.post("/command", json={"kind": "approve", "step": seen}, headers=GOOD).status_code == 503
        assert client.post("/command", content=STOP, headers=GOOD).status_code == 200
    assert [request.kind for request in worker.taken] == [RequestKind.STOP]


def test_nobody_at_work_is_said(tmp_path: Path) -> None:
    with new_campaign(tmp_path / "C"):
        pass
    with served(tmp_path / "C") as client:
        answer = client.post("/command", content=STOP, headers=GOOD)
    assert answer.status_code == 409
    assert "nobody is at work" in answer.json()["text"]


def test_plain_run_can_be_stopped_while_somebody_records_it_and_nothing_else(tmp_path: Path) -> None:
    with new_run(tmp_path / "R"), served(tmp_path / "R") as client:
        assert client.post("/command", content=STOP, headers=GOOD).status_code == 409  # nobody records
        is_asked, is_over = threading.Event(), threading.Event()
        with RecordingControl(tmp_path / "R", is_asked.set) as control:

            def record() -> None:
                while not is_over.wait(0.005):
                    control.look()

            recorder = threading.Thread(target=record)
            recorder.start()
            try:
                pause = client.post("/command", json={"kind": "pause"}, headers=GOOD)
                assert (pause.status_code, is_asked.is_set()) == (409, False)
                stop = client.post("/command", content=STOP, headers=GOOD)
            finally:
                is_over.set()
                recorder.join(10.0)
        assert (stop.status_code, is_asked.is_set()) == (200, True)
        assert "keeps all" in stop.json()["text"]


@pytest.mark.parametrize(
    "body",
    [
        "",
        "{",
        "[]",
        '{"kind": "release"}',  # whoever releases has looked at the telescope
        '{"kind": "stop", "extra": 1}',
        '{"kind": "done"}',
        '{"kind": "done", "facets": ["../../etc"]}',
        '{"kind": "done", "facets": [-1]}',
        '{"kind": "stop", "facets": [1]}',
        '{"kind": "approve", "step": "1"}',
        "[" * 2000,
    ],
)
def test_body_that_is_no_command_is_refused(campaign: CampaignStore, body: str) -> None:
    with served(campaign.path) as client, Worker(campaign) as worker:
        assert client.post("/command", content=body, headers=GOOD).status_code in (409, 422)
    assert not worker.taken


def test_oversized_body_is_refused_whether_or_not_it_says_its_size(campaign: CampaignStore) -> None:
    big = b"x" * (MAX_BODY_BYTES + 1)
    with served(campaign.path) as client, Worker(campaign) as worker:
        assert client.post("/command", content=big, headers=GOOD).status_code == 413
        assert client.post("/command", content=iter([big] * 50), headers=GOOD).status_code == 413  # chunked
        assert client.post("/command", content=STOP, headers=GOOD | {"content-length": "-5"}).status_code == 413
    assert [request.kind for request in worker.taken] == []


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd",
        "/..%2f..%2f..%2fetc%2fpasswd",
        "/%2e%2e/%2e%2e/run.sqlite",
        "/run.sqlite",
        "/__init__.py",
        "/page.html%00.js",
        "/frame/0/..%2f..%2frun.sqlite/0",
        "/frame/0/star_camera/0",
        "/frame/1/star_camera/0",
        "/frame/99999999999999999999999999/star_camera/0",
        "/frame/0/star_camera/99999999999999999999999999",
        "/frame/-1/star_camera/0",
        "/sheet/0",
        "/sheet/7",
        "/sheet/99999999999999999999999999",
        "/facet/999",
        "/facet/99999999999999999999999999",
        "/facet/1%27%20OR%201=1",
    ],
)
def test_nothing_but_the_page_is_given_out(tmp_path: Path, path: str) -> None:
    with new_run(tmp_path / "R"), served(tmp_path / "R") as client:
        answer = client.get(path)
    assert answer.status_code == 404
    assert b"SQLite" not in answer.content
    assert b"root:" not in answer.content


def test_address_with_a_number_that_python_does_not_read_is_refused(tmp_path: Path) -> None:
    with new_run(tmp_path / "R"), served(tmp_path / "R") as client:
        assert client.get("/facet/" + "9" * 5000).status_code == 414


def test_reading_under_a_foreign_name_is_refused(tmp_path: Path) -> None:
    with new_run(tmp_path / "R"), served(tmp_path / "R") as client:
        for path in ("/", "/events", "/facet/1", "/page.js"):
            assert client.get(path, headers={"host": "rebound.evil.example"}).status_code == 421


@pytest.mark.parametrize(
    ("host", "is_loopback", "is_own"),
    [
        ("127.0.0.1:8765", True, True),
        ("localhost:8765", True, True),
        ("LOCALHOST", True, True),
        ("[::1]:8765", True, True),
        ("192.168.0.7:8765", True, False),
        ("192.168.0.7:8765", False, True),
        ("[fe80::1]:8765", False, True),
        ("evil.example", False, False),
        ("127.0.0.1.evil.example", True, False),
        ("localhost.evil.example", True, False),
        ("127.0.0.1@evil.example", True, False),
        ("[::1", True, False),
        ("", True, False),
    ],
)
def test_hosts(host: str, is_loopback: bool, is_own: bool) -> None:
    assert is_own_host(host, Rules(TOKEN, is_loopback)) is is_own


def test_every_answer_has_the_headers_that_browsers_obey(tmp_path: Path) -> None:
    with new_run(tmp_path / "R"), served(tmp_path / "R") as client:
        for path in ("/", "/page.js", "/facet/1", "/nothing", "/command"):
            headers = client.get(path).headers
            policy = headers["content-security-policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert headers["x-content-type-options"] == "nosniff"


def test_html_in_names_travels_as_text_only(tmp_path: Path) -> None:
    with new_campaign(tmp_path / "C", EVIL) as store:
        store.add_event("finding", EVIL)

        async def first_words() -> str:
            feed = Feed(store.path)
            await feed.start()
            words = feed.events()
            said = [await anext(words), await anext(words)]
            await words.aclose()
            await feed.close()
            return said[1]

        said = asyncio.run(first_words())
        with served(store.path) as client:
            page = client.get("/").text
    assert "onerror" not in page  # the page itself is the same for every telescope
    events = dict(line.split("\n")[:2] for line in said.strip().split("\n\n"))
    assert json.loads(events["event: about"].removeprefix("data: "))["telescope"] == EVIL
    assert json.loads(events["event: journal"].removeprefix("data: "))[0]["text"] == EVIL


def test_the_page_makes_no_markup_of_text_and_asks_no_other_host() -> None:
    for name, (content, _) in page_files().items():
        text = content.decode().replace("http://www.w3.org/", "")  # names of XML, never fetched
        for word in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "http://", "https://"):
            assert word not in text, (name, word)
        assert " style=" not in text, name
        assert " onclick=" not in text, name


def test_all_of_the_page_is_below_its_limit(tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        run.append([record(index, len(run.facet_ids)) for index in range(200)])
        with served(tmp_path / "R") as client:
            facet = len(client.get("/facet/1").content)
    assert sum(len(content) for content, _ in page_files().values()) + facet < 500_000

"""Requests from another terminal: taken once, in order, or withdrawn; anything else in the folder does no harm."""

from __future__ import annotations

import os
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from namod_ctl.core.errors import StoreError
from namod_ctl.cycle.control import ALL, OF_FACETS, Answer, ControlBox, Request, RequestKind, send

FOLDER = "control"


class TickingClock:
    def __init__(self) -> None:
        self.time = datetime(2026, 11, 22, 23, 59, 59, 999_990, tzinfo=UTC)  # a new day begins within these tests

    def now(self) -> datetime:
        self.time += timedelta(microseconds=3)
        return self.time


def test_requests_arrive_once_and_in_order(tmp_path: Path) -> None:
    clock = TickingClock()
    requests = [Request(kind=kind) for kind in RequestKind if kind not in OF_FACETS]
    requests += [Request(kind=kind, facet_ids=ids) for kind in sorted(OF_FACETS) for ids in ((13, 31), ALL)]
    early, late = requests[:2], requests[2:]  # to stop and to pause
    sent = [send(tmp_path, request, clock) for request in early]  # before anybody looks
    box = ControlBox(tmp_path)
    sent += [send(tmp_path, request, clock) for request in late]
    assert not any(each.is_taken() for each in sent[2:])
    assert box.poll() == requests
    assert all(each.is_taken() for each in sent)
    assert box.poll() == box.complaints() == []
    assert len({request.id for request in requests}) == len(requests)


def test_answers_reach_who_asked(tmp_path: Path) -> None:
    clock, box = TickingClock(), ControlBox(tmp_path)
    first, second = (send(tmp_path, Request(kind=RequestKind.PAUSE), clock) for _ in range(2))
    for request, text in zip(box.poll(), ("paused", "paused already: ä"), strict=True):
        box.answer(request, text, is_accepted=text == "paused")
    assert second.answer() == Answer(is_accepted=False, text="paused already: ä")
    assert first.answer() == Answer(is_accepted=True, text="paused")
    assert first.answer() is None
    assert list((tmp_path / FOLDER).iterdir()) == []


def test_a_request_is_either_taken_or_withdrawn(tmp_path: Path) -> None:
    clock, box = TickingClock(), ControlBox(tmp_path)
    withdrawn = send(tmp_path, Request(kind=RequestKind.APPROVE), clock)
    assert withdrawn.withdraw()
    assert box.poll() == []
    taken = send(tmp_path, Request(kind=RequestKind.APPROVE), clock)
    assert len(box.poll()) == 1
    assert not taken.withdraw()


def test_taking_and_withdrawing_at_the_same_time(tmp_path: Path) -> None:
    """Whoever comes first: every request is taken or withdrawn, none is both, none neither."""
    clock, box, taken, is_over = TickingClock(), ControlBox(tmp_path), list[Request](), threading.Event()

    def look() -> None:
        while not is_over.is_set():
            taken.extend(box.poll())

    looker = threading.Thread(target=look)
    looker.start()
    try:
        all_sent = [send(tmp_path, Request(kind=RequestKind.RESUME), clock) for _ in range(100)]
        withdrawn = {sent.request.id for sent in all_sent if sent.withdraw()}
        for _ in range(100):
            sent = send(tmp_path, Request(kind=RequestKind.RESUME), clock)
            all_sent.append(sent)
            if sent.withdraw():
                withdrawn.add(sent.request.id)
    finally:
        is_over.set()
        looker.join(10.0)
    taken_ids = [request.id for request in taken]
    assert len(taken_ids) == len(set(taken_ids))
    assert set(taken_ids).isdisjoint(withdrawn)
    assert set(taken_ids) | withdrawn == {sent.request.id for sent in all_sent}
    assert box.complaints() == []


def test_what_an_earlier_process_was_to_carry_out(tmp_path: Path) -> None:
    """It was killed before it looked: its successor stops, but moves nothing that a person saw in another preview."""
    clock = TickingClock()
    approve, stop, release = (
        send(tmp_path, Request(kind=kind), clock)
        for kind in (RequestKind.APPROVE, RequestKind.STOP, RequestKind.RELEASE)
    )
    box = ControlBox(tmp_path)
    for each in (approve, release):
        answer = each.answer()
        assert answer is not None
        assert not answer.is_accepted
    assert box.poll() == [stop.request]
    assert box.poll() == []


def test_answers_that_nobody_fetched_go_with_the_next_start(tmp_path: Path) -> None:
    box = ControlBox(tmp_path)
    send(tmp_path, Request(kind=RequestKind.STOP), TickingClock())
    box.answer(box.poll()[0], "stopped")
    assert len(list((tmp_path / FOLDER).iterdir())) == 1
    ControlBox(tmp_path)
    assert list((tmp_path / FOLDER).iterdir()) == []


@given(data=st.binary(max_size=300), name=st.text("abc.-_ é\n", min_size=1, max_size=20).filter(lambda n: n[0] != "."))
def test_any_bytes_as_a_request(data: bytes, name: str) -> None:
    with TemporaryDirectory() as folder:
        box = ControlBox(Path(folder))
        (Path(folder) / FOLDER / name).write_bytes(data)
        stop = send(Path(folder), Request(kind=RequestKind.STOP), TickingClock())
        assert [request.kind for request in box.poll()] == [RequestKind.STOP]
        assert stop.is_taken()
        (complaint,) = box.complaints()
        assert repr(name) in complaint
        assert os.listdir(Path(folder) / FOLDER) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[" * 60_000,
        '{"kind": "explode"}',
        '{"kind": "stop", "facet_ids": [3]}',
        '{"kind": "done"}',
        '{"kind": "not_done"}',
        '{"kind": "done", "facet_ids": []}',
        '{"kind": "done", "facet_ids": [1e400]}',
        '{"kind": "done", "facet_ids": [true]}',
        '{"kind": "done", "facet_ids": [-1]}',
        '{"kind": "done", "facet_ids": [99999999999999999999]}',
        '{"kind": "done", "facet_ids": "some"}',
        '{"kind": "stop", "id": "../../campaign.sqlite"}',
        '{"kind": "stop", "id": "0123456789abcdef0123456789abcdef\\n"}',
        '{"kind": "stop", "id": "0123456789abcdef0123456789abcdef", "why": ""}',
        '{"kind": "stop"}' + " " * 70_000,
    ],
)
def test_nearly_requests(tmp_path: Path, text: str) -> None:
    box = ControlBox(tmp_path)
    file = tmp_path / FOLDER / "20261122T000000.000000-x.request"
    file.write_text(text)
    assert box.poll() == []
    assert len(box.complaints()) == 1
    assert not file.exists()


def test_what_is_no_file(tmp_path: Path) -> None:
    """A pipe must not block, a link's target must not be read or removed, a folder may hold anything."""
    box, secret = ControlBox(tmp_path), tmp_path / "notes.txt"
    secret.write_text("keep me")
    control = tmp_path / FOLDER
    os.mkfifo(control / "pipe")
    (control / "link").symlink_to(secret)
    (control / "folder").mkdir()
    (control / "folder" / "thesis.tex").write_text("x")
    (control / ".being_written.tmp").write_text("{")
    assert box.poll() == []
    assert len(box.complaints()) == 3
    assert box.poll() == box.complaints() == []
    assert secret.read_text() == "keep me"
    assert sorted(os.listdir(control)) == [".being_written.tmp", "folder"]


def test_a_folder_that_was_deleted(tmp_path: Path) -> None:
    box = ControlBox(tmp_path)
    (tmp_path / FOLDER).rmdir()
    assert box.poll() == []
    send(tmp_path, Request(kind=RequestKind.STOP), TickingClock())
    assert len(box.poll()) == 1


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / FOLDER).write_text("a file in its place")
    with pytest.raises(StoreError, match="control"):
        send(tmp_path, Request(kind=RequestKind.STOP), TickingClock())


def test_contradictory_requests_are_a_bug() -> None:
    with pytest.raises(ValidationError):
        Request(kind=RequestKind.DONE)
    with pytest.raises(ValidationError):
        Request(kind=RequestKind.STOP, facet_ids=(3,))


def test_looking_is_cheap(tmp_path: Path) -> None:
    """Every 50 ms it is looked: a hundredth of that would be 0.5 ms; measured 6 us."""
    box = ControlBox(tmp_path)
    times_s = []
    for _ in range(100):
        start_s = time.perf_counter()
        box.poll()
        times_s.append(time.perf_counter() - start_s)
    assert min(times_s) < 0.5e-3

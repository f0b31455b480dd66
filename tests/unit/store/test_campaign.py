"""The campaign on disk: what goes in comes out, one process at a time writes it, and what is wrong is said in words."""

from __future__ import annotations

import math
import os
import signal
import sqlite3
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import CAMPAIGN_SCHEMA_VERSION
from namod_ctl.store.campaign_lock import running_pid
from namod_ctl.store.campaign_rows import AskedTurns, Cycle

ORDERS = [MoveOrder(Leg(13, 0), 0.0012, -1 / 3), MoveOrder(Leg(13, 1), math.nan, 1e-300)]


class TickingClock:
    def __init__(self) -> None:
        self.time = datetime(2026, 11, 22, 4, 0, tzinfo=UTC)

    def now(self) -> datetime:
        self.time += timedelta(seconds=1)
        return self.time


def new_campaign(path: Path, force: bool = False) -> CampaignStore:
    return CampaignStore.create(path, '{"telescope": {"name": "ä"}}', "a test", TickingClock(), force)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "CAMPAIGN"


def test_what_goes_in_comes_out_after_reopening(path: Path) -> None:
    with new_campaign(path) as store:
        assert store.last_state() is None
        assert store.cycles() == store.orders() == store.turns() == store.events() == []
        store.set_note("learned", "{}")
        store.set_note("learned", "wires")
        first = store.add_transition("idle", "checking", "start", "a person asked")
        second = store.add_event("refused", "facet 3", {"cycle": 1, "a": [math.nan, {"b": np.float64(2.5)}], "ü": None})
        assert store.begin_cycle() == 1
        assert store.begin_cycle() == 2
        store.save_cycle(
            Cycle(1, "cycle_01", 400, 1.25e-6, 1e-8, 2e-7, 1e-7, '{"x": 1}', "correct: far from the limit")
        )
        ids = store.order(1, ORDERS)
        result = MoveResult(ORDERS[1], MoveOutcome.LOST, math.nan, "no answer")
        store.result(ids[1], result)
    with CampaignStore.open(path) as store:
        assert (store.source, store.config_json) == ("a test", '{"telescope": {"name": "ä"}}')
        assert store.note("learned") == "wires"
        assert store.note("nothing") is None
        assert store.last_state() == "checking"
        events = store.events()
        assert [event.id for event in events] == [first, second]
        assert events[0].data == {"from": "idle", "to": "checking", "trigger": "start", "reason": "a person asked"}
        assert events[1].data == {"cycle": 1, "a": [None, {"b": 2.5}], "ü": None}
        assert events[0].time_utc < events[1].time_utc
        assert store.events(since_id=first) == events[1:]
        done, begun = store.cycles()
        assert done == Cycle(1, "cycle_01", 400, 1.25e-6, 1e-8, 2e-7, 1e-7, '{"x": 1}', "correct: far from the limit")
        assert (begun.number, begun.run_folder, begun.n_records, begun.alignment_json) == (2, "cycle_02", 0, None)
        assert math.isnan(begun.a_sigma_now_rad2)
        assert store.run_path(2) == path / "cycle_02"
        intended, lost = store.orders(1)
        assert intended.order == ORDERS[0]
        assert intended.result is None
        assert math.isnan(lost.order.start_m)
        assert lost.order.target_m == 1e-300
        assert lost.result is not None
        assert (lost.result.outcome, lost.result.detail) == (MoveOutcome.LOST, "no answer")
        assert math.isnan(lost.result.readback_m)
        assert store.orders(2) == []
        assert [order.id for order in store.unfinished_orders()] == [ids[0]]


def test_one_result_per_order_and_all_or_none(path: Path) -> None:
    with new_campaign(path) as store:
        ids = store.order(store.begin_cycle(), ORDERS)
        arrived = MoveResult(ORDERS[0], MoveOutcome.ARRIVED, -1 / 3)
        store.result(ids[0], arrived)
        with pytest.raises(StoreError, match="contradicts"):
            store.result(ids[0], MoveResult(ORDERS[0], MoveOutcome.FAULT, 0.0))
        with pytest.raises(StoreError, match="contradicts"):  # 99 was never ordered: the other is not written either
            store.results({ids[1]: MoveResult(ORDERS[1], MoveOutcome.ARRIVED, 0.0), 99: arrived})
        assert [order.result for order in store.orders()] == [arrived, None]


def test_orders_are_refused_together(path: Path) -> None:
    with new_campaign(path) as store:
        cycle = store.begin_cycle()
        with pytest.raises(ValueError, match="no target"):
            store.order(cycle, [ORDERS[0], MoveOrder(Leg(13, 2), 0.0, math.nan)])
        with pytest.raises(StoreError, match="contradicts"):
            store.order(cycle + 1, ORDERS)  # no such cycle
        assert store.orders() == []
        with pytest.raises(ValueError, match="never begun"):
            store.save_cycle(Cycle(7, "cycle_07"))


def test_turns_asked_for_and_done(path: Path) -> None:
    with new_campaign(path) as store:
        with pytest.raises(ConfigError, match="none were asked for yet"):
            store.mark_done([13])
        assert store.mark_done() == []
        first, second = store.begin_cycle(), store.begin_cycle()
        store.ask_turns(first, {13: (10.0, 0.0, -5.0), 31: (1.0, 2.0, 3.0)})
        store.mark_done()
        store.ask_turns(second, {13: (5.0, 0.0, 0.0), 40: (0.0, -15.0, 2.5)})
        assert store.mark_done([40]) == [40]
        assert store.mark_done([40]) == []
        assert store.turns() == [
            AskedTurns(second, 13, (5.0, 0.0, 0.0), False),
            AskedTurns(second, 40, (0.0, -15.0, 2.5), True),
        ]
        assert [turns.is_done for turns in store.turns(first)] == [True, True]
        with pytest.raises(ConfigError, match=r"of facet 31; in cycle 2 turns were asked for of facets 13, 40"):
            store.mark_done([13, 31])
        assert [turns.is_done for turns in store.turns()] == [False, True]
        assert [event.data["facet_ids"] for event in store.events() if event.kind == "done"] == [[13, 31], [40]]


def test_everything_is_committed_when_it_returns(path: Path) -> None:
    """Somebody else sees it while the writer is still at work."""
    with new_campaign(path) as store, CampaignStore.open(path) as reader:
        store.order(store.begin_cycle(), ORDERS)
        assert len(reader.unfinished_orders()) == 2
        store.add_event("note", "x")
        assert [event.text for event in reader.events()] == ["x"]
        with pytest.raises(StoreError, match="read only"):
            reader.add_event("note", "y")


def test_one_process_at_a_time(path: Path) -> None:
    """Another process is told who is at work; a reader is not in its way; a kill leaves no obstacle."""
    new_campaign(path).close()
    assert running_pid(path) is None
    program = (
        "import sys; from namod_ctl.store.campaign import CampaignStore\n"
        "store = CampaignStore.open(sys.argv[1], read_only=False)\n"
        "print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        assert running_pid(path) == process.pid
        with pytest.raises(StoreError, match=rf"process {process.pid} is at work .*namod-ctl status"):
            CampaignStore.open(path, read_only=False)
        with pytest.raises(StoreError, match=f"process {process.pid} is at work"):
            new_campaign(path, force=True)
        with CampaignStore.open(path) as reader:
            assert reader.cycles() == []
        os.kill(process.pid, signal.SIGKILL)
        process.wait(10.0)
        assert (path / "campaign.lock").read_text().strip() == str(process.pid)  # its file is still there
    assert running_pid(path) is None
    with CampaignStore.open(path, read_only=False) as store:
        assert running_pid(path) == os.getpid()
        assert store.begin_cycle() == 1
    assert running_pid(path) is None


def test_a_reader_who_looks_does_not_keep_a_writer_out(path: Path) -> None:
    """Somebody who asks for the status all the time, in a process of his own."""
    new_campaign(path).close()
    program = (
        "import sys, pathlib; from namod_ctl.store.campaign_lock import running_pid\n"
        "path = pathlib.Path(sys.argv[1]); print('looking', flush=True)\n"
        "while path.exists(): running_pid(path)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            for _ in range(200):
                CampaignStore.open(path, read_only=False).close()
        finally:
            process.kill()


def test_what_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "CAMPAIGN"
    with new_campaign(path) as store:
        store.begin_cycle()
    with pytest.raises(ConfigError, match="--resume"):
        new_campaign(path)
    with new_campaign(path, force=True) as store:
        assert store.cycles() == []
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    with pytest.raises(ConfigError, match="not replaced even with --force"):
        new_campaign(other, force=True)
    with pytest.raises(ConfigError, match="does not exist"):
        new_campaign(tmp_path / "no" / "where")
    with pytest.raises(ConfigError, match="is a file"):
        new_campaign(other / "thesis.tex", force=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    new_campaign(empty, force=True).close()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["CAMPAIGN", "empty", "other"]


def execute(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path / "campaign.sqlite")
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


@pytest.mark.parametrize(
    ("statements", "words"),
    [
        ((f"PRAGMA user_version = {CAMPAIGN_SCHEMA_VERSION + 1}",), "update namod-ctl"),
        (("PRAGMA application_id = 1",), "not a campaign of namod-ctl"),
        (("DELETE FROM meta WHERE key = 'config_json'",), "restore the campaign from a copy"),
    ],
)
@pytest.mark.parametrize("read_only", [True, False])
def test_a_database_that_is_not_ours_to_read(
    path: Path, statements: tuple[str, ...], words: str, read_only: bool
) -> None:
    new_campaign(path).close()
    execute(path, *statements)
    with pytest.raises(StoreError, match=words):
        CampaignStore.open(path, read_only=read_only)
    assert running_pid(path) is None  # the lock was let go


def test_damage_is_said_in_words(path: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="namod-ctl align"):
        CampaignStore.open(tmp_path)
    with new_campaign(path) as store:
        store.order(store.begin_cycle(), ORDERS)
    execute(path, "INSERT INTO results VALUES (1, '', 'levitated', 0, '')")
    with CampaignStore.open(path) as store, pytest.raises(StoreError, match="'levitated'; update namod-ctl"):
        store.orders()
    (path / "campaign.sqlite").write_bytes(b"no database at all" * 100)
    with pytest.raises(StoreError, match="no SQLite file"):
        CampaignStore.open(path)


def test_a_disk_that_is_full(path: Path) -> None:
    """SQLite's own limit stands in for the disk's: the error is the same."""
    with new_campaign(path) as store:
        store.begin_cycle()
        store._connection.execute("PRAGMA max_page_count = 30")
        with pytest.raises(StoreError, match=r"campaign\.sqlite: the disk is full: free some space"):
            store.order(1, [MoveOrder(Leg(n, 0), 0.0, 1e-3) for n in range(20_000)])
        assert store.orders() == []
        store._connection.execute("PRAGMA max_page_count = 100000")
        assert store.order(1, ORDERS) == [1, 2]

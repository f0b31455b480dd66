"""A campaign whose process is killed: it opens, nothing it had told is lost, and no transaction is there in part."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from datetime import UTC, datetime
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import is_campaign
from namod_ctl.store.campaign_lock import running_pid
from namod_ctl.store.campaign_rows import Cycle

N_KILLS = 20
N_LEGS = 12  # ordered together
N_FACETS = 4  # whose turns are asked for together
LONGEST_LIFE_S = 0.15
PATIENCE_S = 40.0
START = datetime(2026, 11, 22, tzinfo=UTC)


class StandingClock:
    def now(self) -> datetime:
        return START


def work_until_killed(path: Path, told: Connection) -> None:
    """Cycles without end; tells the number of what is on the disk after every step; in a process of its own."""
    told.send(("begun", 0))
    is_there = is_campaign(path)
    clock = StandingClock()
    store = CampaignStore.open(path, False, clock) if is_there else CampaignStore.create(path, "{}", "kill me", clock)
    for left in store.unfinished_orders():  # as after every crash: read back, then go on
        store.result(left.id, MoveResult(left.order, MoveOutcome.OFF_TARGET, 0.5, "read back"))
        told.send(("result", left.id))
    while True:
        cycle = store.begin_cycle()
        told.send(("cycle", cycle))
        orders = [MoveOrder(Leg(cycle, index), 0.0, index * 1e-3) for index in range(N_LEGS)]
        ids = store.order(cycle, orders)
        told.send(("order", ids[-1]))
        for order_id, order in zip(ids, orders, strict=True):
            store.result(order_id, MoveResult(order, MoveOutcome.ARRIVED, order.target_m))
            told.send(("result", order_id))
        store.ask_turns(cycle, dict.fromkeys(range(N_FACETS), (1.0, 2.0, 3.0)))
        store.mark_done()
        told.send(("done", cycle))
        store.save_cycle(Cycle(cycle, f"cycle_{cycle:02d}", cycle * 100, decision="go on"))
        told.send(("event", store.add_event("cycle", "it is over", {"cycle": cycle})))


def check_whole(path: Path) -> dict[str, int]:
    """The last number of every kind of step that is on the disk."""
    with CampaignStore.open(path) as store:
        cycles, orders, events = store.cycles(), store.orders(), store.events()
        unfinished = store.unfinished_orders()
        done = [cycle.number for cycle in cycles if any(turns.is_done for turns in store.turns(cycle.number))]
        for cycle in cycles:
            assert len(store.orders(cycle.number)) in (0, N_LEGS)
            turns = store.turns(cycle.number)
            assert len(turns) in (0, N_FACETS)
            assert len({each.is_done for each in turns}) <= 1
    assert [cycle.number for cycle in cycles] == list(range(1, len(cycles) + 1))
    assert [order.id for order in orders] == list(range(1, len(orders) + 1))
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    # what was marked as done was journaled with it
    assert [event.data["cycle"] for event in events if event.kind == "done"] == done
    # results came one by one in the order of the orders, so only the latest orders can be without
    assert [order.id for order in unfinished] == [order.id for order in orders[len(orders) - len(unfinished) :]]
    assert len(unfinished) <= N_LEGS
    for order in orders:
        assert order.order == MoveOrder(Leg(order.cycle, order.order.leg.index), 0.0, order.order.leg.index * 1e-3)
    connection = sqlite3.connect(path / "campaign.sqlite")
    assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
    connection.close()
    return {
        "cycle": len(cycles),
        "order": len(orders),
        "result": len(orders) - len(unfinished),
        "done": done[-1] if done else 0,
        "event": len(events),
    }


def test_twenty_kills_at_random_moments(tmp_path: Path) -> None:
    """Every life goes on with the campaign that the last one left behind."""
    path, rng = tmp_path / "CAMPAIGN", random.Random(4)
    context = get_context("forkserver")
    context.set_forkserver_preload(["namod_ctl.store.campaign", "pytest"])
    n_inside = 0
    for _ in range(N_KILLS):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work_until_killed, args=(path, theirs), daemon=True)
        process.start()
        theirs.close()
        assert ours.poll(PATIENCE_S)
        time.sleep(LONGEST_LIFE_S * rng.random() ** 2)  # the moment is what is tested, nothing waits for it
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(PATIENCE_S)
        told: dict[str, int] = {}
        try:
            while ours.poll():
                kind, number = ours.recv()
                told[kind] = number
        except (EOFError, OSError):  # it was killed in the middle of a word
            pass
        assert process.exitcode == -signal.SIGKILL  # and it had not ended by itself, with an error
        if not is_campaign(path):
            assert told.keys() == {"begun"}
            continue
        assert running_pid(path) is None
        found = check_whole(path)
        for kind, number in told.items():
            assert found.get(kind, 0) >= number
        n_inside += len(told) > 1
    assert n_inside > N_KILLS // 3

"""What drives said last, on its way through a campaign's database."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path

import pytest

from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import StoreError
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME, connect_campaign
from namod_ctl.store.pulse import Pulse

LEG, OTHER = Leg(13, 0), Leg(2, 1)
MOVING = DriveState(0.00125, True, True, (), 301.5)
LOST = DriveState(math.nan, False, False, ("lower limit switch", "überheated"), None)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    CampaignStore.create(tmp_path / "CAMPAIGN", "{}", "a test", SystemClock()).close()
    return tmp_path / "CAMPAIGN"


def test_another_program_reads_the_last_state_of_every_leg_at_once(path: Path) -> None:
    with CampaignStore.open(path, read_only=False) as writer, CampaignStore.open(path) as reader:
        database = path / CAMPAIGN_DATABASE_NAME
        pulse = Pulse(connect_campaign(database, read_only=True), database)
        assert reader.seen_legs() == {}
        pulse.has_changed()
        writer.show_legs({LEG: LOST, OTHER: MOVING})
        writer.show_legs({LEG: MOVING})
        assert pulse.has_changed()
        seen = reader.seen_legs()
        assert list(seen) == [OTHER, LEG]
        assert seen[LEG].state == seen[OTHER].state == MOVING
        writer.show_legs({OTHER: "no answer from module 5", LEG: LOST})
        seen = reader.seen_legs()
        assert (seen[OTHER].state, seen[OTHER].silence) == (None, "no answer from module 5")
        state = seen[LEG].state
        assert state is not None
        assert math.isnan(state.position_m)
        assert (state.is_homed, state.faults, state.temperature_k) == (False, LOST.faults, None)
        assert seen[LEG].time_utc >= writer.created_utc
        pulse.close()


def test_it_leaves_the_journal_waiting_for_the_disk(path: Path) -> None:
    """Orders must be on the disk before anything moves: SQLite's synchronous = FULL, which is 2."""
    with CampaignStore.open(path, read_only=False) as store:
        store.show_legs({LEG: MOVING})
        assert store._connection.execute("PRAGMA synchronous").fetchone() == (2,)
        assert not store._connection.in_transaction
    with CampaignStore.open(path) as store, pytest.raises(StoreError):
        store.show_legs({LEG: MOVING})


def test_a_campaign_of_before_has_none_and_gets_some(path: Path) -> None:
    with sqlite3.connect(path / CAMPAIGN_DATABASE_NAME) as connection:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    assert "live_legs" not in tables  # it is made at the first use, so this is what an old campaign looks like
    with CampaignStore.open(path, read_only=False) as store:
        assert store.seen_legs() == {}
        store.show_legs({LEG: MOVING})
        assert set(store.seen_legs()) == {LEG}

"""Where legs stood and how their drives were when they were read last, for whoever looks at a campaign.

Not the journal: nobody acts on it, and a power cut may take the last of it along. The table is made when it is needed;
programs of before do not mind it.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass

from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.store.campaign_rows import real

_SCHEMA = """CREATE TABLE IF NOT EXISTS live_legs (
    facet_id INTEGER NOT NULL, leg_index INTEGER NOT NULL,
    time_utc TEXT NOT NULL,
    position_m REAL, is_moving INTEGER, is_homed INTEGER, faults_json TEXT, temperature_k REAL,
    silence TEXT NOT NULL,
    PRIMARY KEY (facet_id, leg_index)
) WITHOUT ROWID"""


@dataclass(frozen=True, slots=True)
class SeenLeg:
    """What was known of a leg last.

    Attributes
    ----------
    time_utc
        ISO 8601, by the clock of the campaign: when it was written down, at most half a second after it was read.
    state
        As the drive told it; None when it did not answer, or refused to tell.
    silence
        Why there is no state, for a person; empty where there is one.
    """

    time_utc: str
    state: DriveState | None
    silence: str = ""


def save_legs(connection: sqlite3.Connection, heard: Mapping[Leg, DriveState | str], time_utc: str) -> None:
    """Put what is new in place of what was known of these legs; for a transaction of the caller's."""
    connection.execute(_SCHEMA)
    connection.executemany(
        "INSERT OR REPLACE INTO live_legs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        ((leg.facet_id, leg.index, time_utc, *_row(said)) for leg, said in heard.items()),
    )


def read_legs(connection: sqlite3.Connection) -> dict[Leg, SeenLeg]:
    """What was known last, by leg in order; empty while no drive was ever read."""
    is_there = connection.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'live_legs'").fetchone()
    if is_there is None:
        return {}
    rows = connection.execute("SELECT * FROM live_legs ORDER BY facet_id, leg_index").fetchall()
    return {Leg(int(facet_id), int(index)): _seen(*others) for facet_id, index, *others in rows}


def _row(said: DriveState | str) -> tuple[object, ...]:
    if isinstance(said, str):
        return None, None, None, None, None, said
    faults_json = json.dumps(said.faults)
    return said.position_m, said.is_moving, said.is_homed, faults_json, said.temperature_k, ""


def _seen(
    time_utc: str,
    position_m: float | None,
    is_moving: int | None,
    is_homed: int | None,
    faults_json: str | None,
    temperature_k: float | None,
    silence: str,
) -> SeenLeg:
    if faults_json is None:
        return SeenLeg(time_utc, None, silence)
    faults = tuple(str(fault) for fault in json.loads(faults_json))
    return SeenLeg(
        time_utc, DriveState(real(position_m), bool(is_moving), bool(is_homed), faults, temperature_k), silence
    )

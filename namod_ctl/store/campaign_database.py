"""The SQLite file of a campaign: its schema and how it is opened. `database` says how the house treats SQLite.

What is ordered and what came of it are two tables: an order is committed before anything moves, its result after
the drive was read back. An order without a result is what a crash leaves behind.
"""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.store.database import BUSY_TIMEOUT_S, store_errors, transaction
from namod_ctl.store.folders import named_near

CAMPAIGN_DATABASE_NAME = "campaign.sqlite"
CAMPAIGN_SCHEMA_VERSION = 1
CAMPAIGN_APPLICATION_ID = 0x4E4D4350  # "NMCP": tells a campaign from a run and from any other SQLite file

_SCHEMA = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    """CREATE TABLE events (
        event_id INTEGER PRIMARY KEY AUTOINCREMENT,
        time_utc TEXT NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL, data_json TEXT NOT NULL
    )""",
    """CREATE TABLE cycles (
        cycle INTEGER PRIMARY KEY,
        begun_utc TEXT NOT NULL,
        run_folder TEXT NOT NULL,
        n_records INTEGER NOT NULL,
        a_sigma_now_rad2 REAL, a_sigma_uncertainty_rad2 REAL, a_sigma_predicted_rad2 REAL, a_sigma_limit_rad2 REAL,
        alignment_json TEXT,
        decision TEXT NOT NULL
    )""",
    """CREATE TABLE orders (
        order_id INTEGER PRIMARY KEY AUTOINCREMENT,
        time_utc TEXT NOT NULL,
        cycle INTEGER NOT NULL REFERENCES cycles,
        facet_id INTEGER NOT NULL, leg_index INTEGER NOT NULL,
        start_m REAL, target_m REAL NOT NULL
    )""",
    """CREATE TABLE results (
        order_id INTEGER PRIMARY KEY REFERENCES orders,
        time_utc TEXT NOT NULL, outcome TEXT NOT NULL, readback_m REAL, detail TEXT NOT NULL
    )""",
    """CREATE TABLE turns (
        cycle INTEGER NOT NULL REFERENCES cycles,
        facet_id INTEGER NOT NULL,
        turns_deg_json TEXT NOT NULL,
        done_utc TEXT,
        PRIMARY KEY (cycle, facet_id)
    ) WITHOUT ROWID""",
)


def is_campaign(path: Path) -> bool:
    """True for a folder that holds a campaign."""
    return (path / CAMPAIGN_DATABASE_NAME).is_file()


def require_campaign(path: Path) -> None:
    """Raise ConfigError when there is no campaign at `path`."""
    if not is_campaign(path):
        raise ConfigError(
            f"{path}: there is no campaign here ({CAMPAIGN_DATABASE_NAME} is missing){named_near(path, is_campaign)}; "
            "begin one with 'namod-ctl align'"
        )


def connect_new_campaign(path: Path) -> sqlite3.Connection:
    """Connection to a new campaign database at `path` with an empty schema. Raises StoreError."""
    with store_errors(path):
        connection = _connect(path, "rwc")
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            _configure(connection)
            with transaction(connection):
                for statement in _SCHEMA:
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id = {CAMPAIGN_APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {CAMPAIGN_SCHEMA_VERSION}")
        except BaseException:
            connection.close()
            raise
        return connection


def connect_campaign(path: Path, *, read_only: bool) -> sqlite3.Connection:
    """Connection to the campaign database at `path`.

    Raises StoreError when it is no campaign, was written by a newer program, or cannot be opened.
    """
    # where nobody may write and nobody left a log behind, the file is read as it lies there (see `database`)
    is_frozen = read_only and not os.access(path.parent, os.W_OK) and not path.with_name(path.name + "-wal").exists()
    with store_errors(path):
        connection = _connect(path, ("ro" if read_only else "rw") + ("&immutable=1" if is_frozen else ""))
        try:
            _check_identity(connection, path)
            _configure(connection)
        except BaseException:
            connection.close()
            raise
        return connection


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    return sqlite3.connect(uri, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)


def _configure(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")


def _check_identity(connection: sqlite3.Connection, path: Path) -> None:
    application_id = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application_id != CAMPAIGN_APPLICATION_ID:
        raise StoreError(f"{path}: this SQLite file is not a campaign of namod-ctl; name the folder of a campaign")
    if version > CAMPAIGN_SCHEMA_VERSION:
        raise StoreError(
            f"{path}: the campaign has schema version {version}, this program reads up to "
            f"{CAMPAIGN_SCHEMA_VERSION}; update namod-ctl (pip install --upgrade namod-ctl)"
        )

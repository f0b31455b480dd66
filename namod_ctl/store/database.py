"""The SQLite file of a run: its schema, how it is opened, and its errors in words a person can act on.

Why rows and not blobs: a facet's responses lie in a table with one row per record and facet, so that anybody
can ask for them with the plain `sqlite3` shell (`SELECT intensity FROM responses WHERE facet_id = 13`). It
costs twice the space and many times the reading time of packed arrays, which even the largest dishes can
afford (`run` has the figures); a file nobody else can read would cost more.

NaN, the house's "no result", is NULL here: that is what it means in SQL.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from namod_ctl.core.errors import StoreError

DATABASE_NAME = "run.sqlite"
SCHEMA_VERSION = 2
APPLICATION_ID = 0x4E4D4F44  # "NMOD": tells a run from any other SQLite file
BUSY_TIMEOUT_S = 10.0  # another program may hold the file for as long as one transaction lasts

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE facets (position INTEGER PRIMARY KEY, facet_id INTEGER NOT NULL UNIQUE);
CREATE TABLE records (
    record_index INTEGER PRIMARY KEY,
    label TEXT NOT NULL,
    theta_x_rad REAL, theta_y_rad REAL, theta_uncertainty_rad REAL,
    star_intensity REAL,
    star_exposure_s REAL, reflector_exposure_s REAL,
    reject_reason TEXT,
    detail TEXT NOT NULL,
    star_mid_exposure_s REAL, reflector_mid_exposure_s REAL
);
CREATE TABLE responses (
    record_index INTEGER NOT NULL REFERENCES records,
    facet_id INTEGER NOT NULL REFERENCES facets (facet_id),
    intensity REAL,
    saturated_share REAL,
    PRIMARY KEY (record_index, facet_id)
) WITHOUT ROWID;
CREATE TABLE frames (
    record_index INTEGER NOT NULL,
    camera TEXT NOT NULL,
    file_name TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (record_index, camera)
) WITHOUT ROWID;
CREATE TABLE estimates (
    estimate_id INTEGER PRIMARY KEY,
    created_utc TEXT NOT NULL,
    estimator TEXT NOT NULL,
    alignment_json TEXT NOT NULL,
    program_version TEXT NOT NULL
);
"""

# what schema version 1 lacks
_UPGRADE = """
ALTER TABLE records ADD COLUMN star_mid_exposure_s REAL;
ALTER TABLE records ADD COLUMN reflector_mid_exposure_s REAL;
"""

_REMEDY = {
    sqlite3.SQLITE_FULL: "the disk is full: free some space and try again",
    sqlite3.SQLITE_IOERR: "reading or writing failed: is the disk full, broken or gone?",
    sqlite3.SQLITE_BUSY: f"another program holds the run for more than {BUSY_TIMEOUT_S:g} s: end it and try again",
    sqlite3.SQLITE_LOCKED: "another program holds the run: end it and try again",
    sqlite3.SQLITE_READONLY: "it cannot be written: check its permissions, or whether it was opened to read only",
    sqlite3.SQLITE_CANTOPEN: "it cannot be opened: check the permissions of the file and of its folder",
    sqlite3.SQLITE_NOTADB: "it is no SQLite file: restore the run from a copy",
    sqlite3.SQLITE_CORRUPT: "it is damaged: restore it from a copy (`sqlite3 run.sqlite .recover` may save a part)",
    sqlite3.SQLITE_CONSTRAINT: "what is to be written contradicts what is there: is another program writing this run?",
    sqlite3.SQLITE_PERM: "it may not be accessed: check its permissions",
    sqlite3.SQLITE_AUTH: "it may not be accessed: check its permissions",
}


@contextmanager
def store_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and of the file system into a `StoreError` with the path and what to do."""
    try:
        yield
    except sqlite3.Error as error:
        # an extended result code holds the kind of error in its low byte; errors of the module itself have none
        kind = getattr(error, "sqlite_errorcode", -1) & 0xFF
        raise StoreError(f"{path}: {_REMEDY.get(kind, 'the database refuses')} ({error})") from error
    except OSError as error:
        where = error.filename or path
        raise StoreError(f"{where}: {error.strerror or error}: free some space or check permissions") from error


def connect_new(path: Path) -> sqlite3.Connection:
    """Connection to a new run database at `path` with an empty schema. Raises StoreError."""
    with store_errors(path):
        connection = _connect(f"{path.absolute().as_uri()}?mode=rwc")
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            _configure(connection)
            connection.executescript(
                f"BEGIN; {_SCHEMA} PRAGMA application_id = {APPLICATION_ID}; "
                f"PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;"
            )
        except BaseException:
            connection.close()
            raise
        return connection


def connect_existing(path: Path, *, read_only: bool) -> sqlite3.Connection:
    """Connection to the run database at `path`.

    Raises StoreError when it is no run, was written by a newer program, or cannot be opened.
    """
    mode = "ro" if read_only else "rw"
    # SQLite keeps an index beside a database in WAL mode even to read it; where that cannot be written (a run on
    # a DVD or in a colleague's folder) and nobody left a log behind, the file is read as it lies there
    is_frozen = read_only and not os.access(path.parent, os.W_OK) and not path.with_name(path.name + "-wal").exists()
    with store_errors(path):
        connection = _connect(f"{path.absolute().as_uri()}?mode={mode}{'&immutable=1' if is_frozen else ''}")
        try:
            version = _check_identity(connection, path)
            _configure(connection)
            if version < SCHEMA_VERSION and not read_only:
                connection.executescript(f"BEGIN IMMEDIATE; {_UPGRADE} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
        except BaseException:
            connection.close()
            raise
        return connection


@contextmanager
def transaction(connection: sqlite3.Connection, *, reads_only: bool = False) -> Iterator[None]:
    """Everything in the block is committed together, or nothing is; what it reads is the state of one moment."""
    connection.execute("BEGIN DEFERRED" if reads_only else "BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:  # SQLite has already rolled back after a full disk
            connection.execute("ROLLBACK")
        raise


@contextmanager
def unsynced(connection: sqlite3.Connection) -> Iterator[None]:
    """What is committed in the block is not waited for until it is on the disk, and costs no fsync.

    In WAL mode that cannot damage the database: after a power cut these commits may be missing, as if they had not
    been made (SQLite's manual, "PRAGMA synchronous": NORMAL). The next commit outside of the block takes them along.
    """
    connection.execute("PRAGMA synchronous = NORMAL")
    try:
        yield
    finally:
        connection.execute("PRAGMA synchronous = FULL")


def _connect(uri: str) -> sqlite3.Connection:
    return sqlite3.connect(uri, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)


def _configure(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")


def _check_identity(connection: sqlite3.Connection, path: Path) -> int:
    """The schema version of the file."""
    application_id = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application_id != APPLICATION_ID:
        raise StoreError(f"{path}: this SQLite file is not a run of namod-ctl; name the folder of a run")
    if version > SCHEMA_VERSION:
        raise StoreError(
            f"{path}: the run has schema version {version}, this program reads up to {SCHEMA_VERSION}; "
            "update namod-ctl (pip install --upgrade namod-ctl)"
        )
    return int(version)

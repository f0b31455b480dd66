"""Whether anybody has committed to a database since the last look, at the price of some microseconds."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from namod_ctl.store.database import store_errors


class Pulse:
    """Feels the pulse of the database behind a connection of its own, which nobody else may use; for one thread.

    Raises StoreError when the database cannot be read.
    """

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection, self._path = connection, path
        self._version: int | None = None

    def has_changed(self) -> bool:
        """Has another connection committed anything since this was asked last? True the first time."""
        with store_errors(self._path):
            version = int(self._connection.execute("PRAGMA data_version").fetchone()[0])
        has_changed, self._version = version != self._version, version
        return has_changed

    def forget(self) -> None:
        """Say the next time that it has changed, as if it had never been asked."""
        self._version = None

    def close(self) -> None:
        """Let go of the database."""
        with store_errors(self._path):
            self._connection.close()

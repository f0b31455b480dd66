"""A run as it grows, for somebody who only looks: what has come since the last look, and nothing read twice.

It never writes, and never holds a transaction open: SQLite's log can be folded away and the recorder is not held up.
Cost of a look at a run that has not changed: one `PRAGMA data_version`, some microseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.records import Record
from namod_ctl.store.database import DATABASE_NAME, connect_existing, store_errors, transaction
from namod_ctl.store.live_pictures import CAMERAS, live_pictures
from namod_ctl.store.pulse import Pulse
from namod_ctl.store.run import NOTE_PREFIX
from namod_ctl.store.run_rows import record_columns, record_of

Array = NDArray[np.float64]

_BEFORE_ALL = -(2**62)


@dataclass(frozen=True, slots=True, eq=False)
class FacetSamples:
    """One facet's light in the records that count.

    Attributes
    ----------
    theta_rad
        Shape (n, 2). Direction of the star.
    intensity
        Shape (n,). m_ij / s_i; NaN where it was not measured.
    """

    theta_rad: Array
    intensity: Array


@dataclass(frozen=True, slots=True, eq=False)
class Brightest:
    """The record in which a facet shone most, and what it shone in all of them.

    Attributes
    ----------
    theta_rad
        Shape (2,). Where the star stood.
    intensity
        m_ij / s_i of that record.
    total_intensity, n_records
        Sum of m_ij / s_i over all records that count and in which the facet was measured, and their number.
    """

    theta_rad: Array
    intensity: float
    total_intensity: float
    n_records: int

    def joined(self, other: Brightest) -> Brightest:
        """Of the records of both."""
        best = self if self.intensity >= other.intensity else other
        total, n = self.total_intensity + other.total_intensity, self.n_records + other.n_records
        return Brightest(best.theta_rad, best.intensity, total, n)


class RunTail:
    """Follows the run at `path`; a context manager, for one thread. Raises StoreError, and ConfigError for no run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._database = path / DATABASE_NAME
        self._connection = connect_existing(self._database, read_only=True)
        with store_errors(self._database):
            table = self._connection.execute("PRAGMA table_info(records)").fetchall()
        self._columns = record_columns(str(row[1]) for row in table)
        self._pulse = Pulse(self._connection, self._database)
        self._last_index = self._last_bright_index = _BEFORE_ALL

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        with store_errors(self._database):
            self._connection.close()

    def has_changed(self) -> bool:
        """Has anything been committed since this was asked last? True the first time."""
        return self._pulse.has_changed()

    def new_records(self) -> list[Record]:
        """Records committed since the last look, ascending; their arrays per facet are left empty."""
        with store_errors(self._database), transaction(self._connection, reads_only=True):
            rows = self._connection.execute(
                f"SELECT {self._columns} FROM records WHERE record_index > ? ORDER BY record_index", (self._last_index,)
            ).fetchall()
        if rows:
            self._last_index = int(rows[-1][0])
        return [record_of(row, np.empty(0), np.empty(0), self._database) for row in rows]

    def rewind(self) -> None:
        """Have `new_records` begin with the first record again."""
        self._last_index = _BEFORE_ALL

    def note(self, key: str) -> str | None:
        """What stands at this moment under `key` in the run's notes, None when nothing does."""
        with store_errors(self._database):
            row = self._connection.execute("SELECT value FROM meta WHERE key = ?", (NOTE_PREFIX + key,)).fetchone()
        return None if row is None else str(row[0])

    def theta_rad(self, record_index: int) -> Array:
        """Where the star stood in that record, shape (2,); NaN where it was not seen, or there is no such record."""
        with store_errors(self._database):
            row = self._connection.execute(
                "SELECT theta_x_rad, theta_y_rad FROM records WHERE record_index = ?", (record_index,)
            ).fetchone()
        return np.array(row or (None, None), dtype=np.float64)

    def new_brightest(self) -> dict[int, Brightest]:
        """Of every facet, by its id, in the records that count and were committed since this was asked last."""
        with store_errors(self._database), transaction(self._connection, reads_only=True):
            newest = self._connection.execute("SELECT MAX(record_index) FROM records").fetchone()[0]
            # SQLite takes the plain columns from the row that holds the maximum (its manual: "bare columns")
            rows = self._connection.execute(
                "SELECT facet_id, theta_x_rad, theta_y_rad, MAX(intensity / star_intensity), "
                "SUM(intensity / star_intensity), COUNT(intensity) FROM records JOIN responses USING (record_index) "
                "WHERE record_index > ? AND reject_reason IS NULL AND star_intensity > 0 AND intensity IS NOT NULL "
                "GROUP BY facet_id",
                (self._last_bright_index,),
            ).fetchall()
        if newest is not None:
            self._last_bright_index = int(newest)
        return {
            int(facet_id): Brightest(np.array([x, y], dtype=np.float64), float(most), float(total), int(n))
            for facet_id, x, y, most, total, n in rows
        }

    def latest_frames(self) -> dict[str, int]:
        """Index of the last committed record of which there is a picture to show, by camera's name.

        A frame that was kept, or one that is only there to be looked at (`live_pictures`).
        """
        found = {}
        passing = live_pictures(self.path)
        with store_errors(self._database):
            for camera in CAMERAS:
                row = self._connection.execute(
                    "SELECT record_index FROM frames WHERE camera = ? "
                    "AND record_index <= (SELECT MAX(record_index) FROM records) ORDER BY record_index DESC LIMIT 1",
                    (camera,),
                ).fetchone()
                indices = [int(row[0])] if row is not None else []
                if camera in passing:
                    indices.append(passing[camera])
                if indices:
                    found[camera] = max(indices)
        return found

    def latest_estimate_id(self) -> int:
        """Number of the estimate saved last, 0 without one."""
        with store_errors(self._database):
            row = self._connection.execute("SELECT MAX(estimate_id) FROM estimates").fetchone()
        return int(row[0] or 0)

    def samples_of(self, facet_id: int) -> FacetSamples:
        """The facet's light over directions; of no record for a facet that the run does not have."""
        with store_errors(self._database), transaction(self._connection, reads_only=True):
            rows = self._connection.execute(
                "SELECT theta_x_rad, theta_y_rad, intensity / star_intensity FROM records "
                "JOIN responses ON responses.record_index = records.record_index AND responses.facet_id = ? "
                "WHERE reject_reason IS NULL AND star_intensity > 0 ORDER BY records.record_index",
                (facet_id,),
            ).fetchall()
        table = np.array(rows, dtype=np.float64).reshape(-1, 3)  # None becomes NaN
        return FacetSamples(table[:, :2], table[:, 2])

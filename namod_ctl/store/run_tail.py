"""A run as it grows, for somebody who only looks: what has come since the last look, and nothing read twice.

It never writes, and never holds a transaction open: SQLite's log can be folded away and the recorder is not held up.
Cost of a look at a run that has not changed: one `PRAGMA data_version`, some microseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import StoreError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.store.database import DATABASE_NAME, connect_existing, store_errors, transaction
from namod_ctl.store.frames import REFLECTOR_CAMERA, STAR_CAMERA
from namod_ctl.store.pulse import Pulse

Array = NDArray[np.float64]


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
            columns = {str(row[1]) for row in self._connection.execute("PRAGMA table_info(records)")}
        self._has_times = "star_mid_exposure_s" in columns  # schema version 1 has none
        self._pulse = Pulse(self._connection, self._database)
        self._last_index = self._last_bright_index = -(2**62)

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
        times = "star_mid_exposure_s, reflector_mid_exposure_s" if self._has_times else "NULL, NULL"
        with store_errors(self._database), transaction(self._connection, reads_only=True):
            rows = self._connection.execute(
                "SELECT record_index, label, theta_x_rad, theta_y_rad, theta_uncertainty_rad, star_intensity, "
                f"star_exposure_s, reflector_exposure_s, {times}, reject_reason, detail FROM records "
                "WHERE record_index > ? ORDER BY record_index",
                (self._last_index,),
            ).fetchall()
        if rows:
            self._last_index = int(rows[-1][0])
        return [self._record(row) for row in rows]

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
        """Index of the last committed record of which a camera's frame was kept, by camera's name."""
        found = {}
        with store_errors(self._database):
            for camera in (STAR_CAMERA, REFLECTOR_CAMERA):
                row = self._connection.execute(
                    "SELECT record_index FROM frames WHERE camera = ? "
                    "AND record_index <= (SELECT MAX(record_index) FROM records) ORDER BY record_index DESC LIMIT 1",
                    (camera,),
                ).fetchone()
                if row is not None:
                    found[camera] = int(row[0])
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

    def _record(self, row: tuple[object, ...]) -> Record:
        index, label, *numbers, reason, detail = row
        theta_x, theta_y, *others = (math.nan if number is None else float(str(number)) for number in numbers)
        uncertainty, star, star_exposure, reflector_exposure, star_mid, reflector_mid = others
        try:
            reject_reason = None if reason is None else RejectReason(str(reason))
        except ValueError:
            raise StoreError(
                f"{self._database}: record {index} has the unknown reject reason {reason!r}; update namod-ctl"
            ) from None
        return Record(
            index=int(str(index)),
            label=str(label),
            theta_rad=np.array([theta_x, theta_y]),
            theta_uncertainty_rad=uncertainty,
            star_intensity=star,
            facet_intensity=np.empty(0),
            facet_saturated_share=np.empty(0),
            star_exposure_s=star_exposure,
            reflector_exposure_s=reflector_exposure,
            reject_reason=reject_reason,
            detail=str(detail),
            star_mid_exposure_s=star_mid,
            reflector_mid_exposure_s=reflector_mid,
        )

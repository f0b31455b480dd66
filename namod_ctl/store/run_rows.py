"""Records as rows of a run's database, and back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import StoreError
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record

Array = NDArray[np.float64]

INSERT_RECORD = "INSERT INTO records VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
"""For `record_row`."""


def record_columns(has: Iterable[str]) -> str:
    """The columns that `record_of` expects, for a SELECT from `records`, of a table that `has` these columns.

    A run of schema version 1, opened to read only, has no times.
    """
    times = "star_mid_exposure_s, reflector_mid_exposure_s"
    times = times if "star_mid_exposure_s" in has else "NULL, NULL"
    return (
        "record_index, label, theta_x_rad, theta_y_rad, theta_uncertainty_rad, star_intensity, "
        f"star_exposure_s, reflector_exposure_s, {times}, reject_reason, detail"
    )


def record_row(record: Record) -> tuple[object, ...]:
    """The record without its facets' responses. Python's sqlite3 stores NaN as NULL."""
    return (
        int(record.index),
        record.label,
        float(record.theta_rad[0]),
        float(record.theta_rad[1]),
        float(record.theta_uncertainty_rad),
        float(record.star_intensity),
        float(record.star_exposure_s),
        float(record.reflector_exposure_s),
        None if record.reject_reason is None else record.reject_reason.value,
        record.detail,
        float(record.star_mid_exposure_s),
        float(record.reflector_mid_exposure_s),
    )


def record_of(row: Sequence[object], facet_intensity: Array, facet_saturated_share: Array, database: Path) -> Record:
    """The record in a row with `record_columns`; NULL becomes NaN. Raises StoreError for an unknown reject reason."""
    index, label, *numbers, reason, detail = row
    values = np.array(numbers, dtype=np.float64)  # None becomes NaN
    uncertainty, star, star_exposure, reflector_exposure, star_mid, reflector_mid = map(float, values[2:])
    try:
        reject_reason = None if reason is None else RejectReason(str(reason))
    except ValueError:
        raise StoreError(
            f"{database}: record {index} has the unknown reject reason {reason!r}; update namod-ctl"
        ) from None
    return Record(
        index=int(str(index)),
        label=str(label),
        theta_rad=values[:2].copy(),
        theta_uncertainty_rad=uncertainty,
        star_intensity=star,
        facet_intensity=facet_intensity,
        facet_saturated_share=facet_saturated_share,
        star_exposure_s=star_exposure,
        reflector_exposure_s=reflector_exposure,
        reject_reason=reject_reason,
        detail=str(detail),
        star_mid_exposure_s=star_mid,
        reflector_mid_exposure_s=reflector_mid,
    )

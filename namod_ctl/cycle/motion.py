"""Did the telescope move too far during an exposure? Told by where the star stood in the record before."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad_to_deg

MAX_SPEED_BASE_S = 10.0
"""Between records further apart than this the telescope may have gone anywhere: its speed is not known."""


def speed_rad_per_s(before: Record | None, record: Record) -> float:
    """Speed of the star over the camera between two records with a star; NaN when unknown.

    From middle to middle of the star camera's exposures: what a telescope did that went on at its pace.
    """
    if before is None:
        return math.nan
    elapsed_s = record.star_mid_exposure_s - before.star_mid_exposure_s
    if not 0.0 < elapsed_s <= MAX_SPEED_BASE_S:  # NaN as well
        return math.nan
    return float(np.hypot(*(record.theta_rad - before.theta_rad))) / elapsed_s


def judge_motion(record: Record, speed_rad_per_s: float, limit_rad: float) -> Record:
    """The record, rejected when the telescope moved by more than `limit_rad` during the longer exposure."""
    longer_s = max(record.star_exposure_s, record.reflector_exposure_s)
    moved_rad = speed_rad_per_s * longer_s
    if record.reject_reason is not None or not moved_rad > limit_rad:
        return record
    detail = (
        f"the star moved by {rad_to_deg(moved_rad):.4f} deg in the exposure of {longer_s:.3g} s "
        f"(limit {rad_to_deg(limit_rad):.4f} deg): let the telescope wander more slowly"
    )
    return replace(record, reject_reason=RejectReason.TELESCOPE_MOVED, detail=detail)

"""Did the telescope move too far during an exposure? Told by where the star stood in the record before.

A record that follows the one before too late for that is taken with a second look at the star (`pairs`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import RejectReason
from namod_ctl.core.records import Record
from namod_ctl.core.units import rad_to_deg
from namod_ctl.cycle.pairs import Pair
from namod_ctl.imaging.measure import without_dark
from namod_ctl.imaging.radiometry import grey_frame, saturation_adu
from namod_ctl.imaging.star import Star, star_finder
from namod_ctl.optics.instrument import Instrument

Array = NDArray[np.float64]

MAX_SPEED_BASE_S = 7.0
"""Between records further apart than this, two of the longest exposures, the telescope may have gone anywhere."""

UNKNOWN_MOTION = "how far the telescope moved is not known: the star was not seen shortly before nor after"


def speed_rad_per_s(theta_rad: Array, time_s: float, later_theta_rad: Array, later_s: float) -> float:
    """Speed of the star over the camera between two directions (2,) at two moments; NaN when unknown.

    From middle to middle of the star camera's exposures: what a telescope did that went on at its pace.
    """
    elapsed_s = later_s - time_s
    if not 0.0 < elapsed_s <= MAX_SPEED_BASE_S:  # NaN as well
        return math.nan
    return float(np.hypot(*(later_theta_rad - theta_rad))) / elapsed_s


def speed_from_before(before: Record | None, record: Record) -> float:
    """Speed of the star from the record before; NaN when unknown."""
    if before is None:
        return math.nan
    return speed_rad_per_s(before.theta_rad, before.star_mid_exposure_s, record.theta_rad, record.star_mid_exposure_s)


def speed_from_look(pair: Pair, record: Record, instrument: Instrument) -> float:
    """Speed of the star from the second look at it that the pair of the record has; NaN when unknown."""
    if pair.look is None:
        return math.nan
    camera = instrument.star_camera
    grey = grey_frame(without_dark(pair.look.image, camera, pair.look.exposure_s), saturation_adu(camera))
    star = star_finder(camera, instrument.star_size_rad, grey.dtype).find(grey)
    if not isinstance(star, Star):
        return math.nan
    theta_rad = camera.theta_of_pixel(np.array([star.x_px, star.y_px]))
    return speed_rad_per_s(record.theta_rad, pair.star.mid_exposure_s, theta_rad, pair.look.mid_exposure_s)


def judge_motion(record: Record, speed_rad_per_s: float, limit_rad: float) -> Record:
    """The record, rejected when the telescope moved by more than `limit_rad` during the longer exposure.

    Where nobody knows (a speed of NaN, as of the first record after a cloud), it counts, and its detail says so.
    """
    longer_s = max(record.star_exposure_s, record.reflector_exposure_s)
    moved_rad = speed_rad_per_s * longer_s
    if record.reject_reason is not None or moved_rad <= limit_rad:
        return record
    if math.isnan(moved_rad):
        return replace(record, detail=UNKNOWN_MOTION)
    detail = (
        f"the star moved by {rad_to_deg(moved_rad):.4f} deg in the exposure of {longer_s:.3g} s "
        f"(limit {rad_to_deg(limit_rad):.4f} deg): let the telescope wander more slowly"
    )
    return replace(record, reject_reason=RejectReason.TELESCOPE_MOVED, detail=detail)


def with_stored_verdict(record: Record, stored: Record) -> Record:
    """The record of replayed frames with what the recording found out about its motion: second looks are not kept."""
    if record.reject_reason is not None or stored.reject_reason not in (None, RejectReason.TELESCOPE_MOVED):
        return record
    return replace(record, reject_reason=stored.reject_reason, detail=stored.detail)

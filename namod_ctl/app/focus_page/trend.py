"""Does the star become smaller? Told from the last seconds, so that the noise of single frames is not taken for it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

TREND_S = 3.0
"""A hand at the lens waits about so long for what its turn did."""
LEAST_READINGS = 4
"""Also when they took longer than `TREND_S`, as those of long exposures do: two more than a line has numbers."""
STEADY_SHARE = 0.03
"""Smaller changes of the size nobody needs to follow."""
SIGMAS = 2.0


class Trend(StrEnum):
    """Where the star's size goes."""

    BETTER = "better"
    WORSE = "worse"
    STEADY = "steady"


def trend(times_s: Sequence[float], sizes: Sequence[float]) -> Trend | None:
    """Where the size goes at the end of a course; None while there are too few readings.

    A straight line is fitted to the logarithm of the last sizes: the change over them counts when it is larger than
    `STEADY_SHARE` and than `SIGMAS` times its own uncertainty.

    Parameters
    ----------
    times_s, sizes
        Of the readings with a star, in ascending order of time; sizes of any unit.
    """
    if len(times_s) < LEAST_READINGS:
        return None
    n_last = max(LEAST_READINGS, sum(time_s >= times_s[-1] - TREND_S for time_s in times_s))
    t, y = np.asarray(times_s[-n_last:]), np.log(np.asarray(sizes[-n_last:]))
    t = t - t.mean()
    spread = float(t @ t)
    if spread == 0.0:
        return None
    slope = float(t @ y) / spread
    rest = y - y.mean() - slope * t
    span_s = float(t[-1] - t[0])
    uncertainty = span_s * float(np.sqrt(rest @ rest / (n_last - 2) / spread))
    change = span_s * slope
    if abs(change) < max(STEADY_SHARE, SIGMAS * uncertainty):
        return Trend.STEADY
    return Trend.BETTER if change < 0.0 else Trend.WORSE

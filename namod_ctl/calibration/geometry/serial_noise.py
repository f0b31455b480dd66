"""Noise of a series that is not independent from one member to the next: wind, a drive that hunts, clouds."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SIGNIFICANT = 2.0
"""Standard deviations of a correlation from which on it counts."""
LONGEST_LAG_SHARE = 0.25


def variance_factor(residual: NDArray[np.float64]) -> float:
    """How many times the variance of the mean of (n, k) series exceeds that of independent numbers of the same size.

    The worst of the k series counts; at least 1.
    """
    n = len(residual)
    worst = 1.0
    for column in residual.T:
        deviation = column - column.mean()
        square = float(deviation @ deviation)
        total = 1.0
        for lag in range(1, max(int(LONGEST_LAG_SHARE * n), 2)):
            correlation = float(deviation[lag:] @ deviation[:-lag]) / square if square > 0.0 else 0.0
            if correlation < SIGNIFICANT / math.sqrt(n):
                break
            total += 2.0 * correlation
        worst = max(worst, total)
    return worst

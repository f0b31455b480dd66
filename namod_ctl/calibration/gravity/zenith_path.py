"""Where a telescope stood during a run, between zenith and horizon, and from which side it came there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLACK_RAD = 1e-9  # a star that stands still wavers by rounding


@dataclass(frozen=True, slots=True, eq=False)
class ZenithPath:
    """Zenith distances of one run.

    Attributes
    ----------
    zenith_rad
        Shape (n,). At moments that are evenly spread over the run's records, in the order of time; at least one.
    came_from_rad
        Zenith distance from which the telescope turned to the run's star: 0 after its park position at zenith, 90 deg
        after the horizon. NaN when nobody knows.
    """

    zenith_rad: Array
    came_from_rad: float = math.nan

    @property
    def mean_rad(self) -> float:
        """Mean zenith distance of the run."""
        return float(np.mean(self.zenith_rad))

    @property
    def has_side(self) -> bool:
        """Is it known from which side the telescope came?"""
        return math.isfinite(self.came_from_rad)

    def side(self) -> float:
        """+1: it came from above (smaller zenith distances), -1: from below, in between: it turned; 0: unknown.

        Judged by an infinitesimal play; larger ones turn later, see `with_play`.
        """
        if not self.has_side:
            return 0.0
        way = np.diff(np.concatenate([[self.came_from_rad], self.zenith_rad]))
        side, sides = 0.0, []
        for step in way:
            side = float(np.sign(step)) if abs(step) > SLACK_RAD else side
            sides.append(side)
        return float(np.mean(sides))

    def with_play(self, play_rad: float) -> Array:
        """Zenith distances that a structure feels which follows only after a play of `play_rad` to either side.

        A negative play is no physics: it leads by as much as a play lags, and lets a fit step over zero.
        """
        if play_rad == 0.0 or not self.has_side:
            return self.zenith_rad
        lag, felt = abs(play_rad), self.came_from_rad
        behind = np.empty_like(self.zenith_rad)
        for i, zenith in enumerate(self.zenith_rad):
            felt = min(max(felt, zenith - lag), zenith + lag)
            behind[i] = felt
        return behind if play_rad > 0.0 else 2.0 * self.zenith_rad - behind

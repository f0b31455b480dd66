"""A fault of the whole config: all drives move the wrong way, or by one factor more or less than they were told.

Seen facet by facet, a sign or a pitch that is wrong for all could be many things. All facets together leave no doubt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from namod_ctl.cycle.evidence import FacetHistory, deviation_limit
from namod_ctl.cycle.stories import LN_EVIDENCE, LN_PRIOR_AS_ORDERED, LN_PRIOR_UNKNOWN

Array = NDArray[np.float64]

# Fewer facets than this do not speak for all.
_LEAST_FACETS = 4
_LEAST_SHARE = 2.0 / 3.0
# A factor beyond is none of a pitch, a gear or microsteps: then something else is wrong.
_GAIN_RANGE = (0.25, 20.0)
# A gain may be anything in that range, and is found to about a percent of it: so many could have been.
_LN_GAINS = math.log(100.0)
_NEAR_REVERSED = 0.25


def common_gain(seen: Mapping[int, FacetHistory]) -> float:
    """Travel of all legs per travel that their drives tell; 1.0 unless the facets together refute that.

    -1 when the sign is wrong for all. Facets that follow no common gain have faults of their own and do not count,
    as long as most follow it.
    """
    moved = [history for history in seen.values() if np.any(history.travel_m) and history.is_order_seen()]
    if len(moved) < _LEAST_FACETS:
        return 1.0
    gain = _best_gain(moved)
    penalty = LN_PRIOR_AS_ORDERED
    if abs(gain + 1.0) < _NEAR_REVERSED:
        gain = -1.0
    elif _GAIN_RANGE[0] < gain < _GAIN_RANGE[1]:
        penalty += _LN_GAINS
    else:
        return 1.0
    follow = sum(_chi_square(history, gain) <= deviation_limit(len(history.cycles)) for history in moved)
    evidence = sum(_ln_likelihood(history, gain) - _ln_likelihood(history, 1.0) for history in moved)
    is_proven = follow >= _LEAST_SHARE * len(moved) and evidence > LN_EVIDENCE + penalty
    return gain if is_proven else 1.0


def _best_gain(moved: list[FacetHistory]) -> float:
    """Weighted mean of the facets' gains around their median: facets with faults of their own stay out."""
    found = []
    for history in moved:
        expected = history.expected_rad.reshape(-1)
        weight = np.linalg.inv(history.covariance_rad2(history.travel_m[None])[0])
        information = float(expected @ weight @ expected)
        found.append((float(expected @ weight @ history.change_rad.reshape(-1)) / information, information))
    gains, informations = np.array(found).T
    near = np.abs(gains - np.median(gains)) < 0.25 * max(abs(float(np.median(gains))), 1.0)
    return float(np.average(gains[near], weights=informations[near]))


def _chi_square(history: FacetHistory, gain: float) -> float:
    return float(history.deviation((gain * history.travel_m)[None])[0][0])


def _ln_likelihood(history: FacetHistory, gain: float) -> float:
    """Of the facet, which may have a fault of its own."""
    ordered = float(history.deviation((gain * history.travel_m)[None])[1][0])
    return float(np.logaddexp(ordered + LN_PRIOR_AS_ORDERED, history.ln_likelihood_of_anything() + LN_PRIOR_UNKNOWN))

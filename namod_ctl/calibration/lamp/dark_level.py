"""Level and noise of pixels that rounding and a floor at zero have cut: what their histogram says.

Many cameras set their black level so low that noise below it is cut off. The mean of such responses stands above the
level that light adds to; the level is where the noise would be centred without the cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_ndtr, ndtr

from namod_ctl.imaging.dark import QUANTISATION_NOISE_ADU

CUT_SHARE = 1e-3
"""So many zeros among the responses, and the floor at zero has cut them."""

LOST_SHARE = 0.999
"""So many zeros, and the level lies somewhere below: nobody can tell how far."""

CLIP_SIGMAS = 6.0
"""Responses further from the median are hot pixels and cosmic rays."""

ROUNDING_FLOOR_ADU = 0.01
"""No level is known better: rounding is taken to be that of a perfect digitizer."""

LOST_UNCERTAINTY_ADU = 0.5


@dataclass(frozen=True, slots=True)
class DarkLevel:
    """Where responses are centred, their noise, and how well the centre is known.

    Attributes
    ----------
    noise_adu
        Standard deviation before rounding.
    is_lost
        All responses are zero: the level is at or below zero.
    """

    level_adu: float
    noise_adu: float
    uncertainty_adu: float
    is_lost: bool = False


def dark_level(responses: NDArray[np.unsignedinteger[Any]]) -> DarkLevel:
    """The level of responses of any shape, of pixels that are all alike."""
    counts = np.bincount(responses.ravel())
    n = int(counts.sum())
    median = int(np.searchsorted(np.cumsum(counts), 0.5 * n))
    if counts[0] >= LOST_SHARE * n:
        return DarkLevel(0.0, QUANTISATION_NOISE_ADU, LOST_UNCERTAINTY_ADU, is_lost=True)
    values = np.arange(len(counts))
    quarter = int(np.searchsorted(np.cumsum(counts), 0.1587 * n))
    three_quarters = int(np.searchsorted(np.cumsum(counts), 0.8413 * n))
    reach = CLIP_SIGMAS * max(three_quarters - median, median - quarter, 1)
    is_inside = np.abs(values - median) <= reach
    values, counts = values[is_inside], counts[is_inside]
    n = int(counts.sum())
    mean = float(np.average(values, weights=counts))
    variance = float(np.average((values - mean) ** 2, weights=counts))
    if values[0] > 0 or counts[0] < CUT_SHARE * n:
        noise = max(variance - QUANTISATION_NOISE_ADU**2, 0.0) ** 0.5
        rounding = rounding_bias_adu(variance**0.5)
        return DarkLevel(mean, noise, float(np.hypot((variance / n) ** 0.5, max(rounding, ROUNDING_FLOOR_ADU))))
    level, noise = _uncut(values, counts)
    error = max(noise, variance**0.5) / n**0.5 / max(1.0 - float(counts[0]) / n, 0.05)
    return DarkLevel(level, noise, float(np.hypot(error, 2.0 * ROUNDING_FLOOR_ADU)))


def rounding_bias_adu(noise_adu: float) -> float:
    """Largest error that rounding makes in the mean of many pixels with gaussian noise.

    The first harmonic of the saw-tooth that rounding is, which the noise damps: exp(-2 pi^2 sigma^2) / pi.
    """
    return float(np.exp(-2.0 * (np.pi * noise_adu) ** 2) / np.pi)


def _uncut(values: NDArray[np.intp], counts: NDArray[np.intp]) -> tuple[float, float]:
    """Centre and noise of the normal distribution that, rounded and cut at zero, is likeliest to give the counts."""

    def minus_log_likelihood(parameters: NDArray[np.float64]) -> float:
        centre, noise = parameters[0], float(np.exp(parameters[1]))
        upper, lower = (values + 0.5 - centre) / noise, (values - 0.5 - centre) / noise
        share = ndtr(upper) - ndtr(lower)
        with np.errstate(divide="ignore"):
            log_share = np.log(np.maximum(share, 1e-12))
        log_share[0] = log_ndtr(upper[0])
        return -float(np.sum(counts * log_share)) / float(counts.sum())

    start = np.array([float(np.average(values, weights=counts)), np.log(0.7)])
    found = minimize(minus_log_likelihood, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-10})
    return float(found.x[0]), float(np.exp(found.x[1]))

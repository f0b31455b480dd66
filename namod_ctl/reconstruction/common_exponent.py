"""One exponent that all facets have in common: their testimonies, and the solution for it.

Two-stage least squares with heavy tails: the testimonies are linear in the exponent and in each facet's own parameters,
the latter are projected out, and an instrumental variable stands for the log intensity, whose own noise divides the
responses. Errors may be common to a record, to neighbouring records and to a facet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2

Array = NDArray[np.float64]

_NEIGHBOURS = 3  # on either side: seconds, in which a cloud hardly changes
_N_BLOCKS = 40  # of consecutive records, each as good as independent of the others
_BIWEIGHT = 7.0  # sigma from where on a response, or a record, has no say
_MAX_STEPS = 15
_STEP_SIGMA = 0.02
_MEDIAN_CHI2 = float(chi2.median(1))


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """One facet's testimony, linear in its own parameters and in the exponent.

    Attributes
    ----------
    records
        Shape (n,). Rows of the records in which it was looked at.
    residual, variance, gain, leverage
        Shape (n,). Measured minus expected on the scale of the fit, its expected variance, change of the expectation
        with the log of a common factor, and the share of the residual that the fit has absorbed.
    free
        Shape (n, n_parameters). Change of the expectation with the facet's own parameters.
    belief, belief_pull
        Shapes (n_parameters, n_parameters) and (n_parameters,). Inverse covariance of what is expected of these
        beforehand, and that times how far they are from it.
    """

    records: NDArray[np.int64]
    residual: Array
    variance: Array
    gain: Array
    leverage: Array
    free: Array
    belief: Array
    belief_pull: Array


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The exponent and how it was found.

    Attributes
    ----------
    exponent, sigma
        And one standard deviation.
    strength
        By how many sigma the instrumental variable tells the star's intensity.
    lefts
        Of each witness, shape (n,): its residuals without what the exponent, and its own parameters with it, explain.
    """

    exponent: float
    sigma: float
    strength: float
    lefts: list[Array]


def told_by_neighbours(log_star: Array) -> Array:
    """Mean log intensity of the records before and after each one, without its own, shape (n_records,)."""
    n = len(log_star)
    sums = np.concatenate([[0.0], np.cumsum(log_star)])
    index = np.arange(n)
    first, last = np.maximum(index - _NEIGHBOURS, 0), np.minimum(index + _NEIGHBOURS + 1, n)
    told: Array = (sums[last] - sums[first] - log_star) / np.maximum(last - first - 1, 1)
    return told


def common_factors(witnesses: Sequence[Witness], lefts: Sequence[Array], n: int) -> tuple[Array, Array]:
    """Log of the factor common to all facets of each record in the residuals that are left, and its inverse variance.

    Both of shape (n,); zero where no facet was lit.
    """
    score, information = np.zeros(n), np.zeros(n)
    for w, left in zip(witnesses, lefts, strict=True):
        weight, _ = _biweight(left, w.variance)
        np.add.at(score, w.records, weight * w.gain * left)
        np.add.at(information, w.records, weight * w.gain**2)
    factor = np.divide(score, information, out=np.zeros(n), where=information > 0.0)
    return factor, information


def _biweight(residual: Array, variance: Array) -> tuple[Array, Array]:
    """Inverse variances, gradually less for residuals far out; and how much steeper the whole is than the weight says.

    Nearly least squares on ordinary noise, so that neither a slope nor its error is held for outliers. The second, the
    derivative of weight times residual over the weight, is 1 for small residuals.
    """
    out = np.minimum(residual**2 / (_BIWEIGHT**2 * variance), 1.0)
    steepness: Array = np.divide(1.0 - 5.0 * out, 1.0 - out, out=np.zeros(len(out)), where=out < 1.0)
    weight: Array = (1.0 - out) ** 2 / variance
    return weight, steepness


def _weights_of_records(factor: Array, information: Array) -> tuple[Array, Array]:
    """What errors common to all facets of a record, as the star's scintillation, leave of its weight; and steepness.

    Both of shape (n,), see `_biweight`.
    """
    lit = information > 0.0
    square, own = factor[lit] ** 2, 1.0 / information[lit]

    def excess(common: float) -> float:
        return float(np.median(square / (own + common))) - _MEDIAN_CHI2

    most = float(np.median(square)) / _MEDIAN_CHI2
    common = float(brentq(excess, 0.0, most)) if excess(0.0) > 0.0 > excess(most) else 0.0
    weight, steepness = np.zeros(len(factor)), np.zeros(len(factor))
    weight[lit], steepness[lit] = _biweight(factor[lit], own + common)
    weight[lit] *= own
    return weight, steepness


def project(witness: Witness, weight: Array, columns: Array) -> tuple[Array, Array]:
    """Changes of the expectations, the columns (n, k), without what the facet's own parameters can take over.

    Returns these, (n, k), and what the parameters take, (n_parameters, k).
    """
    weighted = witness.free.T * weight
    taken = np.linalg.solve(weighted @ witness.free + witness.belief, weighted @ columns).astype(np.float64)
    return columns - witness.free @ taken, taken


def solve(witnesses: Sequence[Witness], log_star: Array, told: Array) -> Solution:
    """The exponent, with `told` (n_records,) as the instrumental variable for `log_star`."""
    n = len(log_star)
    both = np.stack([told, log_star], axis=1)
    lefts = [w.residual for w in witnesses]
    exponent, sigma, strength = 0.0, math.inf, 0.0
    for _ in range(_MAX_STEPS):
        factor, information = common_factors(witnesses, lefts, n)
        of_record, steepness_of_record = _weights_of_records(factor, information)
        top = bottom = steep = tool_tool = star_star = 0.0
        tools, stars, weights = [], [], []
        for w, left in zip(witnesses, lefts, strict=True):
            weight, steepness = _biweight(left, w.variance)
            weight *= of_record[w.records]
            columns = w.gain[:, None] * both[w.records]
            projected, taken = project(w, weight, columns)
            tool, star = projected.T
            top += float(tool @ (weight * w.residual) + taken[:, 0] @ w.belief_pull)
            bottom += float(tool @ (weight * columns[:, 1]))
            steep += float(tool @ (weight * steepness * steepness_of_record[w.records] * columns[:, 1]))
            tool_tool += float(tool @ (weight * columns[:, 0]))
            star_star += float(star @ (weight * columns[:, 1]))
            tools.append(tool)
            stars.append(star)
            weights.append(weight)
        if not min(abs(bottom), abs(steep), tool_tool, star_star) > 0.0:
            return Solution(0.0, math.inf, 0.0, lefts)
        step, exponent = top / bottom - exponent, top / bottom
        lefts = [w.residual - exponent * star for w, star in zip(witnesses, stars, strict=True)]
        scores = [
            tool * weight * left / (1.0 - w.leverage)
            for w, tool, weight, left in zip(witnesses, tools, weights, lefts, strict=True)
        ]
        sigma = math.sqrt(_variance_of_sum(witnesses, scores, information > 0.0)) / abs(steep)
        shared = min(bottom**2 / (tool_tool * star_star), 1.0 - 1e-12)
        strength = math.sqrt(np.count_nonzero(information) * shared / (1.0 - shared))
        if abs(step) < _STEP_SIGMA * sigma:
            break
    return Solution(exponent, sigma, strength, lefts)


def _variance_of_sum(witnesses: Sequence[Witness], scores: Sequence[Array], is_lit: NDArray[np.bool_]) -> float:
    """Variance of the sum of all scores, as their scatter shows it.

    Errors are common to a record (the star's intensity), to neighbouring records (a cloud's edge) and to a facet's
    records (what its model lacks): the scatter of both kinds of sums tells, with what they share counted once.
    """
    lit = np.flatnonzero(is_lit)
    n_blocks = max(min(_N_BLOCKS, len(lit) // 2), 2)
    block_of = np.zeros(len(is_lit), dtype=np.int64)
    block_of[lit] = np.arange(len(lit)) * n_blocks // len(lit)
    sums = np.zeros((len(witnesses), n_blocks))
    for j, (w, score) in enumerate(zip(witnesses, scores, strict=True)):
        np.add.at(sums[j], block_of[w.records], score)
    of_blocks = n_blocks / (n_blocks - 1.0) * float((sums.sum(axis=0) ** 2).sum())
    of_facets = float((sums.sum(axis=1) ** 2).sum() - (sums**2).sum())
    return of_blocks + max(of_facets, 0.0)

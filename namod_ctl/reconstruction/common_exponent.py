"""One exponent that all facets have in common: their testimonies, and the solution for it.

Generalized least squares with heavy tails: the testimonies are linear in the exponent, in a factor common to all facets
of a record (the star scintillates in the star camera's small lens) and in each facet's own parameters. The latter are
projected out; the former are random, with a variance that the records themselves tell. An instrumental variable stands
for the log intensity, whose own noise divides the responses.

What all facets say about the records' log factors c is a score q = A c with the information A, a matrix of few columns
beside a diagonal one: so all products with (A^-1 + D)^-1, where D is the variance of the random factors, are cheap.
Light that is not shaped as the facets' model has it makes common factors, too: facets of an aligned mirror look alike.
These depend on direction, as smoothly as light does, and are fitted along.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.stats import chi2

Array = NDArray[np.float64]

_NEIGHBOURS = 3  # on either side: seconds, in which a cloud hardly changes
_N_BLOCKS = 40  # of consecutive records, each as good as independent of the others
_BIWEIGHT = 7.0  # sigma from where on a response, or a record, has no say
_MAX_STEPS = 15
_MIN_RECORDS = 4
_MIN_STEPS = 4  # until variances and weights have followed
_STEP_SIGMA = 0.02
_FIRST_SCATTER = 0.1
_LEAST_SHARE = 1e-6  # of its weight that a record far out keeps
_EPSILON = 1e-10
_MEDIAN_CHI2 = float(chi2.median(1))
_LEAST_VARIANCE = 1e-6  # of a record's own factor: no camera repeats to 0.1 %
_LOG_CHI2_VARIANCE = math.pi**2 / 2.0  # of log chi2 with one degree of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """One facet's testimony, linear in its own parameters and in the exponent.

    Attributes
    ----------
    records
        Shape (n,). Rows of the records in which it was looked at.
    residual, variance, gain
        Shape (n,). Measured minus expected on the scale of the fit, its expected variance, and change of the
        expectation with the log of a common factor.
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
    factor, factor_variance
        Shape (n_records,). Log of the factor common to all facets of each record beside that power, and its variance by
        the facets' noise; zero and infinite where no facet was lit.
    """

    exponent: float
    sigma: float
    strength: float
    factor: Array
    factor_variance: Array


def told_by_neighbours(log_star: Array) -> Array:
    """Mean log intensity of the records before and after each one, without its own, shape (n_records,)."""
    told: Array = np.zeros(len(log_star))
    for lag in range(1, _NEIGHBOURS + 1):
        told[:-lag] += log_star[lag:]
        told[lag:] += log_star[:-lag]
    return told / np.maximum(_n_neighbours(len(log_star)), 1)


def _n_neighbours(n: int) -> NDArray[np.int64]:
    index = np.arange(n)
    return np.minimum(index, _NEIGHBOURS) + np.minimum(n - 1 - index, _NEIGHBOURS)


def common_factors(witnesses: Sequence[Witness], n: int) -> tuple[Array, Array]:
    """Log of the factor common to all facets of each record, as their residuals have it, and its inverse variance.

    Both of shape (n,); zero where no facet was lit.
    """
    score, information = np.zeros(n), np.zeros(n)
    for w in witnesses:
        np.add.at(score, w.records, w.gain * w.residual / w.variance)
        np.add.at(information, w.records, w.gain**2 / w.variance)
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


def project(witness: Witness, weight: Array, columns: Array) -> tuple[Array, Array]:
    """Changes of the expectations, the columns (n, k), without what the facet's own parameters can take over.

    Returns these, (n, k), and what the parameters take, (n_parameters, k).
    """
    weighted = witness.free.T * weight
    taken = np.linalg.solve(weighted @ witness.free + witness.belief, weighted @ columns).astype(np.float64)
    return columns - witness.free @ taken, taken


@dataclass(frozen=True, slots=True, eq=False)
class _Testimony:
    """What one facet says about the log factors of the records, linear in these.

    Attributes
    ----------
    records
        Shape (n,). Those in which it was looked at.
    score, diagonal, load
        Shapes (n,), (n,) and (n, n_parameters): its score of the log factors where these are zero, and their
        information diag(diagonal) - load load^T, which its own parameters make less.
    """

    records: NDArray[np.int64]
    score: Array
    diagonal: Array
    load: Array

    def left(self, column: Array) -> Array:
        """The score (n,) that is left beside these log factors (n_records,)."""
        own = column[self.records]
        score: Array = self.score - self.diagonal * own + self.load @ (self.load.T @ own)
        return score


def _inverse_root(matrix: Array) -> Array:
    """A square root of the inverse of a positive matrix, of parameters with whatever units."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), _EPSILON**2))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, None])
    root: Array = scale[:, None] * vectors / np.sqrt(np.maximum(values, _EPSILON))
    return root


def _testify(witness: Witness, common: Array) -> _Testimony:
    """The witness' testimony, its residuals weighted by how far out they are beside these log factors (n_records,)."""
    w = witness
    columns = w.gain * common[w.records]
    weight, _ = _biweight(w.residual - columns, w.variance)
    weighted = w.free.T * weight
    root = _inverse_root(weighted @ w.free + w.belief)
    left = w.residual - columns - w.free @ (root @ (root.T @ (weighted @ (w.residual - columns) - w.belief_pull)))
    weight, _ = _biweight(left, w.variance)
    weighted = w.free.T * weight
    root = _inverse_root(weighted @ w.free + w.belief)
    load = (weighted * w.gain).T @ root
    score = weight * w.gain * w.residual - load @ (root.T @ (weighted @ w.residual - w.belief_pull))
    return _Testimony(w.records, score, weight * w.gain**2, load)


class _Whitened:
    """Products with K = (A^-1 + D)^-1, less what the smooth columns (n_records, k) take over.

    D is a diagonal variance (n_records,) of the random factors.
    """

    def __init__(self, testimonies: Sequence[_Testimony], variance: Array, smooth: Array) -> None:
        n = len(variance)
        self.diagonal = np.zeros(n)
        self._root = np.zeros((n, sum(each.load.shape[1] for each in testimonies)))
        first = 0
        for each in testimonies:
            last = first + each.load.shape[1]
            np.add.at(self.diagonal, each.records, each.diagonal)
            self._root[each.records, first:last] = each.load
            first = last
        self._precision = 1.0 / variance
        self._near = 1.0 / (self.diagonal + self._precision)
        lower = np.linalg.cholesky(np.eye(first) - self._root.T @ (self._near[:, None] * self._root))
        self._far = solve_triangular(lower, self._root.T * self._near, lower=True).astype(np.float64)
        taken = (
            np.stack([self._of_score(self.information(each)) for each in smooth.T], axis=1) if smooth.size else smooth
        )
        self._smooth = smooth @ _inverse_root(smooth.T @ taken)
        self._taken = taken @ _inverse_root(smooth.T @ taken)

    def solved(self, column: Array) -> Array:
        """(A + D^-1)^-1 times a column."""
        product: Array = self._near * column + self._far.T @ (self._far @ column)
        return product

    def information(self, column: Array) -> Array:
        """A times a column."""
        product: Array = self.diagonal * column - self._root @ (self._root.T @ column)
        return product

    def _of_score(self, score: Array) -> Array:
        product: Array = self._precision * self.solved(score)
        return product

    def of_score(self, score: Array) -> tuple[Array, Array]:
        """K c of a score A c, and the smooth part of c, both of shape (n_records,)."""
        pull = self._of_score(score)
        share = self._smooth.T @ pull
        return pull - self._taken @ share, self._smooth @ share

    def times(self, column: Array) -> Array:
        """K times a column."""
        return self.of_score(self.information(column))[0]

    def reach(self, column: Array) -> Array:
        """Change of column^T K c with the score A c, shape (n_records,)."""
        return self.solved((column - self._smooth @ (self._taken.T @ column)) * self._precision)

    def of_each(self) -> Array:
        """Diagonal of K, shape (n_records,)."""
        inverse = self._near + (self._far**2).sum(axis=0)
        whole = self._precision - self._precision**2 * inverse - (self._taken**2).sum(axis=1)
        own: Array = np.maximum(whole, 0.0)
        return own


def _variance_of_random(factor: Array, own: Array, told: Array) -> Array:
    """Variance of the records' random log factors, all of shape (n,).

    Parameters
    ----------
    factor, own
        The factors as they seem, and what of their variance is the facets' noise.
    told
        Log intensity: a brighter star is exposed more shortly, and scintillates more.
    """
    away = told - told.mean()
    slope = float(away @ np.log(factor**2 + _EPSILON)) / (float(away @ away) + _LOG_CHI2_VARIANCE)
    shape = np.exp(slope * away)

    def excess(common: float) -> float:
        return float(np.median(factor**2 / (own + common * shape))) - _MEDIAN_CHI2

    most = float(np.median(factor**2 / shape)) / _MEDIAN_CHI2
    common = float(brentq(excess, 0.0, most)) if excess(0.0) > 0.0 > excess(most) else 0.0
    variance: Array = np.maximum(common * shape, _LEAST_VARIANCE)
    return variance


def solve(witnesses: Sequence[Witness], log_star: Array, told: Array, smooth: Array) -> Solution:
    """The exponent, with `told` (n_records,) as the instrumental variable for `log_star`.

    `smooth` (n_records, k), k = 0 for none, are functions of the records' directions that may add up to a common log
    factor.

    Noise of the star's intensity is a factor of mean 1, whose log is on average below 0 by half its variance; so it
    makes responses seem larger where it is stronger.
    """
    n = len(log_star)
    nothing = Solution(0.0, math.inf, 0.0, np.zeros(n), np.full(n, math.inf))
    spread, bias = np.full(n, _FIRST_SCATTER**2), np.zeros(n)
    common, _ = common_factors(witnesses, n)
    exponent, found = 0.0, nothing
    for n_steps in range(1, _MAX_STEPS + 1):
        testimonies = [_testify(witness, common) for witness in witnesses]
        whitened = _Whitened(testimonies, spread, smooth)
        score = np.zeros(n)
        for each in testimonies:
            np.add.at(score, each.records, each.score)
        tool, star = whitened.times(told), whitened.times(log_star)
        tool_star, tool_tool, star_star = float(told @ star), float(told @ tool), float(log_star @ star)
        if not min(abs(tool_star), tool_tool, star_star) > 0.0:
            return nothing
        top = float(told @ (whitened.of_score(score)[0] - whitened.times(bias)))
        step, exponent = top / tool_star - exponent, top / tool_star
        common = exponent * log_star + bias
        pull, of_direction = whitened.of_score(score - whitened.information(common))
        common += of_direction + spread * pull
        # each record without its pull on all others, and the variance of that
        certainty = whitened.of_each()
        lit = np.flatnonzero((whitened.diagonal > 0.0) & (certainty > _EPSILON))
        if len(lit) < _MIN_RECORDS:
            return nothing
        factor, own = np.zeros(n), np.full(n, math.inf)
        factor[lit] = pull[lit] / certainty[lit]
        own[lit] = np.maximum(1.0 / certainty[lit] - spread[lit], 0.0)
        of_blocks = _variance_of_blocks((tool * factor)[lit])
        reach = whitened.reach(told)
        of_facets = np.array([reach[each.records] @ each.left(common) for each in testimonies])
        variance = _variance_of_random(factor[lit], own[lit], told[lit])
        weight, steepness = _biweight(factor[lit], own[lit] + variance)
        steep = float((told * star)[lit] @ steepness)
        if not abs(steep) > 0.0:
            return nothing
        sigma = math.sqrt(of_blocks + len(of_facets) * float(np.var(of_facets))) / abs(steep)
        shared = min(tool_star**2 / (tool_tool * star_star), 1.0 - 1e-12)
        strength = math.sqrt(len(lit) * shared / (1.0 - shared))
        found = Solution(exponent, sigma, strength, factor + bias, own)
        if n_steps >= _MIN_STEPS and abs(step) < _STEP_SIGMA * sigma:
            break
        spread = np.full(n, float(np.mean(variance)))
        spread[lit] = variance / np.maximum(weight * (own[lit] + variance), _LEAST_SHARE)
        bias = np.zeros(n)
        bias[lit] = variance / 2.0
    return found


def _variance_of_blocks(scores: Array) -> float:
    """Variance of the sum of scores (n,) of consecutive records, as the scatter of their sums in blocks shows it.

    Errors of neighbouring records (a cloud's edge) may go together.
    """
    n = len(scores)
    n_blocks = max(min(_N_BLOCKS, n // 2), 2)
    sums = np.bincount(np.arange(n) * n_blocks // n, weights=scores, minlength=n_blocks)
    return n_blocks / (n_blocks - 1.0) * float((sums**2).sum())

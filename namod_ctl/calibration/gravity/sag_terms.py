"""Which terms a sag needs: of all facets together, and of every one of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import f as f_distribution

from namod_ctl.calibration.gravity.play import Play, measure_play, used_rad
from namod_ctl.calibration.gravity.relative_runs import RelativeRuns
from namod_ctl.calibration.gravity.sag_fit import Fit, fit_facets
from namod_ctl.calibration.gravity.sag_screening import scatter2_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TERM_CHANCE = 1e-3  # a term that chance makes more often than that is not needed


@dataclass(frozen=True, slots=True)
class TermTest:
    """A set of terms on trial.

    Attributes
    ----------
    bic
        Bayesian information criterion, less is better; only differences mean anything.
    chance
        With which chance alone makes the last term fit so much better than without it; NaN for no term.
    """

    terms: tuple[str, ...]
    bic: float
    chance: float


def needed_terms(
    runs: RelativeRuns, candidates: Sequence[tuple[str, ...]]
) -> tuple[tuple[TermTest, ...], tuple[str, ...], Play | None]:
    """Every set of terms on trial, each with the play that suits it, the best set and its play.

    The last candidate has all the terms of the others.

    The scatter that the last one leaves counts as error, unless it is less than the stated errors: runs that wander
    along the same path share errors, and scatter less than they are wrong.
    """
    even = runs.is_even
    plays = {terms: measure_play(runs, terms) if terms else None for terms in candidates}
    fits = {terms: runs.fit(terms, used_rad(play)) for terms, play in plays.items()}
    chi2 = {terms: float(fit.chi2[even].sum()) for terms, fit in fits.items()}
    n_free, n_facets = int(fits[candidates[-1]].n_free[even].sum()), int(even.sum())
    scatter2 = max(scatter2_of(fits[candidates[-1]], even), 1.0)
    n_runs = np.count_nonzero(runs.weight[:, even, 0, 0] > 0.0, axis=0)
    tests = []
    for terms in candidates:
        bic = chi2[terms] / scatter2 + float(np.sum(2 * (1 + len(terms)) * np.log(2.0 * n_runs)))
        tests.append(TermTest(terms, bic, _chance_of_last(terms, chi2, n_facets, n_free, scatter2)))
    in_question = [test for test in tests if not test.terms or test.chance < TERM_CHANCE]
    best = min(in_question, key=lambda test: test.bic).terms
    return tuple(tests), best, plays[best]


def _chance_of_last(
    terms: tuple[str, ...], chi2: dict[tuple[str, ...], float], n_facets: int, n_free: int, scatter2: float
) -> float:
    """F test of the terms against the best set with one term less; NaN without terms."""
    if not terms:
        return math.nan
    less = min(chi2[fewer] for fewer in chi2 if len(fewer) == len(terms) - 1 and set(fewer) <= set(terms))
    return float(f_distribution.sf((less - chi2[terms]) / (2 * n_facets) / scatter2, 2 * n_facets, n_free))


def moving_facets(basis: Array, relative: Array, weight: Array, best: Fit, scatter2: float) -> tuple[Array, Mask]:
    """Chance of every facet's terms, and whether they are worth their numbers; arrays as in `fit_facets`."""
    n_more = 2 * (basis.shape[-1] - 1)
    at_rest = fit_facets(basis[..., :1], relative, weight)
    n_runs = np.count_nonzero(weight[..., 0, 0] > 0.0, axis=0)
    can: Mask = np.asarray(np.isfinite(best.beta_rad).all(axis=(1, 2)))
    if n_more == 0:
        return np.where(can, 1.0, np.nan), np.zeros(len(can), dtype=np.bool_)
    gain = (at_rest.chi2 - best.chi2) / max(scatter2, 1.0)
    chance = np.where(can, chi2_distribution.sf(gain, n_more), np.nan)
    is_worth = can & (gain > n_more * np.log(np.maximum(2.0 * n_runs, 1.0)))
    return chance, is_worth

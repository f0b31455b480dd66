"""True uncertainties: what the curvature of the fit says, corrected by what the run itself shows.

Two things make the formal covariance of a fit too small on field data. A facet's light may have more structure
than the shape model can follow: its own residuals tell (`misfit_factors`). And the noise may not be
independent from record to record, which no residual tells but a repetition does: the records are split at
random into disjoint halves, the facets are fitted in both, and the differences are compared with their
stated errors (`repetition_factor`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.facet_fit import FacetFit, centre_covariance
from namod_ctl.reconstruction.responses import ResponseTable
from namod_ctl.reconstruction.robust import Family, fit_facets

Array = NDArray[np.float64]

_PRIOR_FREEDOM = 5.0  # records' worth of belief that a facet's residuals are like its family's
_LIT = 0.02  # share of the facet's scale from which on a record has a say about misfit
_CAP = 5.0  # residuals beyond are outliers, not misfit
_MIN_FOR_REPETITION = 100  # records; half of fewer is not the same experiment
_FACTOR_OF_SHORT_RUNS = 6.0  # what halves of sparse field runs (FACT 2014) came to at worst
_N_PULLS = 200  # enough for the factor to be good to 5 %
_MAX_SPLITS = 4


def misfit_factors(fits: Sequence[FacetFit | None]) -> Array:
    """Factor >= 1 on each facet's variances, shape (n_facets,), from its own lit residuals; 1 without a fit."""
    factors = np.ones(len(fits))
    for j, fit in enumerate(fits):
        if fit is not None:
            lit = fit.light > _LIT
            freedom = 1.0 - fit.leverage[lit]
            square = np.minimum(fit.residual[lit] ** 2 / (fit.variance[lit] * freedom), _CAP**2)
            factors[j] = (_PRIOR_FREEDOM + float(freedom @ square)) / (_PRIOR_FREEDOM + float(freedom.sum()))
    at_least_one: Array = np.maximum(factors, 1.0)
    return at_least_one


def pulls(first: Sequence[FacetFit | None], second: Sequence[FacetFit | None]) -> Array:
    """Differences of the centres of two independent fits in units of their joint error, shape (n_facets, 2).

    Both covariances include the misfit factor. Facets without both fits are left out.
    """
    found = []
    for a, b, fa, fb in zip(first, second, misfit_factors(first), misfit_factors(second), strict=True):
        if a is not None and b is not None:
            joint = fa * centre_covariance(a) + fb * centre_covariance(b)
            difference = a.parameters[1:3] - b.parameters[1:3]
            found.append(np.linalg.solve(np.linalg.cholesky(joint), difference))
    return np.array(found).reshape(-1, 2)


def width_of_pulls(values: Array) -> float:
    """Half width of the central 68.3 % of pulls: one for a unit gaussian, and not ruled by a few lost facets."""
    return float(np.quantile(np.abs(values), 0.683))


def repetition_factor(table: ResponseTable, family: Family, seed: int = 0) -> float:
    """Factor on all variances, >= 1, that makes random halves of this run agree within their errors.

    Halves of a sparse run agree somewhat worse than the whole would with another one like it, so the factor errs
    on the safe side there.
    """
    if table.n_records < _MIN_FOR_REPETITION:
        return _FACTOR_OF_SHORT_RUNS
    rng = np.random.default_rng(seed)
    n_facets = len(table.facet_ids)
    facets = np.arange(n_facets)
    if 2 * n_facets > _N_PULLS:
        facets = np.sort(rng.choice(n_facets, _N_PULLS // 2, replace=False))
    n_splits = int(np.clip(_N_PULLS // (2 * len(facets)), 1, _MAX_SPLITS))
    collected = []
    for _ in range(n_splits):
        order = rng.permutation(table.n_records)
        halves = (np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :]))
        first, second = (fit_facets(table.select(half), family, facets) for half in halves)
        collected.append(pulls(first, second))
    all_pulls = np.concatenate(collected)
    return max(1.0, width_of_pulls(all_pulls) ** 2) if len(all_pulls) else 1.0

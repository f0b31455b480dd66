"""Facets and runs that do not belong to one state of the mirror."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from namod_ctl.calibration.gravity.relative_runs import RelativeRuns
from namod_ctl.calibration.gravity.sag_fit import Fit, fit_facets, with_column
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import arcmin_to_rad, rad_to_arcmin

Mask = NDArray[np.bool_]

_ODD_CHANCE = 1e-3  # of all facets together that one is called odd by mistake
_DRAWN_SHARE = 0.2
_WRONG_SCATTER = 3.0  # in stated errors
_WRONG_SHARE = 0.1  # of what the sag does: with a scatter as large as this no table is worth its name
_WRONG_RAD = arcmin_to_rad(0.2)
_STEP_SHARE = 0.1  # of a sag's misfit: a step between two runs that leaves so little is what happened
_LEAST_FOR_STEP = 3  # with so few runs a step fits whatever happened
_MOST_ODD_SHARE = 0.3


def scatter2_of(fit: Fit, is_even: Mask) -> float:
    """Variance of the runs about the model in stated variances, of the even facets."""
    is_even = is_even & (fit.n_free > 0)
    if not is_even.any():
        return 1.0
    # the mean of facets that are not odd, unless a few large ones, not found odd yet, make it
    by_facet = fit.chi2[is_even] / fit.n_free[is_even]
    expected = chi2_distribution.ppf(0.5, fit.n_free[is_even]) / fit.n_free[is_even]
    by_median = float(np.median(by_facet) / np.median(expected))
    by_mean = float(fit.chi2[is_even].sum() / fit.n_free[is_even].sum())
    return max(min(by_mean, 2.0 * by_median), 1e-12)


def odd_facets(runs: RelativeRuns, terms: tuple[str, ...], play_rad: float) -> dict[int, str]:
    """Facets that do not follow a sag as the even ones do, by their numbers, and why, for a person."""
    basis, relative = runs.settled(terms, play_rad)
    fit = fit_facets(basis, relative, runs.weight)
    scatter2 = scatter2_of(fit, runs.is_even)
    chance = chi2_distribution.sf(fit.chi2 / max(scatter2, 1.0), np.maximum(fit.n_free, 1))
    found = {}
    is_new = runs.is_even & (fit.n_free > 0) & (chance < _ODD_CHANCE / len(fit.chi2))
    # the worst first: through the mean of all facets they draw others with them
    is_new &= fit.chi2 > _DRAWN_SHARE * np.max(fit.chi2, where=is_new, initial=0.0)
    for j in np.flatnonzero(is_new):
        without = {}
        for k in np.flatnonzero(runs.weight[:, j, 0, 0] > 0.0):
            rest = runs.weight[:, j : j + 1].copy()
            rest[k] = 0.0
            trial = fit_facets(basis[:, j : j + 1], relative[:, j : j + 1], rest)
            if trial.n_free[0] > 0:
                without[int(k)] = float(trial.chi2[0])
        off_rad = float(np.nanmax(np.linalg.norm(fit.residual_rad[:, j], axis=-1)))
        words = f"it does not follow a sag, by up to {rad_to_arcmin(off_rad):.2f} arcmin"
        if without:
            odd_run = min(without, key=without.__getitem__)
            words += f"; run {runs.names[odd_run]} disagrees most: perhaps it was turned before or after that run"
        else:
            words += "; perhaps it was turned between the runs"
        found[int(j)] = words
    return found


def refuse_turned(runs: RelativeRuns, terms: tuple[str, ...], play_rad: float, odd: dict[int, str]) -> None:
    """Raise DataQualityError when the runs are not of one state of the mirror."""
    sides, n_runs = runs.sides(), len(runs.names)
    # facets that differ between the sides each in its own way were not turned
    has_sides = bool(np.ptp(sides) > 1.0) and n_runs > len(terms) + 2
    basis, relative = runs.settled(terms, play_rad, sides if has_sides else None)
    fit = fit_facets(basis, relative, runs.weight)
    scatter = math.sqrt(scatter2_of(fit, runs.is_even))
    can = fit.n_free > 0
    if not can.any():
        raise DataQualityError("no facet was seen in enough runs to tell its sag: record longer")
    sizes = np.linalg.norm(np.nan_to_num(fit.residual_rad[:, can]), axis=-1)
    residual_rad = float(np.median(np.sqrt(np.mean(sizes**2, axis=0))))
    motion = np.einsum("knp,npa->kna", basis[:, can, 1:], fit.beta_rad[can, 1:])
    motion_rad = float(np.median(np.linalg.norm(np.ptp(motion, axis=0), axis=-1)))
    chi2 = {}
    if n_runs > _LEAST_FOR_STEP:  # with fewer a step fits whatever happened
        for boundary in range(1, n_runs):
            step = (np.arange(n_runs) >= boundary).astype(np.float64)
            trial = fit_facets(with_column(basis[..., :2], step), relative, runs.weight)
            chi2[boundary] = float(np.nansum(trial.chi2))
    best = min(chi2, key=chi2.__getitem__, default=0)
    is_step = bool(chi2) and chi2[best] < _STEP_SHARE * float(fit.chi2.sum())
    is_scatter = residual_rad > max(_WRONG_RAD, _WRONG_SHARE * motion_rad)
    is_wrong = scatter > _WRONG_SCATTER and (is_step or is_scatter)
    if not is_wrong and len(odd) <= _MOST_ODD_SHARE * np.count_nonzero(can):
        return
    where = f", most likely between {runs.names[best - 1]} and {runs.names[best]}" if chi2 else ""
    stand_out = f"; {len(odd)} facets stand out" if odd else ""
    raise DataQualityError(
        "the runs do not belong to one state of the mirror: facets are off a sag by "
        f"{rad_to_arcmin(residual_rad):.2f} arcmin, {scatter:.1f} times their errors{stand_out}. Facets were turned or "
        f"corrected in between{where}, or zenith distances are mistaken; use runs between which nothing was turned, "
        "named in the order in which they were recorded"
    )

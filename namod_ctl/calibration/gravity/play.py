"""Hysteresis of the sag: a play of the structure, told by runs to which the telescope came from either side."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import f as f_distribution

from namod_ctl.calibration.gravity.relative_runs import RelativeRuns
from namod_ctl.calibration.gravity.sag_fit import basis_of_zenith
from namod_ctl.core.units import deg_to_rad

Array = NDArray[np.float64]

MOST_RAD = deg_to_rad(10.0)
_STEP_RAD = deg_to_rad(2.0)
_CURVATURE_STEP_RAD = deg_to_rad(0.25)
_AT_RAD = deg_to_rad(45.0)
_SIGNIFICANT_SIGMA = 3.0
_LEAST_SCATTER2 = 0.25  # stated errors are not more than twice too large
_FAR = 10.0  # times the typical misfit of a facet: beyond, more counts little more
_OTHER_SIDE = 0.5  # a run that came clearly from one side has a side beyond this


@dataclass(frozen=True, slots=True)
class Play:
    """Measured hysteresis.

    Attributes
    ----------
    play_rad, sigma_rad
        Half of the zenith distance that the telescope must turn back before the facets follow.
    difference_rad, difference_sigma_rad
        By how much facets differ between the two sides at 45 deg from the zenith: rms over the facets of the length of
        Theta's difference, the common motion taken off.
    own_chance, own_rms_rad
        With which chance alone makes facets differ between the sides beyond this one play, and by how much they do
        (rms of the length, errors taken off); NaN when the runs cannot tell.
    """

    play_rad: float
    sigma_rad: float
    difference_rad: float
    difference_sigma_rad: float
    own_chance: float
    own_rms_rad: float

    @property
    def is_significant(self) -> bool:
        """Is it more than chance?"""
        return abs(self.play_rad) > _SIGNIFICANT_SIGMA * self.sigma_rad

    @property
    def used_rad(self) -> float:
        """The play to reckon with: 0 when it is chance, or leads instead of lags, which no structure does."""
        return max(self.play_rad, 0.0) if self.is_significant else 0.0


def used_rad(play: Play | None) -> float:
    """The play to reckon with: 0 when none was measured."""
    return 0.0 if play is None else play.used_rad


def measure_play(runs: RelativeRuns, terms: tuple[str, ...]) -> Play | None:
    """The play that fits best; None unless runs came from both sides. Errors are scaled by the scatter that remains."""
    sides, even = runs.sides(), runs.is_even
    if not even.any() or sides.max() < _OTHER_SIDE or sides.min() > -_OTHER_SIDE:
        return None

    def chi2(play_rad: float) -> Array:
        return runs.fit(terms, play_rad).chi2[even]

    n_own = np.maximum(runs.fit(terms).n_free[even], 1)
    far = _FAR * n_own * max(float(np.median(chi2(0.0) / n_own)), 1.0)

    def misfit(play_rad: float) -> float:
        # a facet that was turned has no play that fits: it must not decide, however far it is off
        return float(np.sum(far * np.log1p(chi2(play_rad) / far)))

    lagging, leading = (_least(misfit, sign) for sign in (1.0, -1.0))
    # what leads is no structure, but sides that were exchanged: few runs must show that beyond doubt
    doubt = _SIGNIFICANT_SIGMA**2 * max(float(np.median(chi2(lagging) / n_own)), 1.0)
    best = leading if misfit(leading) < misfit(lagging) - doubt else lagging
    here, step = float(chi2(best).sum()), _CURVATURE_STEP_RAD
    curvature = (float(chi2(best + step).sum() + chi2(best - step).sum()) - 2.0 * here) / step**2
    fit = runs.fit(terms, best)
    n_free = int(fit.n_free[even].sum()) - 1
    if n_free < 1:
        return None
    scatter2 = max(here / n_free, 1e-12)
    sigma = math.sqrt(2.0 * max(scatter2, _LEAST_SCATTER2) / curvature) if curvature > 0.0 else math.inf
    slope_basis = np.gradient(basis_of_zenith(_AT_RAD + np.array([-step, 0.0, step]), terms), step, axis=0)[1]
    slope = np.einsum("p,npa->na", slope_basis, fit.beta_rad[even])
    slope_rms = math.sqrt(float(np.nanmean(np.sum(slope**2, axis=-1))))
    own_chance, own_rms = _own_play(runs, terms, best, scatter2)
    return Play(best, sigma, 2.0 * abs(best) * slope_rms, 2.0 * sigma * slope_rms, own_chance, own_rms)


def _least(misfit: Callable[[float], float], sign: float) -> float:
    """The play of that sign, or next to none, at which a misfit is least."""
    grid = sign * np.arange(0.0, MOST_RAD + _STEP_RAD / 2.0, _STEP_RAD)
    start = float(grid[np.argmin([misfit(float(play_rad)) for play_rad in grid])])
    bounds = (start - _STEP_RAD, start + _STEP_RAD)
    return float(minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 1e-4}).x)


def _own_play(runs: RelativeRuns, terms: tuple[str, ...], play_rad: float, scatter2: float) -> tuple[float, float]:
    """Do facets differ between the sides each in its own way? Chance of it, and rms of the difference."""
    sides, n_terms = runs.sides(), 1 + len(terms)
    typical = np.column_stack([runs.basis(terms, play_rad).mean(axis=1), sides])
    if len(sides) <= n_terms + 1 or np.linalg.matrix_rank(typical, tol=1e-3) <= n_terms:
        return math.nan, math.nan
    without, with_own = runs.fit(terms, play_rad), runs.fit(terms, play_rad, sides)
    can = (with_own.n_free > 0) & runs.is_even
    if not can.any():
        return math.nan, math.nan
    n_more, n_free = 2 * int(can.sum()), int(with_own.n_free[can].sum())
    gain = float((without.chi2[can] - with_own.chi2[can]).sum()) / n_more
    left = max(float(with_own.chi2[can].sum()) / n_free, 1e-12)
    own = 2.0 * with_own.beta_rad[can, -1]
    errors = 4.0 * max(scatter2, 1.0) * np.trace(with_own.cov_rad2[can, -1, :, -1, :], axis1=1, axis2=2)
    rms = math.sqrt(max(float(np.mean(np.sum(own**2, axis=-1) - errors)), 0.0))
    return float(f_distribution.sf(gain / max(left, min(scatter2, 1.0)), n_more, n_free)), rms

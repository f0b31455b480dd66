"""Runs of the same telescope against each other: the scale of their responses, and whether the facets stood still.

A response is the facet's brightness in one camera over the star's in the other. Another camera, a cleaned lens or a new
calibration changes all responses of a run by one factor. The facets themselves tell it: all runs are fitted together,
and the logs of the factors are further parameters of that fit. Every facet adds what its records say about them when
its own parameters and each run's background are left free (the Schur complement of its normal equations), so that a
facet that was lit in one run only says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import mahalanobis

from namod_ctl.reconstruction.facet_fit import FacetFit, centre_covariance, response_scales, student_weight
from namod_ctl.reconstruction.facet_psf import CENTRE, evaluate
from namod_ctl.reconstruction.quality import has_signal, n_lit_records
from namod_ctl.reconstruction.responses import ResponseTable
from namod_ctl.reconstruction.robust import Family, fit_facets, fit_reflector

Array = NDArray[np.float64]

_MAX_STEPS = 5
_STEP_SIGMA = 0.3  # a smaller change than this of a factor's uncertainty ends the search
_MAX_LOG_STEP = 1.0
_START_FACTOR = 3.0  # from here on a ratio of the brightest responses is a better start than 1
_BACKGROUND_SIGMA = 0.1  # of a facet's scale: how much its background may change between runs
_MIN_CONTRAST = 5.0  # brightest over typical response: a run beside the light has none
_UNKNOWN_SIGMA = 0.3  # a log factor less certain than this is as good as unknown
_SIGNIFICANT_SIGMA, _SIGNIFICANT_SHARE = 3.0, 0.02
_MIN_LIT_MOVED = 10  # lit records in each run: with fewer, centres are ambiguous rather than uncertain
_MOVED_SIGMA = 5.0  # what a facet's model lacks may look like less
_MOVED_SIZES = 0.5  # of a facet's width: sag and temperature move facets by less


@dataclass(frozen=True, slots=True, eq=False)
class RunComparison:
    """A run beside the reference.

    Attributes
    ----------
    factor, factor_uncertainty
        Responses of the run over those of the reference; NaN when the two have too little light in common.
    n_compared
        Facets lit often enough in both runs to see whether they moved.
    moved_facet_ids
        Those whose centre is not where it is in the reference.
    """

    factor: float
    factor_uncertainty: float
    n_compared: int
    moved_facet_ids: tuple[int, ...]

    @property
    def is_factor_significant(self) -> bool:
        """True when the factor is not 1: by more than chance, and by more than cameras repeat."""
        distance = abs(self.factor - 1.0)
        return distance > _SIGNIFICANT_SIGMA * self.factor_uncertainty and distance > _SIGNIFICANT_SHARE


def compare_runs(
    table: ResponseTable, run_of_record: NDArray[np.int64], reference: int, expected_size_rad: float
) -> list[RunComparison]:
    """Every run beside the run `reference`, itself included.

    Parameters
    ----------
    table
        The records of all runs.
    run_of_record
        Shape (n_records,). Number of each record's run, from 0; every run has records.
    expected_size_rad
        See `robust.fit_reflector`.

    Raises
    ------
    DataQualityError
        See `robust.fit_reflector`.
    """
    runs = [table.select(run_of_record == run) for run in range(int(run_of_record.max()) + 1)]
    others = [run for run in range(len(runs)) if run != reference]
    log_factor, sigma = _first_log_factors(runs, reference), np.full(len(runs), np.nan)
    for _ in range(_MAX_STEPS):
        scale = np.exp(log_factor)[run_of_record][:, None]
        scaled = replace(table, response=table.response / scale)
        family, fits = fit_reflector(scaled, expected_size_rad)
        step, sigma[others] = _step(scaled, fits, run_of_record, others)
        log_factor[others] += np.clip(step, -_MAX_LOG_STEP, _MAX_LOG_STEP)
        if np.all(np.abs(step) < _STEP_SIGMA * sigma[others]):
            break
    is_known = sigma < _UNKNOWN_SIGMA
    is_known[reference], sigma[reference] = True, 0.0
    factor = np.where(is_known, np.exp(log_factor), np.nan)
    centres = [
        _Centres(replace(run, response=run.response / np.exp(log)), family)
        for run, log in zip(runs, np.where(is_known, log_factor, 0.0).tolist(), strict=True)
    ]
    size_rad = float(np.exp(family.log_size))
    comparisons = []
    for run in range(len(runs)):
        n_compared, moved = centres[run].moved_from(centres[reference], size_rad)
        comparisons.append(RunComparison(float(factor[run]), float(factor[run] * sigma[run]), n_compared, moved))
    return comparisons


def _first_log_factors(runs: list[ResponseTable], reference: int) -> Array:
    """Zero, unless the runs' brightest responses are so far apart that a fit of all together would make no sense."""
    logs = np.zeros(len(runs))
    scales = [response_scales(run.response) for run in runs]
    dark = [np.median(np.abs(np.nan_to_num(run.response)), axis=0) for run in runs]
    for run, scale in enumerate(scales):
        lit = (scale > _MIN_CONTRAST * dark[run]) & (scales[reference] > _MIN_CONTRAST * dark[reference])
        if lit.any():
            logs[run] = float(np.log(np.median(scale[lit]) / np.median(scales[reference][lit])))
    logs[np.abs(logs) < np.log(_START_FACTOR)] = 0.0
    return logs


def _step(
    table: ResponseTable, fits: list[FacetFit | None], run_of_record: NDArray[np.int64], others: list[int]
) -> tuple[Array, Array]:
    """Change of the log factors of the runs `others` that fits best, and their uncertainty."""
    information = np.diag(np.full(len(others), 1e-6))  # a run without a facet in common stays as it is
    gradient = np.zeros(len(others))
    of_facets, white = np.zeros_like(information), np.zeros_like(information)
    of_record = np.zeros((table.n_records, len(others)))
    for j, fit in enumerate(fits):
        if fit is None or not has_signal(fit, table, j):
            continue
        _, jacobian = evaluate(fit.parameters, table.theta_rad[fit.used])
        jacobian = fit.slope[:, None] * jacobian
        in_run = run_of_record[fit.used][:, None] == np.array(others)
        gain = (fit.slope * np.maximum(fit.light, 0.0))[:, None] * in_run
        weight = student_weight(fit.residual, fit.variance)
        # The scene is not the same on two nights: each run has a background of its own.
        free = np.concatenate([jacobian, fit.slope[:, None] * in_run], axis=1)
        curvature = (free.T * weight) @ free
        n_own = jacobian.shape[1]
        curvature[:n_own, :n_own] = np.linalg.inv(fit.covariance)  # with what is expected of the parameters
        curvature[range(n_own, len(curvature)), range(n_own, len(curvature))] += _BACKGROUND_SIGMA**-2
        share = np.linalg.solve(curvature, (free.T * weight) @ gain)
        # what of the factor's effect neither the facet's own parameters nor the backgrounds can take over
        left = gain - free @ share
        information += (gain.T * weight) @ left
        # at the mode the facet's own parameters have no gradient
        gradient += (gain - free[:, n_own:] @ share[n_own:]).T @ (weight * fit.residual)
        score = left * (weight * fit.residual)[:, None]
        of_facets += np.outer(score.sum(axis=0), score.sum(axis=0))
        of_record[fit.used] += score
        white += score.T @ score
    covariance = np.linalg.inv(information)
    step: Array = covariance @ gradient
    # Errors are common to a facet's records (its model) and to a record's facets (the star's scintillation): the
    # scatter of both kinds of sums tells, with what they share counted once.
    scatter = covariance @ (of_facets + of_record.T @ of_record - white) @ covariance
    sigma: Array = np.sqrt(np.maximum(np.diag(covariance), np.diag(scatter)))
    return step, sigma


class _Centres:
    """Fits of the facets that one run alone shows well, by column."""

    def __init__(self, table: ResponseTable, family: Family) -> None:
        self._facet_ids = table.facet_ids
        self._fits = {
            j: fit
            for j, fit in enumerate(fit_facets(table, family, np.arange(len(table.facet_ids))))
            if fit is not None
            and n_lit_records(fit, table.response[:, j]) >= _MIN_LIT_MOVED
            and has_signal(fit, table, j)
        }

    def moved_from(self, reference: _Centres, size_rad: float) -> tuple[int, tuple[int, ...]]:
        """How many facets can be compared, and the ids of those that stand elsewhere."""
        common = sorted(self._fits.keys() & reference._fits.keys())
        moved = []
        for j in common:
            here, there = self._fits[j], reference._fits[j]
            a, b = here.parameters[CENTRE], there.parameters[CENTRE]
            inverse = np.linalg.inv(centre_covariance(here) + centre_covariance(there))
            if np.linalg.norm(a - b) > _MOVED_SIZES * size_rad and mahalanobis(a, b, inverse) > _MOVED_SIGMA:
                moved.append(self._facet_ids[j])
        return len(common), tuple(moved)

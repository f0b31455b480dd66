"""Runs of the same telescope against each other: the scale of their responses, and whether the facets stood still.

A response is the facet's brightness in one camera over the star's in the other. Another camera, a cleaned lens or a new
calibration changes all responses of a run by one factor. The facets themselves tell it: all runs are fitted together,
and the logs of the factors are further parameters of that fit. Every facet adds what its records say about them when
its own parameters and each run's background are left free (the Schur complement of its normal equations), so that a
facet that was lit in one run only says nothing.

Whether it is the same mirror, the facets tell together, also where each was lit a few times only: by the median of
their distances from run to run in units of the joint errors. A few centres that a sparse run gets quite wrong do not
change a median, and errors that are too small by two only double it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import DataQualityError
from namod_ctl.reconstruction.facet_fit import FacetFit, centre_covariance, response_scales, student_weight
from namod_ctl.reconstruction.facet_psf import CENTRE, evaluate
from namod_ctl.reconstruction.quality import has_signal, n_lit_records
from namod_ctl.reconstruction.responses import ResponseTable
from namod_ctl.reconstruction.robust import fit_reflector
from namod_ctl.reconstruction.uncertainty import misfit_factors, repetition_factor

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
_OTHER_SIGMA = 4.0  # two runs of one mirror come to 1 and, with errors too small by two, to 2.4
_MIN_COMPARED = 5  # facets, or all of a small telescope: a median of fewer may be one of wrong centres


@dataclass(frozen=True, slots=True, eq=False)
class RunComparison:
    """A run beside the reference.

    Attributes
    ----------
    factor, factor_uncertainty
        Responses of the run over those of the reference; NaN when the two have too little light in common.
    n_compared
        Facets whose centre is known from either run.
    distance_rad
        Median of how far those stand from where they stand in the reference; NaN without any.
    is_other_mirror
        True when that cannot be chance: it is another telescope, or most facets were turned. None when too few could
        be compared.
    moved_facet_ids
        Facets lit often enough in both runs whose centre is not where it is in the reference.
    """

    factor: float
    factor_uncertainty: float
    n_compared: int
    distance_rad: float
    is_other_mirror: bool | None
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
    centres = [_Centres(run, expected_size_rad) for run in runs]  # they do not depend on the factors
    size_rad = float(np.exp(family.log_size))
    comparisons = []
    for run in range(len(runs)):
        there = centres[reference]
        distances_rad = centres[run].distances_rad(there)
        comparisons.append(
            RunComparison(
                factor=float(factor[run]),
                factor_uncertainty=float(factor[run] * sigma[run]),
                n_compared=len(distances_rad),
                distance_rad=float(np.median(distances_rad)) if len(distances_rad) else np.nan,
                is_other_mirror=centres[run].is_other_mirror(there, size_rad),
                moved_facet_ids=centres[run].moved_from(there, size_rad),
            )
        )
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
    """Fits of the facets that one run alone shows, by column."""

    def __init__(self, table: ResponseTable, expected_size_rad: float) -> None:
        self._table = table
        self._fits: dict[int, FacetFit] = {}
        try:
            self._family, fits = fit_reflector(table, expected_size_rad)
        except DataQualityError:  # too few records, or no light in them
            return
        factors = misfit_factors(fits)
        for j, fit in enumerate(fits):
            if fit is not None and has_signal(fit, table, j):
                self._fits[j] = fit
        self._covariances = {j: factors[j] * centre_covariance(fit) for j, fit in self._fits.items()}

    @cached_property
    def _repetition(self) -> float:
        """Dear, and needed only for runs that seem to differ."""
        return repetition_factor(self._table, self._family)

    def distances_rad(self, reference: _Centres) -> Array:
        """How far each facet that both runs show stands from where it is in the other, shape (n,)."""
        return np.array([np.linalg.norm(self._step(reference, j)) for j in self._common(reference)])

    def is_other_mirror(self, reference: _Centres, size_rad: float) -> bool | None:
        """See `RunComparison`."""
        common = self._common(reference)
        if len(common) < min(_MIN_COMPARED, len(self._table.facet_ids)):
            return None
        if np.median(self.distances_rad(reference)) <= _MOVED_SIZES * size_rad:
            return False
        return (
            self._median_sigma(reference, 1.0, 1.0) > _OTHER_SIGMA
            and self._median_sigma(reference, self._repetition, reference._repetition) > _OTHER_SIGMA
        )

    def moved_from(self, reference: _Centres, size_rad: float) -> tuple[int, ...]:
        """Ids of the facets that stand elsewhere, of those that are lit often in either run."""
        moved = []
        for j in self._common(reference):
            if min(self._n_lit(j), reference._n_lit(j)) < _MIN_LIT_MOVED:
                continue
            step = self._step(reference, j)
            joint = self._covariances[j] + reference._covariances[j]
            if np.linalg.norm(step) > _MOVED_SIZES * size_rad and _sigmas(step, joint) > _MOVED_SIGMA:
                moved.append(self._table.facet_ids[j])
        return tuple(moved)

    def _median_sigma(self, reference: _Centres, factor: float, reference_factor: float) -> float:
        return float(
            np.median(
                [
                    _sigmas(
                        self._step(reference, j),
                        factor * self._covariances[j] + reference_factor * reference._covariances[j],
                    )
                    for j in self._common(reference)
                ]
            )
        )

    def _common(self, reference: _Centres) -> list[int]:
        return sorted(self._fits.keys() & reference._fits.keys())

    def _step(self, reference: _Centres, j: int) -> Array:
        step: Array = self._fits[j].parameters[CENTRE] - reference._fits[j].parameters[CENTRE]
        return step

    def _n_lit(self, j: int) -> int:
        return n_lit_records(self._fits[j], self._table.response[:, j])


def _sigmas(step: Array, covariance: Array) -> float:
    """Length of a step in units of its error."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))

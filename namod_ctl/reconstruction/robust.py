"""The default estimator: all facets of a run fitted as one family.

Each facet gets its own centre, size, elongation and shape (`facet_psf`). What the facets have in common is learned from
the run itself and used as the expectation for every one of them: the noise of responses, the typical size and
its spread, the typical elongation, and how strong the shape terms of each order are (empirical Bayes). A facet
that was hit often is fitted by its own records; one that was hit five times leans on its family, and its
covariance says so.

The choice and its rivals: docs/decisions/0002-estimator.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.reconstruction.facet_fit import (
    STUDENT_NU,
    FacetFit,
    NoiseModel,
    Prior,
    fit_facet,
    response_scales,
    to_y,
)
from namod_ctl.reconstruction.facet_psf import (
    BACKGROUND,
    CENTRE,
    ELONGATION_1,
    ELONGATION_2,
    GRADIENT,
    LOG_FLUX,
    LOG_SIZE,
    N_BASIC,
    TERM_ORDER,
)
from namod_ctl.reconstruction.quality import has_signal
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

_N_LEARNING = 120  # facets from which the family is learned: enough for every common number to a few per cent
_N_LEARNING_PASSES = 4
_BACKGROUND = 0.1  # share of the scale: the unlit facet, and how much that may change over a window
_SIZE_RANGE = 4.0  # mirrors may be worse than traced, the camera's aperture adds to it; not more than this
_MIN_DARK_NOISE = 3e-4  # share of the scale; frames of few bits show exact zeros, which are not that certain
_WINDOW_SIGMA = 6.0  # records within this many typical widths of the centre speak for a facet
_MIN_RECORDS = 10  # a window with fewer is widened to the nearest
_N_CANDIDATES = 8  # bright records tried as a starting point
_N_STARTS = 3  # of these, the best supported ones that are fitted


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """What the facets of a run have in common.

    Attributes
    ----------
    log_flux, log_flux_sigma
        Log of the typical integral of a facet's normalized response over directions (rad^2), and its spread; None while
        unknown: then each facet's own scale is taken for its peak.
    log_size, log_size_sigma
        Log of the typical standard deviation per axis of a facet's point spread function (rad), and its spread.
    expected_log_size
        What the optics lead to expect of `log_size`.
    elongation_sigma
        Spread of each elongation parameter about zero.
    term_sigma
        Shape (n_terms,). Spread of the shape coefficients about zero.
    """

    noise: NoiseModel
    log_flux: float | None
    log_flux_sigma: float
    log_size: float
    log_size_sigma: float
    expected_log_size: float
    elongation_sigma: float
    term_sigma: Array

    def prior(self, scale: float, has_terms: bool) -> Prior:
        """Expectation of the parameters of a facet of that response scale; the centre is left free."""
        n = N_BASIC + (len(self.term_sigma) if has_terms else 0)
        mean, sigma = np.zeros(n), np.ones(n)
        own_flux = np.log(2.0 * np.pi) + 2.0 * self.log_size
        mean[LOG_FLUX] = own_flux if self.log_flux is None else self.log_flux - np.log(scale)
        sigma[LOG_FLUX] = self.log_flux_sigma
        mean[LOG_SIZE], sigma[LOG_SIZE] = self.log_size, self.log_size_sigma
        sigma[CENTRE] = 1.0  # rad: flat
        sigma[[ELONGATION_1, ELONGATION_2]] = self.elongation_sigma
        sigma[BACKGROUND] = _BACKGROUND
        sigma[GRADIENT] = _BACKGROUND / (_WINDOW_SIGMA * np.exp(self.log_size))
        sigma[N_BASIC:] = self.term_sigma[: n - N_BASIC]
        return Prior(mean, sigma)


def fit_reflector(
    table: ResponseTable, expected_size_rad: float, seed: int = 0
) -> tuple[Family, list[FacetFit | None]]:
    """The family of the run and the fit of every facet; None for a facet whose responses are all zero.

    `expected_size_rad` is the standard deviation per axis of a facet's light that its optics lead to expect; the
    typical size that is learned stays within a factor `_SIZE_RANGE` of it, so that a run without light can not be
    explained by very wide facets. `seed` chooses the facets from which the family is learned where there are more
    than enough.

    Raises
    ------
    DataQualityError
        Nothing responded at all, or all records point at one place.
    """
    if np.ptp(table.theta_rad, axis=0).max() < expected_size_rad:
        raise DataQualityError(
            f"all {table.n_records} records have the star at one place within "
            f"{rad_to_arcmin(expected_size_rad):.1f} arcmin: let the telescope wander around the star and record again"
        )
    scales = response_scales(table.response)
    live = _live(table, scales)
    if len(live) == 0:
        raise DataQualityError("no facet responded in any record: record again with the star in the field")
    tree = cKDTree(table.theta_rad)
    learning = live
    if len(live) > _N_LEARNING:
        learning = np.sort(np.random.default_rng(seed).choice(live, _N_LEARNING, replace=False))
    first_log_size = _first_log_size(table, learning, scales, expected_size_rad)
    family = _first_family(first_log_size, float(np.log(expected_size_rad)))
    fits = [_first_fit(table, tree, int(j), family, float(scales[j])) for j in learning]
    family = _learn(family, _lit(fits, table, learning))
    for _ in range(_N_LEARNING_PASSES - 1):
        fits = [_refit(table, tree, int(j), family, fit) for j, fit in zip(learning, fits, strict=True)]
        family = _learn(family, _lit(fits, table, learning))
    known = dict(zip(learning.tolist(), fits, strict=True))
    result: list[FacetFit | None] = [None] * len(table.facet_ids)
    for j in live.tolist():
        first = known.get(j) or _first_fit(table, tree, j, family, float(scales[j]))
        result[j] = _refit(table, tree, j, family, first)
    return family, result


def fit_facets(table: ResponseTable, family: Family, facets: NDArray[np.int64]) -> list[FacetFit | None]:
    """Fits of the chosen facets (columns of the table) from scratch, in a family that is already known."""
    scales = response_scales(table.response)
    live = set(_live(table, scales).tolist())
    tree = cKDTree(table.theta_rad)
    result: list[FacetFit | None] = []
    for j in facets.tolist():
        if j not in live:
            result.append(None)
            continue
        fit = _first_fit(table, tree, j, family, float(scales[j]))
        result.append(_refit(table, tree, j, family, _refit(table, tree, j, family, fit)))
    return result


def _live(table: ResponseTable, scales: Array) -> NDArray[np.int64]:
    """Columns of the facets that responded at least once."""
    return np.flatnonzero((scales > 0.0) & (np.nan_to_num(table.response).max(axis=0) > 0.0))


def _lit(fits: list[FacetFit], table: ResponseTable, columns: NDArray[np.int64]) -> list[FacetFit]:
    """The fits of facets that show light: the others have nothing to teach about point spread functions."""
    return [fit for fit, j in zip(fits, columns.tolist(), strict=True) if has_signal(fit, table, j)]


def _first_family(log_size: float, expected_log_size: float) -> Family:
    """Wide expectations to begin with; only the size is taken from the data."""
    term_sigma = 0.25 * 0.7 ** (TERM_ORDER - 3.0)
    noise = NoiseModel(dark=0.01, shot=0.1, relative=0.2)
    return Family(noise, None, 1.0, log_size, 0.5, expected_log_size, 0.25, term_sigma)


def _first_log_size(table: ResponseTable, facets: NDArray[np.int64], scales: Array, expected_size_rad: float) -> float:
    """Log of a first guess of the typical width: scatter of the directions in which each facet was bright."""
    log_sizes = []
    for j in facets:
        response = np.nan_to_num(table.response[:, j])
        bright = np.flatnonzero(response > 0.25 * min(scales[j], np.max(response)))
        spread = table.theta_rad[bright] - np.median(table.theta_rad[bright], axis=0)
        width = 1.4826 * np.median(np.abs(spread))  # MAD of both axes together
        if len(bright) >= 3 and width > 0.0:
            log_sizes.append(np.log(width))
    expected = float(np.log(expected_size_rad))
    return _near(float(np.median(log_sizes)), expected) if log_sizes else expected


def _near(log_size: float, expected_log_size: float) -> float:
    """`log_size` kept within the range that the optics allow."""
    reach = np.log(_SIZE_RANGE)
    return float(np.clip(log_size, expected_log_size - reach, expected_log_size + reach))


def _window(tree: cKDTree, response: Array, centre_rad: Array, log_size: float) -> NDArray[np.int64]:
    """Measured records within the window of a facet."""
    near = np.array(sorted(tree.query_ball_point(centre_rad, _WINDOW_SIGMA * np.exp(log_size))), dtype=np.int64)
    window: NDArray[np.int64] = near[np.isfinite(response[near])] if len(near) else near
    return window


def _nearest(tree: cKDTree, response: Array, centre_rad: Array) -> NDArray[np.int64]:
    """The measured records closest to a facet that ran out of the scan."""
    distance = np.where(np.isfinite(response), np.linalg.norm(tree.data - centre_rad, axis=1), np.inf)
    nearest: NDArray[np.int64] = np.argsort(distance)[:_MIN_RECORDS]
    return nearest


def _first_fit(table: ResponseTable, tree: cKDTree, facet: int, family: Family, scale: float) -> FacetFit:
    """The best plain gaussian from several starting points.

    A bright record far from every other bright record (a wrong star) is a poor starting point: candidates are
    ranked by how bright their neighbourhood is, and the fits by how much of ALL bright responses they explain.
    """
    response = table.response[:, facet]
    y = to_y(np.nan_to_num(response) / scale)
    y -= y.min()
    size = float(np.exp(family.log_size))
    candidates = np.argsort(-np.nan_to_num(response))[:_N_CANDIDATES]
    support = []
    for k in candidates:
        near = tree.query_ball_point(table.theta_rad[k], 2.0 * size)
        # the sum of a few dark neighbours is kept in the mean, so lonely records lose
        support.append(y[near].sum() / (len(near) + 3.0))
    starts: list[int] = []
    for k in candidates[np.argsort(-np.array(support))]:
        if all(np.linalg.norm(table.theta_rad[k] - table.theta_rad[other]) > size for other in starts):
            starts.append(int(k))
    prior = family.prior(scale, has_terms=False)
    best: FacetFit | None = None
    for k in starts[:_N_STARTS]:
        start = prior.mean.copy()
        start[CENTRE] = table.theta_rad[k]
        used = _window(tree, response, table.theta_rad[k], family.log_size)
        fit = fit_facet(table.theta_rad, response, table.faintness, scale, used, start, prior, family.noise)
        if best is None or _explained(fit, y) > _explained(best, y):
            best = fit
    assert best is not None  # a facet with a positive scale has at least one bright record
    return best


def _explained(fit: FacetFit, y: Array) -> float:
    """How much of the brightness of the records a fit accounts for, minus what it claims and is not there."""
    return float(np.abs(y[fit.used]).sum() - np.abs(fit.residual).sum())


def _refit(table: ResponseTable, tree: cKDTree, facet: int, family: Family, last: FacetFit) -> FacetFit:
    """The fit with all shape terms, starting from the last one."""
    response = table.response[:, facet]
    prior = family.prior(last.scale, has_terms=True)
    start = prior.mean.copy()
    start[: len(last.parameters)] = last.parameters
    used = _window(tree, response, last.parameters[CENTRE], family.log_size)
    if len(used) < _MIN_RECORDS:
        used = _nearest(tree, response, last.parameters[CENTRE])
    return fit_facet(table.theta_rad, response, table.faintness, last.scale, used, start, prior, family.noise)


def _learn(family: Family, facets: list[FacetFit]) -> Family:
    """The family as its facets show it: every spread is that of the estimates plus their own uncertainty."""
    if len(facets) < 3:
        return family
    parameters = np.array([fit.parameters for fit in facets])
    parameters[:, LOG_FLUX] += np.log([fit.scale for fit in facets])
    variances = np.array([np.diag(fit.covariance) for fit in facets])

    def spread(columns: object, mean: float = 0.0) -> float:
        square = (parameters[:, columns] - mean) ** 2 + variances[:, columns]  # type: ignore[index]
        return float(np.sqrt(np.mean(square)))

    log_size = _near(float(np.median(parameters[:, LOG_SIZE])), family.expected_log_size)
    term_sigma = family.term_sigma.copy()
    if parameters.shape[1] > N_BASIC:
        for order in np.unique(TERM_ORDER):
            columns = np.flatnonzero(order == TERM_ORDER)
            term_sigma[columns] = np.clip(spread(N_BASIC + columns), 0.01, 0.4)
    log_flux = float(np.median(parameters[:, LOG_FLUX]))
    return Family(
        _learn_noise(family.noise, facets),
        log_flux,
        float(np.clip(spread(LOG_FLUX, log_flux), 0.1, 1.0)),
        log_size,
        float(np.clip(spread(LOG_SIZE, log_size), 0.05, 0.5)),
        family.expected_log_size,
        float(np.clip(spread([ELONGATION_1, ELONGATION_2]), 0.05, 0.4)),
        term_sigma,
    )


def _learn_noise(noise: NoiseModel, facets: list[FacetFit]) -> NoiseModel:
    """The three noise terms that make the residuals of all facets most probable.

    What a fit has absorbed of its own noise (the leverage) is given back, so that few records and many
    parameters do not look like little noise.
    """
    residual = np.concatenate([fit.residual for fit in facets])
    light = np.maximum(np.concatenate([fit.light for fit in facets]), 0.0)
    slope2 = np.concatenate([fit.slope for fit in facets]) ** 2
    freedom = 1.0 - np.concatenate([fit.leverage for fit in facets])
    faintness = np.concatenate([fit.faintness for fit in facets])
    square = residual**2 / freedom
    first = np.log([0.01, 0.05, 0.1])

    def loss(log_terms: Array) -> float:
        variance = slope2 * NoiseModel(*np.exp(log_terms)).variance(light, faintness)
        student = 0.5 * np.log(variance) + 0.5 * (STUDENT_NU + 1.0) * np.log1p(square / (STUDENT_NU * variance))
        # a weak pull (a factor e^2) keeps a term finite that the data does not ask for
        return float((freedom * student).sum() + 0.125 * ((log_terms - first) ** 2).sum())

    start = np.log([noise.dark, noise.shot, noise.relative])
    found = minimize(loss, start, method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.1})
    dark, shot, relative = np.exp(found.x).tolist()
    return NoiseModel(max(dark, _MIN_DARK_NOISE), shot, relative)

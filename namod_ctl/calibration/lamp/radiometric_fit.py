"""The radiometric law fitted to responses, with an honest covariance.

What is known of a lamp is its nominal intensity; what it really gives differs by an error common to a whole placement,
by its drift, and by flicker. So the errors are in the intensity as well as in the response. The response is an outcome
of the true light: regressing the intensity on the measured response would bend the law. The equations of the fit are
therefore formed with the response that the law predicts for the nominal light (the method of instrumental variables),
which makes them those of a regression of the response on what is known, for straight and for curved laws.

Variances of placements and visits are found by restricted maximum likelihood, from the data themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import stdtrit

Array = NDArray[np.float64]

ASSUMED_PLACEMENT_DEX = float(np.log10(1.01))
"""Error of a placement's level where there are too few placements to see it."""

MIN_PLACEMENTS_TO_TELL = 4
UNSEEN_SHARE = 0.25
"""Errors of placements below this share of the error with which a placement is seen are never excluded by the data."""

RELATIVE_STEP = 0.01
LEAST_FREEDOM = 4.0
N_ITERATIONS = 5
LOG_DEX_RANGE = (-5.0, 0.0)
GRID_LOG_DEX = (-4.5, -3.7, -3.0, -2.4, -1.8, -1.2)
UNTUNED = 1e-4
"""Change of a term after which the deviations are sought anew."""

SETTLED = 1e-6
"""Change of a term that is no change: standard errors are a hundred times as large at the least."""

TWO_SIGMA = 0.97725
"""Share of a normal distribution below two standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class LampData:
    """What a fit needs of visits, arrays of shape (n,); logarithms are decadic.

    Attributes
    ----------
    placement
        Number of the stand of the lamp, from 0.
    variance
        Of `log_share`.
    lever_per_adu
        Change of `log_share` per adu of error of the dark level, which is known within `dark_uncertainty_adu`.
    time
        From -0.5 to 0.5.
    placement_scale
        How large errors of a visit's placement are against those of others; one number for each placement.
    dex_per_m
        Change of log10 of the light with the distance; 0 where levels were given as such.
    """

    log_share: Array
    log_exposure: Array
    log_level: Array
    placement: NDArray[np.intp]
    variance: Array
    lever_per_adu: Array
    dark_uncertainty_adu: float
    time: Array
    placement_scale: Array
    dex_per_m: Array

    def only(self, is_kept: NDArray[np.bool_]) -> LampData:
        """The data of some visits; placements without any are closed up."""
        _, placement = np.unique(self.placement[is_kept], return_inverse=True)
        return LampData(
            self.log_share[is_kept],
            self.log_exposure[is_kept],
            self.log_level[is_kept],
            placement.astype(np.intp),
            self.variance[is_kept],
            self.lever_per_adu[is_kept],
            self.dark_uncertainty_adu,
            self.time[is_kept],
            self.placement_scale[is_kept],
            self.dex_per_m[is_kept],
        )


@dataclass(frozen=True, slots=True)
class LawForm:
    """Which terms the fit has beside r_resp, r_expo and r_const."""

    is_curved: bool = False
    drift_degree: int = 1
    has_offset: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class LawFit:
    """A fitted law.

    Attributes
    ----------
    parameters, covariance
        Shapes (4,) and (4, 4): r_resp, r_expo, r_const, r_curve; 0 for what is not fitted. Standard errors are such
        that the truth lies within two of them with 95 %, which accounts for how few placements there are.
    drift_dex
        Shape (drift_degree,): growth of log10 of the lamp's light over the series, by powers of `LampData.time`.
    drift_error_dex
        Their standard errors.
    offset_m, offset_error_m
        What all distances are to be increased by, and its standard error; 0 where it is not fitted.
    visit_dex, placement_dex
        Standard deviations of log10 of the intensity of a visit and of a placement, beyond what the frames show.
    placement_error_dex
        Shape (n_placements,): how far each placement's light is from what its level says.
    residual_dex
        Shape (n,): log10 of the intensity by the law less the nominal one, drift and placement errors taken off.
    log_likelihood, restricted_log_likelihood
        Of the data: for comparison of forms, and of scales of placements.
    """

    form: LawForm
    parameters: Array
    covariance: Array
    drift_dex: Array
    drift_error_dex: Array
    offset_m: float
    offset_error_m: float
    visit_dex: float
    placement_dex: float
    placement_error_dex: Array
    residual_dex: Array
    standardized: Array
    log_likelihood: float
    restricted_log_likelihood: float
    n_terms: int

    @property
    def bic(self) -> float:
        """Bayesian information criterion: less is better."""
        return -2.0 * self.log_likelihood + self.n_terms * float(np.log(len(self.residual_dex)))

    def log_intensity(self, log_share: Array, log_exposure: Array) -> Array:
        """log10 of the intensity by the law."""
        r_resp, r_expo, r_const, r_curve = self.parameters
        value: Array = (r_resp + r_curve * log_share) * log_share + r_expo * log_exposure + r_const
        return value

    def intensity_error_dex(self, log_share: Array, log_exposure: Array) -> Array:
        """Standard error of `log_intensity` by the law's covariance, of the arguments' shape."""
        terms = np.stack([log_share, log_exposure, np.ones_like(log_share), log_share**2], axis=-1)
        error: Array = np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", terms, self.covariance, terms), 0.0))
        return error


def fit_law(data: LampData, form: LawForm) -> LawFit:
    """The law that fits the visits best; needs more visits than terms and two levels."""
    problem = _Problem(data, form)
    theta = _start(data, form)
    moved = np.inf
    for _ in range(N_ITERATIONS):
        problem.predict_by(theta)
        if moved > UNTUNED:
            deviations = problem.likeliest_deviations()
        new, _ = problem.solve(deviations)
        moved = float(np.abs(new - theta).max())
        theta = new
        if moved < SETTLED:
            break
    problem.predict_by(theta)
    return problem.judged(deviations)


def fit_law_of_any_scale(data: LampData, form: LawForm, scales: Sequence[Array], odds: Sequence[float]) -> LawFit:
    """The law where nobody knows how errors of placements compare with one another.

    The average of the fits for each of `scales` (shape (n_visits,) each), weighted by their restricted likelihoods and
    by the `odds` they had before; the covariance holds how they differ too. All else is that of the likeliest fit.
    """
    fits = [fit_law(replace(data, placement_scale=scale / float(np.sqrt(np.mean(scale**2)))), form) for scale in scales]
    log_likelihood = np.array([fit.restricted_log_likelihood for fit in fits])
    weight = np.exp(log_likelihood - log_likelihood.max()) * np.array(odds)
    weight /= weight.sum()
    parameters = np.array([fit.parameters for fit in fits])
    mean = weight @ parameters
    away = parameters - mean
    covariance = np.einsum("k,kij->ij", weight, np.array([fit.covariance for fit in fits]))
    covariance += np.einsum("k,ki,kj->ij", weight, away, away)
    return replace(fits[int(np.argmax(weight))], parameters=mean, covariance=covariance)


def _start(data: LampData, form: LawForm) -> Array:
    """A straight law by plain least squares of the response on what is known."""
    design = np.stack([data.log_level, data.log_exposure, np.ones_like(data.log_level)], axis=1)
    (a, b, c), *_ = np.linalg.lstsq(design, data.log_share, rcond=None)
    a = max(float(a), 1e-2)
    theta = np.zeros(3 + form.is_curved + form.drift_degree + form.has_offset)
    theta[:3] = 1.0 / a, -b / a, -c / a
    return theta


class _Problem:
    """The equations of one fit. Terms are r_resp, r_expo, r_const, [r_curve], drift by powers of the time, [offset]."""

    def __init__(self, data: LampData, form: LawForm) -> None:
        self.data, self.form = data, form
        self.n_placements = int(data.placement.max()) + 1
        self.is_placement_known = self.n_placements >= MIN_PLACEMENTS_TO_TELL
        drift = [-(data.time ** (power + 1)) for power in range(form.drift_degree)]
        self.fixed = [data.log_exposure, np.ones_like(data.log_share)]
        self.lamp = drift + ([-data.dex_per_m] if form.has_offset else [])
        self.terms = self._design(data.log_share)
        belongs = (data.placement[:, None] == np.arange(self.n_placements)).astype(np.float64)
        self.membership = belongs * data.placement_scale[:, None]
        self.placement_scale = self.membership.max(axis=0)

    def _design(self, log_share: Array) -> Array:
        curve = [log_share**2] if self.form.is_curved else []
        return np.stack([log_share, *self.fixed, *curve, *self.lamp], axis=1)

    def predict_by(self, theta: Array) -> None:
        """Take the responses that this law predicts for the nominal light as instruments."""
        known = self.data.log_level - self.terms[:, 1:3] @ theta[1:3]
        first_drift = 3 + self.form.is_curved
        if self.lamp:
            known = known - self.terms[:, first_drift:] @ theta[first_drift:]
        curve = theta[3] if self.form.is_curved else 0.0
        root = np.sqrt(np.maximum(theta[0] ** 2 + 4.0 * curve * known, 1e-6))
        predicted = 2.0 * known / np.maximum(theta[0] + root, 1e-2)
        self.instruments = self._design(predicted)
        self.slope = np.maximum(theta[0] + 2.0 * curve * predicted, 0.05)
        self.lever = (self.slope * self.data.lever_per_adu)[:, None]
        self.common = np.hstack([self.membership, self.lever])

    def _inverse(self, deviations: Array) -> tuple[Array, Array, float]:
        """1 / D, the inverse of the small matrix of Woodbury's formula, and log det of the covariance V = D + U S
        U'."""
        visit, placement = float(deviations[0]), float(deviations[1])
        weight = 1.0 / (self.slope**2 * self.data.variance + visit**2)
        variance = np.append(np.full(self.n_placements, max(placement, 1e-9) ** 2), 0.0)
        variance[-1] = max(self.data.dark_uncertainty_adu, 1e-9) ** 2
        small = np.diag(1.0 / variance) + self.common.T @ (weight[:, None] * self.common)
        _, log_det_small = np.linalg.slogdet(small)
        log_det = log_det_small + float(np.log(variance).sum()) - float(np.log(weight).sum())
        return weight, np.linalg.inv(small), log_det

    def _apply(self, weight: Array, small: Array, right: Array) -> Array:
        """V^-1 times columns."""
        weighted = weight[:, None] * right
        result: Array = weighted - weight[:, None] * (self.common @ (small @ (self.common.T @ weighted)))
        return result

    def solve(self, deviations: Array) -> tuple[Array, Array]:
        """Terms and their covariance for these deviations of visits and placements."""
        weight, small, _ = self._inverse(deviations)
        applied = self._apply(weight, small, self.instruments)
        left = np.linalg.inv(applied.T @ self.terms)
        theta = left @ (applied.T @ self.data.log_level)
        cov = left @ (applied.T @ self.instruments) @ left.T
        return theta, cov

    def _minus_log_likelihood(self, deviations: Array, *, is_restricted: bool) -> float:
        weight, small, log_det = self._inverse(deviations)
        applied = self._apply(weight, small, self.instruments)
        inner = applied.T @ self.instruments
        theta = np.linalg.solve(applied.T @ self.terms, applied.T @ self.data.log_level)
        residual = self.data.log_level - self.terms @ theta
        chi2 = float(residual @ self._apply(weight, small, residual[:, None])[:, 0])
        determinant = float(np.linalg.slogdet(inner)[1]) if is_restricted else 0.0
        return 0.5 * (log_det + determinant + chi2)

    def likeliest_deviations(self) -> Array:
        """Deviations of visits and placements, in dex, by restricted maximum likelihood."""
        n_free = 2 if self.is_placement_known else 1
        given = np.array([ASSUMED_PLACEMENT_DEX])[: 2 - n_free]

        def target(logs: Array) -> float:
            return self._minus_log_likelihood(np.append(10.0**logs, given), is_restricted=True)

        # From a wrong start the first step of a search is so long that it never comes back: so a grid comes first.
        starts = [np.array(start) for start in product(GRID_LOG_DEX, repeat=n_free)]
        found = minimize(target, min(starts, key=target), method="L-BFGS-B", bounds=[LOG_DEX_RANGE] * n_free)
        deviations = np.append(10.0**found.x, given)
        weight, _, _ = self._inverse(deviations)
        seen_dex = (self.n_placements / float(weight.sum())) ** 0.5
        deviations[1] = max(deviations[1], UNSEEN_SHARE * seen_dex)
        return deviations

    def judged(self, deviations: Array) -> LawFit:
        """The fit with everything that is said of it."""
        theta, cov = self.solve(deviations)
        scale = self._two_sigma_factors(deviations, cov)
        cov = cov * np.outer(scale, scale)
        first_drift = 3 + self.form.is_curved
        after_drift = first_drift + self.form.drift_degree
        parameters, covariance = np.zeros(4), np.zeros((4, 4))
        parameters[:first_drift] = theta[:first_drift]
        covariance[:first_drift, :first_drift] = cov[:first_drift, :first_drift]
        weight, small, _ = self._inverse(deviations)
        whole = self.terms @ theta - self.data.log_level
        best = self._apply(weight, small, whole[:, None])[:, 0]
        effect = deviations[1] ** 2 * (self.membership.T @ best)
        dark_error = self.data.dark_uncertainty_adu**2 * float(self.lever[:, 0] @ best)
        residual = whole - self.membership @ effect - self.lever[:, 0] * dark_error
        return LawFit(
            form=self.form,
            parameters=parameters,
            covariance=covariance,
            drift_dex=theta[first_drift:after_drift],
            drift_error_dex=np.sqrt(np.diag(cov)[first_drift:after_drift]),
            offset_m=float(theta[-1]) if self.form.has_offset else 0.0,
            offset_error_m=float(cov[-1, -1] ** 0.5) if self.form.has_offset else 0.0,
            visit_dex=float(deviations[0]),
            placement_dex=float(deviations[1]),
            placement_error_dex=-effect * self.placement_scale,
            residual_dex=residual,
            standardized=residual * np.sqrt(weight),
            log_likelihood=-self._minus_log_likelihood(deviations, is_restricted=False),
            restricted_log_likelihood=-self._minus_log_likelihood(deviations, is_restricted=True),
            n_terms=len(theta),
        )

    def _two_sigma_factors(self, deviations: Array, cov: Array) -> Array:
        """By how much two standard errors must be widened, term by term, as their own size is estimated too.

        Student's quantile for the degrees of freedom that Satterthwaite's formula gives from the information that the
        data hold on the two variances (Giesbrecht and Burns 1985, Biometrics 41, 477).
        """
        variances = deviations**2
        n_free = 2 if self.is_placement_known else 1
        gradient = np.zeros((n_free, len(cov)))
        for i in range(n_free):
            step = np.zeros(2)
            step[i] = RELATIVE_STEP * variances[i]
            _, beyond = self.solve(np.sqrt(variances + step))
            _, before = self.solve(np.sqrt(variances - step))
            gradient[i] = np.diag(beyond - before) / (2.0 * step[i])
        weight, small, _ = self._inverse(deviations)
        inverse = self._apply(weight, small, np.eye(len(self.data.log_share)))
        applied = inverse @ self.instruments
        projected = inverse - applied @ np.linalg.solve(self.instruments.T @ applied, applied.T)
        of_placements = projected @ self.membership
        information = np.empty((2, 2))
        information[0, 0] = np.sum(projected**2)
        information[0, 1] = information[1, 0] = np.sum(of_placements**2)
        information[1, 1] = np.sum((self.membership.T @ of_placements) ** 2)
        scatter = np.linalg.inv(0.5 * information[:n_free, :n_free])
        spread = np.einsum("in,ij,jn->n", gradient, scatter, gradient)
        freedom = np.maximum(2.0 * np.diag(cov) ** 2 / np.maximum(spread, 1e-300), LEAST_FREEDOM)
        factor: Array = stdtrit(freedom, TWO_SIGMA) / 2.0
        return factor

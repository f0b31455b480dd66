"""The radiometric law fitted to responses, with an honest covariance.

What is known of a lamp is its nominal intensity; what it really gives differs by an error common to a whole placement,
by its drift, and by flicker. So the errors are in the intensity as well as in the response. The response is an outcome
of the true light: regressing the intensity on the measured response would bend the law. The equations of the fit are
therefore formed with the response that the law predicts for the nominal light (the method of instrumental variables),
which makes them those of a regression of the response on what is known, for straight and for curved laws.

Variances of placements and visits are found by restricted maximum likelihood, from the data themselves. Distances err
alike in metres, levels alike in their share of the light; what was set by distances errs in its share as well where the
data show it. How well distances are known the person says: each alone errs by no more, which the data tell, and all of
them together by as much, which hardly shows in a series.
"""

from __future__ import annotations

from dataclasses import dataclass
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
LEAST_VARIANCE = 1e-18
N_ITERATIONS = 5
LOG_DEX_RANGE = (-5.0, 0.0)
GRID_LOG_DEX = (-4.5, -3.7, -3.0, -2.4, -1.8, -1.2)
BOTH_GAIN = 1.0
"""By so much must log likelihood grow for a variance of shares beside that of metres (Akaike's criterion)."""

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
    dex_per_m
        Change of log10 of the light with the distance, one number for each placement; 0 where levels were given.
    distance_error_m
        Standard deviation of an error that all distances have in common, and the largest one of their own errors.
    """

    log_share: Array
    log_exposure: Array
    log_level: Array
    placement: NDArray[np.intp]
    variance: Array
    lever_per_adu: Array
    dark_uncertainty_adu: float
    time: Array
    dex_per_m: Array
    distance_error_m: float = 0.0

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
            self.dex_per_m[is_kept],
            self.distance_error_m,
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
        Standard deviations of log10 of the intensity of a visit and of a placement (root mean square of all of them),
        beyond what the frames show.
    placement_error_dex
        Shape (n_placements,): how far each placement's light is from what its level says.
    residual_dex
        Shape (n,): log10 of the intensity by the law less the nominal one, drift and placement errors taken off.
    log_likelihood
        Of the data: for comparison of forms.
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
        self.membership = (data.placement[:, None] == np.arange(self.n_placements)).astype(np.float64)
        per_m = np.array([np.abs(data.dex_per_m[data.placement == i]).max() for i in range(self.n_placements)])
        root_mean_square = float(np.sqrt(np.mean(per_m**2)))
        # Shape (2, n_placements): a placement's variance by that of shares, and by that of metres.
        alike_in_metres = (per_m / root_mean_square) ** 2 if root_mean_square else np.zeros_like(per_m)
        self.shares = np.stack([np.ones_like(per_m), alike_in_metres])
        largest_dex = data.distance_error_m * root_mean_square
        self.is_set_by_distance = largest_dex > 10.0 ** LOG_DEX_RANGE[0]
        largest_log_dex = min(float(np.log10(largest_dex)), LOG_DEX_RANGE[1]) if self.is_set_by_distance else 0.0
        self.bounds = np.array([LOG_DEX_RANGE, LOG_DEX_RANGE, (LOG_DEX_RANGE[0], largest_log_dex)])
        self.is_free = np.array([True, False, False])
        self.offset_error_m = 0.0 if form.has_offset else data.distance_error_m

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
        self.common = np.hstack([self.membership, self.lever, self.data.dex_per_m[:, None]])

    def _common_variance(self, deviations: Array) -> Array:
        """Of the errors that visits have in common: of each placement, of the dark level, of all distances."""
        known = np.array([self.data.dark_uncertainty_adu, self.offset_error_m]) ** 2
        variance: Array = np.maximum(np.append(deviations[1:] ** 2 @ self.shares, known), LEAST_VARIANCE)
        return variance

    def _inverse(self, deviations: Array) -> tuple[Array, Array, float]:
        """1 / D, the inverse of the small matrix of Woodbury's formula, and log det of the covariance V = D + U S
        U'."""
        weight = 1.0 / (self.slope**2 * self.data.variance + float(deviations[0]) ** 2)
        variance = self._common_variance(deviations)
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
        """Deviations of visits, and of placements in share and in metres, in dex; `is_free` says which are sought."""
        if not self.is_placement_known:
            return self._likeliest((True, False, False), np.array([0.0, ASSUMED_PLACEMENT_DEX, 0.0]))[0]
        alone = (True, not self.is_set_by_distance, self.is_set_by_distance)
        deviations, least = self._likeliest(alone, np.zeros(3))
        if self.is_set_by_distance:
            both, further = self._likeliest((True, True, True), deviations)
            if further < least - BOTH_GAIN:
                deviations = both
            else:
                self.is_free = np.array(alone)
        weight, _, _ = self._inverse(deviations)
        seen_dex = (self.n_placements / float(weight.sum())) ** 0.5
        missing = (UNSEEN_SHARE * seen_dex) ** 2 - self._placement_variance(deviations)
        last = int(np.flatnonzero(self.is_free)[-1])
        deviations[last] = (deviations[last] ** 2 + max(missing, 0.0)) ** 0.5
        return deviations

    def _likeliest(self, is_free: tuple[bool, bool, bool], start: Array) -> tuple[Array, float]:
        """Deviations, by restricted maximum likelihood, and minus the logarithm of that."""
        self.is_free = np.array(is_free)

        def completed(logs: Array) -> Array:
            deviations = start.copy()
            deviations[self.is_free] = 10.0**logs
            return deviations

        def target(logs: Array) -> float:
            return self._minus_log_likelihood(completed(logs), is_restricted=True)

        # From a wrong start the first step of a search is so long that it never comes back: so a grid comes first.
        grids = [
            GRID_LOG_DEX if free and not old else (float(np.log10(old or 1.0)),)
            for free, old in zip(is_free, start, strict=True)
        ]
        bounds = self.bounds[self.is_free]
        starts = [np.clip(np.array(one)[self.is_free], *bounds.T) for one in product(*grids)]
        found = minimize(target, min(starts, key=target), method="L-BFGS-B", bounds=bounds)
        return completed(found.x), float(found.fun)

    def _placement_variance(self, deviations: Array) -> float:
        return float(np.mean(deviations[1:] ** 2 @ self.shares))

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
        effect = self._common_variance(deviations) * (self.common.T @ best)
        residual = whole - self.common @ effect
        return LawFit(
            form=self.form,
            parameters=parameters,
            covariance=covariance,
            drift_dex=theta[first_drift:after_drift],
            drift_error_dex=np.sqrt(np.diag(cov)[first_drift:after_drift]),
            offset_m=float(theta[-1]) if self.form.has_offset else 0.0,
            offset_error_m=float(cov[-1, -1] ** 0.5) if self.form.has_offset else 0.0,
            visit_dex=float(deviations[0]),
            placement_dex=self._placement_variance(deviations) ** 0.5,
            placement_error_dex=-effect[: self.n_placements],
            residual_dex=residual,
            standardized=residual * np.sqrt(weight),
            log_likelihood=-self._minus_log_likelihood(deviations, is_restricted=False),
            n_terms=len(theta),
        )

    def _two_sigma_factors(self, deviations: Array, cov: Array) -> Array:
        """By how much two standard errors must be widened, term by term, as their own size is estimated too.

        Student's quantile for the degrees of freedom that Satterthwaite's formula gives from the information that the
        data hold on the two variances (Giesbrecht and Burns 1985, Biometrics 41, 477).
        """
        variances = np.maximum(deviations**2, LEAST_VARIANCE)
        free = np.flatnonzero(self.is_free)
        gradient = np.zeros((len(free), len(cov)))
        for i, number in enumerate(free):
            step = np.zeros(len(variances))
            step[number] = RELATIVE_STEP * variances[number]
            _, beyond = self.solve(np.sqrt(variances + step))
            _, before = self.solve(np.sqrt(variances - step))
            gradient[i] = np.diag(beyond - before) / (2.0 * step[number])
        weight, small, _ = self._inverse(deviations)
        inverse = self._apply(weight, small, np.eye(len(self.data.log_share)))
        applied = inverse @ self.instruments
        projected = inverse - applied @ np.linalg.solve(self.instruments.T @ applied, applied.T)
        # Derivatives of the covariance by the variances, as factors A of A A'.
        factors = [np.eye(len(projected)), *(self.membership * np.sqrt(share) for share in self.shares)]
        factors = [factors[number] for number in free]
        information = np.array([[np.sum((one.T @ projected @ other) ** 2) for other in factors] for one in factors])
        scatter = np.linalg.pinv(0.5 * information)
        spread = np.einsum("in,ij,jn->n", gradient, scatter, gradient)
        freedom = np.maximum(2.0 * np.diag(cov) ** 2 / np.maximum(spread, 1e-300), LEAST_FREEDOM)
        factor: Array = stdtrit(freedom, TWO_SIGMA) / 2.0
        return factor

"""The fit of one facet: maximum a posteriori with a heavy-tailed likelihood, by damped Gauss-Newton steps.

Responses are compared as y = (R / scale + EPSILON)^POWER / POWER. A response carries noise that grows with it
(scintillation, the star camera, pixels of the facet), and a power between the square root (shot noise) and the
logarithm makes bright and faint records speak with the weight they deserve and keeps the errors symmetric.
The noise itself is measured on the run (`NoiseModel`); its distribution is Student's t, so single bad responses lose
their weight gradually.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.facet_psf import (
    BACKGROUND,
    CENTRE,
    ELONGATION_1,
    ELONGATION_2,
    GRADIENT_Y,
    background_of,
    evaluate,
)

Array = NDArray[np.float64]

POWER = 0.25
EPSILON = 0.02  # responses below this share of the facet's scale are "dark" and differ by noise only
STUDENT_NU = 4.0  # heavy enough for field data, still 90 % efficient on gaussian noise
_MAX_ELONGATION = 1.2  # axis ratio exp(2 * 1.2) = 11: beyond, a "facet" is a streak
_MAX_STEPS = 40
_SCALE_RANGE = 1000.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Variance of a facet's response, in units of its scale.

    It is (dark * faintness)^2 + shot^2 * light + relative^2 * light^2: what a dark facet shows does not come from the
    star, so divided by a faint star its noise is larger by as much.
    """

    dark: float
    shot: float
    relative: float

    def variance(self, light: Array, faintness: Array | float) -> Array:
        """Variance of the response where the facet's light is `light` (units of the scale), with a star that faint."""
        positive = np.maximum(light, 0.0)
        variance: Array = (self.dark * faintness) ** 2 + self.shot**2 * positive + self.relative**2 * positive**2
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Independent gaussian expectations of the parameters, each of shape (n_parameters,)."""

    mean: Array
    sigma: Array


@dataclass(frozen=True, slots=True, eq=False)
class FacetFit:
    """A fitted facet.

    Attributes
    ----------
    parameters, covariance
        Posterior mode, shape (p,), and covariance, (p, p); see `facet_psf` for the order.
    scale
        Response of the facet that counts as 1.
    used
        Shape (n_used,). Indices of the records in the window.
    residual, variance, slope, light, leverage, faintness
        Shape (n_used,). Residual and its expected variance in y, dy/dR, light above background in units of
        scale, the share of each residual that the fit has absorbed, and how faint the star was.
    """

    parameters: Array
    covariance: Array
    scale: float
    used: NDArray[np.int64]
    residual: Array
    variance: Array
    slope: Array
    light: Array
    leverage: Array
    faintness: Array


def to_y(response: Array) -> Array:
    """The scale on which responses (in units of the facet's scale) are compared."""
    y: Array = np.power(np.maximum(response + EPSILON, 0.1 * EPSILON), POWER) / POWER
    return y


def y_slope(response: Array) -> Array:
    """dy/dR at `response` (in units of the facet's scale)."""
    slope: Array = np.power(np.maximum(response + EPSILON, 0.1 * EPSILON), POWER - 1.0)
    return slope


def student_loss(residual: Array, variance: Array) -> Array:
    """Negative log likelihood of each residual without its normalisation."""
    loss: Array = 0.5 * (STUDENT_NU + 1.0) * np.log1p(residual**2 / (STUDENT_NU * variance))
    return loss


def student_weight(residual: Array, variance: Array) -> Array:
    """Weights of the equivalent least squares, 1 / variance for a residual of typical size."""
    weight: Array = (STUDENT_NU + 1.0) / (STUDENT_NU + residual**2 / variance) / variance
    return weight


def fit_facet(
    theta_rad: Array,
    response: Array,
    faintness: Array,
    scale: float,
    used: NDArray[np.int64],
    start: Array,
    prior: Prior,
    noise: NoiseModel,
) -> FacetFit:
    """Posterior mode of one facet's parameters from the records `used`.

    `theta_rad` (n, 2), `response` and `faintness` (n,) hold all records, `start` and the prior have as many entries as
    there are parameters (N_BASIC for a plain gaussian). Responses that are NaN must not be in `used`.
    """
    theta, measured, faint = theta_rad[used], response[used] / scale, faintness[used]
    y = to_y(measured)
    precision = 1.0 / prior.sigma**2

    def linearize(parameters: Array) -> tuple[Array, Array, Array, Array, Array]:
        light, jacobian = evaluate(parameters, theta)
        expected = light + background_of(parameters, theta) * faint
        jacobian[:, BACKGROUND : GRADIENT_Y + 1] *= faint[:, None]
        slope = y_slope(expected)
        return y - to_y(expected), slope[:, None] * jacobian, slope**2 * noise.variance(light, faint), slope, light

    def misfit(residual: Array, variance: Array, parameters: Array) -> float:
        return float(student_loss(residual, variance).sum() + 0.5 * (precision * (parameters - prior.mean) ** 2).sum())

    parameters, damping = start.copy(), 1e-2
    residual, jacobian, variance, slope, light = linearize(parameters)
    for _ in range(_MAX_STEPS):
        weight = student_weight(residual, variance)
        curvature = (jacobian.T * weight) @ jacobian
        curvature[np.diag_indices_from(curvature)] += precision
        gradient = jacobian.T @ (weight * residual) - precision * (parameters - prior.mean)
        now = misfit(residual, variance, parameters)
        for _ in range(8):
            damped = curvature + np.diag(damping * np.diag(curvature))
            trial = parameters + np.linalg.solve(damped, gradient)
            if max(abs(trial[ELONGATION_1]), abs(trial[ELONGATION_2])) < _MAX_ELONGATION:
                new = linearize(trial)
                # the variance is held during a step: otherwise the fit could buy likelihood with noise
                gain = now - misfit(new[0], variance, trial)
                if gain > 0.0:
                    break
            damping *= 5.0
        else:
            break
        damping = max(damping / 5.0, 1e-6)
        parameters = trial
        residual, jacobian, variance, slope, light = new
        if gain < 1e-4:
            break
    weight = student_weight(residual, variance)
    curvature = (jacobian.T * weight) @ jacobian
    curvature[np.diag_indices_from(curvature)] += precision
    covariance: Array = np.linalg.inv(curvature).astype(np.float64)
    leverage = weight * np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    leverage = np.minimum(leverage, 0.97)
    return FacetFit(parameters, covariance, scale, used, residual, variance, slope, light, leverage, faint)


def response_scales(response: Array) -> Array:
    """Response of each facet when lit, roughly: its second largest, so that a single flash does not set it.

    `response` has shape (n_records, n_facets). Kept within a factor `_SCALE_RANGE` of the brightest facets, so that
    a dark facet's noise is not magnified without end; all zero when nothing was ever lit.
    """
    second = np.sort(np.nan_to_num(response), axis=0)[-2] if len(response) > 1 else np.zeros(response.shape[1])
    if not np.any(second > 0.0):
        return np.zeros(response.shape[1])
    scales: Array = np.maximum(second, np.quantile(second[second > 0.0], 0.9) / _SCALE_RANGE)
    return scales


def centre_covariance(fit: FacetFit) -> Array:
    """Posterior covariance of the centre, shape (2, 2), rad^2."""
    covariance: Array = fit.covariance[CENTRE, CENTRE]
    return covariance

"""The shape of one facet's point spread function as a Gauss-Hermite series whose moments are its parameters.

The normalized response of a facet over the star's direction Theta is modelled as

    mu(Theta) = (background + gradient . Theta) * faintness of the star
                + flux / (2 pi sqrt(det cov)) * exp(-|u|^2 / 2) * P(1 + sum_ab c_ab h_a(u_1) h_b(u_2)),
    u = W (Theta - centre),

with W the inverse square root of the covariance and h_n = He_n / sqrt(n!) the normalized probabilists'
Hermite polynomials. The series starts at order 3. Hermite functions are orthogonal, so terms of order 3 and
above carry no first and no second moment: whatever the shape, `centre` is the centre of gravity and
`W^-2` the covariance of the light. That is why the estimate does not depend on how the sky was sampled and
is not pulled by skewed, flat-topped or ring-like point spread functions (docs/decisions/0002).
P keeps the light positive: P(q) = (q + sqrt(q^2 + 4 d^2)) / 2 with a small d, P(q) ~ q wherever there is light.

Parameters are a vector: log flux, centre x, centre y (rad), log of the size s = (log det cov) / 4,
two elongations e1 and e2 (cov = exp(2 s) * expm(2 [[e1, e2], [e2, -e1]])), background at
Theta = 0 and its gradient (1/rad), then c_ab by ascending order.
Responses are in units of a scale of the facet's own, the flux in that unit times rad^2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOG_FLUX, CENTRE_X, CENTRE_Y, LOG_SIZE, ELONGATION_1, ELONGATION_2, BACKGROUND, GRADIENT_X, GRADIENT_Y = range(9)
N_BASIC = 9  # parameters of a plain gaussian with background
CENTRE = slice(CENTRE_X, CENTRE_Y + 1)
GRADIENT = slice(GRADIENT_X, GRADIENT_Y + 1)
MAX_ORDER = 6  # orders 3 to 6: 22 terms, shrunk to zero where the data does not ask for them
_LOG_TWO_PI = math.log(2.0 * math.pi)
_POSITIVITY = 0.03  # d of the positive map, a share of the peak


def shape_terms(max_order: int = MAX_ORDER) -> list[tuple[int, int]]:
    """Orders (a, b) of the Hermite terms behind the basic parameters, by ascending total order."""
    return [(order - b, b) for order in range(3, max_order + 1) for b in range(order + 1)]


_TERMS = shape_terms()
TERM_ORDER = np.array([a + b for a, b in _TERMS])
_A = np.array([a for a, _ in _TERMS])
_B = np.array([b for _, b in _TERMS])
_ROOT = np.sqrt(np.arange(MAX_ORDER + 1, dtype=np.float64))


def _hermite(u: Array) -> Array:
    """Normalized Hermite polynomials h_0 .. h_MAX_ORDER at `u`, shape (MAX_ORDER + 1, n)."""
    table = np.empty((MAX_ORDER + 1, len(u)))
    table[0], table[1] = 1.0, u
    for n in range(1, MAX_ORDER):
        table[n + 1] = (u * table[n] - _ROOT[n] * table[n - 1]) / _ROOT[n + 1]
    return table


def _inverse_root(log_size: float, e1: float, e2: float) -> tuple[Array, Array, Array]:
    """W = exp(-s) expm(-E) and its derivatives by e1 and e2, each of shape (2, 2)."""
    e = math.hypot(e1, e2)
    if e > 1e-4:  # below, the series of sinh(e)/e and of its derivative are exact to double precision
        ratio = math.sinh(e) / e
        slope = (math.cosh(e) - ratio) / e**2
    else:
        ratio, slope = 1.0 + e**2 / 6.0, 1.0 / 3.0
    scale, cosh = math.exp(-log_size), math.cosh(e)
    root = scale * np.array([[cosh - ratio * e1, -ratio * e2], [-ratio * e2, cosh + ratio * e1]])
    cross = slope * e1 * e2
    by_e1 = scale * np.array(
        [[ratio * (e1 - 1.0) - slope * e1**2, -cross], [-cross, ratio * (e1 + 1.0) + slope * e1**2]]
    )
    by_e2 = scale * np.array(
        [[ratio * e2 - cross, -ratio - slope * e2**2], [-ratio - slope * e2**2, ratio * e2 + cross]]
    )
    return root, by_e1, by_e2


def evaluate(parameters: Array, theta_rad: Array) -> tuple[Array, Array]:
    """Light of the facet above its background at `theta_rad`, and the derivatives of the whole response.

    `theta_rad` has shape (n, 2); returned are the light, shape (n,), and the Jacobian of light + background,
    shape (n, n_parameters). A parameter vector of length N_BASIC is a plain gaussian.
    """
    offset = theta_rad - parameters[CENTRE]
    root, by_e1, by_e2 = _inverse_root(*parameters[LOG_SIZE : ELONGATION_2 + 1])
    u1, u2 = root @ offset.T
    log_peak = parameters[LOG_FLUX] - 2.0 * parameters[LOG_SIZE] - _LOG_TWO_PI
    gaussian = np.exp(log_peak - 0.5 * (u1 * u1 + u2 * u2))
    jacobian = np.empty((len(theta_rad), len(parameters)))
    if len(parameters) > N_BASIC:
        coefficients = parameters[N_BASIC:]
        h1, h2 = _hermite(u1), _hermite(u2)
        products = h1[_A] * h2[_B]
        series = 1.0 + coefficients @ products
        # h_n' = sqrt(n) h_(n-1); for n = 0 the factor is zero, whatever row -1 holds
        series_by_u1 = (coefficients * _ROOT[_A]) @ (h1[_A - 1] * h2[_B])
        series_by_u2 = (coefficients * _ROOT[_B]) @ (h1[_A] * h2[_B - 1])
        smooth = np.sqrt(series * series + 4.0 * _POSITIVITY**2)
        positive, positive_slope = 0.5 * (series + smooth), 0.5 * (1.0 + series / smooth)
        light = gaussian * positive
        by_u1 = gaussian * (positive_slope * series_by_u1) - u1 * light
        by_u2 = gaussian * (positive_slope * series_by_u2) - u2 * light
        jacobian[:, N_BASIC:] = (gaussian * positive_slope * products).T
    else:
        light = gaussian
        by_u1, by_u2 = -u1 * light, -u2 * light
    jacobian[:, LOG_FLUX] = light
    jacobian[:, CENTRE_X] = -(by_u1 * root[0, 0] + by_u2 * root[1, 0])
    jacobian[:, CENTRE_Y] = -(by_u1 * root[0, 1] + by_u2 * root[1, 1])
    jacobian[:, LOG_SIZE] = -(by_u1 * u1 + by_u2 * u2) - 2.0 * light
    for column, derivative in ((ELONGATION_1, by_e1), (ELONGATION_2, by_e2)):
        v1, v2 = derivative @ offset.T
        jacobian[:, column] = by_u1 * v1 + by_u2 * v2
    jacobian[:, BACKGROUND] = 1.0
    jacobian[:, GRADIENT] = theta_rad
    return light, jacobian


def background_of(parameters: Array, theta_rad: Array) -> Array:
    """Response of the unlit facet at `theta_rad` (n, 2), shape (n,)."""
    background: Array = parameters[BACKGROUND] + theta_rad @ parameters[GRADIENT]
    return background


def covariances_of(log_size: Array, e1: Array, e2: Array) -> Array:
    """Covariances exp(2 s) expm(2 E), shape (n, 2, 2), rad^2, of sizes and elongations of shape (n,)."""
    e = 2.0 * np.hypot(e1, e2)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(e > 1e-6, 2.0 * np.sinh(e) / e, 2.0)
    scale, cosh = np.exp(2.0 * log_size), np.cosh(e)
    entries = [cosh + ratio * e1, ratio * e2, ratio * e2, cosh - ratio * e1]
    covariances: Array = np.stack([scale * entry for entry in entries], axis=-1).reshape(-1, 2, 2)
    return covariances


def covariance_of_light(parameters: Array) -> Array:
    """Second central moments of the point spread function, shape (2, 2), rad^2."""
    log_size, e1, e2 = parameters[[LOG_SIZE, ELONGATION_1, ELONGATION_2], None]
    covariance: Array = covariances_of(log_size, e1, e2)[0]
    return covariance

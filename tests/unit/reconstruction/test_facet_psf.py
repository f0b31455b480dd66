"""The Gauss-Hermite model: its derivatives against finite differences, its moments against plain summation."""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.reconstruction.facet_psf import (
    BACKGROUND,
    CENTRE,
    ELONGATION_1,
    ELONGATION_2,
    LOG_FLUX,
    LOG_SIZE,
    N_BASIC,
    TERM_ORDER,
    background_of,
    covariance_of_light,
    evaluate,
)


def parameters_of(rng, term_sigma, elongation=0.3):
    values = np.zeros(N_BASIC + len(TERM_ORDER))
    values[LOG_FLUX] = rng.normal(0, 0.5)
    values[CENTRE] = rng.normal(0, 1.0, 2)
    values[LOG_SIZE] = rng.normal(0, 0.2)
    values[[ELONGATION_1, ELONGATION_2]] = rng.normal(0, elongation, 2)
    values[BACKGROUND] = 0.1
    values[N_BASIC:] = rng.normal(0, term_sigma, len(TERM_ORDER))
    return values


def expm_symmetric(matrix):
    value, vector = np.linalg.eigh(matrix)
    return vector @ np.diag(np.exp(value)) @ vector.T


@pytest.mark.parametrize("n_parameters", [N_BASIC, N_BASIC + len(TERM_ORDER)])
@pytest.mark.parametrize("elongation", [0.3, 1e-6])
def test_the_jacobian_is_the_derivative(n_parameters, elongation):
    """Central differences of step 1e-5 are good to about 1e-8; strong terms make the positive map work as well."""
    rng = np.random.default_rng(1)
    values = parameters_of(rng, 0.3, elongation)[:n_parameters]
    theta = values[CENTRE] + rng.normal(0, 2.0, (60, 2))
    _, jacobian = evaluate(values, theta)
    for column in range(n_parameters):
        step = np.zeros(n_parameters)
        step[column] = 1e-5
        moved = (values + step, values - step)
        above, below = (evaluate(value, theta)[0] + background_of(value, theta) for value in moved)
        numeric = (above - below) / 2e-5
        np.testing.assert_allclose(jacobian[:, column], numeric, rtol=1e-6, atol=2e-8, err_msg=f"parameter {column}")


@pytest.mark.parametrize("seed", range(5))
def test_the_parameters_are_the_moments_of_the_light(seed):
    """Whatever the shape terms: the integral is the flux, the mean the centre, the second moments the covariance.

    Exact where the series is positive; there the positive map lifts it by less than 0.03^2 / series. Terms of spread
    0.02 keep the series positive but in the far wings; 1 % of a width is ten times less than any run can tell.
    """
    values = parameters_of(np.random.default_rng(seed), 0.02)
    size = np.exp(values[LOG_SIZE])
    axis = np.linspace(-9 * size, 9 * size, 361)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    light, _ = evaluate(values, grid + values[CENTRE])
    cell = (axis[1] - axis[0]) ** 2
    flux, mean = light.sum() * cell, light @ grid / light.sum()
    cov = (grid.T * light) @ grid / light.sum()
    e1, e2 = values[[ELONGATION_1, ELONGATION_2]]
    expected = size**2 * expm_symmetric(2 * np.array([[e1, e2], [e2, -e1]]))
    assert flux == pytest.approx(np.exp(values[LOG_FLUX]), rel=0.01)
    np.testing.assert_allclose(mean, 0.0, atol=0.01 * size)
    np.testing.assert_allclose(cov, expected, atol=0.03 * size**2)
    np.testing.assert_allclose(covariance_of_light(values), expected, rtol=1e-12)


def test_strong_terms_do_not_make_light_negative():
    rng = np.random.default_rng(7)
    for _ in range(20):
        values = parameters_of(rng, 0.5)
        light, _ = evaluate(values, values[CENTRE] + rng.normal(0, 3.0, (200, 2)))
        assert light.min() >= 0.0

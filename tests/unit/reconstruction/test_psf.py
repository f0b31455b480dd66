"""Areas of light distributions that can be worked out on paper."""

from __future__ import annotations

import numpy as np
import pytest
from response_maker import ARCMIN, instrument, make_run

from namod_ctl.reconstruction.psf import LightOfFacets, area_of_covariance, area_predicted
from namod_ctl.reconstruction.reconstruct import reconstruct


def test_two_facets_side_by_side():
    """Equal round spots of sigma 1 at x = -2 and +2: variances 1 + 4 and 1."""
    light = LightOfFacets(np.ones(2), np.array([[-2.0, 0.0], [2.0, 0.0]]), np.array([np.eye(2)] * 2))
    centre, cov = light.combined()
    np.testing.assert_allclose(centre, 0.0)
    np.testing.assert_allclose(cov, np.diag([5.0, 1.0]))
    assert area_of_covariance(cov) == pytest.approx(np.pi * np.sqrt(5.0))


def test_light_weighs():
    """Three times the light at x = 0 as at x = 4: centre 1, variance 3."""
    light = LightOfFacets(np.array([3.0, 1.0]), np.array([[0.0, 0.0], [4.0, 0.0]]), np.zeros((2, 2, 2)))
    centre, cov = light.combined()
    np.testing.assert_allclose(centre, [1.0, 0.0])
    np.testing.assert_allclose(cov, np.diag([3.0, 0.0]))


def test_prediction_without_any_error_is_the_perfect_area():
    perfect = np.array([np.diag([4.0, 1.0])] * 5)
    area = area_predicted(np.ones(5), perfect, np.zeros((5, 2)), np.zeros((5, 2, 2)))
    assert area.a_sigma_rad2 == pytest.approx(2 * np.pi)
    assert area.uncertainty_rad2 == pytest.approx(0.0, abs=1e-6)


def test_prediction_with_many_facets_off_by_chance_adds_the_variances():
    """n facets off by sigma: the variance grows by sigma^2 (n - 1) / n; 400 draws of 200 facets are good to 1 %."""
    n = 200
    area = area_predicted(
        np.ones(n), np.array([np.eye(2)] * n), np.zeros((n, 2)), np.array([np.diag([3.0, 8.0])] * n), seed=1
    )
    expected = np.pi * np.sqrt((1 + 3 * (n - 1) / n) * (1 + 8 * (n - 1) / n))
    assert area.a_sigma_rad2 == pytest.approx(expected, rel=0.01)
    assert 0.0 < area.uncertainty_rad2 < 0.15 * expected


def test_a_facet_that_is_not_turned_stays_where_it_is():
    light = np.array([1.0, 1.0])
    left = np.array([[0.0, 0.0], [4.0, 0.0]])
    area = area_predicted(light, np.array([np.eye(2)] * 2), left, np.zeros((2, 2, 2)))
    assert area.a_sigma_rad2 == pytest.approx(np.pi * np.sqrt(5.0))


def test_area_of_a_run_is_that_of_its_rays():
    """The model's wings and the few facets at the rim of the scan are good to 3 %."""
    run = make_run(6, n_facets=15)
    found = reconstruct(run.table, instrument()).alignment
    assert found.now.a_sigma_rad2 == pytest.approx(run.a_sigma_rad2, rel=0.03)
    assert found.now.uncertainty_rad2 < 0.03 * run.a_sigma_rad2
    assert found.predicted.a_sigma_rad2 < 12 * ARCMIN**2 < run.a_sigma_rad2

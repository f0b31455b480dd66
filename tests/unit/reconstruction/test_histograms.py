"""Histograms against numpy's own, and the simple estimators on tables worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from response_maker import DEG, make_run

from namod_ctl.reconstruction.estimators import SIMPLE_ESTIMATORS
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.psf import area_of_histograms
from namod_ctl.reconstruction.responses import ResponseTable


def table_of(theta, response):
    theta, response = np.array(theta, dtype=float), np.array(response, dtype=float)
    n = len(theta)
    return ResponseTable(tuple(range(response.shape[1])), np.arange(n), theta, np.full(n, np.nan), response, np.ones(n))


@pytest.mark.parametrize("bin_size_rad", [0.01 * DEG, 0.037 * DEG, 2.0 * DEG])
def test_histograms_are_numpys(bin_size_rad):
    table = make_run(3, 400, n_facets=3).table
    found = histogram_responses(table, bin_size_rad)
    x, y = table.theta_rad.T
    edges = (found.y_edges_rad, found.x_edges_rad)
    exposure, *_ = np.histogram2d(y, x, bins=edges)
    assert exposure.sum() == 400
    np.testing.assert_array_equal(found.exposure, exposure)
    with np.errstate(invalid="ignore"):
        for j in range(3):
            raw, *_ = np.histogram2d(y, x, bins=edges, weights=table.response[:, j])
            np.testing.assert_allclose(found.raw[j], raw, rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(found.psf[j], raw / exposure, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(np.diff(found.x_edges_rad), bin_size_rad)
    np.testing.assert_allclose(found.x_edges_rad / bin_size_rad, np.round(found.x_edges_rad / bin_size_rad), atol=1e-9)


def test_responses_not_measured_count_as_zero():
    table = table_of([[0.5, 0.5], [0.5, 0.5]], [[np.nan], [3.0]])
    found = histogram_responses(table, 1.0)
    assert found.exposure.sum() == 2.0
    assert found.raw.sum() == 3.0
    assert found.psf.ravel().tolist() == [1.5]


def test_estimators_by_hand():
    """Three visits of (0.5, 0.5) and one each of (2.5, 0.5) and (0.5, 4.5); bins of 1 rad have these as centres."""
    theta = [[0.5, 0.5]] * 3 + [[2.5, 0.5], [0.5, 4.5]]
    response = [[1, 0, 2], [1, 0, 0], [1, 0, 1], [2, 0, 1], [1, 0, 0]]
    table = table_of(theta, response)
    centres = {name: function(table, 1.0) for name, function in SIMPLE_ESTIMATORS.items()}
    np.testing.assert_allclose(centres["brightest"].theta_rad[0], [2.5, 0.5])
    np.testing.assert_allclose(centres["brightest"].theta_rad[2], [0.5, 0.5])
    # cog of facet 0: weights 3 at (0.5, 0.5), 2 at (2.5, 0.5), 1 at (0.5, 4.5)
    np.testing.assert_allclose(centres["cog"].theta_rad[0], [7.0 / 6.0, 7.0 / 6.0])
    np.testing.assert_allclose(centres["cog"].theta_rad[2], [1.0, 0.5])
    # H_psf of facet 0: 1, 2 and 1; of facet 2: 1, 1 and 0
    np.testing.assert_allclose(centres["histogram-cog"].theta_rad[0], [1.5, 1.5])
    np.testing.assert_allclose(centres["histogram-cog"].theta_rad[2], [1.5, 0.5])
    for name in SIMPLE_ESTIMATORS:
        assert np.isnan(centres[name].theta_rad[1]).all(), f"{name} guesses where a dark facet points"


def test_a_responses_place_is_not_its_neighbours():
    """Axes are not swapped: light at x = 3 stays at x = 3."""
    found = histogram_responses(table_of([[0.5, 0.5], [3.5, 1.5]], [[0.0], [7.0]]), 1.0)
    row, column = np.argwhere(found.raw[0] == 7.0)[0]
    assert (found.x_centres_rad[column], found.y_centres_rad[row]) == (3.5, 1.5)


def test_area_of_a_histogram():
    """A gaussian of 3 by 2 bins, sampled evenly: pi * 3 * 2, plus Sheppard's 1/12 per axis, which is 2 % here."""
    axis = np.arange(-20, 21) + 0.5
    theta = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    light = np.exp(-0.5 * ((theta[:, 0] - 0.5) ** 2 / 9.0 + (theta[:, 1] + 0.5) ** 2 / 4.0))
    assert area_of_histograms(table_of(theta, light[:, None]), 1.0) == pytest.approx(6 * np.pi, rel=0.002)
    lifted = table_of(theta, light[:, None] + 0.2)
    assert area_of_histograms(lifted, 1.0) > 60 * np.pi  # the background rules
    assert area_of_histograms(lifted, 1.0, np.array([0.2])) == pytest.approx(6 * np.pi, rel=0.002)

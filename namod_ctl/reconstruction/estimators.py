"""Estimators of a facet's centre by name: the paper's simple ones, and the robust fit they are measured against.

`brightest`, `cog` and `histogram-cog` reproduce what other programs do and take every record at face value; no
background is removed and no record is left out. `robust` is the default (`robust.fit_reflector`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

DEFAULT_ESTIMATOR = "robust"


@dataclass(frozen=True, slots=True, eq=False)
class Centres:
    """Centres of all facets: theta_rad (n_facets, 2) and its covariance (n_facets, 2, 2); NaN where unknown."""

    theta_rad: Array
    theta_cov_rad2: Array


def brightest(table: ResponseTable, bin_size_rad: float) -> Centres:
    """Direction of the single brightest record of each facet, as the original program took it; no covariance.

    Source: the instruction graphic of arXiv:1605.06274.
    """
    response = np.nan_to_num(table.response)
    theta = table.theta_rad[np.argmax(response, axis=0)]
    theta[response.max(axis=0) <= 0.0] = np.nan
    return Centres(theta, np.full((len(theta), 2, 2), np.nan))


def centre_of_gravity(table: ResponseTable, bin_size_rad: float) -> Centres:
    """Mean direction of all records, weighted with the response; covariance as if records were independent draws."""
    return _weighted_mean(table.theta_rad, np.nan_to_num(table.response))


def histogram_centre_of_gravity(table: ResponseTable, bin_size_rad: float) -> Centres:
    """Centre of gravity of H_psf, so that a direction visited often counts no more than one visited once.

    Source: arXiv:1605.06274, section 2.
    """
    histograms = histogram_responses(table, bin_size_rad)
    visited = histograms.exposure > 0
    x, y = np.meshgrid(histograms.x_centres_rad, histograms.y_centres_rad)
    return _weighted_mean(np.stack([x[visited], y[visited]], axis=1), histograms.psf[:, visited].T)


def _weighted_mean(theta_rad: Array, weight: Array) -> Centres:
    """Means of `theta_rad` (n, 2) under `weight` (n, n_facets), with their covariances."""
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / total
    mean = share.T @ theta_rad
    offset = theta_rad[:, None, :] - mean[None, :, :]
    covariance = np.einsum("ij,ija,ijb->jab", share**2, offset, offset)
    return Centres(mean, covariance)


SIMPLE_ESTIMATORS: dict[str, Callable[[ResponseTable, float], Centres]] = {
    "brightest": brightest,
    "cog": centre_of_gravity,
    "histogram-cog": histogram_centre_of_gravity,
}
ESTIMATOR_NAMES = (DEFAULT_ESTIMATOR, *SIMPLE_ESTIMATORS)

"""Weighted least squares of many facets at once: their directions over zenith distance, each with its own terms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.units import arcmin_to_rad

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TERMS = ("sin", "cos")
"""Of the sag: sin z grows with the weight across the axis, cos z - 1 with what the weight along it loses."""

MOST_WANDER_RAD = arcmin_to_rad(30.0)
"""Typical at most: what all facets do together between zenith and horizon."""
_LEAST_STRENGTH = 1e-8  # of the terms' sums of squares: below, runs at one place are taken for several


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Facets' parameters, as fitted with the errors as they were stated.

    Attributes
    ----------
    beta_rad
        Shape (n_facets, n_terms, 2), the constant first; NaN for facets whose runs do not tell the terms apart.
    cov_rad2
        Shape (n_facets, n_terms, 2, n_terms, 2).
    chi2
        Shape (n_facets,).
    n_free
        Shape (n_facets,). Measured numbers beyond those that the terms need.
    residual_rad
        Shape (n_runs, n_facets, 2); NaN where there is no measurement.
    """

    beta_rad: Array
    cov_rad2: Array
    chi2: Array
    n_free: NDArray[np.int64]
    residual_rad: Array


def basis_of_zenith(zenith_rad: Array, terms: tuple[str, ...]) -> Array:
    """Constant and terms at zenith distances (...,), shape (..., 1 + n_terms)."""
    columns = {"sin": np.sin(zenith_rad), "cos": np.cos(zenith_rad) - 1.0}
    return np.stack([np.ones_like(zenith_rad), *(columns[term] for term in terms)], axis=-1)


def fit_facets(basis: Array, theta_rad: Array, weight: Array) -> Fit:
    """Every facet's terms.

    Parameters
    ----------
    basis
        Shape (n_runs, n_facets, n_terms).
    theta_rad
        Shape (n_runs, n_facets, 2); any finite number where there is no measurement.
    weight
        Shape (n_runs, n_facets, 2, 2). Inverse covariances; zero where there is no measurement.
    """
    n_facets, n_terms = theta_rad.shape[1], basis.shape[-1]
    is_seen = weight[..., 0, 0] > 0.0
    n_runs = is_seen.sum(axis=0)
    gram = np.einsum("knp,knq,kn->npq", basis, basis, is_seen.astype(np.float64))
    strength = np.linalg.eigvalsh(gram)
    can = (n_runs >= n_terms) & (strength[:, 0] > _LEAST_STRENGTH * strength[:, -1])
    normal = np.einsum("knp,knq,knab->npaqb", basis, basis, weight).reshape(n_facets, 2 * n_terms, 2 * n_terms)
    right = np.einsum("knp,knab,knb->npa", basis, weight, theta_rad).reshape(n_facets, 2 * n_terms, 1)
    beta = np.full((n_facets, n_terms, 2), np.nan)
    cov = np.full((n_facets, n_terms, 2, n_terms, 2), np.nan)
    beta[can] = np.linalg.solve(normal[can], right[can])[..., 0].reshape(-1, n_terms, 2)
    cov[can] = np.linalg.inv(normal[can]).reshape(-1, n_terms, 2, n_terms, 2)
    residual = theta_rad - np.einsum("knp,npa->kna", basis, beta)
    chi2 = np.where(can, np.einsum("kna,knab,knb->n", np.nan_to_num(residual), weight, np.nan_to_num(residual)), 0.0)
    residual[~is_seen] = np.nan
    n_free = np.where(can, 2 * (n_runs - n_terms), 0)
    return Fit(beta, cov, chi2, n_free, residual)


def weights_of(cov_rad2: Array, is_used: Mask) -> Array:
    """Inverse covariances, shape (..., 2, 2); zero where `is_used` (...,) is not."""
    weight = np.zeros_like(cov_rad2)
    weight[is_used] = np.linalg.inv(cov_rad2[is_used])
    return weight


def with_column(basis: Array, of_run: Array) -> Array:
    """The basis with a further term that is the same for all facets, shape (n_runs,)."""
    column = np.broadcast_to(of_run[:, None, None], (*basis.shape[:2], 1))
    return np.concatenate([basis, column], axis=-1)


def without_wander(basis: Array, wander: Array, theta_rad: Array, weight: Array) -> Array:
    """Directions (n_runs, n_facets, 2) without what the whole image wandered while a run went on.

    A star that wanders lights the facets one after the other, while the telescope follows the sky and the whole image
    moves on with it: the mean of all facets, which is taken off, is not that of the moment at which a facet was seen.
    How far the image goes per unit of `wander` is found here from the facets themselves, jointly with their own terms.

    Parameters
    ----------
    wander
        Shape (n_runs, n_facets). The sag's term at the time when a facet was seen, less its mean over the facets.
    weight
        As in `fit_facets`; zero also where a facet is to have no say.
    """
    if not wander.any():
        return theta_rad
    left = np.nan_to_num(fit_facets(basis, theta_rad, weight).residual_rad)
    # of a wander along x and along y, what the facets' own terms can not take over
    own = [np.nan_to_num(fit_facets(basis, wander[..., None] * axis, weight).residual_rad) for axis in np.eye(2)]
    pull = np.array([np.einsum("kna,knab,knb->", o, weight, left) for o in own])
    hold = np.array([[np.einsum("kna,knab,knb->", o, weight, p) for p in own] for o in own])
    rate = np.linalg.solve(hold + np.eye(2) / MOST_WANDER_RAD**2, pull)
    rest: Array = theta_rad - wander[..., None] * rate
    return rest

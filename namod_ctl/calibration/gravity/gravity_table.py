"""The look-up table: how facets turn with zenith distance, what that does to the image, and what remains with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.play import used_rad
from namod_ctl.calibration.gravity.sag_fit import basis_of_zenith
from namod_ctl.calibration.gravity.sag_of_runs import SagFit
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, rad_to_deg
from namod_ctl.optics.coordinates import correction_of_theta

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Side = Literal["above", "below"]

BEYOND_RAD = deg_to_rad(10.0)
"""So far beyond the runs a table is used; the sag's sine still holds there."""
_N_DRAWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class GravityTable:
    """The sag of all facets relative to their light-weighted mean, over zenith distance.

    Attributes
    ----------
    beta_rad, cov_rad2
        As in `SagFit`: constant, then `terms`; NaN for facets of which no sag is known.
    is_moving
        Shape (n_facets,). The others' terms are left out.
    light, variance_rad2
        Shape (n_facets,). Weight of each facet in the image, and the variance per axis of its own light.
    zenith_range_rad
        Least and largest zenith distance of the runs.
    play_rad
        Measured play of the structure, 0 where none is known.
    """

    telescope: str
    facet_ids: tuple[int, ...]
    terms: tuple[str, ...]
    beta_rad: Array
    cov_rad2: Array
    is_moving: Mask
    light: Array
    variance_rad2: Array
    zenith_range_rad: tuple[float, float]
    play_rad: float = 0.0

    def check_zenith(self, zenith_rad: float, what: str) -> None:
        """Raise ConfigError for a zenith distance at which the table says nothing; `what` names it for a person."""
        low, high = self.zenith_range_rad
        if not max(low - BEYOND_RAD, 0.0) - 1e-9 <= zenith_rad <= high + BEYOND_RAD + 1e-9:
            raise ConfigError(
                f"{what} {rad_to_deg(zenith_rad):g} deg: the table rests on runs from {rad_to_deg(low):.0f} to "
                f"{rad_to_deg(high):.0f} deg and holds {rad_to_deg(BEYOND_RAD):.0f} deg beyond; choose a zenith "
                "distance there, or record a run nearer to it and fit the table anew"
            )

    def motion_rad(self, zenith_rad: Array, side: Side | None = None) -> Array:
        """Theta of every facet by its sag at zenith distances (...,): shape (..., n_facets, 2), 0 at zenith.

        Facets that do not move, or of which nothing is known, stand at 0: they go with the mean of all. `side` is that
        from which the telescope comes; without it the middle of both.
        """
        beta = np.where(self.is_moving[:, None, None], self.beta_rad[:, 1:], 0.0)
        motion: Array = np.einsum("...p,npa->...na", self._basis(zenith_rad, side)[..., 1:], beta)
        return motion

    def change_rad(self, from_rad: float, to_rad: float, side: Side | None = None) -> Array:
        """By how much Theta of every facet changes between zenith distances, shape (n_facets, 2)."""
        change: Array = self.motion_rad(np.array(to_rad), side) - self.motion_rad(np.array(from_rad), side)
        return change

    def tilt_change_rad(self, from_rad: float, to_rad: float, side: Side | None = None) -> Array:
        """Phi, shape (n_facets, 2), to be added to the normals of facets aligned at `from_rad` when at `to_rad`."""
        return correction_of_theta(self.change_rad(from_rad, to_rad, side))

    def change_cov_rad2(self, from_rad: float, zenith_rad: float) -> Array:
        """Covariance of `change_rad`, shape (n_facets, 2, 2); of facets at rest 0."""
        basis = self._basis(np.array(zenith_rad), None) - self._basis(np.array(from_rad), None)
        cov: Array = np.einsum("p,npaqb,q->nab", basis, self.cov_rad2, basis)
        return np.where(self.is_moving[:, None, None], cov, 0.0)

    def limit_rad2(self) -> float:
        """A_sigma of the same facets, every one on the axis."""
        return float(self.area_rad2(np.zeros((len(self.facet_ids), 2))))

    def image_cov_rad2(self, theta_rad: Array) -> Array:
        """Covariance (..., 2, 2) of the light of all facets when they stand at `theta_rad` (..., n_facets, 2)."""
        share = self.light / self.light.sum()
        offset = theta_rad - np.einsum("n,...na->...a", share, theta_rad)[..., None, :]
        spread: Array = np.einsum("n,...na,...nb->...ab", share, offset, offset)
        return spread + float(share @ self.variance_rad2) * np.eye(2)

    def area_rad2(self, theta_rad: Array) -> Array:
        """A_sigma = pi sqrt(det cov), shape (...,), when the facets stand at `theta_rad` (..., n_facets, 2)."""
        area: Array = math.pi * np.sqrt(np.linalg.det(self.image_cov_rad2(theta_rad)))
        return area

    def areas_without_rad2(self, zenith_rad: Array, aligned_at_rad: float) -> Array:
        """A_sigma over zenith distances (n,) of facets that were aligned at one and left alone."""
        return self.area_rad2(self.motion_rad(zenith_rad) - self.motion_rad(np.array(aligned_at_rad)))

    def areas_with(self, zenith_rad: Array, aligned_at_rad: float, seed: int = 0) -> tuple[Array, Array]:
        """A_sigma over zenith distances (n,) with the table, and its scatter: by its errors, and the unknown side."""
        rng = np.random.default_rng(seed)
        mean, scatter = np.empty(len(zenith_rad)), np.empty(len(zenith_rad))
        for i, zenith in enumerate(zenith_rad):
            roots = _roots(self.change_cov_rad2(aligned_at_rad, float(zenith)))
            off = self.motion_rad(zenith, "above") - self.motion_rad(zenith)
            draws = rng.standard_normal((_N_DRAWS, *off.shape))
            sides = rng.choice([-1.0, 1.0], (_N_DRAWS, 1, 1))
            areas = self.area_rad2(sides * off + np.einsum("nab,knb->kna", roots, draws))
            mean[i], scatter[i] = areas.mean(), areas.std()
        return mean, scatter

    def _basis(self, zenith_rad: Array, side: Side | None) -> Array:
        lag = {None: 0.0, "above": self.play_rad, "below": -self.play_rad}[side]
        return basis_of_zenith(np.asarray(zenith_rad) - lag, self.terms)


def table_of_fit(
    fit: SagFit,
    telescope: str,
    facet_ids: tuple[int, ...],
    light: Array,
    variance_rad2: Array,
    zenith_range_rad: tuple[float, float],
) -> GravityTable:
    """The table of a fit; facets that do not follow a sag, or do not move, are left out of it."""
    return GravityTable(
        telescope,
        facet_ids,
        fit.terms,
        fit.beta_rad,
        fit.cov_rad2,
        fit.is_moving,
        light,
        variance_rad2,
        zenith_range_rad,
        used_rad(fit.play),
    )


def _roots(cov_rad2: Array) -> Array:
    values, vectors = np.linalg.eigh(cov_rad2)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root


def zenith_grid_rad(from_rad: float, to_rad: float, step_rad: float) -> Array:
    """Zenith distances from one to another, evenly spaced by about `step_rad`, both ends included."""
    n_steps = max(math.ceil((to_rad - from_rad) / step_rad - 1e-9), 1)
    return np.linspace(from_rad, to_rad, n_steps + 1)

"""A made-up dish that leans over: analytic sag, and runs that measure it with honest errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.gravity_table import GravityTable
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad

Array = NDArray[np.float64]

N_FACETS = 24
FOUR = (10.0, 25.0, 40.0, 60.0)
ERROR_RAD = arcmin_to_rad(0.05)


@dataclass(frozen=True)
class Dish:
    """Theta_j(z) = stand + sine sin z + cosine (cos z - 1), each (n_facets, 2)."""

    stand: Array
    sine: Array
    cosine: Array
    light: Array

    def theta_rad(self, zenith_rad: float) -> Array:
        theta: Array = self.stand + self.sine * math.sin(zenith_rad) + self.cosine * (math.cos(zenith_rad) - 1.0)
        return theta

    def relative(self, theta_rad: Array) -> Array:
        rest: Array = theta_rad - self.light @ theta_rad / self.light.sum()
        return rest


def dish(seed: int = 1, sine_arcmin: float = 1.0, cosine_arcmin: float = 0.0) -> Dish:
    rng = np.random.default_rng(seed)

    def draw(size_arcmin: float) -> Array:
        return arcmin_to_rad(size_arcmin) * rng.standard_normal((N_FACETS, 2))

    return Dish(draw(4.0), draw(sine_arcmin), draw(cosine_arcmin), rng.uniform(0.8, 1.2, N_FACETS))


def runs(
    of: Dish,
    zenith_deg: tuple[float, ...] = FOUR,
    sides: tuple[str, ...] | None = None,
    play_deg: float = 0.0,
    seed: int = 1,
    stated: float = 1.0,
) -> list[RunOfFacets]:
    """Runs at these zenith distances; the star camera points elsewhere in each. `stated` errors over true ones."""
    rng = np.random.default_rng(seed)
    found = []
    for zenith, side in zip(zenith_deg, sides or repeat("above"), strict=sides is not None):
        behind = {"above": -play_deg, "below": play_deg}[side]
        theta = of.theta_rad(deg_to_rad(zenith + behind)) + rng.normal(0.0, arcmin_to_rad(1.0), 2)
        theta = theta + rng.normal(0.0, ERROR_RAD, theta.shape)
        path = ZenithPath(np.array([deg_to_rad(zenith)]), 0.0 if side == "above" else math.pi / 2.0)
        cov = np.tile((stated * ERROR_RAD) ** 2 * np.eye(2), (N_FACETS, 1, 1))
        found.append(RunOfFacets(f"run_at_{zenith:g}", path, theta, cov, np.ones((N_FACETS, 1))))
    return found


def table(of: Dish, width_arcmin: float = 1.4) -> GravityTable:
    """A table without errors."""
    beta = np.stack([of.relative(term) for term in (of.stand, of.sine, of.cosine)], axis=1)
    return GravityTable(
        telescope="Leaning dish",
        facet_ids=tuple(range(N_FACETS)),
        terms=("sin", "cos"),
        beta_rad=beta,
        cov_rad2=np.zeros((N_FACETS, 3, 2, 3, 2)),
        is_moving=np.ones(N_FACETS, dtype=np.bool_),
        light=of.light,
        variance_rad2=np.full(N_FACETS, arcmin_to_rad(width_arcmin) ** 2),
        zenith_range_rad=(deg_to_rad(10.0), deg_to_rad(60.0)),
    )

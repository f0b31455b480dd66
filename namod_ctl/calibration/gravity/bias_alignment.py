"""The best facets that stand still: orientations that keep the image small over a range of zenith distances.

Mounts with bolts can not follow a look-up table. Instead of aligning them perfectly at one zenith distance they are
aligned to a compromise. The area A(z) = pi sqrt(det C(z)) changes with the offset o_j of facet j by
-A(z) w_j C(z)^-1 (S_j(z) - o_j), so the best offsets solve

    o_j = [sum_z W(z) A(z)^p C(z)^-1]^-1 sum_z W(z) A(z)^p C(z)^-1 S_j(z)

with p = 1 for the least mean area and a large p for the least worst one; C depends on the offsets, hence the iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.gravity_table import GravityTable
from namod_ctl.core.errors import DataQualityError

Array = NDArray[np.float64]

_MOST_SHARPNESS = 60.0  # of the power, in units of the areas' spread: the worst is met to some percent of that
_LEAST_SPREAD = 1e-9
_N_POWERS, _N_STEPS = 12, 200
_SMALL_STEP = 1e-7  # of the area


class Aim(StrEnum):
    """What is to be small."""

    MEAN = "mean"
    WORST = "worst"


@dataclass(frozen=True, slots=True, eq=False)
class Compromise:
    """The best orientations.

    Attributes
    ----------
    offset_rad
        Shape (n_facets, 2). Theta's part by the sag that is aligned away: facets aligned so stand at S_j(z) - o_j.
    area_rad2
        Shape (n_zenith,). A_sigma with them.
    """

    zenith_rad: Array
    offset_rad: Array
    area_rad2: Array


def best_compromise(table: GravityTable, zenith_rad: Array, weights: Array, aim: Aim) -> Compromise:
    """Offsets that make the weighted mean, or the largest, A_sigma over zenith distances least.

    Parameters
    ----------
    zenith_rad, weights
        Shape (n,) each. Zenith distances, and how much observing time is spent at each.

    Raises
    ------
    DataQualityError
        No facet moves, so that there is nothing to compromise about.
    """
    if not table.is_moving.any():
        raise DataQualityError("no facet moves with zenith distance: align as usual, there is nothing to compromise")
    motion = table.motion_rad(zenith_rad)
    is_mean = aim is Aim.MEAN
    share = weights / weights.sum() if is_mean else (weights > 0.0) / np.count_nonzero(weights > 0.0)
    offset = np.einsum("z,zna->na", share, motion)
    offset = _iterate(table, motion, share, offset, 1.0, 1.0)
    if not is_mean:
        logs = np.log(table.area_rad2(motion - offset))
        spread = max(float(np.ptp(logs)), _LEAST_SPREAD)
        # to the worst little by little: a large power at once jumps to and fro between the two ends
        for sharpness in np.geomspace(1.0, _MOST_SHARPNESS, _N_POWERS):
            offset = _iterate(table, motion, share, offset, sharpness / spread, 1.0 / (1.0 + sharpness))
    return Compromise(zenith_rad, offset, table.area_rad2(motion - offset))


def _iterate(table: GravityTable, motion: Array, share: Array, offset: Array, power: float, damping: float) -> Array:
    before = np.inf
    for _ in range(_N_STEPS):
        covs = table.image_cov_rad2(motion - offset)
        areas = np.sqrt(np.linalg.det(covs))
        relative = (areas / areas.max()) ** power
        goal = float((share @ relative) ** (1.0 / power) * areas.max())
        if abs(before - goal) < _SMALL_STEP * damping * goal:
            break
        before = goal
        pull = (share * relative)[:, None, None] * np.linalg.inv(covs)
        best = np.linalg.solve(pull.sum(axis=0), np.einsum("zab,znb->an", pull, motion)).T
        offset = offset + damping * (best - offset)
    return offset

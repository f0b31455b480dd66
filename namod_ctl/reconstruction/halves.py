"""A run against itself: its even and odd records as two independent runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR
from namod_ctl.reconstruction.reconstruct import DEFAULT_BIN_SIZE_RAD, reconstruct
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class HalvesComparison:
    """Two independent estimates of every facet.

    Attributes
    ----------
    distance_rad
        Shape (n_facets,). How far apart the two estimates of each facet's centre are; NaN where one is missing.
    pull
        Shape (n_facets, 2). Difference in units of the joint stated uncertainty, decorrelated; NaN where there is none.
    is_flagged
        Shape (n_facets,). True where either estimate says that nobody should turn on it.
    """

    facet_ids: tuple[int, ...]
    distance_rad: Array
    pull: Array
    is_flagged: NDArray[np.bool_]


def compare_halves(
    table: ResponseTable,
    instrument: Instrument,
    estimator: str = DEFAULT_ESTIMATOR,
    bin_size_rad: float = DEFAULT_BIN_SIZE_RAD,
) -> HalvesComparison:
    """Reconstruct the records of even and of odd position separately, each as if the other did not exist."""
    even, odd = (
        reconstruct(table.select(np.arange(first, table.n_records, 2)), instrument, estimator, bin_size_rad).alignment
        for first in (0, 1)
    )
    difference = _thetas(even) - _thetas(odd)
    pull = np.full_like(difference, np.nan)
    for j, (a, b) in enumerate(zip(even.facets, odd.facets, strict=True)):
        joint = a.theta_cov_rad2 + b.theta_cov_rad2
        if np.isfinite(joint).all() and np.isfinite(difference[j]).all():
            pull[j] = np.linalg.solve(np.linalg.cholesky(joint), difference[j])
    doubt = FacetFlag.UNRELIABLE | FacetFlag.NO_SIGNAL
    flagged = np.array([bool((a.flags | b.flags) & doubt) for a, b in zip(even.facets, odd.facets, strict=True)])
    return HalvesComparison(table.facet_ids, np.linalg.norm(difference, axis=1), pull, flagged)


def _thetas(alignment: Alignment) -> Array:
    return np.array([facet.theta_rad for facet in alignment.facets])

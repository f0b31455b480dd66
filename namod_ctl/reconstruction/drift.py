"""How the facets moved between two runs of one telescope, apart from what all of them did together.

A common shift of all facets says nothing of the mirror: the star camera was touched, or its axis calibrated anew. It is
estimated robustly (Tukey's biweight, so that facets that did move have no say) and taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri_exp

from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment

Array = NDArray[np.float64]

MIN_COMPARED = 3
FALSE_ALARM = 0.01
"""Chance that any facet at all is called moved when none has."""

_BIWEIGHT = 5.0  # sigma from where on a facet has no say in the common shift
_MEDIAN_OF_RAYLEIGH = math.sqrt(2.0 * math.log(2.0))  # of distances in units of sigma, in two dimensions
_MAX_STEPS = 100
_STEP_SHARE = 1e-6  # of the shift's own uncertainty: a smaller step ends the search
_NO_SAY = FacetFlag.NO_SIGNAL | FacetFlag.UNRELIABLE


@dataclass(frozen=True, slots=True, eq=False)
class FacetDrift:
    """One facet in both runs; NaN where one of them has no estimate or no uncertainty.

    Attributes
    ----------
    drift_rad, drift_cov_rad2
        Shapes (2,) and (2, 2). Theta in the second run minus that in the first, minus the common shift.
    significance_sigma
        How unlikely that is for a facet that stood still, as a distance in sigma of one normal number.
    has_moved
        Less likely than `FALSE_ALARM` for the whole mirror to be chance, and neither estimate is unreliable.
    """

    facet_id: int
    first: FacetAlignment
    second: FacetAlignment
    drift_rad: Array
    drift_cov_rad2: Array
    significance_sigma: float
    has_moved: bool


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Two alignments of one telescope, facet by facet.

    Attributes
    ----------
    facets
        Those in both runs, ascending by id.
    shift_rad, shift_cov_rad2
        Shapes (2,) and (2, 2). What all facets did together.
    n_compared, n_in_shift
        Facets with estimates in both runs, and those of them that the common shift rests on.
    scatter
        How many times further apart the typical facet is than its uncertainty says; 1 for a mirror that stood still.
    """

    facets: tuple[FacetDrift, ...]
    shift_rad: Array
    shift_cov_rad2: Array
    n_compared: int
    n_in_shift: int
    scatter: float
    only_in_first: tuple[int, ...]
    only_in_second: tuple[int, ...]

    @property
    def moved_ids(self) -> tuple[int, ...]:
        """Facets that moved significantly."""
        return tuple(facet.facet_id for facet in self.facets if facet.has_moved)


def drift_between(first: Alignment, second: Alignment) -> Drift:
    """What changed from the first to the second alignment.

    Raises
    ------
    DataQualityError
        Fewer than `MIN_COMPARED` facets can be compared.
    """
    here, there = ({facet.facet_id: facet for facet in alignment.facets} for alignment in (first, second))
    ids = sorted(here.keys() & there.keys())
    change = np.array([there[i].theta_rad - here[i].theta_rad for i in ids]).reshape(-1, 2)
    cov = np.array([here[i].theta_cov_rad2 + there[i].theta_cov_rad2 for i in ids]).reshape(-1, 2, 2)
    known = np.isfinite(change).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    known[known] = np.linalg.eigvalsh(cov[known])[:, 0] > 0.0
    trusted = known & np.array([not (here[i].flags | there[i].flags) & _NO_SAY for i in ids], dtype=bool)
    if np.count_nonzero(trusted) < MIN_COMPARED:
        raise DataQualityError(
            f"{np.count_nonzero(trusted)} facets have reliable estimates with uncertainties in both runs, at least "
            f"{MIN_COMPARED} are needed to tell their motion from a common shift: record longer, and reconstruct with "
            "the default estimator"
        )
    shift, gains, scatter = _common_shift(change[trusted], cov[trusted])
    gain_of = np.zeros((len(ids), 2, 2))
    gain_of[trusted] = gains
    # a facet's own part in the shift is not independent of the facet: what it shares is counted once
    shift_cov = scatter**2 * np.einsum("nij,njk,nlk->il", gains, cov[trusted], gains)
    own = gain_of @ cov
    drift = np.where(known[:, None], change - shift, np.nan)
    drift_cov = np.where(known[:, None, None], cov - own - own.swapaxes(1, 2) + shift_cov, np.nan)
    facets = []
    for j, facet_id in enumerate(ids):
        log_p = _log_chance(drift[j], drift_cov[j]) if known[j] else math.nan
        facets.append(
            FacetDrift(
                facet_id,
                here[facet_id],
                there[facet_id],
                drift[j],
                drift_cov[j],
                -float(ndtri_exp(log_p - math.log(2.0))) if known[j] else math.nan,
                bool(trusted[j] and log_p < math.log(FALSE_ALARM / np.count_nonzero(trusted))),
            )
        )
    return Drift(
        facets=tuple(facets),
        shift_rad=shift,
        shift_cov_rad2=shift_cov,
        n_compared=int(np.count_nonzero(known)),
        n_in_shift=int(np.count_nonzero(np.any(gains != 0.0, axis=(1, 2)))),
        scatter=scatter,
        only_in_first=tuple(sorted(here.keys() - there.keys())),
        only_in_second=tuple(sorted(there.keys() - here.keys())),
    )


def _common_shift(change: Array, cov: Array) -> tuple[Array, Array, float]:
    """The shift, shape (2,); what each facet adds to it per change, shape (n, 2, 2); and the scatter, at least 1."""
    precision = np.linalg.inv(cov)
    shift = np.median(change, axis=0)
    gains, scatter = np.zeros_like(cov), 1.0
    for _ in range(_MAX_STEPS):
        off = change - shift
        distance = np.sqrt(np.einsum("ni,nij,nj->n", off, precision, off))
        scatter = max(1.0, float(np.median(distance)) / _MEDIAN_OF_RAYLEIGH)
        weight = np.clip(1.0 - (distance / (_BIWEIGHT * scatter)) ** 2, 0.0, None) ** 2
        weighted = weight[:, None, None] * precision
        total = weighted.sum(axis=0)
        gains = np.linalg.solve(total, weighted)
        step = np.einsum("nij,nj->i", gains, change) - shift
        shift = shift + step
        if float(step @ total @ step) < _STEP_SHARE**2:
            break
    return shift, gains, scatter


def _log_chance(drift: Array, cov: Array) -> float:
    """Log of the chance that a facet that stood still seems to have moved this far (chi^2 of two numbers)."""
    return -0.5 * float(drift @ np.linalg.solve(cov, drift))

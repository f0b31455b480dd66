"""The result of a reconstruction: what every facet's point spread function and orientation are."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import FacetFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FacetAlignment:
    """One facet's estimate and correction; every number is NaN where there is no estimate.

    Attributes
    ----------
    theta_rad, theta_cov_rad2
        Shapes (2,) and (2, 2). Star direction at which the facet is brightest, telescope frame.
    width_major_rad, width_minor_rad
        Standard deviations of the facet's point spread function along its principal axes.
    flux, background
        Integral of the facet's normalized response over directions (rad^2), and its unlit response (1).
    tilt_correction_rad
        Shape (2,). Phi = -(theta - aim) / 2, to be added to the facet's normal.
    leg_travel_m, bolt_turn_deg
        Shape (n_legs,). NaN where the facet must not be moved; `bolt_turn_deg` is empty for mounts without bolts.
    remarks
        Lines for a person: why the flags are set, why a correction is refused.
    """

    facet_id: int
    theta_rad: Array
    theta_cov_rad2: Array
    width_major_rad: float
    width_minor_rad: float
    flux: float
    background: float
    n_records_in_psf: int
    flags: FacetFlag
    tilt_correction_rad: Array
    leg_travel_m: Array
    bolt_turn_deg: Array
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BadRecord:
    """A record left out of the estimates because it disagrees with all others.

    Attributes
    ----------
    kind
        `wrong_star`, `stray_light` or `cloud_edge`.
    detail
        One line for a person: what was seen, and what was expected.
    facet_ids
        The facets whose estimate it would have changed most.
    """

    index: int
    kind: str
    detail: str
    facet_ids: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class AreaOfPsf:
    """A_sigma = pi * sqrt(det(cov)) of a light distribution over directions, rad^2, with one standard deviation."""

    a_sigma_rad2: float
    uncertainty_rad2: float


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What one reconstruction found for the whole reflector."""

    telescope: str
    estimator: str
    n_records: int
    n_used: int
    axis_rad: Array
    now: AreaOfPsf
    now_all_records: AreaOfPsf
    predicted: AreaOfPsf
    facets: tuple[FacetAlignment, ...]
    bad_records: tuple[BadRecord, ...] = ()
    facets_not_in_run: tuple[int, ...] = ()
    remarks: tuple[str, ...] = field(default=())

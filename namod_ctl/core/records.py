"""The record: one image pair, reduced to the numbers the reconstruction needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import RejectReason


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One image pair, reduced.

    Attributes
    ----------
    index
        Number of the record in its run; unique, ascending.
    label
        Where it came from (file prefix, stamp), for people.
    theta_rad
        Shape (2,). Direction of the star in the telescope frame, (theta_x, theta_y); NaN without a star.
    theta_uncertainty_rad
        One standard deviation of each axis of `theta_rad`; NaN when unknown.
    star_intensity
        Relative intensity of the star, s_i; NaN without a star.
    facet_intensity
        Shape (n_facets,). Mean relative intensity over each facet's polygon, m_ij, in the order of the
        run's facet ids; NaN where a facet could not be measured.
    facet_saturated_share
        Shape (n_facets,). Share of each polygon's pixels that are saturated, 0 to 1; NaN when unknown.
    star_exposure_s, reflector_exposure_s
        Exposures; NaN when unknown.
    star_mid_exposure_s, reflector_mid_exposure_s
        Middle of each camera's exposure, seconds since the run began; NaN when unknown.
    reject_reason
        None for a record that counts.
    detail
        One line for a person about a rejection: which file, which value, which limit.
    """

    index: int
    label: str
    theta_rad: NDArray[np.float64]
    theta_uncertainty_rad: float
    star_intensity: float
    facet_intensity: NDArray[np.float64]
    facet_saturated_share: NDArray[np.float64]
    star_exposure_s: float
    reflector_exposure_s: float
    reject_reason: RejectReason | None = None
    detail: str = ""
    star_mid_exposure_s: float = math.nan
    reflector_mid_exposure_s: float = math.nan

    @property
    def mid_exposure_difference_s(self) -> float:
        """By how much the reflector's exposure was later than the star's, middle to middle; NaN when unknown."""
        return self.reflector_mid_exposure_s - self.star_mid_exposure_s

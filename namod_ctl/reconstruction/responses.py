"""The response table: normalized responses of all facets over the directions of the star."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.records import Record

Array = NDArray[np.float64]

_VARIED = 1.2  # ratio of brightest to faintest star from which on the scene matters
_SCENE_QUANTILE = 0.1  # a facet is unlit in far more records than these
_MIN_FOR_SCENE = 20


@dataclass(frozen=True, slots=True, eq=False)
class ResponseTable:
    """Accepted records as arrays.

    Attributes
    ----------
    facet_ids
        Order of the facets along the last axis of `response`.
    record_index
        Shape (n_records,). Number of each record in its run.
    theta_rad
        Shape (n_records, 2). Direction of the star, telescope frame.
    theta_uncertainty_rad
        Shape (n_records,). One standard deviation per axis; NaN when unknown.
    response
        Shape (n_records, n_facets). R_ij = m_ij / s_i (arXiv:1605.06274, eq. of section 2); NaN where not measured.
    faintness
        Shape (n_records,). How many times fainter than in the run's typical record the star was; ones when unknown.
        What does not come from the star is magnified by that much in `response`.
    """

    facet_ids: tuple[int, ...]
    record_index: NDArray[np.int64]
    theta_rad: Array
    theta_uncertainty_rad: Array
    response: Array
    faintness: Array

    @property
    def n_records(self) -> int:
        """Number of accepted records."""
        return len(self.record_index)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> ResponseTable:
        """The table of the chosen records only (mask or indices along the first axis)."""
        return ResponseTable(
            self.facet_ids,
            self.record_index[keep],
            self.theta_rad[keep],
            self.theta_uncertainty_rad[keep],
            self.response[keep],
            self.faintness[keep],
        )


def tabulate_responses(
    records: Iterable[Record], facet_ids: Sequence[int], *, is_at_rest: bool = False
) -> ResponseTable:
    """Response table of the records that count; rejected ones are left out.

    An unlit facet still shows the faint scene around the telescope, which does not fade with the star. Where the star's
    brightness varied over the run (clouds, zenith distance, another star), the scene of each facet, its dim
    records' intensity, is therefore taken off before the intensity is divided by that of the star. What changes in the
    scene meanwhile is taken off by `scene`, when the facets' light is known. Not so where the light is `is_at_rest`,
    all records in one direction: then a facet's dim records show it lit by a dim light.
    """
    accepted = [record for record in records if record.reject_reason is None]
    n = len(accepted)
    intensity = np.array([record.facet_intensity for record in accepted], dtype=np.float64).reshape(n, len(facet_ids))
    star = np.array([record.star_intensity for record in accepted], dtype=np.float64)
    if not is_at_rest and n >= _MIN_FOR_SCENE and star.max() > _VARIED * star.min():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a facet that was never measured stays NaN
            intensity = intensity - np.nanquantile(intensity, _SCENE_QUANTILE, axis=0)
    return ResponseTable(
        tuple(facet_ids),
        np.array([record.index for record in accepted], dtype=np.int64),
        np.array([record.theta_rad for record in accepted], dtype=np.float64).reshape(n, 2),
        np.array([record.theta_uncertainty_rad for record in accepted], dtype=np.float64),
        np.where(np.isfinite(intensity), intensity, np.nan) / star[:, None],
        np.median(star) / star if n else np.ones(0),
    )

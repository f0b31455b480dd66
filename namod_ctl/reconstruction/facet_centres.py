"""Centres of all facets with what stands against them, from the robust fits or from one of the simple estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import FacetFlag
from namod_ctl.reconstruction.alignment import BadRecord
from namod_ctl.reconstruction.estimators import Centres
from namod_ctl.reconstruction.facet_fit import FacetFit, centre_covariance
from namod_ctl.reconstruction.facet_psf import CENTRE
from namod_ctl.reconstruction.normalization import Normalization, centre_shift_per_exponent
from namod_ctl.reconstruction.quality import ScanRegion, judge_fit
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]


def robust_centres(
    used: ResponseTable, fits: Sequence[FacetFit | None], factors: Array, region: ScanRegion, size_rad: float
) -> tuple[Centres, list[FacetFlag], list[tuple[str, ...]]]:
    """Centres, flags and remarks of the robust fits to `used`, their covariances times `factors` (n_facets,)."""
    n = len(fits)
    theta, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    flags: list[FacetFlag] = []
    remarks: list[tuple[str, ...]] = []
    for j, fit in enumerate(fits):
        if fit is None:
            flags.append(FacetFlag.NO_SIGNAL)
            remarks.append(("its response is zero in every record",))
            continue
        facet_cov = factors[j] * centre_covariance(fit)
        verdict = judge_fit(fit, used, j, facet_cov, region, size_rad)
        flags.append(verdict.flags)
        remarks.append(verdict.remarks)
        if not verdict.flags & FacetFlag.NO_SIGNAL:
            theta[j], cov[j] = fit.parameters[CENTRE], verdict.centre_cov_rad2
    return Centres(theta, cov), flags, remarks


def with_doubt_of_slope(
    centres: Centres, used: ResponseTable, fits: Sequence[FacetFit | None], normalization: Normalization
) -> Centres:
    """The centres with what the uncertainty of the exponent that was taken out adds to their covariances."""
    cov = centres.theta_cov_rad2.copy()
    for j, fit in enumerate(fits):
        if fit is not None:
            shift = normalization.exponent_uncertainty * centre_shift_per_exponent(used, fit)
            cov[j] += np.outer(shift, shift)
    return replace(centres, theta_cov_rad2=cov)


def simple_flags(
    table: ResponseTable, centres: Centres, bad: Sequence[BadRecord], estimator: str
) -> tuple[list[FacetFlag], list[tuple[str, ...]]]:
    """Flags of an estimator that takes records at face value: only what it must not hide."""
    flags = [FacetFlag.NONE if np.isfinite(theta).all() else FacetFlag.NO_SIGNAL for theta in centres.theta_rad]
    remarks: list[tuple[str, ...]] = [() for _ in flags]
    if estimator == "brightest":
        for j, record in brightest_is_bad(table, bad).items():
            flags[j] |= FacetFlag.RESTS_ON_BAD_RECORD
            remarks[j] = (f"its brightest record is number {record.index}, {record.kind}: {record.detail}",)
    return flags, remarks


def brightest_is_bad(table: ResponseTable, bad: Sequence[BadRecord]) -> dict[int, BadRecord]:
    """Columns of the facets whose single brightest record is a bad one."""
    by_index = {record.index: record for record in bad}
    brightest = table.record_index[np.argmax(np.nan_to_num(table.response), axis=0)]
    return {j: by_index[int(index)] for j, index in enumerate(brightest) if int(index) in by_index}

"""Flags of a facet's estimate, each with the figures behind it in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.reconstruction.facet_fit import FacetFit
from namod_ctl.reconstruction.facet_psf import CENTRE, covariance_of_light
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

_LIT_SHARE = 0.1  # a record counts as in the PSF from this share of the facet's scale on
_MIN_LIT = 2  # one lit record is a direction, not a centre
_MIN_CONTRAST = 3.0  # lit responses over the 95 % level of the dark ones; pure noise reaches 2
_FAR_SIGMA = 4.0  # records beyond are dark
_MIN_DARK = 20  # dark records needed to know their level
_MAX_SIGMA_SIZES = 3.0  # the 3 sigma edge of a PSF: beyond, a corrected facet may miss the others altogether
_CUT_SIGMA, _CUT_SHARE = 2.0, 0.1  # a PSF is cut when more than this share of its 2 sigma ellipse was never visited
_N_ELLIPSE = 48


class ScanRegion:
    """The convex hull of the recorded directions. Raises DataQualityError when they span no area."""

    def __init__(self, theta_rad: Array) -> None:
        try:
            self._hull = Delaunay(theta_rad)
        except (QhullError, ValueError):
            raise DataQualityError(
                "the star's directions all lie on one line: let the telescope wander across the star in both "
                "directions and record again"
            ) from None

    def contains(self, theta_rad: Array) -> NDArray[np.bool_]:
        """For directions of shape (n, 2): which lie within the scan."""
        inside: NDArray[np.bool_] = self._hull.find_simplex(theta_rad) >= 0
        return inside


def n_lit_records(fit: FacetFit, response: Array) -> int:
    """Number of records in the facet's window in which it was lit, whatever its background."""
    dark = np.median(response[fit.used])
    return int(np.count_nonzero(response[fit.used] - dark > _LIT_SHARE * fit.scale))


def has_signal(fit: FacetFit, table: ResponseTable, facet: int) -> bool:
    """True when the facet's point spread function is brighter than its dark records ever are.

    `facet` is a column of the table, NaN is ignored. Compared is the brightness itself: with a faint star, darkness
    seems to respond. Dark records are those far from the centre; where the scan has too few of those, the dimmer half.
    """
    response = table.response[:, facet] / table.faintness
    measured = np.isfinite(response)
    offset = table.theta_rad - fit.parameters[CENTRE]
    inverse = np.linalg.inv(covariance_of_light(fit.parameters))
    is_near = np.einsum("ia,ab,ib->i", offset, inverse, offset) < _FAR_SIGMA**2
    dark, near = response[measured & ~is_near], response[measured & is_near]
    if len(dark) < _MIN_DARK:
        dark = np.sort(response[measured])[: max(1, int(measured.sum()) // 2)]
    if len(near) < _MIN_LIT:
        near = response[fit.used]
    if len(near) < _MIN_LIT:
        return False
    level = float(np.median(dark))
    scatter = float(np.quantile(np.abs(dark - level), 0.95))
    return bool(np.sort(near)[-_MIN_LIT] - level > _MIN_CONTRAST * scatter)


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What stands against an estimate, in words, and the covariance of its centre with all that counted, (2, 2)."""

    flags: FacetFlag
    remarks: tuple[str, ...]
    centre_cov_rad2: Array


def judge_fit(
    fit: FacetFit, table: ResponseTable, column: int, centre_cov_rad2: Array, region: ScanRegion, size_rad: float
) -> Verdict:
    """Verdict on a facet's robust estimate; `size_rad` is the width against which its uncertainty is measured."""
    response = table.response[:, column]
    if not has_signal(fit, table, column):
        return Verdict(FacetFlag.NO_SIGNAL, ("no response rises above the facet's background",), centre_cov_rad2)
    flags, remarks = FacetFlag.NONE, []
    centre = fit.parameters[CENTRE]
    if not region.contains(centre[None])[0]:
        flags |= FacetFlag.PSF_OUTSIDE_SCAN | FacetFlag.UNRELIABLE
        remarks.append("its centre lies outside the recorded directions: steer the telescope further out there")
    elif (cut := _cut_share(fit, region)) > _CUT_SHARE:
        flags |= FacetFlag.PSF_CUT_BY_SCAN_EDGE
        remarks.append(f"{100.0 * cut:.0f} % of its outline lies beyond the recorded directions")
        # the light that nobody saw may lie anywhere out there
        centre_cov_rad2 = centre_cov_rad2 + cut**2 * covariance_of_light(fit.parameters)
    n_lit = n_lit_records(fit, response)
    if n_lit < _MIN_LIT:
        flags |= FacetFlag.FEW_RECORDS | FacetFlag.UNRELIABLE
        remarks.append(f"lit in {n_lit} records only, {_MIN_LIT} are needed: record longer around its centre")
    sigma = math.sqrt(float(np.linalg.eigvalsh(centre_cov_rad2)[-1]))
    limit = _MAX_SIGMA_SIZES * size_rad
    if sigma > limit:
        flags |= FacetFlag.LARGE_UNCERTAINTY | FacetFlag.UNRELIABLE
        remarks.append(
            f"uncertain by {rad_to_arcmin(sigma):.1f} arcmin, the limit is {rad_to_arcmin(limit):.1f} arcmin"
        )
    return Verdict(flags, tuple(remarks), centre_cov_rad2)


def _cut_share(fit: FacetFit, region: ScanRegion) -> float:
    """Share of the outline of the point spread function, at 2 sigma, that lies beyond the scan."""
    angle = np.linspace(0.0, 2.0 * np.pi, _N_ELLIPSE, endpoint=False)
    circle = _CUT_SIGMA * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline = fit.parameters[CENTRE] + circle @ np.linalg.cholesky(covariance_of_light(fit.parameters)).T
    return float(1.0 - np.mean(region.contains(outline)))

"""The text report of a reconstruction: what a person at the telescope reads first."""

from __future__ import annotations

from collections.abc import Mapping
from math import floor, log10

import numpy as np

from namod_ctl.core.flags import FACET_FLAG_MEANING, REJECT_REASON_MEANING, FacetFlag, RejectReason
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.reconstruction.alignment import AreaOfPsf, FacetAlignment
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR
from namod_ctl.reconstruction.halves import HalvesComparison
from namod_ctl.reconstruction.normalization import slope_in_words
from namod_ctl.reconstruction.reconstruct import Reconstruction

REPORT_FILE = "report.txt"
LIMIT_WORDS = "limit of mirrors without figure errors (ray-traced)"
"""What the area of an ideal reflector is called wherever people read of it."""


def area_text(area: AreaOfPsf) -> str:
    """An area in square minutes of arc with its uncertainty, if it has one, in two significant digits."""
    if not np.isfinite(area.a_sigma_rad2):
        return "not known: this estimator states no uncertainty"
    value, uncertainty = rad2_to_arcmin2(area.a_sigma_rad2), rad2_to_arcmin2(area.uncertainty_rad2)
    if not uncertainty > 0.0:
        return f"{value:.1f} arcmin2"
    n_decimals = max(1 - floor(log10(uncertainty)), 0)
    if round(uncertainty, n_decimals) >= 10.0 ** (2 - n_decimals):  # 0.0996 is 0.10, not 0.100
        n_decimals = max(n_decimals - 1, 0)
    return f"{value:.{n_decimals}f} +- {uncertainty:.{n_decimals}f} arcmin2"


def report_text(result: Reconstruction, n_rejected: Mapping[RejectReason, int]) -> str:
    """The report as plain text, lines ended by newlines; `n_rejected` counts the records that never counted.

    What its areas mean: docs/decisions/0003.
    """
    alignment = result.alignment
    axis_deg = rad_to_deg(alignment.axis_rad)
    lines = [
        f"{alignment.telescope}: {len(alignment.facets)} facets, {alignment.n_records} records, "
        f"{alignment.n_used} used, estimator {alignment.estimator}",
    ]
    if n_rejected:
        reasons = ", ".join(f"{count} {REJECT_REASON_MEANING[reason]}" for reason, count in n_rejected.items())
        lines.append(f"{sum(n_rejected.values())} more were rejected when they were measured: {reasons}")
    if any(FacetFlag.NO_GAIN in facet.flags for facet in alignment.facets):
        lines += ["", f"DO NOT TURN ANYTHING: {FACET_FLAG_MEANING[FacetFlag.NO_GAIN]}."]
    lines += [
        "",
        "Point spread function of the whole reflector, A_sigma",
        f"  now                         {area_text(alignment.now)}",
        f"  predicted after correction  {area_text(alignment.predicted)}",
        f"  limit                       {area_text(result.limit)}",
        f"  aim of the corrections      ({axis_deg[0]:+.4f}, {axis_deg[1]:+.4f}) deg",
        f"  The {LIMIT_WORDS}: these facets, each of its own focal length,",
        "  perfectly aligned. The prediction is with facets of ideal figure, too: it is of ray-traced light, and what",
        "  the facets' own figure errors add is not in it. The preview of a campaign counts these errors.",
        "",
        f"Bad records: {len(alignment.bad_records)} of {alignment.n_records}, "
        + ("left out" if alignment.estimator == DEFAULT_ESTIMATOR else f"which estimator {alignment.estimator} uses"),
    ]
    for record in alignment.bad_records:
        facets = ", ".join(str(facet_id) for facet_id in record.facet_ids)
        lines.append(f"  {record.index:5d}  {record.kind}: {record.detail}" + (f"; facets {facets}" if facets else ""))
    lines += ["", "Normalization", *(f"  {line}" for line in _normalization_lines(result))]
    lines += ["", "What that changes", *(f"  {remark}" for remark in alignment.remarks), ""]
    if alignment.facets_not_in_run:
        missing = ", ".join(str(facet_id) for facet_id in alignment.facets_not_in_run)
        lines += [f"Facets of the config that this run does not have: ids {missing}", ""]
    lines.append("facet  theta_x   theta_y    +-     width maj x min  lit  flags")
    lines.append("       arcmin    arcmin   arcmin   arcmin       records")
    lines += [_facet_line(facet) for facet in alignment.facets]
    flags = FacetFlag.NONE
    for facet in alignment.facets:
        flags |= facet.flags
    if flags:
        lines += ["", "Flags", *(f"  {flag.name}: {FACET_FLAG_MEANING[flag]}" for flag in FacetFlag if flag in flags)]
    remarks = [
        f"  facet {facet.facet_id}: {remark}"
        for facet in alignment.facets
        for remark in facet.remarks
        if not remark.startswith("facet ")
    ]
    if remarks:
        lines += ["", "Remarks", *remarks]
    return "\n".join(lines) + "\n"


def _normalization_lines(result: Reconstruction) -> list[str]:
    """How responses depended on the star's brightness, and what was done about it."""
    found = result.normalization
    if not found.is_known:
        return [f"whether responses depend on the star's brightness is not known: {found.doubt}"]
    slope = f"responses against the star's brightness: {slope_in_words(found)}"
    if result.removed_exponent:
        return [slope, "significant; the self-calibration has taken it out of all responses"]
    if found.is_implausible:
        return [
            slope,
            "no calibration is off by that much: was it the star that the facets showed? Nothing was changed",
        ]
    if found.is_significant:
        return [slope, "significant, and still in the responses: the self-calibration was off"]
    return [slope, "not significant; the responses are as recorded"]


def _facet_line(facet: FacetAlignment) -> str:
    if not np.isfinite(facet.theta_rad).all():
        return f"{facet.facet_id:5d}  no estimate{'':34}{facet.n_records_in_psf:4d}  {' '.join(facet.flags.names)}"
    x, y = rad_to_arcmin(facet.theta_rad)
    sigma = float(rad_to_arcmin(np.sqrt(np.trace(facet.theta_cov_rad2) / 2.0)))
    major, minor = rad_to_arcmin(facet.width_major_rad), rad_to_arcmin(facet.width_minor_rad)
    uncertainty = f"{sigma:6.2f}" if np.isfinite(sigma) else "     -"
    return (
        f"{facet.facet_id:5d} {x:+8.2f}  {y:+8.2f}  {uncertainty}   {major:5.2f} x {minor:5.2f}  "
        f"{facet.n_records_in_psf:6d}  {' '.join(facet.flags.names)}"
    ).rstrip()


def halves_text(comparison: HalvesComparison) -> str:
    """How well two independent halves of the run agree, as plain text."""
    distance = rad_to_arcmin(comparison.distance_rad)
    known = np.isfinite(distance)
    lines = ["", "Even against odd records, distance of the two estimates of a facet"]
    lines.append("                     facets  median / arcmin  rms / arcmin  width of pulls")
    for name, chosen in (("all with an estimate", known), ("not flagged", known & ~comparison.is_flagged)):
        if not chosen.any():
            continue
        pull = comparison.pull[chosen]
        width = f"{np.std(pull):.2f}" if np.isfinite(pull).all() else "-"
        rms = np.sqrt(np.mean(distance[chosen] ** 2))
        lines.append(f"{name:20s} {int(chosen.sum()):6d} {np.median(distance[chosen]):16.2f} {rms:13.2f} {width:>15s}")
    flagged = [str(facet) for facet, flag in zip(comparison.facet_ids, comparison.is_flagged, strict=True) if flag]
    lines.append(f"Flagged in either half: {', '.join(flagged) or 'none'}")
    return "\n".join(lines) + "\n"

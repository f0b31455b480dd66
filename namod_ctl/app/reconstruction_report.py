"""The text report of a reconstruction: what a person at the telescope reads first."""

from __future__ import annotations

import numpy as np

from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.reconstruction.alignment import AreaOfPsf, FacetAlignment
from namod_ctl.reconstruction.reconstruct import Reconstruction

REPORT_FILE = "report.txt"


def _area(area: AreaOfPsf) -> str:
    value, uncertainty = rad2_to_arcmin2(area.a_sigma_rad2), rad2_to_arcmin2(area.uncertainty_rad2)
    return f"{value:.1f} +- {uncertainty:.1f} arcmin2" if uncertainty > 0.0 else f"{value:.1f} arcmin2"


def report_text(result: Reconstruction) -> str:
    """The report as plain text, lines ended by newlines."""
    alignment = result.alignment
    axis_deg = rad_to_deg(alignment.axis_rad)
    lines = [
        f"{alignment.telescope}: {len(alignment.facets)} facets, {alignment.n_records} records, "
        f"{alignment.n_used} used, estimator {alignment.estimator}",
        "",
        "Point spread function of the whole reflector, A_sigma",
        f"  now                         {_area(alignment.now)}",
        f"  predicted after correction  {_area(alignment.predicted)}",
        f"  ray-traced limit            {_area(result.limit)}",
        f"  aim of the corrections      ({axis_deg[0]:+.4f}, {axis_deg[1]:+.4f}) deg",
        "",
        f"Records left out as bad: {len(alignment.bad_records)} of {alignment.n_records}",
    ]
    for record in alignment.bad_records:
        facets = ", ".join(str(facet_id) for facet_id in record.facet_ids)
        lines.append(f"  {record.index:5d}  {record.kind}: {record.detail}" + (f"; facets {facets}" if facets else ""))
    lines += ["", "What that changes", *(f"  {remark}" for remark in alignment.remarks), ""]
    if alignment.facets_not_in_run:
        missing = ", ".join(str(facet_id) for facet_id in alignment.facets_not_in_run)
        lines += [f"Facets of the config that this run does not have: {missing}", ""]
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

"""What changed between two runs, as a table in the terminal and as compare.csv."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment
from namod_ctl.reconstruction.drift import FALSE_ALARM, Drift, FacetDrift

DRIFT_FILE = "compare.csv"
_UNQUIET = 3.0
MOST_ROWS = 60
"""As many facets are listed in a terminal; of more, those with the most significant drifts."""


def drift_csv(drift: Drift) -> str:
    """Text of compare.csv: one row per facet of both runs; empty where there is no number."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["facet_id", "theta_x_1_arcmin", "theta_y_1_arcmin", "theta_x_2_arcmin", "theta_y_2_arcmin",
         "drift_x_arcmin", "drift_y_arcmin", "drift_x_uncertainty_arcmin", "drift_y_uncertainty_arcmin",
         "drift_xy_cov_arcmin2", "significance_sigma", "has_moved", "flags_1", "flags_2"]
    )  # fmt: skip
    for facet in drift.facets:
        sigma_rad = np.sqrt(np.diag(facet.drift_cov_rad2))
        numbers = [*rad_to_arcmin(np.concatenate([facet.first.theta_rad, facet.second.theta_rad]))]
        numbers += [*rad_to_arcmin(facet.drift_rad), *rad_to_arcmin(sigma_rad)]
        numbers += [rad2_to_arcmin2(facet.drift_cov_rad2[0, 1]), facet.significance_sigma]
        writer.writerow(
            [
                facet.facet_id,
                *(f"{number:.4f}" if math.isfinite(number) else "" for number in numbers),
                int(facet.has_moved),
                "|".join(facet.first.flags.names),
                "|".join(facet.second.flags.names),
            ]
        )
    return text.getvalue()


def drift_table(drift: Drift, names: tuple[str, str]) -> Table:
    """One row per facet, the common shift taken off; of many facets only the most significant ones."""
    shown = sorted(drift.facets, key=lambda facet: -np.nan_to_num(facet.significance_sigma, nan=-1.0))[:MOST_ROWS]
    more = "" if len(shown) == len(drift.facets) else f", the {MOST_ROWS} most significant of {len(drift.facets)}"
    table = Table(
        title=f"Directions and drifts in arcmin{more}", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    table.add_column("facet", justify="right", no_wrap=True)
    for name in names:
        table.add_column(f"theta x, y in\n{name}", justify="right", no_wrap=True)
    for name in ("drift", "in x", "in y", "+-", "sigma"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", min_width=5)
    for facet in sorted(shown, key=lambda facet: facet.facet_id):
        table.add_row(*_cells(facet), style="bold" if facet.has_moved else "")
    return table


def _cells(facet: FacetDrift) -> list[str]:
    cells = [str(facet.facet_id), _theta(facet.first), _theta(facet.second)]
    if math.isfinite(facet.significance_sigma):
        x, y = rad_to_arcmin(facet.drift_rad)
        doubt = rad_to_arcmin(math.sqrt(float(np.trace(facet.drift_cov_rad2)) / 2.0))
        cells += [f"{math.hypot(x, y):.2f}", f"{x:+.2f}", f"{y:+.2f}", f"{doubt:.2f}"]
        cells.append(f"{facet.significance_sigma:.1f}")
    else:
        cells += ["-"] * 5
    flags = sorted({*facet.first.flags.names, *facet.second.flags.names})
    return [*cells, " ".join((["MOVED"] if facet.has_moved else []) + flags)]


def _theta(facet: FacetAlignment) -> str:
    if not np.isfinite(facet.theta_rad).all():
        return "no estimate"
    x, y = rad_to_arcmin(facet.theta_rad)
    return f"{x:+.2f} {y:+6.2f}"


def drift_summary(drift: Drift, alignments: tuple[Alignment, Alignment], names: tuple[str, str]) -> str:
    """What changed, in sentences."""
    x, y = rad_to_arcmin(drift.shift_rad)
    doubts = rad_to_arcmin(np.sqrt(np.diag(drift.shift_cov_rad2)))
    lines = [f"{alignments[0].telescope}: from {names[0]} to {names[1]}, {drift.n_compared} facets compared"]
    for name, alignment in zip(names, alignments, strict=True):
        area, doubt = rad2_to_arcmin2(alignment.now.a_sigma_rad2), rad2_to_arcmin2(alignment.now.uncertainty_rad2)
        lines.append(f"  A_sigma in {name}: {area:.1f} +- {doubt:.1f} arcmin2 ({alignment.n_used} records)")
    lines.append(
        f"  common shift, taken off: ({x:+.2f} +- {doubts[0]:.2f}, {y:+.2f} +- {doubts[1]:.2f}) arcmin, "
        f"from {drift.n_in_shift} facets"
    )
    if drift.scatter > _UNQUIET:
        lines.append(
            f"  the typical facet moved {drift.scatter:.0f} times its uncertainty: was the mirror aligned in between? "
            "The common shift is then little known, and all drifts with it"
        )
    moved = ", ".join(map(str, drift.moved_ids)) or "none"
    lines.append(
        f"  moved: {moved} ({len(drift.moved_ids)} of {drift.n_compared}; the chance that any of them is called so by "
        f"accident is {FALSE_ALARM:.0%})"
    )
    for name, ids in zip(names, (drift.only_in_first, drift.only_in_second), strict=True):
        if ids:
            lines.append(f"  only in {name}: facet {', '.join(map(str, ids))}")
    return "\n".join(lines)

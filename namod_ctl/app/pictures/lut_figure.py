"""Pictures of look-up tables over zenith distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from namod_ctl.app.lut.files import Lut
from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg

Array = NDArray[np.float64]

_BLUE = "#0072b2"
_STYLES = ((VERMILLION, "-", "o"), (_BLUE, "-", "s"), (ORANGE, "--", "^"))


def draw_lut(
    lut: Lut,
    zenith_rad: Array,
    curves: Sequence[tuple[str, Array]],
    title: str,
    uncertainty_rad2: Array | None = None,
) -> Figure:
    """A_sigma over zenith distance, each curve (n,), and how far every facet moves.

    `uncertainty_rad2` (n,) is drawn as a band about the last curve.
    """
    figure = Figure(figsize=(12.0, 5.4), dpi=DPI, facecolor="white")
    areas, facets = figure.add_axes((0.065, 0.1, 0.43, 0.7)), figure.add_axes((0.565, 0.1, 0.42, 0.7))
    zenith_deg = rad_to_deg(zenith_rad)
    for (name, area), (colour, line, mark) in zip(curves, _STYLES, strict=False):
        areas.plot(zenith_deg, rad2_to_arcmin2(area), line, marker=mark, ms=4, color=colour, label=name)
    if uncertainty_rad2 is not None:
        last = curves[-1][1]
        low, high = rad2_to_arcmin2(last - uncertainty_rad2), rad2_to_arcmin2(last + uncertainty_rad2)
        areas.fill_between(zenith_deg, low, high, color=_STYLES[len(curves) - 1][0], alpha=0.25, lw=0)
    limit = rad2_to_arcmin2(lut.table.limit_rad2())
    areas.axhline(limit, color="black", lw=1.2, ls=":", label=f"limit of these facets, {limit:.2f} arcmin²")
    top = max(float(rad2_to_arcmin2(np.max(area))) for _, area in curves)
    areas.set_ylim(0.97 * limit, max(1.04 * top + 0.02 * limit, 1.1 * limit))
    bottom = areas.get_ylim()[0]
    runs_deg = [run.zenith_deg for run in lut.runs]
    areas.plot(runs_deg, np.full(len(runs_deg), bottom), "^", color="black", ms=9, clip_on=False, label="runs")
    areas.set_xlabel("zenith distance [deg]")
    areas.set_ylabel("A_sigma [arcmin²]")
    areas.grid(alpha=0.3)
    areas.legend(fontsize=9, loc="lower left", bbox_to_anchor=(-0.01, 1.005), ncols=2, frameon=False)
    _draw_facets(facets, lut)
    figure.text(0.065, 0.945, title, fontsize=12)
    return figure


def _draw_facets(axes: Axes, lut: Lut) -> None:
    """How Theta of every facet moves from the least to the largest zenith distance of the runs."""
    table = lut.table
    low, high = table.zenith_range_rad
    motion = rad_to_arcmin(table.change_rad(low, high))
    reach = max(1.15 * float(np.abs(motion).max()), 0.05)
    sigma = rad_to_arcmin(np.sqrt(np.diagonal(table.change_cov_rad2(low, high), axis1=1, axis2=2)))
    moving = table.is_moving
    axes.errorbar(
        motion[moving, 0], motion[moving, 1], xerr=sigma[moving, 0], yerr=sigma[moving, 1],
        fmt="o", ms=3, color=_BLUE, ecolor=SKY, elinewidth=1.0, label=f"{int(moving.sum())} facets that move",
    )  # fmt: skip
    if not moving.all():
        axes.plot(0.0, 0.0, "x", color=VERMILLION, ms=9, mew=2, label=f"{int((~moving).sum())} facets left as they are")
    axes.axhline(0.0, color="grey", lw=0.6)
    axes.axvline(0.0, color="grey", lw=0.6)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_xlabel("theta_x [arcmin]")
    axes.set_ylabel("theta_y [arcmin]")
    words = f"Facets' motion from {rad_to_deg(low):.0f} to {rad_to_deg(high):.0f} deg, relative to their mean"
    axes.set_title(words, fontsize=10, pad=26.0)
    axes.legend(fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)

"""The sheet of all facets' point spread functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import AbstractPathEffect, withStroke
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, NOT_SEEN, ORANGE, VERMILLION, colours, ellipse_axes
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import rad2_to_deg2, rad_to_deg
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment
from namod_ctl.reconstruction.histograms import ResponseHistograms
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

PSF_MAPS_FILE = "psf_maps.png"

_SHOWN_SIGMAS = 3.0  # of an estimate's uncertainty; one alone would be hidden by the mark of the centre
_BRIGHT_SHARE = 0.99  # responses above this quantile share the brightest colour: stray light would dim all others
_MOST_DOTS = 60_000  # up to here records are drawn one by one, which shows a sparse run better than bins do
_GAP = 0.10  # between panels, share of a panel's width
_TITLE = 0.16  # room for the id above a panel, share of its width
_PANEL_IN = 2.0
_SHORTEST_EDGE_IN, _LONGEST_EDGE_IN = 7.0, 40.0
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN = 0.75, 1.25, 0.75, 0.85


@dataclass(frozen=True, slots=True, eq=False)
class _Mosaic:
    """Panels side by side in one pair of axes (deg): a thousand are drawn as quickly as thirty.

    Attributes
    ----------
    shifts_deg
        Shape (n_panels, 2). Added to a star direction to get its place in the panel; row by row from the top left.
    panel_pt
        Width of a panel.
    """

    x_deg: Array
    y_deg: Array
    n_columns: int
    n_rows: int
    shifts_deg: Array
    panel_pt: float

    @property
    def letters_pt(self) -> float:
        """Size of the letters at a panel."""
        return float(np.clip(0.085 * self.panel_pt, 3.0, 11.0))

    def box_deg(self, panel: int) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of a panel."""
        x, y = self.shifts_deg[panel]
        return self.x_deg[0] + x, self.x_deg[-1] + x, self.y_deg[0] + y, self.y_deg[-1] + y


def _lay_out(histograms: ResponseHistograms, n_panels: int) -> tuple[_Mosaic, tuple[float, float]]:
    """The mosaic and its size on paper in inches."""
    x_deg, y_deg = rad_to_deg(histograms.x_edges_rad), rad_to_deg(histograms.y_edges_rad)
    width, height = float(np.ptp(x_deg)), float(np.ptp(y_deg))
    pitch_x, pitch_y = width * (1.0 + _GAP), height + width * (_GAP + _TITLE)
    n_columns = max(1, round(math.sqrt(1.25 * n_panels * pitch_y / pitch_x)))
    n_rows = -(-n_panels // n_columns)
    row, column = np.divmod(np.arange(n_panels), n_columns)
    shifts_deg = np.column_stack([column * pitch_x - x_deg[0], -row * pitch_y - y_deg[-1]])
    panel_in = max(_PANEL_IN, _SHORTEST_EDGE_IN / n_columns)
    panel_in = min(panel_in, _LONGEST_EDGE_IN / n_columns, _LONGEST_EDGE_IN / n_rows)
    mosaic = _Mosaic(x_deg, y_deg, n_columns, n_rows, shifts_deg, panel_in / (1.0 + _GAP) * 72.0)
    return mosaic, (n_columns * panel_in, n_rows * panel_in * pitch_y / pitch_x)


def draw_psf_maps(histograms: ResponseHistograms, table: ResponseTable, alignment: Alignment) -> Figure:
    """All facets on one sheet in the order of their ids, with estimated centres and what stands against them.

    The records of short runs are drawn one by one, those of long ones as H_psf.
    """
    facets = {facet.facet_id: facet for facet in alignment.facets}
    order = np.argsort(table.facet_ids)
    mosaic, map_in = _lay_out(histograms, len(order))
    grow = max(1.0, map_in[0] / 14.0)  # of everything around the panels
    left_in, right_in, bottom_in, top_in = (grow * edge_in for edge_in in (_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN))
    size_in = (map_in[0] + left_in + right_in, map_in[1] + bottom_in + top_in)
    figure = Figure(figsize=size_in, dpi=DPI, facecolor="white")
    axes = figure.add_axes(
        (left_in / size_in[0], bottom_in / size_in[1], map_in[0] / size_in[0], map_in[1] / size_in[1])
    )

    brightest = float(np.nanquantile(table.response, _BRIGHT_SHARE))
    scale = PowerNorm(0.5, vmin=0.0, vmax=brightest if brightest > 0 else 1.0)
    is_sparse = table.response.size <= _MOST_DOTS
    ordered = [(table.facet_ids[column], facets.get(table.facet_ids[column])) for column in order]
    _draw_light(axes, mosaic, histograms, table, order, scale, is_sparse)
    for panel, (facet_id, facet) in enumerate(ordered):
        _draw_frame(axes, mosaic, panel, facet_id, facet)
    _draw_centres(axes, mosaic, [facet for _, facet in ordered])
    _label_axes(axes, mosaic, grow)

    bar_box = (1.0 - 0.92 * right_in / size_in[0], bottom_in / size_in[1], 0.16 * right_in / size_in[0])
    bar_axes = figure.add_axes((*bar_box, map_in[1] / size_in[1]))
    bar = figure.colorbar(ScalarMappable(scale, colours()), cax=bar_axes, extend="max", extendfrac=0.02)
    bar.set_label("normalized response R = m / s [1], square-root scale", fontsize=9 * grow)
    bar.ax.tick_params(labelsize=8 * grow)
    title = (
        f"{alignment.telescope}: point spread functions of {len(order)} facets, {table.n_records} records, "
        f"estimator {alignment.estimator}"
    )
    figure.text(left_in / size_in[0], 1.0 - 0.35 * top_in / size_in[1], title, fontsize=12 * grow, va="center")
    figure.legend(
        handles=_legend_handles(grow, is_sparse), loc="center left", ncols=5, fontsize=8 * grow, frameon=False,
        bbox_to_anchor=((left_in - 0.1) / size_in[0], 1.0 - 0.75 * top_in / size_in[1]), borderpad=0.0,
    )  # fmt: skip
    return figure


def _draw_light(
    axes: Axes,
    mosaic: _Mosaic,
    histograms: ResponseHistograms,
    table: ResponseTable,
    order: NDArray[np.int64],
    scale: PowerNorm,
    is_sparse: bool,
) -> None:
    if not is_sparse:
        psf = histograms.psf
        for panel, column in enumerate(order):
            axes.imshow(
                psf[column], origin="lower", extent=mosaic.box_deg(panel), cmap=colours(), norm=scale,
                interpolation="nearest", aspect="auto",
            )  # fmt: skip
        return
    places = rad_to_deg(table.theta_rad)[:, np.newaxis] + mosaic.shifts_deg
    response = table.response[:, order]
    brightest_last = np.argsort(response, axis=None)  # so that no dark record hides a bright one
    dot_pt = float(np.clip(0.5 * mosaic.panel_pt / math.sqrt(table.n_records), 1.0, 4.0))
    x_deg, y_deg = places.reshape(-1, 2)[brightest_last].T
    axes.scatter(
        x_deg, y_deg, c=response.ravel()[brightest_last], s=dot_pt**2,
        cmap=colours(), norm=scale, linewidths=0.0, zorder=1.5,
    )  # fmt: skip


_SHORT_NAMES = {
    FacetFlag.NO_SIGNAL: "no signal",
    FacetFlag.UNRELIABLE: "unreliable",
    FacetFlag.BEYOND_TRAVEL_LIMIT: "too far to turn",
    FacetFlag.PSF_OUTSIDE_SCAN: "outside scan",
    FacetFlag.PSF_CUT_BY_SCAN_EDGE: "cut by edge",
    FacetFlag.FEW_RECORDS: "few records",
    FacetFlag.LARGE_UNCERTAINTY: "uncertain",
}


def _facet_name(facet_id: int, facet: FacetAlignment | None) -> tuple[str, bool]:
    """What stands above a panel: the id and the gravest flag in words; and whether turning is forbidden."""
    if facet is None:
        return f"{facet_id}: not estimated", True
    words = [name for flag, name in _SHORT_NAMES.items() if flag in facet.flags]
    return (f"{facet_id}: {words[0]}" if words else str(facet_id)), facet.flags.forbids_turning


def _draw_frame(axes: Axes, mosaic: _Mosaic, panel: int, facet_id: int, facet: FacetAlignment | None) -> None:
    left, right, bottom, top = mosaic.box_deg(panel)
    name, is_forbidden = _facet_name(facet_id, facet)
    is_flagged = facet is not None and bool(facet.flags)
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fc=NOT_SEEN, ec="none", zorder=-1))
    frame = Rectangle((left, bottom), right - left, top - bottom, fc="none", ec="#808080", lw=0.5, zorder=2)
    if is_forbidden or is_flagged:
        frame.set(ec=VERMILLION if is_forbidden else ORANGE, lw=min(2.5, 0.025 * mosaic.panel_pt))
        frame.set_linestyle("-" if is_forbidden else "--")
    axes.add_patch(frame)
    axes.text(
        left, top + 0.03 * (right - left), name, fontsize=mosaic.letters_pt, va="bottom",
        weight="bold" if is_forbidden else "normal", color=VERMILLION if is_forbidden else "black",
    )  # fmt: skip


def _draw_centres(axes: Axes, mosaic: _Mosaic, facets: Sequence[FacetAlignment | None]) -> None:
    known = [
        (rad_to_deg(facet.theta_rad) + shift_deg, ellipse_axes(rad2_to_deg2(facet.theta_cov_rad2)))
        for facet, shift_deg in zip(facets, mosaic.shifts_deg, strict=True)
        if facet is not None and _is_in_view(facet, mosaic)
    ]
    if not known:
        return
    centres = np.array([centre for centre, _ in known])
    major, minor, angle = np.array([ellipse for _, ellipse in known]).T
    outline: list[AbstractPathEffect] = [withStroke(linewidth=2.5, foreground="white")]
    ellipses = EllipseCollection(
        _SHOWN_SIGMAS * major, _SHOWN_SIGMAS * minor, angle, units="xy", offsets=centres,
        offset_transform=axes.transData, facecolors="none", edgecolors=VERMILLION, linewidths=1.0, zorder=3,
    )  # fmt: skip
    ellipses.set_path_effects(outline)
    axes.add_collection(ellipses)
    size_pt = float(np.clip(0.045 * mosaic.panel_pt, 2.0, 6.0))
    mark_pt = max(0.6, 0.2 * size_pt)
    axes.plot(*centres.T, "+", color=VERMILLION, ms=size_pt, mew=mark_pt, path_effects=outline, zorder=4)


def _is_in_view(facet: FacetAlignment, mosaic: _Mosaic) -> bool:
    """False for no estimate, and for one outside the panel: it would be drawn into a neighbour's."""
    x_deg, y_deg = rad_to_deg(facet.theta_rad)
    return bool(mosaic.x_deg[0] <= x_deg <= mosaic.x_deg[-1] and mosaic.y_deg[0] <= y_deg <= mosaic.y_deg[-1])


def _label_axes(axes: Axes, mosaic: _Mosaic, grow: float) -> None:
    """Ticks in deg below the lowest panels and left of the leftmost ones; there is room for few, so for round ones."""
    columns = mosaic.shifts_deg[: mosaic.n_columns, 0]
    rows = mosaic.shifts_deg[:: mosaic.n_columns, 1]
    x_ticks, y_ticks = _round_ticks(mosaic.x_deg), _round_ticks(mosaic.y_deg)
    axes.set_xticks([float(tick + shift) for shift in columns for tick in x_ticks])
    axes.set_xticklabels([f"{tick:g}" for _ in columns for tick in x_ticks])
    axes.set_yticks([float(tick + shift) for shift in rows for tick in y_ticks])
    axes.set_yticklabels([f"{tick:g}" for _ in rows for tick in y_ticks])
    axes.tick_params(labelsize=0.85 * mosaic.letters_pt, length=2.0)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("star direction theta_x [deg]", fontsize=10 * grow)
    axes.set_ylabel("star direction theta_y [deg]", fontsize=10 * grow)
    width = float(np.ptp(mosaic.x_deg))
    axes.set_xlim(-0.02 * width, mosaic.box_deg(len(columns) - 1)[1] + 0.02 * width)
    axes.set_ylim(mosaic.box_deg(len(mosaic.shifts_deg) - 1)[2] - 0.02 * width, _TITLE * width)


def _round_ticks(edges_deg: Array) -> list[float]:
    """Zero and one round value to each side, as far as they lie inside."""
    reach = 0.8 * float(max(abs(edges_deg[0]), abs(edges_deg[-1])))
    decade = 10.0 ** math.floor(math.log10(reach))
    step = max(factor * decade for factor in (1.0, 2.0, 3.0, 5.0) if factor * decade <= reach)
    return [tick for tick in (-step, 0.0, step) if edges_deg[0] <= tick <= edges_deg[-1]]


def _legend_handles(grow: float, is_sparse: bool) -> list[Line2D | Patch]:
    cross = Line2D([], [], c=VERMILLION, ls="", marker="+", ms=7 * grow, mew=2 * grow, label="estimated centre")
    ring = Line2D([], [], c=VERMILLION, ls="", marker="o", mfc="none", ms=7 * grow, label="its uncertainty (3 sigma)")
    dot = Line2D([], [], c="#404040", ls="", marker="o", ms=4 * grow, mec="none", label="a record")
    return [
        cross,
        ring,
        Patch(fc="none", ec=VERMILLION, lw=2.0 * grow, label="do not turn"),
        Patch(fc="none", ec=ORANGE, lw=2.0 * grow, ls="--", label="flagged"),
        dot if is_sparse else Patch(fc=NOT_SEEN, ec="none", label="no record"),
    ]

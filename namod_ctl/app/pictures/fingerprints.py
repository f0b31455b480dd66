"""compare.png: the point spread functions of every facet in two runs, side by side.

As arXiv:1605.06274 shows them for 2014 and 2015: the shape of a facet's light is its fingerprint, its place says
whether the facet moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, NOT_SEEN, VERMILLION, colours
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.drift import Drift, FacetDrift
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

FINGERPRINTS_FILE = "compare.png"

_RECORDS_PER_BIN = 1.5
_MOST_BINS = 60  # along the edge of a map; finer ones are not seen at this size
_BRIGHT_SHARE = 0.99  # responses above this quantile share the brightest colour, as on the sheet of all maps
_MARGIN_WIDTHS = 2.5  # of a facet's light around the outermost centres
_PAIR_GAP, _MAP_GAP, _TITLE = 0.16, 0.04, 0.24  # shares of a map's width
_MAP_IN, _LONGEST_EDGE_IN, _SHORTEST_EDGE_IN = 0.95, 40.0, 8.5
_TOP_IN, _BOTTOM_IN, _SIDE_IN = 1.15, 0.55, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Fingerprint:
    """A run as it is compared: its name, what was found, and the records that it was found from."""

    name: str
    alignment: Alignment
    table: ResponseTable


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What every map shows, rad: a square of `n_bins` x `n_bins` bins from `low` on."""

    low: NDArray[np.int64]
    bin_rad: float
    n_bins: int

    def share(self, theta_rad: Array) -> Array:
        """Place in a map, (0, 0) at its lower left and (1, 1) at its upper right corner."""
        place: Array = (np.asarray(theta_rad) / self.bin_rad - self.low) / self.n_bins
        return place


def draw_fingerprints(first: Fingerprint, second: Fingerprint, drift: Drift) -> Figure:
    """Two small maps per facet of both runs: H_psf in the first run on the left, in the second on the right."""
    view = _view(first, second)
    maps = [_maps(run.table, view) for run in (first, second)]
    n_columns, map_in = _columns(len(drift.facets))
    pitch = np.array([2.0 + _MAP_GAP + _PAIR_GAP, 1.0 + _PAIR_GAP + _TITLE])
    n_rows = -(-len(drift.facets) // n_columns)
    size_in = np.array([n_columns, n_rows]) * pitch * map_in + [2 * _SIDE_IN, _TOP_IN + _BOTTOM_IN]
    figure = Figure(figsize=tuple(size_in), dpi=DPI, facecolor="white")
    box = (_SIDE_IN / size_in[0], _BOTTOM_IN / size_in[1])
    axes = figure.add_axes((*box, 1.0 - 2 * box[0], 1.0 - (_TOP_IN + _BOTTOM_IN) / size_in[1]))
    axes.set_xlim(0.0, n_columns * pitch[0])
    axes.set_ylim(-n_rows * pitch[1], 0.0)
    axes.set_axis_off()
    letters_pt = float(np.clip(9.0 * map_in, 4.0, 9.0))
    for number, facet in enumerate(drift.facets):
        row, column = divmod(number, n_columns)
        corner = np.array([column * pitch[0] + 0.5 * _PAIR_GAP, -(row + 1) * pitch[1] + 0.5 * _PAIR_GAP])
        for side, of_run in enumerate(maps):
            of_side = corner + np.array([side * (1.0 + _MAP_GAP), 0.0])
            _draw_map(axes, of_side, of_run.get(facet.facet_id), facet, view)
        _draw_title(axes, corner, facet, letters_pt)
    _write_head(figure, size_in, (first, second), drift, view)
    return figure


def _view(first: Fingerprint, second: Fingerprint) -> _View:
    """A square that holds the light of all facets in both runs, as far as it was scanned."""
    facets = [facet for run in (first, second) for facet in run.alignment.facets]
    centres = np.array([facet.theta_rad for facet in facets if np.isfinite(facet.theta_rad).all()])
    width_rad = float(np.nanmedian([facet.width_major_rad for facet in facets]))
    scanned = np.concatenate([run.table.theta_rad for run in (first, second)])
    low = np.maximum(centres.min(axis=0) - _MARGIN_WIDTHS * width_rad, scanned.min(axis=0))
    high = np.minimum(centres.max(axis=0) + _MARGIN_WIDTHS * width_rad, scanned.max(axis=0))
    edge_rad = float((high - low).max())
    # the sparser run decides how large bins must be, so that both are drawn alike
    area_rad2 = float(np.prod(np.ptp(scanned, axis=0)))
    n_records = min(first.table.n_records, second.table.n_records)
    bin_rad = max(edge_rad / _MOST_BINS, math.sqrt(_RECORDS_PER_BIN * area_rad2 / n_records))
    n_bins = math.ceil(edge_rad / bin_rad) + 1
    middle = 0.5 * (low + high) / bin_rad
    return _View(np.floor(middle - 0.5 * n_bins + 0.5).astype(np.int64), bin_rad, n_bins)


def _maps(table: ResponseTable, view: _View) -> dict[int, Array]:
    """H_psf in the view by facet id, shape (n_bins, n_bins), 1 for what is as bright as the run's brightest facets."""
    histograms = histogram_responses(table, view.bin_rad)
    psf = histograms.psf
    brightest = float(np.nanquantile(table.response, _BRIGHT_SHARE))
    edges = np.array([histograms.x_edges_rad[0], histograms.y_edges_rad[0]])
    column, row = np.rint(edges / view.bin_rad).astype(np.int64) - view.low
    whole = np.full((len(psf), view.n_bins, view.n_bins), np.nan)
    to_rows, from_rows = _overlap(int(row), psf.shape[1], view.n_bins)
    to_columns, from_columns = _overlap(int(column), psf.shape[2], view.n_bins)
    whole[:, to_rows, to_columns] = psf[:, from_rows, from_columns] / (brightest if brightest > 0.0 else 1.0)
    return dict(zip(table.facet_ids, whole, strict=True))


def _overlap(start: int, n_from: int, n_to: int) -> tuple[slice, slice]:
    """Slices of the target and of the source, which lies at `start` in the target."""
    first, last = max(start, 0), max(min(start + n_from, n_to), 0)
    return slice(first, max(first, last)), slice(first - start, max(first, last) - start)


def _columns(n_facets: int) -> tuple[int, float]:
    """Pairs side by side, and the width of a map in inches."""
    n_columns = max(1, round(math.sqrt(0.75 * n_facets)))
    pairs_in = n_columns * (2.0 + _MAP_GAP + _PAIR_GAP)
    return n_columns, min(max(_MAP_IN, _SHORTEST_EDGE_IN / pairs_in), _LONGEST_EDGE_IN / pairs_in)


def _draw_map(axes: Axes, corner: Array, light: Array | None, facet: FacetDrift, view: _View) -> None:
    x, y = corner
    axes.add_patch(Rectangle((x, y), 1.0, 1.0, fc=NOT_SEEN, ec="none", zorder=0))
    if light is not None:
        axes.imshow(
            light, origin="lower", extent=(x, x + 1.0, y, y + 1.0), cmap=colours(),
            norm=PowerNorm(0.5, vmin=0.0, vmax=1.0, clip=True), interpolation="nearest", aspect="auto", zorder=1,
        )  # fmt: skip
    place = view.share(facet.first.theta_rad)  # in both maps: motion shows against it
    if np.all((place >= 0.0) & (place <= 1.0)):
        outline = [withStroke(linewidth=2.5, foreground="black")]
        axes.plot(*(corner + place), "+", color="white", ms=6, mew=1.2, path_effects=outline, zorder=3)


def _draw_title(axes: Axes, corner: Array, facet: FacetDrift, letters_pt: float) -> None:
    x, y = corner
    words = f"{facet.facet_id}"
    if math.isfinite(facet.significance_sigma):
        words += f": {rad_to_arcmin(float(np.linalg.norm(facet.drift_rad))):.2f}′, {facet.significance_sigma:.1f}σ"
    else:
        words += ": not compared"
    axes.text(
        x, y + 1.04, words, fontsize=letters_pt, va="bottom", weight="bold" if facet.has_moved else "normal",
        color=VERMILLION if facet.has_moved else "black",
    )  # fmt: skip
    if facet.has_moved:
        axes.add_patch(Rectangle((x, y), 2.0 + _MAP_GAP, 1.0, fc="none", ec=VERMILLION, lw=2.0, zorder=4))


def _write_head(
    figure: Figure, size_in: Array, runs: tuple[Fingerprint, Fingerprint], drift: Drift, view: _View
) -> None:
    left = _SIDE_IN / size_in[0]
    x, y = rad_to_arcmin(drift.shift_rad)
    areas = [
        f"{side} {run.name}, A_sigma {rad2_to_arcmin2(run.alignment.now.a_sigma_rad2):.1f} ± "
        f"{rad2_to_arcmin2(run.alignment.now.uncertainty_rad2):.1f} arcmin²"
        for side, run in zip(("left", "right"), runs, strict=True)
    ]
    lines = [
        (f"{runs[0].alignment.telescope}: {areas[0]};  {areas[1]}", 11),
        (
            f"Common shift ({x:+.2f}, {y:+.2f}) arcmin, taken off the drifts.  Each map is "
            f"{rad_to_arcmin(view.n_bins * view.bin_rad):.1f} arcmin wide, each run on its own square-root scale.",
            9,
        ),
    ]
    for line, (text, size_pt) in enumerate(lines):
        figure.text(left, 1.0 - (0.27 + 0.25 * line) / size_in[1], text, fontsize=size_pt, va="center")
    cross = Line2D([], [], c="#808080", ls="", marker="+", ms=8, mew=2, label="centre in the first run, in both maps")
    moved = Patch(fc="none", ec=VERMILLION, lw=2.0, label="moved significantly")
    figure.legend(
        handles=[cross, moved, Patch(fc=NOT_SEEN, ec="none", label="no record")], loc="center left", ncols=3,
        fontsize=9, frameon=False, bbox_to_anchor=(left, 1.0 - 0.83 / size_in[1]), borderpad=0.0,
    )  # fmt: skip
    footer = "Above each pair: facet, drift in arcmin without the common shift, significance in sigma."
    figure.text(left, 0.2 / size_in[1], footer, fontsize=9)

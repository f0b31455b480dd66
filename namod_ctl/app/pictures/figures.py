"""Figures of a reconstruction as a whole: the exposure map, and the light of all facets together."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, NOT_SEEN, ORANGE, SKY, VERMILLION, colours, ellipse_axes
from namod_ctl.app.pictures.label_places import LabelPlaces
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf
from namod_ctl.reconstruction.histograms import ResponseHistograms
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

EXPOSURE_MAP_FILE = "exposure_map.png"
PSF_SUM_FILE = "psf_sum.png"

_MOST_LABELS = 60
_FAR_LABEL_PT = 10.0
_LETTERS_PER_IN = 14.0  # of the footer's size, about


@dataclass(frozen=True, slots=True, eq=False)
class PsfPanel:
    """One distribution of the whole reflector's light over directions.

    Attributes
    ----------
    x_centres_rad, y_centres_rad
        Shapes (n_columns,) and (n_rows,), ascending; centres of bins of one size.
    light
        Shape (n_rows, n_columns). Light per bin in any unit; NaN where nothing is known.
    centre_rad, cov_rad2
        Shapes (2,) and (2, 2). Centre of gravity and covariance of the light.
    """

    title: str
    x_centres_rad: Array
    y_centres_rad: Array
    light: Array
    centre_rad: Array
    cov_rad2: Array
    area: AreaOfPsf


def draw_exposure_map(histograms: ResponseHistograms, table: ResponseTable, alignment: Alignment) -> Figure:
    """H_exposure: how many records fell where, with the records that were left out and their numbers.

    `histograms` and `table` are of all records, those included that were left out of the estimates.
    """
    figure = Figure(figsize=(9.0, 7.6), dpi=DPI, facecolor="white")
    axes = figure.add_axes((0.10, 0.09, 0.72, 0.78))
    x_deg, y_deg = rad_to_deg(histograms.x_edges_rad), rad_to_deg(histograms.y_edges_rad)
    exposure = np.where(histograms.exposure > 0, histograms.exposure, np.nan)
    most = float(histograms.exposure.max())
    mesh = axes.pcolormesh(x_deg, y_deg, exposure, cmap=colours(), norm=PowerNorm(0.5, vmin=0.0, vmax=most))
    axes.set_facecolor(NOT_SEEN)
    axes.set_aspect("equal")
    margin_deg = 0.03 * float(max(np.ptp(x_deg), np.ptp(y_deg)))  # so that marks at the edge are whole
    axes.set_xlim(x_deg[0] - margin_deg, x_deg[-1] + margin_deg)
    axes.set_ylim(y_deg[0] - margin_deg, y_deg[-1] + margin_deg)
    axes.set_xlabel("star direction theta_x [deg]")
    axes.set_ylabel("star direction theta_y [deg]")
    bar = figure.colorbar(mesh, cax=figure.add_axes((0.85, 0.09, 0.025, 0.78)))
    bar.locator = MaxNLocator(integer=True)
    bar.update_ticks()
    bar.set_label("records per bin, square-root scale")
    axes.plot(
        *rad_to_deg(alignment.axis_rad), "x", color=SKY, ms=12, mew=2.5, label="axis that corrections aim at",
        path_effects=[withStroke(linewidth=4.5, foreground="black")], zorder=4,
    )  # fmt: skip
    theta_of = dict(zip(table.record_index.tolist(), rad_to_deg(table.theta_rad), strict=True))
    bad = [record.index for record in alignment.bad_records if record.index in theta_of]
    if bad:
        points = np.array([theta_of[index] for index in bad])
        label = f"{len(bad)} records left out, with their numbers"
        axes.plot(*points.T, "o", mfc="none", mec=VERMILLION, ms=9, mew=2, label=label, zorder=3)
        _number_records(figure, axes, bad[:_MOST_LABELS], points)
    bin_deg = float(x_deg[1] - x_deg[0])
    covered_deg2 = np.count_nonzero(histograms.exposure) * bin_deg**2
    figure.text(
        0.10, 0.965,
        f"{alignment.telescope}: exposure map of {table.n_records} records, bins of {bin_deg:.3g} deg, "
        f"{covered_deg2:.3g} deg² seen at least once",
        fontsize=11, va="center",
    )  # fmt: skip
    figure.legend(loc="upper left", bbox_to_anchor=(0.09, 0.945), ncols=2, fontsize=9, frameon=False)
    if len(bad) > _MOST_LABELS:
        figure.text(0.82, 0.01, f"only the first {_MOST_LABELS} numbers are shown", fontsize=8, ha="right")
    return figure


def _number_records(figure: Figure, axes: Axes, numbers: Sequence[int], points: Array) -> None:
    """Numbers beside their marks, none over another number or mark; a line joins those that stand far off."""
    axes.apply_aspect()
    to_pixel = axes.transData
    marks_px = to_pixel.transform(points)
    letters_pt = 8.0
    pixel_per_pt = figure.dpi / 72.0
    corners = axes.get_window_extent()
    places = LabelPlaces(np.array([corners.x0, corners.y0, corners.x1, corners.y1]), marks_px, 7.0 * pixel_per_pt)
    lines = []
    for number, mark_px in zip(numbers, marks_px[: len(numbers)], strict=True):
        size_px = np.array([0.72 * len(str(number)) + 0.3, 1.25]) * letters_pt * pixel_per_pt
        centre_px = places.place(size_px, mark_px)
        if centre_px is None:
            continue
        x, y = to_pixel.inverted().transform(centre_px)
        axes.text(
            x, y, str(number), fontsize=letters_pt, ha="center", va="center_baseline", zorder=5,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip
        if np.linalg.norm(centre_px - mark_px) > 2.0 * _FAR_LABEL_PT * pixel_per_pt:
            lines.append(to_pixel.inverted().transform([mark_px, centre_px]))
    axes.add_collection(LineCollection(lines, colors=VERMILLION, linewidths=0.8, zorder=2))


def draw_psf_sum(panels: Sequence[PsfPanel], telescope: str, limit: AreaOfPsf | None = None) -> Figure:
    """The whole reflector's light side by side (now, after correction) at one scale, with A_sigma ellipses.

    `limit` is the ray-traced area of the perfectly aligned reflector, written below.
    """
    reach = [_reach_arcmin(panel) for panel in panels]
    lowest, highest = np.min([low for low, _ in reach], axis=0), np.max([high for _, high in reach], axis=0)
    panel_in = 5.4
    size_in = (0.9 + panel_in * len(panels) + 1.0, 6.85)
    bottom, height = 0.94 / size_in[1], (panel_in - 0.36) / size_in[1]
    figure = Figure(figsize=size_in, dpi=DPI, facecolor="white")
    densities = [_density(panel) for panel in panels]
    norm = PowerNorm(0.5, vmin=0.0, vmax=max(float(np.nanmax(density)) for density in densities))
    for number, (panel, density) in enumerate(zip(panels, densities, strict=True)):
        left = (0.8 + panel_in * number) / size_in[0]
        axes = figure.add_axes((left, bottom, (panel_in - 0.35) / size_in[0], height))
        mesh = axes.pcolormesh(
            rad_to_arcmin(panel.x_centres_rad), rad_to_arcmin(panel.y_centres_rad), density,
            cmap=colours(), norm=norm, shading="nearest",
        )  # fmt: skip
        _draw_area(axes, panel)
        axes.set_facecolor(NOT_SEEN)
        axes.set_xlim(lowest[0], highest[0])
        axes.set_ylim(lowest[1], highest[1])
        axes.set_aspect("equal")
        axes.set_xlabel("theta_x [arcmin]")
        if number == 0:
            axes.set_ylabel("theta_y [arcmin]")
        else:
            axes.tick_params(labelleft=False)
        axes.set_title(f"{panel.title}\nA_sigma = {_area_text(panel.area)}", fontsize=11)
    bar = figure.colorbar(mesh, cax=figure.add_axes((1.0 - 0.85 / size_in[0], bottom, 0.18 / size_in[0], height)))
    bar.set_label("share of all light per arcmin², square-root scale")
    title = f"{telescope}: point spread function of the whole reflector"
    figure.text(0.8 / size_in[0], 1.0 - 0.12 / size_in[1], title, fontsize=12, va="top")
    footer = "Ellipse: one standard deviation of the light; its area is A_sigma."
    if limit is not None:
        footer += f"  Ray-traced limit of perfectly aligned facets without figure errors: {_area_text(limit)}."
    footer = textwrap.fill(footer, int(_LETTERS_PER_IN * (size_in[0] - 0.9)))
    figure.text(0.8 / size_in[0], 0.015, footer, fontsize=9)
    return figure


def _reach_arcmin(panel: PsfPanel) -> tuple[Array, Array]:
    bin_rad = np.array([np.diff(panel.x_centres_rad).mean(), np.diff(panel.y_centres_rad).mean()])
    lowest = np.array([panel.x_centres_rad[0], panel.y_centres_rad[0]]) - 0.5 * bin_rad
    highest = np.array([panel.x_centres_rad[-1], panel.y_centres_rad[-1]]) + 0.5 * bin_rad
    return rad_to_arcmin(lowest), rad_to_arcmin(highest)


def _density(panel: PsfPanel) -> Array:
    """Share of all light per arcmin^2: comparable between panels of other bins and other units."""
    bin_rad2 = float(np.diff(panel.x_centres_rad).mean() * np.diff(panel.y_centres_rad).mean())
    density: Array = panel.light / (np.nansum(panel.light) * rad2_to_arcmin2(bin_rad2))
    return density


def _draw_area(axes: Axes, panel: PsfPanel) -> None:
    x, y = rad_to_arcmin(panel.centre_rad)
    major, minor, angle_deg = ellipse_axes(rad2_to_arcmin2(panel.cov_rad2))
    outline = [withStroke(linewidth=4.0, foreground="black")]
    ellipse = Ellipse((x, y), major, minor, angle=angle_deg, fc="none", ec=ORANGE, lw=2.0, path_effects=outline)
    axes.add_patch(ellipse)
    axes.plot(x, y, "+", color=ORANGE, ms=10, mew=2, path_effects=outline)


def _area_text(area: AreaOfPsf) -> str:
    value, uncertainty = rad2_to_arcmin2(area.a_sigma_rad2), rad2_to_arcmin2(area.uncertainty_rad2)
    if not math.isfinite(value):
        return "unknown"
    digits = 2 if 0.0 < uncertainty < 0.1 else 1
    return f"{value:.{digits}f} ± {uncertainty:.{digits}f} arcmin²" if uncertainty > 0 else f"{value:.1f} arcmin²"

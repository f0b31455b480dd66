"""The picture of the optical axis: where every measurement puts it, and how it moves with the zenith distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION, ellipse_axes
from namod_ctl.calibration.geometry.optical_axis import AxisFit, AxisPosition
from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.camera_model import CameraModel

MARGIN = 1.35
SMALLEST_PX = 1.0


def draw_axis(fit: AxisFit, positions: Sequence[AxisPosition], names: Sequence[str], camera: CameraModel) -> Figure:
    """Measurements in the image of `camera` with their uncertainties, and over the zenith distance where it is told."""
    has_zenith = all(position.zenith_rad is not None for position in positions) and len(positions) > 1
    figure = Figure(figsize=(11.0, 4.8) if has_zenith else (6.0, 5.2), dpi=DPI, facecolor="white")
    image = figure.add_axes((0.08, 0.13, 0.36, 0.72) if has_zenith else (0.15, 0.12, 0.78, 0.74))
    points = np.array([position.pixel for position in positions])
    for position, name in zip(positions, names, strict=True):
        major, minor, angle = ellipse_axes(position.covariance_px2)
        image.add_patch(Ellipse(tuple(position.pixel), major, minor, angle=angle, fill=False, edgecolor=SKY, lw=1.2))
        label = name if position.zenith_rad is None else f"{rad_to_deg(position.zenith_rad):.0f} deg"
        image.annotate(
            label,
            tuple(position.pixel),
            xytext=(8, 6),
            textcoords="offset points",
            fontsize=8,
            path_effects=[withStroke(linewidth=3.0, foreground="white")],
            zorder=5,
        )
    image.plot(*points.T, "o", color=SKY, ms=5, label="measured")
    image.plot(*fit.pixel, "x", color=VERMILLION, ms=9, mew=2.0, label="axis")
    sigma = np.sqrt(np.diag(fit.covariance_px2))
    reach = MARGIN * max(float(np.abs(points - fit.pixel).max()), 2.0 * float(sigma.max()), SMALLEST_PX)
    image.set_xlim(fit.pixel[0] - reach, fit.pixel[0] + reach)
    image.set_ylim(fit.pixel[1] + reach, fit.pixel[1] - reach)
    image.set_aspect("equal")
    image.ticklabel_format(useOffset=False)
    image.tick_params(axis="x", labelsize=8)
    image.set_xlabel("column [px]")
    image.set_ylabel("row [px]")
    image.legend(fontsize=8, loc="upper right")
    if has_zenith:
        zenith_deg = np.array([rad_to_deg(position.zenith_rad or 0.0) for position in positions])
        order = np.argsort(zenith_deg)
        for k, (name, colour) in enumerate((("column", SKY), ("row", ORANGE))):
            axes = figure.add_axes((0.56, 0.52 - 0.39 * k, 0.41, 0.33))
            doubt = np.array([np.sqrt(position.covariance_px2[k, k]) for position in positions])
            axes.errorbar(zenith_deg[order], points[order, k], doubt[order], fmt="o-", color=colour, capsize=3, lw=1.0)
            axes.axhline(fit.pixel[k], color="#777777", lw=0.8)
            axes.ticklabel_format(useOffset=False, axis="y")
            axes.set_ylabel(f"{name} [px]")
            if k == 0:
                axes.set_xticklabels([])
            else:
                axes.set_xlabel("zenith distance [deg]")
    figure.suptitle(
        f"optical axis: column {fit.pixel[0]:.2f} +- {sigma[0]:.2f}, row {fit.pixel[1]:.2f} +- {sigma[1]:.2f}",
        fontsize=10,
        y=0.96,
    )
    return figure

"""The picture of a star's trail: where it crossed the image, and what the fit leaves."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION
from namod_ctl.calibration.geometry.star_trail import TrailFit
from namod_ctl.calibration.geometry.trail_solution import Trail
from namod_ctl.core.units import rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel

MAX_SHOWN_SIGMAS = 6.0


def draw_trail(fit: TrailFit, trail: Trail, camera: CameraModel, title: str) -> Figure:
    """The trail in the image of `camera`, and its residuals along and across the motion over time."""
    figure = Figure(figsize=(11.0, 4.8), dpi=DPI, facecolor="white")
    image = figure.add_axes((0.07, 0.13, 0.36, 0.70))
    image.set_xlim(-0.5, camera.n_columns - 0.5)
    image.set_ylim(camera.n_rows - 0.5, -0.5)
    image.set_aspect("equal")
    image.set_xlabel("column [px]")
    image.set_ylabel("row [px]")
    used, out = fit.is_used, ~fit.is_used
    image.plot(*trail.pixel[used].T, ".", color=SKY, ms=5, label=f"{np.count_nonzero(used)} frames")
    if out.any():
        image.plot(*trail.pixel[out].T, "x", color=VERMILLION, ms=7, label=f"{np.count_nonzero(out)} left out")
    first, last = trail.pixel[used][0], trail.pixel[used][-1]
    image.annotate("", xy=tuple(last), xytext=tuple(first), arrowprops={"arrowstyle": "->", "color": "#777777"})
    image.legend(loc="upper right", fontsize=8)
    image.set_title(f"moves {rad_to_deg(fit.direction_rad):.2f} deg from the columns", fontsize=9)
    minutes = (trail.time_s - trail.time_s[0]) / 60.0
    limit = MAX_SHOWN_SIGMAS * float(max(fit.rms_px.max(), 1e-3))
    for row, (name, colour) in enumerate((("along", SKY), ("across", ORANGE))):
        axes = figure.add_axes((0.54, 0.51 - 0.38 * row, 0.43, 0.32))
        values = np.clip(fit.residual_px[:, row], -limit, limit)
        axes.axhline(0.0, color="#777777", lw=0.8)
        axes.plot(minutes[used], values[used], ".", color=colour, ms=5)
        axes.plot(minutes[out], values[out], "x", color=VERMILLION, ms=7)
        axes.set_ylabel(f"{name} the path [px]", fontsize=9)
        axes.set_title(f"scatter {fit.rms_px[row]:.3f} px", fontsize=8, loc="right", pad=2)
        if row == 0:
            axes.set_xticklabels([])
        else:
            axes.set_xlabel("time [min]")
    scale, doubt = rad_to_mdeg(fit.camera.plate_scale_rad), rad_to_mdeg(fit.plate_scale_uncertainty_rad)
    figure.suptitle(f"{title}: {scale:.5f} +- {doubt:.5f} mdeg per px", fontsize=11, y=0.97)
    return figure

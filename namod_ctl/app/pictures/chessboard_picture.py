"""The picture of a calibration with chessboards: where the corners were, what the fit leaves, how the lens bends."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION
from namod_ctl.calibration.geometry.chessboard import ChessboardFit
from namod_ctl.core.units import rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel

ARROW_SHARE = 0.02
"""Of the image's width: how long the typical residual is drawn."""


def draw_chessboard(fit: ChessboardFit, camera: CameraModel) -> Figure:
    """Corners with their residuals in the image of `camera`, and the lens' distortion over the angle."""
    figure = Figure(figsize=(11.0, 4.8), dpi=DPI, facecolor="white")
    image = figure.add_axes((0.07, 0.13, 0.42, 0.70))
    image.set_xlim(-0.5, camera.n_columns - 0.5)
    image.set_ylim(camera.n_rows - 0.5, -0.5)
    image.set_aspect("equal")
    image.set_xlabel("column [px]")
    image.set_ylabel("row [px]")
    corners = np.concatenate([view.corners_px for view in fit.views])
    left = fit.corner_residual_px.reshape(-1, 2)
    enlarged = ARROW_SHARE * camera.n_columns / max(fit.residual_rms_px, 1e-6)
    image.plot(*corners.T, ".", color=SKY, ms=3)
    image.quiver(
        *corners.T, *(left * enlarged).T, angles="xy", scale_units="xy", scale=1.0, color=VERMILLION, width=0.002
    )
    image.set_title(
        f"{len(fit.views)} boards; residuals {fit.residual_rms_px:.3f} px rms, drawn {enlarged:.0f} times longer",
        fontsize=9,
    )
    axes = figure.add_axes((0.58, 0.13, 0.38, 0.70))
    bend = fit.camera.distortion
    assert bend is not None
    corner_px = np.array([[0.0, 0.0], [camera.n_columns - 1.0, camera.n_rows - 1.0]]) - bend.centre_pixel
    radius_px = np.linspace(0.0, float(np.linalg.norm(corner_px, axis=1).max()), 200)
    angle2 = (fit.camera.plate_scale_rad * radius_px) ** 2
    share = bend.k1_per_rad2 * angle2 + bend.k2_per_rad4 * angle2**2
    axes.axhline(0.0, color="#777777", lw=0.8)
    axes.plot(rad_to_deg(np.sqrt(angle2)), -share * radius_px, color=SKY, lw=2, label="this lens")
    tangent = np.tan(np.sqrt(angle2)) / np.maximum(np.sqrt(angle2), 1e-9)
    axes.plot(
        rad_to_deg(np.sqrt(angle2[1:])), (tangent[1:] - 1.0) * radius_px[1:], "--", color=ORANGE, lw=1.5,
        label="a perfect lens (tangent)",
    )  # fmt: skip
    axes.set_xlabel("angle from the centre of distortion [deg]")
    axes.set_ylabel("shift outwards against a linear scale [px]")
    axes.legend(fontsize=8)
    scale, doubt = rad_to_mdeg(fit.camera.plate_scale_rad), rad_to_mdeg(fit.plate_scale_uncertainty_rad)
    figure.suptitle(f"chessboard: {scale:.4f} +- {doubt:.4f} mdeg per px in the centre", fontsize=11, y=0.97)
    return figure

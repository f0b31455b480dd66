"""The picture of a star field: what was recognized, how well it fits, and how the lens bends."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION
from namod_ctl.app.pictures.label_places import LabelPlaces
from namod_ctl.app.views.star_field_table import star_name
from namod_ctl.calibration.geometry.field_geometry import FieldGeometry
from namod_ctl.calibration.geometry.plate_solution import K1, K1_OF_TANGENT, K2_OF_TANGENT
from namod_ctl.calibration.geometry.star_search import SeenStars
from namod_ctl.calibration.sky.star_catalogue import StarCatalogue
from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.coordinates import angles_of_direction

Array = NDArray[np.float64]

_BLUE = "#0072b2"
_ARROW_SHARE = 0.06
_N_NAMED = 12
_NAME_PT, _LETTER_SHARE = 7.0, 0.62
"""Size of the names, and the mean width of a letter as a share of it."""
_MARK_RADIUS_PT = 6.0
_POINTS_PER_ARROW = 8


def draw_star_field(
    geometry: FieldGeometry, stars: SeenStars, camera: CameraModel, catalogue: StarCatalogue, title: str
) -> Figure:
    """The image with its stars and their residuals; beside it the bend of the lens over the angle from its axis."""
    figure = Figure(figsize=(12.5, 5.6), dpi=DPI, facecolor="white")
    _draw_image(figure, figure.add_axes((0.06, 0.17, 0.53, 0.71)), geometry, stars, camera, catalogue)
    _draw_bend(figure.add_axes((0.67, 0.17, 0.31, 0.71)), geometry, stars, camera)
    figure.text(0.06, 0.94, title, fontsize=12)
    return figure


def _draw_image(
    figure: Figure, axes: Axes, geometry: FieldGeometry, stars: SeenStars, camera: CameraModel, catalogue: StarCatalogue
) -> None:
    match, fit = geometry.match, geometry.match.fit
    size = np.clip(80.0 - 12.0 * (stars.magnitude - stars.magnitude.min()), 8.0, None)
    is_other = np.ones(len(stars.pixel), dtype=bool)
    is_other[match.seen] = False
    is_other[match.strangers] = False
    x_px, y_px = stars.pixel.T
    axes.scatter(x_px[is_other], y_px[is_other], s=size[is_other], color="#b0b0b0", label="other lights", lw=0)
    axes.scatter(x_px[match.seen], y_px[match.seen], s=size[match.seen], color=_BLUE, label="catalogue stars")
    if match.strangers.size:
        axes.scatter(
            x_px[match.strangers],
            y_px[match.strangers],
            s=60,
            marker="x",
            color=VERMILLION,
            label="bright, in no catalogue",
        )
    missing = np.zeros((0, 2))
    if match.missing.size:
        missing = fit.plate.pixels_of(geometry.known.directions[match.missing])
        axes.scatter(
            missing[:, 0], missing[:, 1], s=70, marker="s", facecolors="none", edgecolors=ORANGE, label="not seen"
        )
    measured = stars.pixel[match.seen[match.is_measured]]
    # Residuals are counted along the camera's axes: right, or left if mirrored, and up.
    residual = fit.residual_px * np.array([-1.0 if fit.plate.is_mirrored else 1.0, -1.0])
    largest = max(float(np.linalg.norm(residual, axis=1).max()), 1e-3)
    factor = _ARROW_SHARE * camera.n_columns / largest
    axes.quiver(
        *measured.T, *(factor * residual).T, angles="xy", scale_units="xy", scale=1.0, color="black", width=0.003
    )
    axes.plot(*camera.axis_pixel, "+", color="black", ms=12, label="telescope's axis (config)")
    axes.set_xlim(0, camera.n_columns)
    axes.set_ylim(camera.n_rows, 0)
    axes.set_aspect("equal")
    axes.set_xlabel("column [px]")
    axes.set_ylabel("row [px]")
    axes.set_title(f"arrows: image less model, longest {largest:.2g} px", fontsize=10)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=5, frameon=False, handletextpad=0.3)
    along = np.linspace(0.0, 1.0, _POINTS_PER_ARROW)[:, None, None]
    arrows = (measured + along * factor * residual).reshape(-1, 2)
    marks = [stars.pixel, arrows, missing, camera.axis_pixel[None]]
    named = [
        (star_name(catalogue, int(geometry.known.number[known])), stars.pixel[seen])
        for seen, known in zip(match.seen[:_N_NAMED], match.known[:_N_NAMED], strict=True)
    ]
    _draw_names(figure, axes, named, np.concatenate(marks))


def _draw_names(figure: Figure, axes: Axes, named: Sequence[tuple[str, Array]], marks: Array) -> None:
    """Names where nothing else is drawn; those that find no room are left out: the table has them all."""
    axes.apply_aspect()
    corners, to_screen = axes.get_window_extent(), axes.transData.transform
    pixel_per_pt = figure.dpi / 72.0
    frame_px = np.array([corners.x0, corners.y0, corners.x1, corners.y1])
    places = LabelPlaces(frame_px, to_screen(marks), _MARK_RADIUS_PT * pixel_per_pt)
    for name, at in named:
        size_px = np.array([_LETTER_SHARE * len(name), 1.2]) * _NAME_PT * pixel_per_pt
        centre_px = places.place(size_px, to_screen(at))
        if centre_px is None:
            continue
        x_px, y_px = axes.transData.inverted().transform(centre_px)
        axes.plot([at[0], x_px], [at[1], y_px], color="grey", lw=0.6, zorder=0.5)  # whose name it is
        text = axes.text(x_px, y_px, name, fontsize=_NAME_PT, ha="center", va="center")
        text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])


def _draw_bend(axes: Axes, geometry: FieldGeometry, stars: SeenStars, camera: CameraModel) -> None:
    fit, match = geometry.match.fit, geometry.match
    plate = fit.plate
    scale = plate.plate_scale_rad
    corner_rad = 0.5 * scale * math.hypot(camera.n_columns, camera.n_rows)
    angle = np.linspace(0.0, corner_rad, 100)

    def bend_px(at: Array, straight_rad: Array) -> Array:
        """How much farther out the image is than that of a perfect lens."""
        perfect = at * (1.0 + K1_OF_TANGENT * at**2 + K2_OF_TANGENT * at**4)
        out: Array = (perfect - straight_rad) / scale
        return out

    curve = bend_px(angle, angle * (1.0 + plate.k1_per_rad2 * angle**2 + plate.k2_per_rad4 * angle**4))
    half = math.sqrt(fit.covariance[K1, K1]) * angle**3 / scale
    axes.fill_between(
        rad_to_deg(angle), curve - half, curve + half, color=SKY, alpha=0.4, lw=0, label="uncertainty of k1"
    )
    axes.plot(rad_to_deg(angle), curve, color=_BLUE, label="fitted lens")
    chosen = match.is_measured
    true = angles_of_direction(geometry.known.directions[match.known[chosen]] @ plate.attitude)
    at = scale * np.linalg.norm(stars.pixel[match.seen[chosen]] - plate.centre_pixel, axis=1)
    axes.plot(
        rad_to_deg(at[fit.is_used]), bend_px(at, np.linalg.norm(true, axis=1))[fit.is_used], "o", color="black", ms=5,
        label="stars",
    )  # fmt: skip
    axes.axhline(0.0, color="grey", lw=0.8, ls="--", label="lens without distortion")
    axes.set_xlabel("angle from the lens's axis [deg]")
    axes.set_ylabel("image farther out than undistorted [px]")
    axes.set_title("bend of the lens", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)

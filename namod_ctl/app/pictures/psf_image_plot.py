"""The picture of a point spread function as the PSF camera saw it: its light, its radii, and how A_sigma grew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION, colours
from namod_ctl.app.psf_files import RADII
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.imaging.psf_aperture import CONTAINMENT_SHARES
from namod_ctl.imaging.psf_combine import Exposed, Psf
from namod_ctl.imaging.psf_image import ImagePsf

LEVELS = (0.01, 0.03, 0.1, 0.3, 0.7)
"""Of the brightest light: contours."""
_STYLES = ("-", "--", "-.", ":")


def draw_psf(psf: Psf, exposed: Sequence[Exposed], plate_scale_rad: float, title: str) -> Figure:
    """Light with contours, ellipse and radii; light within circles; A_sigma over the aperture.

    The light is that of the image with the least uncertainty.
    """
    image = min((one.image for one in exposed), key=lambda shown: shown.uncertainty_px2 / shown.a_sigma_px2)
    scale_arcmin = rad_to_arcmin(plate_scale_rad)
    figure = Figure(figsize=(11.5, 5.6), dpi=DPI, layout="constrained")
    light, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    contained, growth = right.get_subplotspec().subgridspec(2, 1).subplots()
    right.remove()
    figure.suptitle(title)
    _draw_light(figure, light, image, psf, scale_arcmin)
    _draw_contained(contained, image, psf, scale_arcmin)
    _draw_growth(growth, exposed, image, psf, scale_arcmin)
    return figure


def _draw_light(figure: Figure, axes: Axes, image: ImagePsf, psf: Psf, scale_arcmin: float) -> None:
    picture = np.maximum(image.picture, 0.0) / image.picture.max()
    step = image.picture_step_px
    left, top = ((np.array(image.picture_corner_px) - 0.5) - image.numbers[:2]) * scale_arcmin
    width, height = np.array(picture.shape[::-1]) * step * scale_arcmin
    extent = (float(left), float(left + width), float(-top - height), float(-top))  # rows count downwards
    shown = axes.imshow(picture, extent=extent, cmap=colours(), norm=PowerNorm(0.5, 0.0, 1.0), interpolation="nearest")
    x = left + (np.arange(picture.shape[1]) + 0.5) * step * scale_arcmin
    y = -top - (np.arange(picture.shape[0]) + 0.5) * step * scale_arcmin
    axes.contour(x, y, _smooth(picture), levels=LEVELS, colors="white", linewidths=0.6)
    figure.colorbar(shown, ax=axes, label="light / brightest (contours: 0.01, 0.03, 0.1, 0.3, 0.7)", shrink=0.8)
    axes.add_patch(
        Ellipse(
            (0.0, 0.0),
            2.0 * rad_to_arcmin(float(psf.axes_rad[0])),
            2.0 * rad_to_arcmin(float(psf.axes_rad[1])),
            angle=rad_to_deg(psf.angle_rad),
            fill=False,
            color=VERMILLION,
            linewidth=2.0,
            label="1 sigma ellipse",
        )
    )
    for name, radius, style in zip(RADII, rad_to_arcmin(psf.radii_rad), _STYLES, strict=True):
        axes.add_patch(
            Circle((0.0, 0.0), float(radius), fill=False, color=ORANGE, linestyle=style, linewidth=1.4, label=name)
        )
    reach = 1.15 * max(rad_to_arcmin(float(psf.radii_rad[-1])), 2.5 * rad_to_arcmin(float(psf.axes_rad[0])))
    reach = max(reach, 0.8 * float(np.sqrt(np.linalg.eigvalsh(image.aperture_px2)[1])) * scale_arcmin)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_xlabel("to the right of the centre / arcmin")
    axes.set_ylabel("above the centre / arcmin")
    axes.legend(loc="upper right", fontsize="small")


def _draw_contained(axes: Axes, image: ImagePsf, psf: Psf, scale_arcmin: float) -> None:
    row, column = np.indices(image.picture.shape)
    step = image.picture_step_px
    x, y = (
        corner + step * index + (step - 1) / 2.0 - centre
        for corner, index, centre in zip(image.picture_corner_px, (column, row), image.numbers[:2], strict=True)
    )
    radius = np.hypot(x, y).ravel() * scale_arcmin
    order = np.argsort(radius)
    within = np.cumsum(image.picture.ravel()[order]) * step**2 / image.light
    radius = radius[order]
    is_shown = radius <= 2.0 * rad_to_arcmin(float(psf.radii_rad[-1]))
    axes.plot(radius[is_shown], within[is_shown], color="black")
    for name, share, at, style in zip(RADII, CONTAINMENT_SHARES, rad_to_arcmin(psf.radii_rad), _STYLES, strict=True):
        axes.plot([at, at, 0.0], [0.0, share, share], color=ORANGE, linestyle=style)
        axes.annotate(f"{name} {at:.2f}", (at, share), textcoords="offset points", xytext=(6, -12), fontsize="small")
    axes.set_xlim(0.0, None)
    axes.set_ylim(0.0, 1.08)
    axes.set_xlabel("radius about the centre / arcmin")
    axes.set_ylabel("share of the light within")


def _draw_growth(axes: Axes, exposed: Sequence[Exposed], image: ImagePsf, psf: Psf, scale_arcmin: float) -> None:
    growth = image.growth
    radius = growth.radius_px * scale_arcmin
    area, doubt, plain = (
        values * scale_arcmin**2 for values in (growth.a_sigma_px2, growth.uncertainty_px2, growth.without_wings_px2)
    )
    axes.fill_between(radius, area - doubt, area + doubt, color=SKY, alpha=0.4, linewidth=0.0)
    axes.plot(radius, area, color=SKY, marker="o", markersize=3, label="with the wings outside, 1 sigma")
    axes.plot(radius, plain, color="black", linestyle="--", label="light within the aperture alone")
    chosen = float(np.sqrt(np.linalg.eigvalsh(image.aperture_px2)[1])) * scale_arcmin
    axes.axvline(chosen, color=VERMILLION, linestyle=":", label="aperture that counts")
    whole, whole_doubt = (rad2_to_arcmin2(value) for value in (psf.a_sigma_rad2, psf.a_sigma_uncertainty_rad2))
    label = f"result of {len(exposed)}: {whole:.2f} $\\pm$ {whole_doubt:.2f}"
    axes.errorbar([chosen], [whole], yerr=[whole_doubt], fmt="D", color=VERMILLION, capsize=4, label=label)
    axes.set_ylim(0.0, 1.25 * max(float(np.nanmax(area + doubt)), whole + whole_doubt))
    axes.set_xlabel("long radius of the aperture / arcmin")
    axes.set_ylabel("A_sigma / arcmin$^2$")
    axes.legend(fontsize="small", loc="lower right")


def _smooth(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of 3 x 3: contours of single noisy pixels say nothing."""
    padded = np.pad(picture, 1, mode="edge")
    rows, columns = picture.shape
    total = sum(padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3))
    return np.asarray(total / 9.0, dtype=np.float64)

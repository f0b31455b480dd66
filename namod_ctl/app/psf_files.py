"""Results of the PSF camera: `psf.json` for programs, a table for people."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from namod_ctl import __version__
from namod_ctl.core.units import m_to_mm, rad2_to_arcmin2, rad_to_arcmin, rad_to_deg, rad_to_mdeg
from namod_ctl.imaging.psf_combine import Exposed, Psf

JSON_FILE, PNG_FILE = "psf.json", "psf.png"
SCHEMA = "namod-psf/1"
RADII = ("r39", "r68", "r80", "r95")


@dataclass(frozen=True, slots=True)
class PsfSource:
    """Where the images came from.

    Attributes
    ----------
    focal_length_m
        Of the telescope; None where no config tells it: then nothing is known in mm.
    """

    words: str
    camera: str
    serial_number: str | None
    plate_scale_rad: float
    focal_length_m: float | None


def psf_to_json(psf: Psf, exposed: Sequence[Exposed], names: Sequence[str], source: PsfSource) -> str:
    """The text of `psf.json`."""
    scale_arcmin = rad_to_arcmin(source.plate_scale_rad)
    long, short = rad_to_arcmin(psf.axes_rad)
    long_doubt, short_doubt = rad_to_arcmin(psf.axes_uncertainty_rad)
    images = []
    for one, name in zip(exposed, names, strict=True):
        image = one.image
        images.append(
            {
                "name": name,
                "exposure_s": _number(one.exposure_s),
                "a_sigma_arcmin2": image.a_sigma_px2 * scale_arcmin**2,
                "uncertainty_arcmin2": image.uncertainty_px2 * scale_arcmin**2,
                "centre_px": [float(value) for value in image.numbers[:2]],
                "brightest_share_of_full_scale": image.peak_share,
                "aperture_arcmin": float(np.sqrt(np.linalg.eigvalsh(image.aperture_px2)[1])) * scale_arcmin,
                "light_beyond_aperture_share": image.wings_share,
                "background_adu": float(image.background.coefficients[0]),
                "background_misfit": image.background.misfit,
            }
        )
    whole = {
        "schema": SCHEMA,
        "program_version": __version__,
        "source": source.words,
        "camera": {
            "model": source.camera,
            "serial_number": source.serial_number,
            "plate_scale_mdeg_per_px": rad_to_mdeg(source.plate_scale_rad),
        },
        "n_images": psf.n_images,
        "a_sigma_arcmin2": rad2_to_arcmin2(psf.a_sigma_rad2),
        "a_sigma_uncertainty_arcmin2": rad2_to_arcmin2(psf.a_sigma_uncertainty_rad2),
        "of_which_common_to_all_images_arcmin2": rad2_to_arcmin2(psf.common_uncertainty_rad2),
        "scatter_of_images_over_expected": _number(psf.scatter),
        "ellipse": {
            "sigma_long_arcmin": long,
            "sigma_long_uncertainty_arcmin": long_doubt,
            "sigma_short_arcmin": short,
            "sigma_short_uncertainty_arcmin": short_doubt,
            "angle_deg": rad_to_deg(psf.angle_rad),
            "angle_uncertainty_deg": rad_to_deg(psf.angle_uncertainty_rad),
            "angle_is_from": "image right towards image top",
        },
        "containment": {
            name: {
                "arcmin": rad_to_arcmin(float(radius)),
                "uncertainty_arcmin": rad_to_arcmin(float(doubt)),
                "mdeg": rad_to_mdeg(float(radius)),
                "mm": None if source.focal_length_m is None else m_to_mm(float(radius) * source.focal_length_m),
            }
            for name, radius, doubt in zip(RADII, psf.radii_rad, psf.radii_uncertainty_rad, strict=True)
        },
        "centre_px": [float(value) for value in psf.centre_px],
        "centre_uncertainty_px": [float(value) for value in psf.centre_uncertainty_px],
        "drift_px": [float(value) for value in psf.drift_px],
        "remarks": list(psf.remarks),
        "images": images,
    }
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def psf_table(psf: Psf, source: PsfSource) -> Table:
    """What people read."""
    table = Table(title=f"Point spread function, {psf.n_images} image{'s' if psf.n_images > 1 else ''}")
    heads = ["", "arcmin", "+-", "mdeg"] + ([] if source.focal_length_m is None else ["mm"])
    for head in heads:
        table.add_column(head, justify="right" if head else "left")

    def length(words: str, value_rad: float, doubt_rad: float) -> None:
        cells = [f"{rad_to_arcmin(value_rad):.3f}", f"{rad_to_arcmin(doubt_rad):.3f}", f"{rad_to_mdeg(value_rad):.2f}"]
        if source.focal_length_m is not None:
            cells.append(f"{m_to_mm(value_rad * source.focal_length_m):.3f}")
        table.add_row(words, *cells)

    area, doubt = rad2_to_arcmin2(psf.a_sigma_rad2), rad2_to_arcmin2(psf.a_sigma_uncertainty_rad2)
    table.add_row("A_sigma, arcmin2", f"{area:.3f}", f"{doubt:.3f}", *[""] * (len(heads) - 3), style="bold")
    for name, radius, radius_doubt in zip(RADII, psf.radii_rad, psf.radii_uncertainty_rad, strict=True):
        length(f"{name}, radius with {name[1:]} % of the light", float(radius), float(radius_doubt))
    length("sigma along the long axis", float(psf.axes_rad[0]), float(psf.axes_uncertainty_rad[0]))
    length("sigma along the short axis", float(psf.axes_rad[1]), float(psf.axes_uncertainty_rad[1]))
    return table


def rest_of_psf(psf: Psf) -> list[str]:
    """Lines below the table."""
    angle, doubt = rad_to_deg(psf.angle_rad), rad_to_deg(psf.angle_uncertainty_rad)
    axis = f"long axis at {angle:.0f} +- {doubt:.0f} deg, from the image's right towards its top"
    if doubt > 30.0:
        axis = "round: no direction of the long axis can be told"
    x, y = psf.centre_px
    lines = [f"centre of gravity at column {x:.2f}, row {y:.2f} (+- {psf.centre_uncertainty_px.max():.2f}); {axis}"]
    if psf.n_images > 1:
        drift = float(np.linalg.norm(psf.drift_px))
        lines.append(
            f"from the first image to the last the star drifted {drift:.1f} pixels; the images scatter "
            f"{psf.scatter:.2f} times as much as their noise explains"
        )
    return lines + [f"note: {remark}" for remark in psf.remarks]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None

"""What a field of stars says of the star camera, for people."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from namod_ctl.calibration.geometry.field_geometry import FieldGeometry, bend_in_words
from namod_ctl.calibration.sky.star_catalogue import StarCatalogue
from namod_ctl.core.units import rad_to_deg, rad_to_mdeg
from namod_ctl.optics.camera_model import CameraModel

_RAREST = 1e-12


def geometry_table(geometry: FieldGeometry, camera: CameraModel) -> Table:
    """What was found, beside what the config says."""
    table = Table(title=f"{camera.name}: geometry from {int(geometry.match.fit.is_used.sum())} stars")
    for heading in ("", "found", "the config says"):
        table.add_column(heading, justify="left" if not heading else "right")
    plate = geometry.match.fit.plate
    table.add_row(
        "plate scale / mdeg per px",
        f"{rad_to_mdeg(plate.plate_scale_rad):.5f} +- {rad_to_mdeg(geometry.plate_scale_uncertainty_rad):.5f}",
        f"{rad_to_mdeg(camera.plate_scale_rad):.5f}",
    )
    before = f"{rad_to_deg(camera.orientation.rotation_rad):.3f}"
    if geometry.rotation_rad is None or geometry.rotation_uncertainty_rad is None:
        table.add_row("rotation / deg", "not known", before)
    else:
        rotation, error = rad_to_deg(geometry.rotation_rad), rad_to_deg(geometry.rotation_uncertainty_rad)
        table.add_row("rotation / deg", f"{rotation:.4f} +- {error:.4f}", before)
    table.add_row("mirrored", _yes(plate.is_mirrored), _yes(camera.orientation.is_mirrored))
    table.add_row("bend of the lens", bend_in_words(geometry, camera), "")
    table.add_row("residual / px", f"{geometry.match.fit.rms_px:.3f}", "")
    table.add_row("such a match by chance", _odds(geometry.match.false_expected), "")
    return table


def star_table(geometry: FieldGeometry, stars_px: NDArray[np.float64], catalogue: StarCatalogue) -> Table:
    """The stars that were recognized, brightest first; `stars_px` (n, 2) are those of the frame."""
    match = geometry.match
    table = Table(title="Stars recognized")
    for heading in ("star", "V / mag", "x / px", "y / px", "residual / px"):
        table.add_column(heading, justify="left" if heading == "star" else "right")
    residual_of = {int(match.seen[i]): k for k, i in enumerate(np.flatnonzero(match.is_measured))}
    for seen, known in sorted(zip(match.seen, match.known, strict=True), key=lambda pair: pair[0]):
        number = int(geometry.known.number[known])
        place = residual_of.get(int(seen))
        table.add_row(
            star_name(catalogue, number),
            f"{catalogue.v_mag[number]:.2f}",
            f"{stars_px[seen, 0]:.1f}",
            f"{stars_px[seen, 1]:.1f}",
            "not measured" if place is None else _residual(geometry, place),
        )
    return table


def star_name(catalogue: StarCatalogue, number: int) -> str:
    """Name, else Hipparcos number."""
    return catalogue.names[number] or f"HIP {catalogue.hip[number]}"


def where_it_looked(geometry: FieldGeometry) -> str:
    """Where the telescope's axis pointed, to be compared with what the telescope says."""
    x, y, z = geometry.axis_direction
    height_deg = rad_to_deg(math.asin(z))
    if geometry.rotation_rad is None:
        ra_deg = rad_to_deg(math.atan2(y, x)) % 360.0
        return f"The camera looked at right ascension {ra_deg:.2f}, declination {height_deg:+.2f} deg."
    azimuth_deg = rad_to_deg(math.atan2(-y, x)) % 360.0
    return f"The telescope's axis pointed at azimuth {azimuth_deg:.2f}, altitude {height_deg:.2f} deg."


def _residual(geometry: FieldGeometry, place: int) -> str:
    fit = geometry.match.fit
    text = f"{np.linalg.norm(fit.residual_px[place]):.3f}"
    return text if fit.is_used[place] else f"{text}, left out"


def _odds(expected: float) -> str:
    return "less than one in 1e12" if expected < _RAREST else f"one in {1.0 / expected:.0e}"


def _yes(is_so: bool) -> str:
    return "yes" if is_so else "no"

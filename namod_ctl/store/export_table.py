"""Columns of geometry for the table of facets: where they are, where they look, and what they are."""

from __future__ import annotations

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import NDArray

from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]


def add_geometry(table: QTable, reflector: Reflector, normals: Array) -> None:
    """Add columns of positions, normals and shapes to a table of facets.

    `normals` of shape (n_facets, 3) belong to `reflector.facets`, telescope frame, NaN where there is no estimate. Rows
    are matched by `facet_id`, all of which must be in the reflector.
    """
    row_of = {facet_id: row for row, facet_id in enumerate(reflector.ids)}
    rows = [row_of[int(facet_id)] for facet_id in table["facet_id"]]
    facets = [reflector.facets[row] for row in rows]
    positions_m = reflector.positions_m[rows].reshape(-1, 3)
    normals = normals[rows].reshape(-1, 3)

    def add(name: str, values: object, description: str) -> None:
        table[name] = values
        table[name].info.description = description

    for axis, name in enumerate("xyz"):
        add(f"position_{name}", positions_m[:, axis] * u.m, "centre of the mirror surface, telescope frame")
    for axis, name in enumerate("xyz"):
        add(f"normal_{name}", normals[:, axis], "unit normal as found, telescope frame")
    add("focal_length", np.array([facet.focal_length_m for facet in facets]) * u.m, "half the radius of curvature")
    add("shape", [facet.shape.value for facet in facets], "outline")
    add("width", np.array([facet.width_m for facet in facets]) * u.m, "flat to flat, or diameter")
    rotations_deg = rad_to_deg(np.array([facet.rotation_rad for facet in facets]))
    add("rotation", rotations_deg * u.deg, "of the outline about the normal; at 0 a hexagon has a corner at +y")

"""Writing the table of the facets' outlines that `facet_tables.read_polygon_table` reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.store.facet_tables import POLYGON_HEADER
from namod_ctl.store.table_text import write_text

Array = NDArray[np.float64]


def format_polygon_table(polygons_px: Mapping[int, Array], comments: Sequence[str]) -> str:
    """The table of outlines by facet id, each of shape (n_corners, 2), (x, y) pixel, to a hundredth, ids ascending."""
    lines = [f"# {' '.join(comment.split())}" for comment in comments]
    lines.append(",".join(POLYGON_HEADER))
    for facet_id in sorted(polygons_px):
        lines += [f"{facet_id},{x_px:.2f},{y_px:.2f}" for x_px, y_px in polygons_px[facet_id]]
    return "\n".join(lines) + "\n"


def write_polygon_table(path: Path, polygons_px: Mapping[int, Array], comments: Sequence[str]) -> None:
    """Write the table, whole or not at all; see `format_polygon_table`."""
    write_text(path, format_polygon_table(polygons_px, comments))

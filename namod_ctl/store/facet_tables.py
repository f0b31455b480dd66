"""This program's own tables: facets with their ids, and their outlines in the reflector camera's image.

Both are comma-separated with one header line that carries the units; lines that begin with '#' are comments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.reflector import Facet, FacetShape
from namod_ctl.store.table_text import Row, lines, raise_together, read_text, refuse_repeated_ids

Array = NDArray[np.float64]

FACET_HEADER = ("facet_id", "x_m", "y_m", "z_m", "focal_length_m", "shape", "width_m", "rotation_deg")
POLYGON_HEADER = ("facet_id", "x_px", "y_px")


def read_facet_table(path: Path) -> tuple[Facet, ...]:
    """The facets of a table file; see `parse_facet_table`."""
    return parse_facet_table(read_text(path), str(path))


def parse_facet_table(text: str, source: str) -> tuple[Facet, ...]:
    """The facets of a table with the columns `FACET_HEADER`, in its order.

    Raises
    ------
    ConfigError
        All bad rows together, each with line, column and value.
    """
    problems: list[ConfigError] = []
    facets: list[Facet] = []
    for row in _rows(text, source, FACET_HEADER):
        try:
            facets.append(_facet(row))
        except ConfigError as problem:
            problems.append(problem)
    raise_together(problems)
    refuse_repeated_ids(source, [facet.id for facet in facets])
    return tuple(facets)


def _rows(text: str, source: str, header: tuple[str, ...]) -> list[Row]:
    rows = [
        Row(source, number, tuple(field.strip() for field in line.split(",")))
        for number, line in lines(text)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows or rows[0].fields != header:
        found = f"line {rows[0].line} is {','.join(rows[0].fields)!r}" if rows else "the file has no rows"
        raise ConfigError(f"{source}: the header must be {','.join(header)!r}, but {found}")
    if len(rows) == 1:
        raise ConfigError(f"{source}: no rows below the header")
    problems = [
        row.problem(f"{len(row.fields)} columns, expected {len(header)}: {','.join(header)}")
        for row in rows[1:]
        if len(row.fields) != len(header)
    ]
    raise_together(problems)
    return rows[1:]


def _facet(row: Row) -> Facet:
    facet_id = row.whole_number(0, "facet_id")
    position_m = np.array([row.number(i, FACET_HEADER[i], -50.0, 50.0, "m") for i in range(1, 4)])
    focal_length_m = row.number(4, "focal_length_m", 0.1, 150.0, "m")
    if row.fields[5] not in list(FacetShape):
        raise row.problem(f"column 6 (shape) holds {row.fields[5]!r}, known are {', '.join(FacetShape)}")
    return Facet(
        id=facet_id,
        position_m=position_m,
        focal_length_m=focal_length_m,
        shape=FacetShape(row.fields[5]),
        width_m=row.number(6, "width_m", 0.01, 5.0, "m"),
        rotation_rad=deg_to_rad(row.number(7, "rotation_deg", -360.0, 360.0, "deg")),
    )


def read_polygon_table(path: Path) -> dict[int, Array]:
    """The outlines of a table file; see `parse_polygon_table`."""
    return parse_polygon_table(read_text(path), str(path))


def parse_polygon_table(text: str, source: str) -> dict[int, Array]:
    """Outlines by facet id, shape (n_corners, 2), (x, y) pixel, of a table with the columns `POLYGON_HEADER`.

    The rows of a facet stand together, in order along its outline.

    Raises
    ------
    ConfigError
        All bad rows together, each with line, column and value.
    """
    problems: list[ConfigError] = []
    corners: dict[int, list[tuple[float, float]]] = {}
    last_id: int | None = None
    for row in _rows(text, source, POLYGON_HEADER):
        try:
            facet_id = row.whole_number(0, "facet_id")
            corner = (row.number(1, "x_px", -1e6, 1e6, "px"), row.number(2, "y_px", -1e6, 1e6, "px"))
            if facet_id != last_id and facet_id in corners:
                raise row.problem(f"the rows of facet {facet_id} do not stand together: one outline per facet")
        except ConfigError as problem:
            problems.append(problem)
            continue
        corners.setdefault(facet_id, []).append(corner)
        last_id = facet_id
    raise_together(problems)
    return {facet_id: np.array(outline) for facet_id, outline in corners.items()}

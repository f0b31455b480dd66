"""Facet lists of the simulations: Mars/Ceres reflector files and sim_telarray mirror lists.

Both are in cm. The frame of Mars/Ceres files is taken as the telescope frame; nothing in them says how a hexagon is
turned: it is taken to have a corner at +y, as FACT's. In sim_telarray's frame x points down, with the telescope above
the horizon, and y is the telescope frame's x (docs/exports.md has the sources).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import cm_to_m, deg_to_rad, m_to_cm
from namod_ctl.optics.layouts import Dish, matched_focal_length_m
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.store.table_text import (
    Row,
    lines,
    raise_together,
    read_text,
    refuse_repeated_ids,
    write_text,
)

Array = NDArray[np.float64]

MARS_TYPES = {"hex": FacetShape.HEXAGON, "square": FacetShape.SQUARE, "disk": FacetShape.ROUND}
MARS_NAMES = {FacetShape.HEXAGON: "Hex", FacetShape.SQUARE: "Square", FacetShape.ROUND: "Disk"}
MARS_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "f", "type", "fD")
MARS_IDS = "# facet ids, row by row:"
NORMAL_LENGTH_TOLERANCE = 0.01

# Code 1 is the hexagon whose flats face sim_telarray's +-x (the telescope frame's -+y), code 3 the one turned to it.
SIM_SHAPES = {
    "0": (FacetShape.ROUND, 0.0),
    "1": (FacetShape.HEXAGON, 30.0),
    "2": (FacetShape.SQUARE, 0.0),
    "3": (FacetShape.HEXAGON, 0.0),
}
SIM_LEAST_Z_CM = 1e-6  # 10 nm: sim_telarray takes a z of 0 as "on the dish, wherever that is"
SIM_ID = re.compile(r"\bid\s*=\s*([0-9]{1,6})\b")

POSITION_LIMIT_CM = 5000.0
FOCAL_LENGTHS_CM = (10.0, 15000.0)
WIDTHS_CM = (1.0, 500.0)


@dataclass(frozen=True, slots=True, eq=False)
class FacetList:
    """Facets as a file lists them.

    Attributes
    ----------
    normals
        Shape (n_facets, 3), telescope frame, as written in the file: unit vectors to its digits, estimates or
        design. None where the form has no normals.
    """

    facets: tuple[Facet, ...]
    normals: Array | None


def read_mars(path: Path, ids: Sequence[int] | None = None) -> FacetList:
    """The facets of a Mars/Ceres reflector file; see `parse_mars`."""
    return parse_mars(read_text(path), str(path), ids)


def parse_mars(text: str, source: str, ids: Sequence[int] | None = None) -> FacetList:
    """The facets of a Mars/Ceres reflector text, rows `x y z nx ny nz f type fD`, in the file's order.

    Ids come from `ids`, else from the comment that `format_mars` writes, else they count the rows from 1.

    Raises
    ------
    ConfigError
        All bad rows together, each with line, column and value.
    """
    rows, comment_ids = _mars_rows(text, source)
    problems: list[ConfigError] = []
    facets: list[Facet] = []
    normals: list[Array] = []
    chosen_ids = _ids_for(len(rows), ids if ids is not None else comment_ids, source)
    for facet_id, row in zip(chosen_ids, rows, strict=True):
        try:
            facet, normal = _mars_facet(row, facet_id)
        except ConfigError as problem:
            problems.append(problem)
        else:
            facets.append(facet)
            normals.append(normal)
    raise_together(problems)
    return FacetList(tuple(facets), np.array(normals))


def _mars_rows(text: str, source: str) -> tuple[list[Row], list[int] | None]:
    rows, comment_ids = [], None
    for number, line in lines(text):
        if line.startswith(MARS_IDS):
            words = line[len(MARS_IDS) :].split()
            if not all(re.fullmatch(r"[0-9]{1,6}", word) for word in words):
                raise ConfigError(f"{source}, line {number}: the comment of facet ids holds something that is no id")
            comment_ids = [int(word) for word in words]
        fields = tuple(line.partition("#")[0].split())
        if fields:
            rows.append(Row(source, number, fields))
    return rows, comment_ids


def _ids_for(n_rows: int, ids: Sequence[int] | None, source: str) -> list[int]:
    if n_rows == 0:
        raise ConfigError(f"{source}: no facet in it; is it a facet list?")
    if ids is None:
        return list(range(1, n_rows + 1))
    if len(ids) != n_rows:
        raise ConfigError(f"{source}: {n_rows} facets but {len(ids)} facet ids; give one id per facet, in their order")
    refuse_repeated_ids(source, list(ids))
    return list(ids)


def _mars_facet(row: Row, facet_id: int) -> tuple[Facet, Array]:
    if len(row.fields) != len(MARS_COLUMNS):
        raise row.problem(f"{len(row.fields)} columns, expected {len(MARS_COLUMNS)}: {' '.join(MARS_COLUMNS)}")
    position_cm = [row.number(i, MARS_COLUMNS[i], -POSITION_LIMIT_CM, POSITION_LIMIT_CM, "cm") for i in range(3)]
    normal = np.array([row.number(i, MARS_COLUMNS[i], -1.0, 1.0, "(unit vector)") for i in range(3, 6)])
    length = float(np.linalg.norm(normal))
    if abs(length - 1.0) > NORMAL_LENGTH_TOLERANCE or normal[2] <= 0.0:
        raise row.problem(
            f"columns 4 to 6 (nx ny nz) hold ({normal[0]:g}, {normal[1]:g}, {normal[2]:g}) of length {length:.4g}; "
            "a normal is a unit vector that points to the sky (nz > 0)"
        )
    focal_length_cm = row.number(6, "f", *FOCAL_LENGTHS_CM, "cm")
    shape = MARS_TYPES.get(row.fields[7].lower())
    if shape is None:
        raise row.problem(f"column 8 (type) holds {row.fields[7]!r}, known are {', '.join(MARS_NAMES.values())}")
    width_cm = row.number(8, "fD", *WIDTHS_CM, "cm")
    facet = Facet(
        id=facet_id,
        position_m=cm_to_m(np.array(position_cm)),
        focal_length_m=cm_to_m(focal_length_cm),
        shape=shape,
        width_m=cm_to_m(width_cm),
    )
    return facet, normal


def format_mars(reflector: Reflector, normals: Array) -> str:
    """A Mars/Ceres reflector text with these unit normals, shape (n_facets, 3), telescope frame; 10 decimals each."""
    normals = np.asarray(normals, dtype=np.float64)
    if normals.shape != (len(reflector.facets), 3) or not np.isfinite(normals).all():
        raise ValueError(f"normals must be finite and of shape ({len(reflector.facets)}, 3), not {normals.shape}")
    out = [
        "# Reflector for Mars/Ceres. Columns: x y z [cm] nx ny nz [unit normal] f [cm] type fD [cm, flat to flat]",
        f"{MARS_IDS} {' '.join(map(str, reflector.ids))}",
    ]
    for facet, normal in zip(reflector.facets, normals, strict=True):
        x_cm, y_cm, z_cm = (m_to_cm(float(value_m)) for value_m in facet.position_m)
        out.append(
            f"{x_cm:.6f} {y_cm:.6f} {z_cm:.6f} {normal[0]:.10f} {normal[1]:.10f} {normal[2]:.10f} "
            f"{m_to_cm(facet.focal_length_m):.6f} {MARS_NAMES[facet.shape]} {m_to_cm(facet.width_m):.6f}"
        )
    return "\n".join(out) + "\n"


def write_mars(path: Path, reflector: Reflector, normals: Array) -> None:
    """Write a Mars/Ceres reflector file, whole or not at all; see `format_mars`."""
    write_text(path, format_mars(reflector, normals))


def read_sim_telarray(path: Path, dish: Dish, ids: Sequence[int] | None = None) -> FacetList:
    """The facets of a sim_telarray mirror list; see `parse_sim_telarray`."""
    return parse_sim_telarray(read_text(path), str(path), dish, ids)


def parse_sim_telarray(text: str, source: str, dish: Dish, ids: Sequence[int] | None = None) -> FacetList:
    """The facets of a sim_telarray mirror list, rows `x y diameter focal_length shape [z] [#% id=..]`, in our frame.

    A row without z stands on `dish`; a focal length of 0 means the distance to the focal point. Ids come from `ids`,
    else from `#% id=..` if every row has one, else they count the rows from 1.

    Raises
    ------
    ConfigError
        All bad rows together, each with line, column and value.
    """
    problems: list[ConfigError] = []
    facets: list[Facet] = []
    written_ids: list[int | None] = []
    rows = []
    for number, line in lines(text):
        content, _, comment = line.partition("#")
        if content.split():
            rows.append(Row(source, number, tuple(content.split())))
            found = SIM_ID.search(comment) if comment.startswith("%") else None
            written_ids.append(int(found[1]) if found else None)
    known_ids = [facet_id for facet_id in written_ids if facet_id is not None]
    if ids is None and known_ids and len(known_ids) < len(rows):
        raise ConfigError(f"{source}: {len(known_ids)} of {len(rows)} rows have an id; give all rows one, or none")
    for facet_id, row in zip(
        _ids_for(len(rows), ids if ids is not None else known_ids or None, source), rows, strict=True
    ):
        try:
            facets.append(_sim_facet(row, facet_id, dish))
        except ConfigError as problem:
            problems.append(problem)
    raise_together(problems)
    return FacetList(tuple(facets), None)


def _sim_facet(row: Row, facet_id: int, dish: Dish) -> Facet:
    if len(row.fields) not in (5, 6):
        raise row.problem(f"{len(row.fields)} columns, expected 5 or 6: x y diameter focal_length shape [z]")
    x_cm = row.number(0, "x", -POSITION_LIMIT_CM, POSITION_LIMIT_CM, "cm")
    y_cm = row.number(1, "y", -POSITION_LIMIT_CM, POSITION_LIMIT_CM, "cm")
    width_cm = row.number(2, "diameter", *WIDTHS_CM, "cm")
    focal_length_cm = row.number(3, "focal_length", 0.0, FOCAL_LENGTHS_CM[1], "cm")
    if 0.0 < focal_length_cm < FOCAL_LENGTHS_CM[0]:
        raise row.problem(f"column 4 (focal_length) holds {row.fields[3]}: check the unit, cm are expected")
    if row.fields[4] not in SIM_SHAPES:
        raise row.problem(f"column 5 (shape) holds {row.fields[4]!r}, known are 0 round, 1 and 3 hexagon, 2 square")
    shape, rotation_deg = SIM_SHAPES[row.fields[4]]
    x_m, y_m = cm_to_m(y_cm), -cm_to_m(x_cm)
    if len(row.fields) == 6:
        z_m = cm_to_m(row.number(5, "z", -POSITION_LIMIT_CM, POSITION_LIMIT_CM, "cm"))
    else:
        z_m = float(dish.height_m(np.hypot(x_m, y_m)))
        if not np.isfinite(z_m):
            raise row.problem(f"columns 1 and 2 hold ({x_cm:g}, {y_cm:g}) cm, which lies beyond the dish; give a z")
    position_m = np.array([x_m, y_m, z_m])
    return Facet(
        id=facet_id,
        position_m=position_m,
        focal_length_m=(
            cm_to_m(focal_length_cm)
            if focal_length_cm > 0.0
            else float(matched_focal_length_m(position_m, dish.focal_length_m))
        ),
        shape=shape,
        width_m=cm_to_m(width_cm),
        rotation_rad=deg_to_rad(rotation_deg),
    )


def format_sim_telarray(reflector: Reflector) -> str:
    """A sim_telarray mirror list in sim_telarray's frame, z always written, before `#%`.

    Raises
    ------
    ConfigError
        A facet is turned in a way the form has no code for, or lies below the dish's vertex.
    """
    out = ["# Mirror list for sim_telarray. Columns: x y diameter focal_length [cm] shape z [cm] #% id"]
    for facet in reflector.facets:
        x_cm, y_cm, z_cm = (m_to_cm(float(value_m)) for value_m in facet.position_m)
        if z_cm < -SIM_LEAST_Z_CM:
            raise ConfigError(
                f"facet {facet.id}: its centre lies {-z_cm:.3f} cm below the dish's vertex, and sim_telarray takes the "
                "absolute value of z; move the telescope frame's origin down in the config, or use another form"
            )
        place = " ".join(f"{round(value_cm, 6) + 0.0:.6f}" for value_cm in (-y_cm, x_cm))  # never -0
        out.append(
            f"{place} {m_to_cm(facet.width_m):.6f} {m_to_cm(facet.focal_length_m):.6f} "
            f"{_sim_shape_code(facet)} {max(z_cm, SIM_LEAST_Z_CM):.6f} #% id={facet.id}"
        )
    return "\n".join(out) + "\n"


def _sim_shape_code(facet: Facet) -> str:
    """The code of a facet's outline; turns that map the outline on itself do not count."""
    if facet.shape is FacetShape.ROUND:
        return "0"
    period_rad = deg_to_rad(60.0 if facet.shape is FacetShape.HEXAGON else 90.0)
    for code, (shape, rotation_deg) in SIM_SHAPES.items():
        turn_rad = (facet.rotation_rad - deg_to_rad(rotation_deg)) % period_rad
        if shape is facet.shape and min(turn_rad, period_rad - turn_rad) < deg_to_rad(0.01):
            return code
    raise ConfigError(
        f"facet {facet.id}: a {facet.shape} turned by {facet.rotation_rad:.4f} rad has no code in a sim_telarray "
        "mirror list (hexagons: 0 or 30 deg, squares: 0 deg); write a Mars/Ceres file instead"
    )


def write_sim_telarray(path: Path, reflector: Reflector) -> None:
    """Write a sim_telarray mirror list, whole or not at all; see `format_sim_telarray`."""
    write_text(path, format_sim_telarray(reflector))

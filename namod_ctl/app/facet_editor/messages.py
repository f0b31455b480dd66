"""What the editor's page sends, checked, and what it gets back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from namod_ctl.app.facet_editor.workbench import Workbench
from namod_ctl.core.errors import ConfigError

Array = NDArray[np.float64]

Coordinate = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid")


class SentFacet(_Message):
    """A marked centre (one point) or an outline, in the picture's pixels."""

    id: Annotated[int, Field(ge=0, le=999_999)]
    points: Annotated[list[tuple[Coordinate, Coordinate]], Field(min_length=1, max_length=200)]


class Marks(_Message):
    """Facets that the person marked."""

    facets: Annotated[list[SentFacet], Field(max_length=1000)]


class Drawing(_Message):
    """The outlines as they are on the page; an id may stand twice."""

    facets: Annotated[list[SentFacet], Field(max_length=2000)]
    is_missing_confirmed: bool = False
    basis: Literal["hand", "marks", "edges"] = "hand"


def read_message(kind: type[Marks] | type[Drawing], body: bytes) -> Any:
    """The message. Raises ConfigError for anything else."""
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        detail = error.errors()[0]
        where = ".".join(map(str, detail["loc"]))
        raise ConfigError(f"the page sent something else than facets ({where}: {detail['msg']}); reload it") from None


def points_by_id(facets: Sequence[SentFacet]) -> dict[int, Array]:
    """Points by facet id, each of shape (n, 2). Raises ConfigError for an id that stands twice."""
    repeated = repeated_ids(facets)
    if repeated:
        raise ConfigError(f"facet ids occur more than once: {', '.join(map(str, repeated))}; give each facet its own")
    return {facet.id: np.array(facet.points, dtype=np.float64) for facet in facets}


def repeated_ids(facets: Sequence[SentFacet]) -> list[int]:
    """Ids that stand twice or more."""
    ids = [facet.id for facet in facets]
    return sorted({facet_id for facet_id in ids if ids.count(facet_id) > 1})


def facets_to_json(polygons_px: Mapping[int, Array]) -> list[dict[str, Any]]:
    """Outlines as the page takes them, to a hundredth of a pixel."""
    return [
        {"id": facet_id, "points": np.round(outline, 2).tolist()} for facet_id, outline in sorted(polygons_px.items())
    ]


def map_to_json(bench: Workbench) -> dict[str, Any]:
    """What the page shows first."""
    columns, rows = bench.size
    return {
        "telescope": bench.instrument.name,
        "picture": {"columns": columns, "rows": rows, "name": bench.image_name},
        "out": bench.out.name if bench.out is not None else "",
        "ids": sorted(bench.instrument.reflector.ids),
        "facets": facets_to_json(bench.polygons_px()),
    }


def check_to_json(bench: Workbench, drawing: Drawing) -> dict[str, Any]:
    """Faults and missing facets of a drawing."""
    first = {facet.id: np.array(facet.points, dtype=np.float64) for facet in reversed(drawing.facets)}
    faults = bench.faults(first)
    for facet_id in repeated_ids(drawing.facets):
        faults.setdefault(facet_id, []).append("is drawn twice: delete one outline, or correct its number")
    return {
        "faults": [{"id": facet_id, "texts": texts} for facet_id, texts in sorted(faults.items())],
        "missing": bench.missing(first),
    }

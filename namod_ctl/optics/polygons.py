"""Outlines of facets in an image: is a polygon one that pixels can be counted in, and do they go together?"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_AREA_PX2 = 1.0
MAX_OVERLAP_SHARE = 0.05
"""Of the smaller polygon's area: hand-drawn and projected outlines of touching facets share a little."""

_SUBPIXELS = 4  # per pixel and axis, for the common area of polygons that are not convex


def polygon_fault(corners_px: Array, n_columns: int, n_rows: int) -> str | None:
    """What is wrong with a facet's outline, for a person, naming the corner (counted from 1); None if it is sound.

    `corners_px` has shape (n_corners, 2), (x, y) pixel, in order along the outline. An image reaches from -0.5 to
    n - 0.5 in pixel coordinates, as the centre of the first pixel is at 0.
    """
    n_corners = len(corners_px)
    if n_corners < 3:
        return f"has {n_corners} corners; an outline needs at least 3"
    for number, (x_px, y_px) in enumerate(corners_px, start=1):
        if not (-0.5 <= x_px <= n_columns - 0.5 and -0.5 <= y_px <= n_rows - 0.5):  # also catches NaN
            return (
                f"corner {number} at ({x_px:g}, {y_px:g}) px lies outside the image of {n_columns} x {n_rows} pixels; "
                "give corners as (column, row) of this camera's full image"
            )
    crossing = crossing_sides(corners_px)
    if crossing is not None:
        first, second = crossing
        return (
            f"crosses itself: the side from corner {first + 1} meets the side from corner {second + 1}; "
            "list the corners in order along the outline, each once"
        )
    area_px2 = polygon_area_px2(corners_px)
    if area_px2 < MIN_AREA_PX2:
        return f"covers {area_px2:g} square pixels; it needs at least {MIN_AREA_PX2:g}"
    return None


def polygon_area_px2(corners_px: Array) -> float:
    """Area of an outline of shape (n_corners, 2) (the shoelace rule)."""
    x, y = (corners_px - corners_px[0]).T
    return abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))) / 2.0


def polygon_centre_px(corners_px: Array) -> Array:
    """Centre of gravity, shape (2,), of the area in an outline of shape (n_corners, 2)."""
    x, y = (corners_px - corners_px[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = np.array([((x + np.roll(x, -1)) * cross).sum(), ((y + np.roll(y, -1)) * cross).sum()])
    centre: Array = corners_px[0] + sums / (3.0 * cross.sum())
    return centre


def crossing_sides(corners_px: Array) -> tuple[int, int] | None:
    """Two sides, by the index of their first corner, that meet other than in the corner of neighbours, or None.

    Neighbours that fold back onto each other, and a side without length, count. Shape (n_corners, 2), n_corners >= 3.
    """
    start, end = corners_px, np.roll(corners_px, -1, axis=0)
    n = len(corners_px)
    first, second = np.triu_indices(n, k=1)
    is_neighbour = (second - first == 1) | (second - first == n - 1)
    a, b, c, d = start[first], end[first], start[second], end[second]
    is_common = (_turn(a, b, c) * _turn(a, b, d) <= 0) & (_turn(c, d, a) * _turn(c, d, b) <= 0)
    overlap = (np.minimum(np.maximum(a, b), np.maximum(c, d)) - np.maximum(np.minimum(a, b), np.minimum(c, d))).min(
        axis=1
    )
    is_crossing = is_common & (overlap >= 0) & ~is_neighbour
    # Neighbours always share a corner: they cross when one folds back onto the other, or has no length.
    ahead, back = b - a, d - c
    is_folded = (ahead[:, 0] * back[:, 1] == ahead[:, 1] * back[:, 0]) & ((ahead * back).sum(axis=1) <= 0)
    found = np.flatnonzero(is_crossing | (is_neighbour & is_folded))
    return (int(first[found[0]]), int(second[found[0]])) if found.size else None


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Sign of the turn from a over b to c; 0 on one line."""
    turn: Array = np.sign((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    return turn


def overlapping_polygons(polygons_px: Mapping[int, Array]) -> list[tuple[int, int, float]]:
    """Pairs of sound polygons that cover each other: (id, id, share of the smaller one's area), largest share first."""
    ids = list(polygons_px)
    if not ids:
        return []
    low = np.array([polygons_px[i].min(axis=0) for i in ids])
    high = np.array([polygons_px[i].max(axis=0) for i in ids])
    is_near = (low[:, None] < high[None]).all(axis=2) & (low[None] < high[:, None]).all(axis=2)
    pairs = []
    for first, second in zip(*np.nonzero(np.triu(is_near, k=1)), strict=True):
        one, other = polygons_px[ids[first]], polygons_px[ids[second]]
        share = _common_area_px2(one, other) / min(polygon_area_px2(one), polygon_area_px2(other))
        if share > 0.0:
            pairs.append((ids[first], ids[second], share))
    return sorted(pairs, key=lambda pair: -pair[2])


def _common_area_px2(one: Array, other: Array) -> float:
    origin = np.minimum(one.min(axis=0), other.min(axis=0))
    a, b = (one - origin).astype(np.float32), (other - origin).astype(np.float32)
    if cv2.isContourConvex(a) and cv2.isContourConvex(b):
        return float(cv2.intersectConvexConvex(a, b)[0])
    width, height = np.ceil(np.maximum(a.max(axis=0), b.max(axis=0)) * _SUBPIXELS).astype(int) + 1
    masks = []
    for corners in (a, b):
        mask = np.zeros((height, width), dtype=np.uint8)
        cv2.fillPoly(mask, [np.rint(corners * _SUBPIXELS).astype(np.int32)], 1)
        masks.append(mask)
    return float(np.count_nonzero(masks[0] & masks[1])) / _SUBPIXELS**2


def clip_to_image(corners_px: Array, n_columns: int, n_rows: int) -> Array:
    """The part of a convex polygon that lies in the image, shape (n, 2); (0, 2) if none does.

    Source: Sutherland and Hodgman 1974, https://doi.org/10.1145/360767.360802.
    """
    clipped = np.asarray(corners_px, dtype=np.float64)
    for axis, limit, sign in ((0, -0.5, 1.0), (0, n_columns - 0.5, -1.0), (1, -0.5, 1.0), (1, n_rows - 0.5, -1.0)):
        inside = sign * (clipped[:, axis] - limit)
        kept: list[Array] = []
        for k in range(len(clipped)):
            before = k - 1
            if (inside[k] >= 0.0) != (inside[before] >= 0.0):
                share = inside[before] / (inside[before] - inside[k])
                entry = clipped[before] + share * (clipped[k] - clipped[before])
                entry[axis] = limit
                kept.append(entry)
            if inside[k] >= 0.0:
                kept.append(clipped[k])
        clipped = np.array(kept).reshape(-1, 2)
    return clipped


def map_faults(polygons_px: Mapping[int, Array], n_columns: int, n_rows: int) -> dict[int, list[str]]:
    """What is wrong with the outlines of a reflector, by facet id, for a person; empty if all are sound.

    Missing facets are no fault here: one may be dismounted.
    """
    faults: dict[int, list[str]] = {}
    for facet_id, corners_px in polygons_px.items():
        fault = polygon_fault(corners_px, n_columns, n_rows)
        if fault is not None:
            faults[facet_id] = [fault]
    sound = {facet_id: corners for facet_id, corners in polygons_px.items() if facet_id not in faults}
    for first, second, share in overlapping_polygons(sound):
        if share > MAX_OVERLAP_SHARE:
            for facet_id, other in ((first, second), (second, first)):
                faults.setdefault(facet_id, []).append(
                    f"overlaps with facet {other} by {share:.0%} of the smaller one, at most {MAX_OVERLAP_SHARE:.0%} "
                    "pass: move one of them"
                )
    return faults

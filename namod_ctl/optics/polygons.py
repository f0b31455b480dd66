"""Outlines of facets in an image: is a polygon one that pixels can be counted in?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_AREA_PX2 = 1.0


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
    crossing = _first_crossing(corners_px)
    if crossing is not None:
        first, second = crossing
        return (
            f"crosses itself: the side from corner {first + 1} meets the side from corner {second + 1}; "
            "list the corners in order along the outline, each once"
        )
    x_px, y_px = corners_px[:, 0], corners_px[:, 1]
    area_px2 = abs(float(np.sum(x_px * np.roll(y_px, -1) - np.roll(x_px, -1) * y_px))) / 2.0
    if area_px2 < MIN_AREA_PX2:
        return f"covers {area_px2:g} square pixels; it needs at least {MIN_AREA_PX2:g}"
    return None


def _first_crossing(corners_px: Array) -> tuple[int, int] | None:
    """Two sides of the outline, by the index of their first corner, that meet other than in a shared corner."""
    n_corners = len(corners_px)
    for first in range(n_corners):
        if _folds_back(corners_px[first - 1], corners_px[first], corners_px[(first + 1) % n_corners]):
            return (first - 1) % n_corners, first
        for second in range(first + 1, n_corners):
            is_neighbour = second == first + 1 or (first == 0 and second == n_corners - 1)
            if is_neighbour:
                continue
            if _sides_meet(
                corners_px[first],
                corners_px[(first + 1) % n_corners],
                corners_px[second],
                corners_px[(second + 1) % n_corners],
            ):
                return first, second
    return None


def _side_of(start: Array, end: Array, point: Array) -> float:
    """Positive if `point` lies to one side of the line from `start` to `end`, negative on the other, 0 on it."""
    along, to_point = end - start, point - start
    return float(along[0] * to_point[1] - along[1] * to_point[0])


def _folds_back(before: Array, corner: Array, after: Array) -> bool:
    """Does the side that leaves `corner` run back over the one that arrives, or has one of them no length?"""
    arriving, leaving = corner - before, after - corner
    return _side_of(before, corner, after) == 0 and float(arriving @ leaving) <= 0


def _is_within(start: Array, end: Array, point: Array) -> bool:
    """For a point on the line through `start` and `end`: does it lie between them?"""
    return bool((np.minimum(start, end) <= point).all() and (point <= np.maximum(start, end)).all())


def _sides_meet(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Do the segments a-b and c-d share a point?"""
    side_c, side_d = _side_of(a, b, c), _side_of(a, b, d)
    side_a, side_b = _side_of(c, d, a), _side_of(c, d, b)
    if side_c * side_d < 0 and side_a * side_b < 0:
        return True
    return (
        (side_c == 0 and _is_within(a, b, c))
        or (side_d == 0 and _is_within(a, b, d))
        or (side_a == 0 and _is_within(c, d, a))
        or (side_b == 0 and _is_within(c, d, b))
    )

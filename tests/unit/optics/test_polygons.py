"""Which outlines of facets are refused, and that the text names the corner."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.optics.polygons import polygon_fault

STAR = [[50, 10], [70, 80], [10, 35], [90, 35], [30, 80]]  # a pentagram


def _fault(corners: list[list[float]]) -> str | None:
    return polygon_fault(np.array(corners, dtype=float).reshape(-1, 2), 100, 100)


@pytest.mark.parametrize(
    "corners",
    [
        [[10, 10], [20, 10], [15, 20]],
        [[10, 10], [90, 10], [90, 90], [50, 20], [10, 90]],  # a notch: not convex, but sound
        [[-0.5, -0.5], [99.5, -0.5], [99.5, 99.5], [-0.5, 99.5]],  # the whole image
        [[10, 10], [15, 10], [20, 10], [20, 20]],  # a corner on a straight side
    ],
)
def test_sound_outlines_pass(corners: list[list[float]]) -> None:
    assert _fault(corners) is None


@pytest.mark.parametrize(
    ("corners", "says"),
    [
        ([[10, 10], [20, 10]], "2 corners"),
        ([[10, 10], [20, 20], [20, 10], [10, 20]], "crosses itself: the side from corner 1 meets .* corner 3"),
        (STAR, "crosses itself"),
        ([[10, 10], [50, 10], [50, 50], [30, 10], [10, 50]], "crosses itself"),  # touches a side
        ([[10, 10], [50, 10], [50, 10], [10, 50]], "crosses itself"),  # a corner twice
        ([[10, 10], [50, 10], [30, 10], [10, 50]], "crosses itself"),  # folds back
        ([[10, 10], [10.5, 10], [10.2, 10.5]], "square pixels"),
        ([[10, 10], [20, 10], [20, 100]], r"corner 3 at \(20, 100\) px lies outside"),
        ([[10, 10], [20, -0.6], [20, 20]], "corner 2"),
        ([[10, 10], [float("nan"), 10], [20, 20]], "corner 2"),
    ],
)
def test_faulty_outlines_are_named(corners: list[list[float]], says: str) -> None:
    fault = _fault(corners)
    assert fault is not None
    assert re.search(says, fault), fault


@given(st.lists(st.floats(0.0, 6.28), min_size=3, max_size=12, unique_by=lambda angle: round(angle, 1)), st.booleans())
def test_corners_in_order_around_a_circle_never_cross(angles_rad: list[float], is_reversed: bool) -> None:
    ordered = sorted(angles_rad, reverse=is_reversed)
    corners = [[50 + 40 * np.cos(angle), 50 + 40 * np.sin(angle)] for angle in ordered]
    fault = _fault(corners)
    assert fault is None or "square pixels" in fault


@given(st.permutations(range(6)))
def test_only_the_two_directions_around_a_hexagon_are_simple(order: list[int]) -> None:
    corners = [[50 + 40 * np.cos(np.pi / 3 * k), 50 + 40 * np.sin(np.pi / 3 * k)] for k in order]
    steps = {(b - a) % 6 for a, b in zip(order, [*order[1:], order[0]], strict=True)}
    is_in_order = steps in ({1}, {5})
    assert (_fault(corners) is None) == is_in_order

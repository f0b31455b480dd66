"""Outlines that must go together: overlap, the image's edge, and all faults of a map by facet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.optics.polygons import clip_to_image, map_faults, overlapping_polygons, polygon_area_px2

SQUARE = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]])
NOTCHED = np.array([[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [30.0, 20.0], [10.0, 50.0]])


@pytest.mark.parametrize(("shift", "share"), [((20.0, 0.0), 0.0), ((10.0, 0.0), 0.5), ((10.0, 10.0), 0.25)])
def test_overlap_of_squares_is_that_of_the_ruler(shift, share):
    pairs = overlapping_polygons({1: SQUARE, 2: SQUARE + shift})
    assert pairs == ([] if share == 0.0 else [(1, 2, pytest.approx(share, abs=1e-6))])


def test_an_outline_in_the_notch_of_another_does_not_overlap():
    wedge = np.array([[22.0, 45.0], [38.0, 45.0], [30.0, 24.0]])
    assert all(share < 0.05 for *_, share in overlapping_polygons({1: NOTCHED, 2: wedge}))
    assert overlapping_polygons({1: NOTCHED, 2: wedge - (15.0, 15.0)})[0][2] > 0.5


def test_a_map_tells_every_fault_by_facet():
    faults = map_faults(
        {
            1: SQUARE,
            2: SQUARE + 4.0,
            3: SQUARE[[0, 2, 1, 3]] + 40.0,
            4: SQUARE + 80.0,
            5: SQUARE + np.array([60.0, 0.0]),
        },
        100,
        100,
    )
    assert sorted(faults) == [1, 2, 3, 4]
    assert "overlaps with facet 2 by 64%" in faults[1][0]
    assert "crosses itself" in faults[3][0]
    assert "outside the image" in faults[4][0]


@given(x=st.floats(-40, 120), y=st.floats(-40, 120), turn=st.floats(0, 6.28))
def test_clipping_keeps_what_both_have(x, y, turn):
    """The area of the clipped outline is that which a fine grid of points finds in both."""
    angles = turn + np.arange(6) * np.pi / 3
    hexagon = np.array([x, y]) + 30.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    clipped = clip_to_image(hexagon, 100, 80)
    grid = np.stack(np.meshgrid(np.arange(0.0, 100.0, 0.5) - 0.25, np.arange(0.0, 80.0, 0.5) - 0.25), -1).reshape(-1, 2)
    apothem = 30.0 * np.cos(np.pi / 6)
    normals = np.column_stack([np.cos(angles + np.pi / 6), np.sin(angles + np.pi / 6)])
    common_px2 = 0.25 * np.count_nonzero(((grid - [x, y]) @ normals.T <= apothem).all(axis=1))
    area_px2 = polygon_area_px2(clipped) if len(clipped) >= 3 else 0.0
    assert area_px2 == pytest.approx(common_px2, abs=60.0)
    assert len(clipped) == 0 or (np.all(clipped >= -0.5) and np.all(clipped <= [99.5, 79.5]))

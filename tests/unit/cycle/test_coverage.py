"""Coverage of the region: what is counted where, and where the star should go."""

from __future__ import annotations

import math

import numpy as np
import pytest

from namod_ctl.cycle.coverage import N_CELLS, empty_coverage, where_next, with_record

RADIUS = math.radians(0.35)


def test_rows_count_upwards_and_columns_to_the_right() -> None:
    coverage = with_record(empty_coverage(RADIUS), np.array([0.9 * RADIUS, 0.0]))
    assert coverage.counts[N_CELLS // 2, N_CELLS - 1] == 1
    coverage = with_record(coverage, np.array([0.0, -0.9 * RADIUS]))
    assert coverage.counts[0, N_CELLS // 2] == 1
    assert coverage.counts.sum() == 2


@pytest.mark.parametrize("theta", [[np.nan, 0.0], [1.2 * RADIUS, 0.0], [0.0, -5.0]])
def test_what_lies_outside_is_not_counted(theta: list[float]) -> None:
    assert with_record(empty_coverage(RADIUS), np.array(theta)).counts.sum() == 0


def test_following_the_advice_covers_the_region_without_a_detour() -> None:
    """One record per cell, each step to the cell next door as long as there is an empty one."""
    coverage, theta = empty_coverage(RADIUS), np.zeros(2)
    n_cells = int(coverage.is_inside.sum())
    for _ in range(n_cells):
        theta = where_next(coverage, theta)
        coverage = with_record(coverage, theta)
    assert coverage.share == 1.0
    assert coverage.counts[coverage.is_inside].tolist() == [1] * n_cells


def test_without_a_star_the_advice_counts_from_the_middle() -> None:
    assert where_next(empty_coverage(RADIUS), np.full(2, np.nan)) == pytest.approx([0.0, 0.0])


def test_the_share_is_that_of_the_circle() -> None:
    """An area of the circle, pi / 4 of the square, to a cell's width."""
    inside = empty_coverage(RADIUS).is_inside.mean()
    assert inside == pytest.approx(math.pi / 4.0, abs=1.0 / N_CELLS)


def test_a_hole_is_found_wherever_a_facet_could_hide_in_it() -> None:
    coverage = empty_coverage(RADIUS)
    y, x = np.meshgrid(coverage.centres_rad, coverage.centres_rad, indexing="ij")
    for hole in ([0.0, 0.0], [0.4 * RADIUS, -0.3 * RADIUS]):
        for radius, is_hole in ((0.15 * RADIUS, False), (0.3 * RADIUS, True)):
            covered = empty_coverage(RADIUS)
            for theta in np.column_stack([x.ravel(), y.ravel()]):
                if np.hypot(*(theta - hole)) > radius:
                    covered = with_record(covered, theta)
            assert covered.share > 0.85
            assert covered.has_hole == is_hole, (hole, radius)
    assert coverage.has_hole

"""Generated reflectors against published telescopes and the geometry of their surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.layouts import (
    Dish,
    Layout,
    facet_area_m2,
    facet_outline_m,
    generate_reflector,
    matched_focal_length_m,
    overlapping_facets,
)
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

FACT_FACETS = Path(__file__).parents[3] / ".." / "shared" / "data" / "fact_2014" / "fact_facets_measured.txt"

LST = Layout(Dish(28.0, parabola_share=1.0), FacetShape.HEXAGON, 1.51, 1.54, 1.0, 11.4)
MST = Layout(Dish(16.0, sphere_radius_m=19.2), FacetShape.HEXAGON, 1.2, 1.22, 0.8, 5.95, "edge")
MINI_FACT = Layout(Dish(0.45), FacetShape.HEXAGON, 0.0605, 0.062, 0.03, 0.17)


def _area_m2(reflector: Reflector) -> float:
    return sum(facet_area_m2(facet) for facet in reflector.facets)


def test_lst_has_the_published_facets_and_area() -> None:
    # CTA LST: 198 facets of 1.51 m, about 390 m2, 23 m across.
    reflector = generate_reflector(LST)
    assert len(reflector.facets) == 198
    assert _area_m2(reflector) == pytest.approx(390.0, abs=2.0)
    outer_radius_m = np.hypot(*reflector.positions_m[:, :2].T).max()
    assert 10.7 < outer_radius_m < 11.5


def test_mst_has_the_published_facets_and_area() -> None:
    # CTA MST: 86 facets of 1.2 m, 12 m dish; 106 m2 is the sum of its facets.
    reflector = generate_reflector(MST)
    assert len(reflector.facets) == 86
    assert _area_m2(reflector) == pytest.approx(106.0, abs=2.0)


def test_mini_fact_is_f_1_29() -> None:
    reflector = generate_reflector(MINI_FACT)
    assert len(reflector.facets) == 30
    equal_area_diameter_m = np.sqrt(4.0 * _area_m2(reflector) / np.pi)
    assert 0.45 / equal_area_diameter_m == pytest.approx(1.29, abs=0.01)
    assert facet_area_m2(reflector.facets[0]) == pytest.approx(31.7e-4, abs=0.05e-4)


def test_the_hexagonal_lattice_has_facts_pattern() -> None:
    if not FACT_FACETS.is_file():
        pytest.skip("the measured FACT facets are not in ../shared/data")
    measured_m = np.loadtxt(FACT_FACETS, usecols=(0, 1)) / 100.0
    generated_m = 10.0 * generate_reflector(MINI_FACT).positions_m[:, :2]
    distance_m = np.linalg.norm(measured_m[:, np.newaxis] - generated_m, axis=2)
    nearest = distance_m.argmin(axis=1)
    assert sorted(nearest) == list(range(30))
    assert distance_m.min(axis=1).max() < 0.03  # FACT's facets stand within some cm of the ideal lattice


def test_davies_cotton_facets_are_one_focal_length_from_the_focus() -> None:
    reflector = generate_reflector(replace(LST, dish=Dish(28.0)))
    distance_m = np.linalg.norm(reflector.positions_m - [0.0, 0.0, 28.0], axis=1)
    np.testing.assert_allclose(distance_m, 28.0, rtol=1e-14)
    np.testing.assert_allclose([facet.focal_length_m for facet in reflector.facets], 28.0, rtol=1e-14)


def test_a_parabolic_dish_delays_no_light() -> None:
    # Light of one wave front travels 28 m more than from the vertex plane, whichever facet it meets.
    positions_m = generate_reflector(LST).positions_m
    path_m = np.linalg.norm(positions_m - [0.0, 0.0, 28.0], axis=1) - positions_m[:, 2]
    np.testing.assert_allclose(path_m, 28.0, rtol=1e-14)


def test_parabolic_facets_match_the_gaussian_curvature_of_the_surface() -> None:
    for facet in generate_reflector(LST).facets[::20]:
        radius_m = np.hypot(*facet.position_m[:2])
        curvature = (1.0 / 56.0) ** 2 / (1.0 + (radius_m / 56.0) ** 2) ** 2  # of z = r^2 / (4 f)
        assert facet.focal_length_m == pytest.approx(0.5 / np.sqrt(curvature), rel=1e-12)


def test_the_modified_davies_cotton_dish_is_flatter_and_stays_on_its_sphere() -> None:
    positions_m = generate_reflector(MST).positions_m
    np.testing.assert_allclose(np.linalg.norm(positions_m - [0.0, 0.0, 19.2], axis=1), 19.2, rtol=1e-14)
    assert (positions_m[:, 2] < Dish(16.0).height_m(np.hypot(*positions_m[:, :2].T))).all()


def test_the_mixing_ratio_is_the_mean_of_both_surfaces() -> None:
    radius_m = np.array([0.0, 1.0, 2.0])
    sphere_m, parabola_m = Dish(5.0).height_m(radius_m), Dish(5.0, 1.0).height_m(radius_m)
    np.testing.assert_allclose(Dish(5.0, 0.25).height_m(radius_m), 0.75 * sphere_m + 0.25 * parabola_m)
    assert parabola_m[2] == 0.2  # 2^2 / (4 * 5)
    assert sphere_m[2] == pytest.approx(5.0 - np.sqrt(21.0))


def test_aligned_normals_throw_axis_parallel_light_on_the_focal_point() -> None:
    for layout in (LST, MST, MINI_FACT):
        reflector = generate_reflector(layout)
        normals = reflector.aligned_normals()
        incoming = np.array([0.0, 0.0, -1.0])
        reflected = incoming - 2.0 * (normals @ incoming)[:, np.newaxis] * normals
        steps = (layout.dish.focal_length_m - reflector.positions_m[:, 2]) / reflected[:, 2]
        hits_m = reflector.positions_m + steps[:, np.newaxis] * reflected
        np.testing.assert_allclose(hits_m[:, :2], 0.0, atol=1e-12)


@pytest.mark.parametrize("shape", list(FacetShape))
@pytest.mark.parametrize("centre", ["facet", "edge", "corner"])
def test_facets_never_overlap_and_ids_count_outwards(shape: FacetShape, centre: str) -> None:
    layout = Layout(Dish(10.0, 0.5), shape, 0.5, 0.51, 0.0, 3.0, centre)  # type: ignore[arg-type]
    reflector = generate_reflector(layout)
    assert reflector.ids == tuple(range(1, len(reflector.facets) + 1))
    radius_m = np.hypot(*reflector.positions_m[:, :2].T)
    assert (np.diff(radius_m) > -1e-6).all()
    assert overlapping_facets(reflector) == []
    centres_m = reflector.positions_m[:, :2]
    distance_m = np.linalg.norm(centres_m[:, np.newaxis] - centres_m, axis=2) + 9.0 * np.eye(len(centres_m))
    assert distance_m.min() == pytest.approx(0.51)


def test_each_ring_counts_counter_clockwise_from_plus_x() -> None:
    reflector = generate_reflector(replace(MINI_FACT, outer_radius_m=0.07))
    angle_deg = np.degrees(np.arctan2(reflector.positions_m[:, 1], reflector.positions_m[:, 0])) % 360.0
    np.testing.assert_allclose(angle_deg, [0.0, 60.0, 120.0, 180.0, 240.0, 300.0], atol=1e-9)


def test_a_dish_of_a_thousand_facets_is_generated_but_no_more() -> None:
    layout = Layout(Dish(28.0), FacetShape.SQUARE, 0.5, 0.5, 0.0, 8.9)
    assert 980 < len(generate_reflector(layout).facets) <= 1000
    with pytest.raises(ConfigError, match="1 to 1000"):
        generate_reflector(replace(layout, outer_radius_m=12.0))
    with pytest.raises(ConfigError, match="at most 1000"):
        generate_reflector(replace(layout, outer_radius_m=20_000.0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"spacing_m": 1.0}, "overlap"),
        ({"inner_radius_m": 12.0}, "larger than outer_radius_m"),
        ({"inner_radius_m": 0.1, "outer_radius_m": 0.2}, "has 0 facets"),
        ({"dish": Dish(5.0, sphere_radius_m=8.0)}, "beyond the dish's sphere"),
    ],
)
def test_impossible_layouts_are_refused(change: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        generate_reflector(replace(LST, **change))  # type: ignore[arg-type]


def _facet(facet_id: int, x_m: float, shape: FacetShape = FacetShape.SQUARE) -> Facet:
    return Facet(facet_id, np.array([x_m, 0.0, 0.0]), 1000.0, shape, 1.0)


def test_the_overlap_of_two_squares_is_their_common_share() -> None:
    pairs = overlapping_facets(Reflector(1000.0, (_facet(3, 0.0), _facet(8, 0.75), _facet(9, 5.0))))
    assert [(first, second) for first, second, _ in pairs] == [(3, 8)]
    assert pairs[0][2] == pytest.approx(0.25, abs=1e-4)


def test_outlines_have_their_flats_where_the_words_say() -> None:
    upwards = np.array([0.0, 0.0, 1.0])
    hexagon_m = facet_outline_m(_facet(1, 0.0, FacetShape.HEXAGON), upwards)
    np.testing.assert_allclose(hexagon_m[0], [0.0, 1.0 / np.sqrt(3.0)], atol=1e-12)  # a corner at +y
    assert hexagon_m[:, 0].max() == pytest.approx(0.5)  # flats face +-x
    square_m = facet_outline_m(_facet(1, 0.0), upwards)
    np.testing.assert_allclose(np.abs(square_m), 0.5)


def test_a_tilted_facet_looks_narrower_along_its_tilt() -> None:
    normal = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    square_m = facet_outline_m(_facet(1, 0.0), normal)
    assert np.ptp(square_m[:, 0]) == pytest.approx(np.cos(0.3))
    assert np.ptp(square_m[:, 1]) == pytest.approx(1.0)


def test_the_matched_focal_length_is_the_distance_to_the_focus() -> None:
    assert matched_focal_length_m(np.array([3.0, 0.0, 1.0]), 5.0) == 5.0  # 3-4-5 triangle

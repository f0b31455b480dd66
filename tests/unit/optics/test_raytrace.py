"""Ray tracing against what optics gives in closed form."""

from __future__ import annotations

import time

import numpy as np
import pytest

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.coordinates import theta_of_hit
from namod_ctl.optics.raytrace import (
    a_sigma_rad2,
    combine_moments,
    containment_radius_m,
    facet_moments,
    sample_outline,
    trace,
    with_common_focal_length,
)
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

F_M = 5.0


def one_facet(
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    focal_length_m: float = F_M,
    shape: FacetShape = FacetShape.HEXAGON,
    width_m: float = 0.6,
    rotation_rad: float = 0.0,
) -> Reflector:
    return Reflector(F_M, (Facet(1, np.array(position), focal_length_m, shape, width_m, rotation_rad),))


@pytest.mark.parametrize(
    ("shape", "variance_per_width2"),
    [(FacetShape.HEXAGON, 5 / 72), (FacetShape.SQUARE, 1 / 12), (FacetShape.ROUND, 1 / 16)],
)
def test_outlines_are_filled_evenly(shape: FacetShape, variance_per_width2: float) -> None:
    """Second moments of area from any table of sections: 5/72 w2 of a hexagon, w2/12 of a square, d2/16 of a disc."""
    points = sample_outline(one_facet(shape=shape, rotation_rad=0.3).facets[0], 3000)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=2e-3 * 0.6)
    np.testing.assert_allclose(np.cov(points.T), variance_per_width2 * 0.6**2 * np.eye(2), atol=3e-3 * 0.6**2 / 12)


def test_a_hexagon_has_flats_towards_x_and_corners_towards_y() -> None:
    reach = np.abs(sample_outline(one_facet().facets[0], 20000)).max(axis=0)
    np.testing.assert_allclose(reach, [0.3, 0.6 / np.sqrt(3)], rtol=0.01)
    turned = np.abs(sample_outline(one_facet(rotation_rad=np.pi / 6).facets[0], 20000)).max(axis=0)
    np.testing.assert_allclose(turned, [0.6 / np.sqrt(3), 0.3], rtol=0.01)


def test_a_square_turns_counter_clockwise() -> None:
    """A square turned by +0.2 rad has its corner of the first quadrant at 45 deg + 0.2 rad."""
    points = sample_outline(one_facet(shape=FacetShape.SQUARE, rotation_rad=0.2).facets[0], 20000)
    first_quadrant = points[(points > 0).all(axis=1)]
    corner = first_quadrant[np.argmax(np.linalg.norm(first_quadrant, axis=1))]
    assert np.arctan2(corner[1], corner[0]) == pytest.approx(np.pi / 4 + 0.2, abs=0.02)


def test_spherical_aberration_of_a_lone_mirror() -> None:
    """A ray at height h crosses the axis R - R / (2 cos a) above the vertex, sin a = h / R, and is 2 a steep."""
    radius = 2 * F_M
    reflector = one_facet(width_m=4.0, shape=FacetShape.ROUND)
    height = sample_outline(reflector.facets[0], 500)
    angle = np.arcsin(np.linalg.norm(height, axis=1) / radius)
    crossing = radius - radius / (2 * np.cos(angle))
    expected = (crossing - F_M) * np.tan(2 * angle)  # out on the ray's own side is positive
    hit = trace(reflector, 500).hit_m[0]
    signed = np.sum(hit * height, axis=1) / np.linalg.norm(height, axis=1)
    np.testing.assert_allclose(signed, expected, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(hit, axis=1), np.abs(expected), atol=1e-13)


def test_a_facet_of_wrong_focal_length_is_out_of_focus() -> None:
    """Thin mirror, small against its focal length: the blur is the outline shrunk by 1 - f / f_facet."""
    moments = facet_moments(trace(one_facet(focal_length_m=1.05 * F_M, width_m=0.1), 3000))
    expected = 5 / 72 * 0.1**2 * (1 - 1 / 1.05) ** 2
    np.testing.assert_allclose(moments.cov_m2[0], expected * np.eye(2), atol=0.005 * expected)


def test_an_image_moves_against_its_star() -> None:
    """The image of a star at Theta lies at -f tan(Theta)."""
    theta = np.array([0.003, -0.001])
    moments = facet_moments(trace(one_facet(width_m=0.05), 1000, theta))  # small: no coma to speak of
    np.testing.assert_allclose(moments.mean_m[0], -F_M * np.tan(theta), rtol=1e-4)


@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), (1.2, 0.0, 0.15), (-0.6, 1.0, 0.14)])
def test_a_tilted_facet_is_brightest_at_twice_its_tilt(position: tuple[float, float, float]) -> None:
    """DESIGN section 2. To first order: what is left is 3 % at most, from the facet's inclination to the axis."""
    tilt = np.array([[0.002, -0.001]])
    reflector = one_facet(position, width_m=0.05)
    aligned = facet_moments(trace(reflector, 200)).mean_m[0]
    off = facet_moments(trace(reflector, 200, tilt_rad=tilt)).mean_m[0]
    mended = facet_moments(trace(reflector, 200, 2 * tilt[0], tilt)).mean_m[0]
    full_shift = 2 * np.linalg.norm(tilt) * F_M
    assert np.linalg.norm(aligned) < 1e-5
    assert np.linalg.norm(mended) < 0.03 * full_shift
    np.testing.assert_allclose(theta_of_hit(off, F_M, np.zeros(2)), 2 * tilt[0], atol=0.03 * 2 * np.linalg.norm(tilt))


def test_light_is_the_projected_area() -> None:
    """A hexagon of 0.6 m has 0.3118 m2; its normal leans by half the angle to the focal point."""
    reflector = one_facet((2.0, 0.0, 0.4))
    lean = 0.5 * np.arctan2(2.0, F_M - 0.4)
    light = facet_moments(trace(reflector, 2000)).light_m2[0]
    assert light == pytest.approx(np.sqrt(3) / 2 * 0.36 * np.cos(lean), rel=1e-4)


def test_roughness_blurs_by_twice_the_slope_error() -> None:
    slope = 2e-4
    rng = np.random.default_rng(1)
    cov = facet_moments(trace(one_facet(width_m=0.01), 40000, roughness_rad=slope, rng=rng)).cov_m2[0]
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), 2 * slope * F_M, rtol=0.02)  # 5 sigma of 40000 rays
    assert abs(cov[0, 1]) < 0.03 * cov[0, 0]


def test_a_tilted_twin_widens_the_sum_by_the_law_of_moments() -> None:
    """Two equal spots 2 d apart: variance d2 along the line between them, whatever their own width."""
    twins = Reflector(F_M, one_facet(width_m=0.01).facets * 2)
    tilt = np.array([[0.001, 0.0], [-0.001, 0.0]])
    total = combine_moments(facet_moments(trace(twins, 100, tilt_rad=tilt)))
    assert total.cov_m2[0, 0] == pytest.approx((2 * 0.001 * F_M) ** 2, rel=1e-3)
    rays = trace(twins, 100, tilt_rad=tilt)
    everything = np.cov(rays.hit_m.reshape(-1, 2).T, aweights=rays.light_m2.ravel(), bias=True)
    np.testing.assert_allclose(total.cov_m2, everything, rtol=1e-9, atol=1e-18)


def test_a_sigma_of_a_round_gaussian_is_the_circle_of_one_sigma() -> None:
    assert a_sigma_rad2(np.diag([0.01**2, 0.02**2]), 5.0) == pytest.approx(np.pi * 0.002 * 0.004)


def test_containment_of_an_evenly_lit_disc() -> None:
    """An out-of-focus round facet makes an evenly lit disc: 80 % of its light lie within sqrt(0.8) of its radius."""
    reflector = one_facet(focal_length_m=1.1 * F_M, shape=FacetShape.ROUND)
    edge = 0.3 * (1 - 1 / 1.1)
    assert containment_radius_m(trace(reflector, 5000), 0.8) == pytest.approx(np.sqrt(0.8) * edge, rel=0.01)


def test_sampling_converges_below_half_a_percent() -> None:
    reflector = with_common_focal_length(
        Reflector(
            F_M,
            tuple(
                Facet(i, np.array([x, y, (x * x + y * y) / (4 * F_M)]), 5.1, FacetShape.HEXAGON, 0.6)
                for i, (x, y) in enumerate([(0.6, 0.0), (-1.2, 0.5), (0.3, 1.5), (0.0, -1.0)])
            ),
        )
    )
    coarse, fine = (
        a_sigma_rad2(combine_moments(facet_moments(trace(reflector, n))).cov_m2, F_M) for n in (2000, 40000)
    )
    assert coarse == pytest.approx(fine, rel=0.005)


def test_a_thousand_facets_take_seconds() -> None:
    grid = [(x, y) for x in np.linspace(-10, 10, 40) for y in np.linspace(-10, 10, 25)]
    facets = tuple(
        Facet(i, np.array([x, y, (x * x + y * y) / 112]), 28.5, FacetShape.HEXAGON, 0.5)
        for i, (x, y) in enumerate(grid)
    )
    start = time.perf_counter()
    moments = facet_moments(trace(Reflector(28.0, facets), 500))
    assert time.perf_counter() - start < 5.0
    assert np.linalg.norm(moments.mean_m, axis=1).max() < 0.01  # coma of each facet only: all aim at the focus


def test_refuses_a_facet_larger_than_its_sphere() -> None:
    with pytest.raises(ConfigError, match=r"facet 1: a width of 6\.0 m does not fit"):
        trace(one_facet(focal_length_m=1.0, width_m=6.0), 100)


def test_refuses_light_that_never_arrives() -> None:
    with pytest.raises(ConfigError, match=r"facet 1: light of a star .* does not arrive in the focal plane"):
        trace(one_facet(), 100, tilt_rad=np.array([[2.0, 0.0]]))

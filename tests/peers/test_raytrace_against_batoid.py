"""Hits of every ray on 30 tilted facets, on and off axis, against batoid (Rubin Observatory's ray tracer).

batoid sees the same geometry in its own words: one Sphere per facet in a CoordSys at the facet's vertex, and a
Plane. It is given the incoming rays, and finds the points on the spheres itself.
"""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.optics.coordinates import direction_to_star
from namod_ctl.optics.raytrace import sample_surface, tilted_normals, trace
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

batoid = pytest.importorskip("batoid", reason="batoid is not installed (extra `peers`)")

F_M = 4.889
ONE_MICROMETRE_M = 1e-6


def davies_cotton_of_thirty() -> Reflector:
    """30 hexagons on rows like FACT's, with focal lengths that scatter like FACT's."""
    columns_of_row = {-3: 2, -2: 5, -1: 6, 0: 4, 1: 6, 2: 5, 3: 2}
    places = [((k - (n - 1) / 2) * 0.62, row * 0.54) for row, n in columns_of_row.items() for k in range(n)]
    focal_lengths = F_M + 0.02 * np.random.default_rng(3).standard_normal(len(places))
    return Reflector(
        F_M,
        tuple(
            Facet(j, np.array([x, y, F_M - np.sqrt(F_M**2 - x * x - y * y)]), f, FacetShape.HEXAGON, 0.606)
            for j, ((x, y), f) in enumerate(zip(places, focal_lengths, strict=True))
        ),
    )


@pytest.mark.parametrize("theta_deg", [(0.0, 0.0), (1.5, 0.0), (-0.7, 2.0)])
def test_every_ray_hits_where_batoid_says(theta_deg: tuple[float, float]) -> None:
    reflector = davies_cotton_of_thirty()
    assert len(reflector.facets) == 30
    theta = np.radians(theta_deg)
    tilt = 0.003 * np.random.default_rng(4).standard_normal((30, 2))
    n_rays = 300
    ours = trace(reflector, n_rays, theta, tilt)
    to_star = direction_to_star(theta)
    for j, (facet, normal) in enumerate(zip(reflector.facets, tilted_normals(reflector, tilt), strict=True)):
        # 3 m up the incoming ray: where on the sphere it arrives is batoid's own business.
        start = sample_surface(facet, normal, n_rays)[0] + 3.0 * to_star
        rays = batoid.RayVector(*start.T.copy(), *(np.full(n_rays, -component) for component in to_star))
        lean = batoid.RotY(np.arctan2(normal[0], normal[2])) @ batoid.RotX(-np.arcsin(normal[1]))
        vertex = batoid.CoordSys(origin=facet.position_m, rot=lean)
        batoid.Sphere(2.0 * facet.focal_length_m).reflect(rays, coordSys=vertex)
        batoid.Plane().intersect(rays, coordSys=batoid.CoordSys(origin=[0.0, 0.0, F_M]))
        assert not rays.failed.any()
        np.testing.assert_allclose(lean[:, 2], normal, atol=1e-12)
        np.testing.assert_allclose(np.column_stack([rays.x, rays.y]), ours.hit_m[j], rtol=0, atol=ONE_MICROMETRE_M)

"""Ray tracing of a segmented reflector: where the light of a star arrives in the focal plane.

Spherical facets of any outline, position, tilt, focal length and surface roughness are hit by parallel light.
Reflection is exact (no small angles). Facets do not shadow each other here, nor do masts and camera: shadowing
takes light away but moves none.

Positions in the focal plane are telescope x and y in m, relative to the focal point; as star directions they are
read with `namod_ctl.optics.coordinates.theta_of_hit`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.coordinates import direction_to_star, rotation_to_normal
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

Array = NDArray[np.float64]

_GOLDEN_SHARE = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class RayTrace:
    """Where the rays of one star arrive.

    Attributes
    ----------
    hit_m
        Shape (n_facets, n_rays, 2). Arrival in the plane z = focal_length_m, telescope x and y.
    light_m2
        Shape (n_facets, n_rays). Light of each ray: the mirror area it stands for, projected on the star's direction.
    """

    focal_length_m: float
    hit_m: Array
    light_m2: Array


@dataclass(frozen=True, slots=True, eq=False)
class LightMoments:
    """Moments of one or several distributions of light in the focal plane.

    Attributes
    ----------
    light_m2
        Shape (...). Light of each distribution.
    mean_m
        Shape (..., 2). Centre of gravity.
    cov_m2
        Shape (..., 2, 2). Covariance about it.
    """

    light_m2: Array
    mean_m: Array
    cov_m2: Array


def outline_area_m2(facet: Facet) -> float:
    """Area of a facet's outline."""
    match facet.shape:
        case FacetShape.HEXAGON:
            return math.sqrt(3.0) / 2.0 * facet.width_m**2
        case FacetShape.SQUARE:
            return facet.width_m**2
        case FacetShape.ROUND:
            return math.pi / 4.0 * facet.width_m**2


def sample_outline(facet: Facet, n_rays: int) -> Array:
    """Points spread evenly over a facet's outline, shape (n_rays, 2), m, in the facet's own x and y; no randomness.

    A Fibonacci lattice of the unit square is mapped on the outline by a map that keeps areas: the square as it
    is, the disc in polar coordinates, the hexagon as three rhombi.
    """
    index = np.arange(n_rays)
    first, second = (index + 0.5) / n_rays, (index * _GOLDEN_SHARE + 0.5) % 1.0
    match facet.shape:
        case FacetShape.SQUARE:
            points = np.column_stack([first - 0.5, second - 0.5])
        case FacetShape.ROUND:
            radius, azimuth = 0.5 * np.sqrt(first), math.tau * second
            points = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth)])
        case FacetShape.HEXAGON:
            rhombus, along = np.divmod(3.0 * first, 1.0)
            azimuth = math.pi / 2.0 + rhombus * math.tau / 3.0
            edges = [np.column_stack([np.cos(a), np.sin(a)]) for a in (azimuth, azimuth + math.tau / 3.0)]
            points = (along[:, None] * edges[0] + second[:, None] * edges[1]) / math.sqrt(3.0)
    cosine, sine = math.cos(facet.rotation_rad), math.sin(facet.rotation_rad)
    turned: Array = facet.width_m * points @ np.array([[cosine, sine], [-sine, cosine]])
    return turned


def sample_surface(facet: Facet, normal: Array, n_rays: int) -> tuple[Array, Array]:
    """Points on a facet's mirror surface and the surface's normals there, in the frame of the facet.

    Parameters
    ----------
    normal
        Shape (3,). Unit normal at the facet's centre, telescope frame.

    Returns
    -------
    Points and unit normals, each of shape (n_rays, 3): the points in m in the telescope frame, the normals in the
    facet's own frame (z along `normal`), where roughness is added to them.

    Raises
    ------
    ConfigError
        When the outline does not fit on the facet's sphere.
    """
    radius_m = 2.0 * facet.focal_length_m
    across_m = sample_outline(facet, n_rays)
    sine = across_m / radius_m
    sine2 = np.sum(sine**2, axis=1)
    if not np.all(sine2 < 1.0):
        raise ConfigError(
            f"facet {facet.id}: a width of {facet.width_m} m does not fit on a sphere of {radius_m} m radius "
            f"(focal length {facet.focal_length_m} m); check both lengths and their units"
        )
    cosine = np.sqrt(1.0 - sine2)
    sag_m = radius_m * sine2 / (1.0 + cosine)  # = R - sqrt(R^2 - r^2) without its cancellation
    points_m: Array = facet.position_m + np.column_stack([across_m, sag_m]) @ rotation_to_normal(normal).T
    return points_m, np.column_stack([-sine, cosine])


def tilted_normals(reflector: Reflector, tilt_rad: Array) -> Array:
    """Unit normals, shape (n_facets, 3), telescope frame, of facets of tilts (n_facets, 2): aligned + (t_x, t_y, 0)."""
    normals = reflector.aligned_normals()
    normals[:, :2] += tilt_rad
    unit: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def trace(
    reflector: Reflector,
    n_rays: int,
    theta_rad: Array | None = None,
    tilt_rad: Array | None = None,
    roughness_rad: float = 0.0,
    rng: np.random.Generator | None = None,
) -> RayTrace:
    """Arrival of a star's light in the focal plane, facet by facet.

    Parameters
    ----------
    n_rays
        Rays per facet.
    theta_rad
        Shape (2,). Direction of the star, telescope frame; on the axis when left out.
    tilt_rad
        Shape (n_facets, 2). Tilt of each facet; all aligned when left out.
    roughness_rad
        Standard deviation of the surface's slope about each of the facet's two axes (not of the reflected ray).
    rng
        Draws the roughness; needed only with one.

    Raises
    ------
    ConfigError
        When a facet's light does not arrive in the focal plane at all, or its outline does not fit on its sphere.
    """
    theta = np.zeros(2) if theta_rad is None else np.asarray(theta_rad, dtype=np.float64)
    tilts = np.zeros((len(reflector.facets), 2)) if tilt_rad is None else np.asarray(tilt_rad, dtype=np.float64)
    if roughness_rad > 0.0 and rng is None:
        raise ValueError("roughness needs a random generator")
    to_star = direction_to_star(theta)
    hit_m = np.empty((len(reflector.facets), n_rays, 2))
    light_m2 = np.empty((len(reflector.facets), n_rays))
    for j, (facet, normal) in enumerate(zip(reflector.facets, tilted_normals(reflector, tilts), strict=True)):
        points_m, local = sample_surface(facet, normal, n_rays)
        rotation = rotation_to_normal(normal)
        # A ray stands for the same patch of the outline as every other; the mirror surface over that patch is
        # larger by 1 / local z, and shows the star its cosine.
        light_m2[j] = outline_area_m2(facet) / n_rays * (local @ rotation.T @ to_star) / local[:, 2]
        if rng is not None and roughness_rad > 0.0:
            local[:, :2] += rng.normal(0.0, roughness_rad, (n_rays, 2))
            local /= np.linalg.norm(local, axis=1, keepdims=True)
        surface_normal = local @ rotation.T
        reflected = 2.0 * (surface_normal @ to_star)[:, None] * surface_normal - to_star
        height_m = reflector.focal_length_m - points_m[:, 2]
        if np.any(light_m2[j] <= 0.0) or np.any(reflected[:, 2] * height_m <= 0.0):
            raise ConfigError(
                f"facet {facet.id}: light of a star at theta = ({theta[0]:.4f}, {theta[1]:.4f}) rad does not arrive in "
                f"the focal plane at z = {reflector.focal_length_m} m; check the star's direction, the facet's "
                f"position and the telescope's focal length"
            )
        hit_m[j] = points_m[:, :2] + reflected[:, :2] * (height_m / reflected[:, 2])[:, None]
    return RayTrace(reflector.focal_length_m, hit_m, light_m2)


def facet_moments(rays: RayTrace) -> LightMoments:
    """Moments of each facet's light; leading shape (n_facets,)."""
    light = rays.light_m2.sum(axis=1)
    share = rays.light_m2 / light[:, None]
    mean = np.einsum("fr,fra->fa", share, rays.hit_m)
    offset = rays.hit_m - mean[:, None, :]
    return LightMoments(light, mean, np.einsum("fr,fra,frb->fab", share, offset, offset))


def combine_moments(parts: LightMoments) -> LightMoments:
    """Moments of the sum of several distributions of light (leading shape (n,)); leading shape ()."""
    light = parts.light_m2.sum()
    share = parts.light_m2 / light
    mean = share @ parts.mean_m
    offset = parts.mean_m - mean
    within = np.einsum("f,fab->ab", share, parts.cov_m2)
    between = np.einsum("f,fa,fb->ab", share, offset, offset)
    return LightMoments(np.asarray(light), mean, within + between)


def a_sigma_rad2(cov_m2: Array, focal_length_m: float) -> float:
    """A_sigma = pi * sqrt(det(cov)) of light in the focal plane, seen as directions; `cov_m2` of shape (2, 2).

    Source: arXiv:1605.06274, section 4.
    """
    return math.pi * math.sqrt(max(float(np.linalg.det(cov_m2 / focal_length_m**2)), 0.0))


def containment_radius_m(rays: RayTrace, share: float) -> float:
    """Radius about the centre of gravity that holds `share` (0 to 1) of all light."""
    centre = combine_moments(facet_moments(rays)).mean_m
    distance = np.linalg.norm(rays.hit_m - centre, axis=-1).ravel()
    order = np.argsort(distance)
    contained = np.cumsum(rays.light_m2.ravel()[order])
    return float(distance[order][np.searchsorted(contained, share * contained[-1])])


def with_common_focal_length(reflector: Reflector) -> Reflector:
    """The reflector with every facet given the focal length of the telescope: what a perfect maker would deliver."""
    facets = tuple(replace(facet, focal_length_m=reflector.focal_length_m) for facet in reflector.facets)
    return replace(reflector, facets=facets)

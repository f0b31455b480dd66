"""Generated reflectors: where the facets of a segmented dish stand, from a few numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

Array = NDArray[np.float64]
LatticeCentre = Literal["facet", "edge", "corner"]

MAX_FACETS = 1000
SAME_RADIUS_SHARE = 1e-6  # of the spacing: sites closer than this in radius belong to one ring
OUTLINE_CORNERS = {FacetShape.HEXAGON: 6, FacetShape.SQUARE: 4, FacetShape.ROUND: 48}


@dataclass(frozen=True, slots=True)
class Dish:
    """The surface on which the facets' centres stand, between a sphere and a paraboloid.

    Attributes
    ----------
    focal_length_m
        Distance from the dish vertex to the focal plane.
    parabola_share
        0: sphere of radius `sphere_radius_m`; 1: paraboloid z = r^2 / (4 f); between: the mean of both heights with
        that weight.
    sphere_radius_m
        f for a Davies-Cotton reflector, larger (1.2 f) for the modified Davies-Cotton of the CTA
        medium-sized telescopes; None means f.
    """

    focal_length_m: float
    parabola_share: float = 0.0
    sphere_radius_m: float | None = None

    def height_m(self, radius_m: Array) -> Array:
        """Height z over the dish vertex at distances `radius_m` (any shape) from the axis; NaN beyond the sphere."""
        sphere_radius_m = self.focal_length_m if self.sphere_radius_m is None else self.sphere_radius_m
        with np.errstate(invalid="ignore"):
            sphere_m = sphere_radius_m - np.sqrt(sphere_radius_m**2 - radius_m**2)
        parabola_m = radius_m**2 / (4.0 * self.focal_length_m)
        if self.parabola_share == 1.0:  # a paraboloid has no rim: do not let the sphere's NaN in
            return parabola_m
        height: Array = (1.0 - self.parabola_share) * sphere_m + self.parabola_share * parabola_m
        return height


@dataclass(frozen=True, slots=True)
class Layout:
    """A regular lattice of equal facets on a dish.

    Attributes
    ----------
    shape, width_m
        Outline of every facet; flat to flat, diameter of a round one.
    spacing_m
        From a facet's centre to its nearest neighbours' centres, seen along the axis.
    inner_radius_m, outer_radius_m
        Facets are where their centre's distance to the axis lies between these two, both included.
    centre
        What of the lattice lies on the axis: a facet's centre, the middle between two neighbours (along x) or
        the corner where facets meet.
    facet_focal_length_m
        Focal length of all facets; None gives each its distance to the focal point, see `matched_focal_length_m`.
    """

    dish: Dish
    shape: FacetShape
    width_m: float
    spacing_m: float
    inner_radius_m: float
    outer_radius_m: float
    centre: LatticeCentre = "facet"
    facet_focal_length_m: float | None = None


def matched_focal_length_m(position_m: Array, focal_length_m: float) -> Array:
    """Focal length, shape (...), that images a star on the focal point from facets at `position_m` (..., 3).

    It is the distance from the facet to the focal point. On a Davies-Cotton sphere that is f for all facets. On a
    paraboloid it is f + r^2 / (4 f), half the geometric mean of the two principal radii of curvature
    2 f (1 + (r / 2f)^2)^(3/2) and 2 f (1 + (r / 2f)^2)^(1/2) of the surface there.
    """
    focus_m = np.array([0.0, 0.0, focal_length_m])
    distance_m: Array = np.linalg.norm(position_m - focus_m, axis=-1)
    return distance_m


def _lattice_m(layout: Layout) -> Array:
    """Sites of the lattice out to the outer radius, shape (n, 2); hexagonal but for squares.

    Neighbours of the hexagonal lattice lie along x, where the hexagons' flats are.
    """
    n = int(np.ceil(2.0 * layout.outer_radius_m / layout.spacing_m)) + 2
    column, row = (
        index.astype(np.float64).ravel() for index in np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1))
    )
    if layout.shape is FacetShape.SQUARE:
        sites = np.column_stack([column, row])
        offsets = {"facet": (0.0, 0.0), "edge": (0.5, 0.0), "corner": (0.5, 0.5)}
    else:
        sites = np.column_stack([column + row / 2.0, row * np.sqrt(3.0) / 2.0])
        offsets = {"facet": (0.0, 0.0), "edge": (0.5, 0.0), "corner": (0.5, 0.5 / np.sqrt(3.0))}
    lattice_m: Array = (sites - offsets[layout.centre]) * layout.spacing_m
    return lattice_m


def generate_reflector(layout: Layout) -> Reflector:
    """The reflector of that layout.

    Ids count from 1 in rings: by distance from the axis, and within a ring counter-clockwise from +x as
    seen from the focal point.

    Raises
    ------
    ConfigError
        The facets would overlap or leave the sphere, there would be none, or more than `MAX_FACETS`.
    """
    _refuse_impossible(layout)
    sites_m = _lattice_m(layout)
    radius_m = np.hypot(sites_m[:, 0], sites_m[:, 1])
    margin_m = SAME_RADIUS_SHARE * layout.spacing_m
    is_inside = (radius_m >= layout.inner_radius_m - margin_m) & (radius_m <= layout.outer_radius_m + margin_m)
    sites_m, radius_m = sites_m[is_inside], radius_m[is_inside]
    if not 1 <= len(sites_m) <= MAX_FACETS:
        raise ConfigError(
            f"the layout has {len(sites_m)} facets between inner_radius_m = {layout.inner_radius_m} and "
            f"outer_radius_m = {layout.outer_radius_m}; it must have 1 to {MAX_FACETS}: change radii or spacing_m"
        )
    height_m = layout.dish.height_m(radius_m)
    if not np.isfinite(height_m).all():
        raise ConfigError(
            f"outer_radius_m = {layout.outer_radius_m} reaches beyond the dish's sphere; "
            "make it smaller or the dish flatter (dish_radius_m)"
        )
    angle_rad = np.round(np.arctan2(sites_m[:, 1], sites_m[:, 0]), 9) % (2.0 * np.pi)
    ring = np.round(radius_m / margin_m)
    order = np.lexsort((angle_rad, ring))
    positions_m = np.column_stack([sites_m, height_m])[order]
    focal_lengths_m = (
        matched_focal_length_m(positions_m, layout.dish.focal_length_m)
        if layout.facet_focal_length_m is None
        else np.full(len(positions_m), layout.facet_focal_length_m)
    )
    facets = tuple(
        Facet(id=number, position_m=position_m, focal_length_m=float(f_m), shape=layout.shape, width_m=layout.width_m)
        for number, (position_m, f_m) in enumerate(zip(positions_m, focal_lengths_m, strict=True), start=1)
    )
    return Reflector(layout.dish.focal_length_m, facets)


def _refuse_impossible(layout: Layout) -> None:
    if layout.spacing_m < layout.width_m:
        raise ConfigError(
            f"spacing_m = {layout.spacing_m} is smaller than the facets' width_m = {layout.width_m}: they would overlap"
        )
    if layout.inner_radius_m > layout.outer_radius_m:
        raise ConfigError(
            f"inner_radius_m = {layout.inner_radius_m} is larger than outer_radius_m = {layout.outer_radius_m}"
        )
    n_expected = np.pi * layout.outer_radius_m**2 / layout.spacing_m**2
    if n_expected > 100 * MAX_FACETS:  # do not even lay out millions of sites
        raise ConfigError(
            f"outer_radius_m = {layout.outer_radius_m} with spacing_m = {layout.spacing_m} makes about "
            f"{n_expected:.0f} facets; at most {MAX_FACETS} are possible"
        )


def facet_area_m2(facet: Facet) -> float:
    """Mirror area of a facet, that of its flat outline."""
    if facet.shape is FacetShape.HEXAGON:
        return float(np.sqrt(3.0) / 2.0 * facet.width_m**2)
    if facet.shape is FacetShape.SQUARE:
        return facet.width_m**2
    return float(np.pi / 4.0 * facet.width_m**2)


def facet_outline_m(facet: Facet, normal: Array) -> Array:
    """Corners of a facet as seen along the axis, shape (n_corners, 2), telescope x and y.

    The outline lies in the plane perpendicular to `normal` (3,); a round facet becomes a polygon of 48 corners.
    """
    n_corners = OUTLINE_CORNERS[facet.shape]
    # The first corner: at +y for a hexagon, half-way between the flats for a square.
    first_rad = np.pi / 4.0 if facet.shape is FacetShape.SQUARE else np.pi / 2.0
    angle_rad = first_rad + facet.rotation_rad + 2.0 * np.pi * np.arange(n_corners) / n_corners
    half_width_m = facet.width_m / 2.0
    reach_m = half_width_m if facet.shape is FacetShape.ROUND else half_width_m / np.cos(np.pi / n_corners)
    up = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    corners_m = facet.position_m + reach_m * (np.outer(np.cos(angle_rad), right) + np.outer(np.sin(angle_rad), up))
    outline: Array = corners_m[:, :2]
    return outline


def overlapping_facets(reflector: Reflector) -> list[tuple[int, int, float]]:
    """Pairs of facets that cover each other as seen along the axis: (id, id, share of the smaller one's area)."""
    outlines = [
        facet_outline_m(facet, normal).astype(np.float32)
        for facet, normal in zip(reflector.facets, reflector.aligned_normals(), strict=True)
    ]
    areas_m2 = [float(cv2.contourArea(outline)) for outline in outlines]
    reach_m = np.array([np.linalg.norm(o - o.mean(axis=0), axis=1).max() for o in outlines])
    centres_m = reflector.positions_m[:, :2]
    distance_m = np.linalg.norm(centres_m[:, np.newaxis] - centres_m[np.newaxis], axis=2)
    is_near = np.triu(distance_m < reach_m[:, np.newaxis] + reach_m[np.newaxis], k=1)
    pairs = []
    for first, second in zip(*np.nonzero(is_near), strict=True):
        common_m2, _ = cv2.intersectConvexConvex(outlines[first], outlines[second])
        share = float(common_m2) / min(areas_m2[first], areas_m2[second])
        if share > 0.0:
            pairs.append((reflector.facets[first].id, reflector.facets[second].id, share))
    return pairs

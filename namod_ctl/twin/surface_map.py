"""Which pixel of the reflector camera sees which point of which facet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.coordinates import rotation_to_normal
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector

Array = NDArray[np.float64]

N_CORNERS = {FacetShape.HEXAGON: 6, FacetShape.SQUARE: 4, FacetShape.ROUND: 48}


@dataclass(frozen=True, slots=True, eq=False)
class FacetPixels:
    """The pixels of one facet.

    `index` (n,) counts in the raveled image (rows, columns); `across_m` (n, 2) are the points there, `outline_m`
    (n_corners, 2) is the polygon, both in the facet's own x and y.
    """

    index: NDArray[np.intp]
    across_m: Array
    outline_m: Array


def outline_m(facet: Facet) -> Array:
    """Corners of a facet, shape (n_corners, 2), in its own x and y; as `sample_outline` fills them."""
    n = N_CORNERS[facet.shape]
    first = math.pi / 4.0 if facet.shape is FacetShape.SQUARE else math.pi / 2.0
    angle = first + facet.rotation_rad + math.tau * np.arange(n) / n
    reach_m = facet.width_m / 2.0 / (1.0 if facet.shape is FacetShape.ROUND else math.cos(math.pi / n))
    return reach_m * np.column_stack([np.cos(angle), np.sin(angle)])


def project(points_m: Array, focal_length_m: float, camera: CameraModel) -> Array:
    """Where a pinhole camera in the focal point, looking down, sees points (..., 3): pixel (x, y), shape (..., 2)."""
    height_m = focal_length_m - points_m[..., 2:]
    return camera.pixel_of_theta(points_m[..., :2] / height_m)


def projected_outlines(reflector: Reflector, camera: CameraModel) -> list[Array]:
    """Outline of every facet, shape (n_corners, 2), (x, y) pixel, as the camera in the focal point sees it."""
    return [
        project(
            facet.position_m
            + np.column_stack([outline_m(facet), np.zeros(N_CORNERS[facet.shape])]) @ rotation_to_normal(normal).T,
            reflector.focal_length_m,
            camera,
        )
        for facet, normal in zip(reflector.facets, reflector.aligned_normals(), strict=True)
    ]


def map_facets(reflector: Reflector, camera: CameraModel, polygons_px: Mapping[int, Array]) -> list[FacetPixels]:
    """The pixels of every facet inside its polygon, in the reflector's order; none for one without a polygon.

    An affine map ties a facet to its polygon: corner to corner where the numbers of corners agree; otherwise (a facet
    half hidden behind a mast) by the projection of the dish, laid on all polygons' centres.
    """
    outlines = projected_outlines(reflector, camera)
    seen = [j for j, facet in enumerate(reflector.facets) if facet.id in polygons_px]
    to_image = _laid_on(
        np.array([outlines[j].mean(axis=0) for j in seen]),
        np.array([polygons_px[reflector.facets[j].id].mean(axis=0) for j in seen]),
    )
    pixels = []
    for facet, outline in zip(reflector.facets, outlines, strict=True):
        polygon = polygons_px.get(facet.id)
        if polygon is None:
            pixels.append(FacetPixels(np.empty(0, dtype=np.intp), np.empty((0, 2)), outline_m(facet)))
            continue
        expected = _with_ones(outline) @ to_image
        corners = _matched(expected, polygon) if len(polygon) == len(outline) else expected
        to_facet = np.linalg.lstsq(_with_ones(corners), outline_m(facet), rcond=None)[0]
        index = _pixels_inside(polygon, camera.n_columns, camera.n_rows)
        place = np.column_stack([index % camera.n_columns, index // camera.n_columns]).astype(np.float64)
        pixels.append(FacetPixels(index, _with_ones(place) @ to_facet, _with_ones(polygon) @ to_facet))
    return pixels


def _with_ones(points: Array) -> Array:
    return np.column_stack([points, np.ones(len(points))])


def _laid_on(projected_px: Array, centres_px: Array) -> Array:
    """Affine map (3, 2) from the ideal projection to the image; that itself with too few facets to tell."""
    if len(projected_px) < 4:
        return np.vstack([np.eye(2), np.zeros(2)])
    return np.asarray(np.linalg.lstsq(_with_ones(projected_px), centres_px, rcond=None)[0], dtype=np.float64)


def _matched(expected: Array, polygon: Array) -> Array:
    """The polygon's corners in the order of the expected ones: the turn and sense that move them least."""
    turns = [np.roll(corners, k, axis=0) for corners in (polygon, polygon[::-1]) for k in range(len(polygon))]
    return min(turns, key=lambda corners: float(np.sum((corners - expected) ** 2)))


def _pixels_inside(polygon: Array, n_columns: int, n_rows: int) -> NDArray[np.intp]:
    """Raveled indices of the pixels whose centres lie inside the polygon."""
    low = np.maximum(np.floor(polygon.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(polygon.max(axis=0)).astype(int), (n_columns - 1, n_rows - 1))
    x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    index: NDArray[np.intp] = (y * n_columns + x)[is_inside(polygon, x, y)]
    return index


def is_inside(polygon: Array, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Do the points `x`, `y` (any shape) lie in the polygon (n_corners, 2)?"""
    inside = np.zeros(x.shape, dtype=bool)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:  # a ray to the right of the point crosses this side, or not
            inside ^= ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return inside

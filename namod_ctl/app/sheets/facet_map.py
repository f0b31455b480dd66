"""Where facets lie in a picture of the reflector, and where text finds room in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.layouts import facet_area_m2, facet_outline_m
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

_FREE_MARGIN_SHARE = 0.04  # of the picture's short edge, kept free around a reflector drawn from its facet list


def outlines_m(reflector: Reflector) -> dict[int, Array]:
    """Corners of every facet by id, shape (n_corners, 2), telescope x and y, m, as seen along the axis."""
    return {
        facet.id: facet_outline_m(facet, normal)
        for facet, normal in zip(reflector.facets, reflector.aligned_normals(), strict=True)
    }


def polygon_area(corners: Array) -> float:
    """Area of a polygon of shape (n_corners, 2), in the square of its unit (the shoelace rule)."""
    x, y = corners.T
    return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def polygon_centre(corners: Array) -> Array:
    """Centre of gravity of a polygon's area, shape (2,)."""
    x, y = (corners - corners[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = np.array([((x + np.roll(x, -1)) * cross).sum(), ((y + np.roll(y, -1)) * cross).sum()])
    centre: Array = corners[0] + sums / (3.0 * cross.sum())
    return centre


@dataclass(frozen=True, slots=True, eq=False)
class FacetInPicture:
    """One facet in a picture.

    Attributes
    ----------
    outline_px
        Shape (n_corners, 2), (x, y) pixel.
    legs_px
        Shape (n_legs, 2). Where the legs are.
    width_px
        Flat to flat of a hexagon of this area; the yardstick for text.
    """

    facet_id: int
    outline_px: Array
    centre_px: Array
    legs_px: Array
    width_px: float


def locate_facets(instrument: Instrument, polygons_px: Mapping[int, Array]) -> tuple[FacetInPicture, ...]:
    """Every facet that has a polygon, with its legs, in the order of the reflector.

    The scale is taken from each facet's own area, so that perspective and the lens need not be known.
    """
    image_to_telescope = instrument.reflector_camera.orientation.image_to_telescope
    located = []
    for facet in instrument.reflector.facets:
        if facet.id not in polygons_px:
            continue
        outline_px = polygons_px[facet.id]
        centre_px = polygon_centre(outline_px)
        area_px2 = polygon_area(outline_px)
        px_per_m = np.sqrt(area_px2 / facet_area_m2(facet))
        legs_px = centre_px + px_per_m * instrument.mounts[facet.id].legs_m @ image_to_telescope
        width_px = float(np.sqrt(area_px2 * 2.0 / np.sqrt(3.0)))
        located.append(FacetInPicture(facet.id, outline_px, centre_px, legs_px, width_px))
    return tuple(located)


def polygons_of_facet_list(instrument: Instrument, n_columns: int, n_rows: int) -> dict[int, Array]:
    """Outlines of all facets, pixel, for a picture of that size when no map of the facets has been made.

    Seen from far above the focal point (no perspective), as the reflector camera is turned, filling the picture.
    """
    image_to_telescope = instrument.reflector_camera.orientation.image_to_telescope
    outlines = {i: outline_m @ image_to_telescope for i, outline_m in outlines_m(instrument.reflector).items()}
    corners = np.concatenate(list(outlines.values()))
    lowest, highest = corners.min(axis=0), corners.max(axis=0)
    free_px = 2.0 * _FREE_MARGIN_SHARE * min(n_columns, n_rows)
    px_per_m = float(np.min((np.array([n_columns, n_rows]) - free_px) / (highest - lowest)))
    middle_px = 0.5 * (np.array([n_columns, n_rows]) - 1.0)
    return {
        facet_id: middle_px + px_per_m * (outline - 0.5 * (lowest + highest)) for facet_id, outline in outlines.items()
    }


@dataclass(slots=True)
class FreeRoom:
    """Room for text inside one outline: what is taken stays taken.

    Attributes
    ----------
    taken_px
        Boxes already in use, each (left, top, right, bottom).
    lines_px
        Points along lines that text must not cover, shape (n_points, 2).
    """

    outline_px: Array
    lines_px: Array
    taken_px: list[Array]

    def place(self, size_px: Array, wish_px: Array, avoid_px: Sequence[Array] = (), n_steps: int = 29) -> Array | None:
        """Centre of the free box of that size (width, height) nearest to `wish_px`, and take it; None if none is free.

        The box is nearer to `wish_px` than to any of `avoid_px`, so that a text cannot be read as another's.
        """
        lowest, highest = self.outline_px.min(axis=0), self.outline_px.max(axis=0)
        grid = np.stack(
            np.meshgrid(np.linspace(lowest[0], highest[0], n_steps), np.linspace(lowest[1], highest[1], n_steps)), -1
        ).reshape(-1, 2)
        distance_px = np.linalg.norm(grid - wish_px, axis=1)
        for other_px in avoid_px:
            is_nearer = distance_px < np.linalg.norm(grid - other_px, axis=1)
            grid, distance_px = grid[is_nearer], distance_px[is_nearer]
        boxes = np.concatenate([grid - 0.5 * size_px, grid + 0.5 * size_px], axis=1)
        free = np.flatnonzero(self._are_free(boxes))
        if len(free) == 0:
            return None
        best = free[np.argmin(distance_px[free])]
        self.taken_px.append(boxes[best])
        return np.asarray(grid[best])

    def _are_free(self, boxes: Array) -> NDArray[np.bool_]:
        left, top, right, bottom = boxes.T[:, :, np.newaxis]
        taken = np.array(self.taken_px).reshape(-1, 4).T
        hits_text = (left < taken[2]) & (taken[0] < right) & (top < taken[3]) & (taken[1] < bottom)
        x, y = self.lines_px.T
        hits_line = (x > left) & (x < right) & (y > top) & (y < bottom)
        corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2)
        is_inside = Outline(self.outline_px).contains_points(corners).reshape(-1, 4).all(axis=1)
        is_free: NDArray[np.bool_] = is_inside & ~hits_text.any(axis=1) & ~hits_line.any(axis=1)
        return is_free

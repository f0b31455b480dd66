"""Facet photometry: the mean intensity of every facet's polygon in a frame of the reflector camera.

A pixel belongs to a polygon when its centre lies inside. Which samples of a frame (a sample is one channel of one
pixel) belong to which facet is worked out once; a frame then costs one gathering, one table and one sum per facet.
Most samples of a facet fill whole blocks of 32 bytes and are gathered as such, in half the time of gathering each by
itself (`benchmarks/bench_imaging.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.radiometry import (
    N_COLOURS,
    Array,
    Frame,
    checked_frame,
    exposure_factor,
    response_table,
    saturation_adu,
)
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.polygons import crossing_sides

MAX_GROUP_PIXELS = 20_000
"""Pixels, of three colours, whose table entries fill half a megabyte."""

BLOCK_BYTES = 32
"""numpy copies items of 32 bytes in one step, and none larger."""


@dataclass(frozen=True, slots=True, eq=False)
class FacetLight:
    """What a frame of the reflector camera says about every facet.

    Attributes
    ----------
    intensity
        Shape (n_facets,). Mean relative intensity of the facet's pixels; 0 for a dark facet.
    saturated_share
        Shape (n_facets,). Share of the facet's pixels with a saturated channel, 0 to 1.
    """

    intensity: Array
    saturated_share: Array


class FacetPhotometer:
    """The polygons of a reflector as pixels of its camera, ready to measure one frame after another.

    Attributes
    ----------
    facet_ids
        Ids in the order of all results.
    n_pixels
        Shape (n_facets,), int: pixels per facet.

    Raises
    ------
    ConfigError
        When a facet has no polygon, or one that has no area, crosses itself or leaves the image.
    """

    def __init__(self, polygons_px: Mapping[int, Array], facet_ids: Sequence[int], n_columns: int, n_rows: int) -> None:
        if not facet_ids:
            raise ConfigError("no facets to measure: give the polygon of at least one facet")
        missing = [facet_id for facet_id in facet_ids if facet_id not in polygons_px]
        if missing:
            raise ConfigError(
                f"facets {missing} have no polygon in the reflector image: give one to each, or leave these facets out"
            )
        pixels = [pixels_of_polygon(polygons_px[i], n_columns, n_rows, f"facet {i}") for i in facet_ids]
        self.facet_ids = tuple(facet_ids)
        self.n_pixels = np.array([of_facet.size for of_facet in pixels])
        self._pixels = np.concatenate(pixels)
        self._starts = np.concatenate([[0], np.cumsum(self.n_pixels)[:-1]])
        # Facets that are gathered together: what they hold stays in the processor's cache.
        group = np.cumsum(self.n_pixels) // MAX_GROUP_PIXELS
        self._groups = np.split(np.arange(len(facet_ids)), np.flatnonzero(np.diff(group)) + 1)
        self._plans: dict[tuple[int, int], list[tuple[_Gathering, _Gathering]]] = {}

    def _plan(self, n_channels: int, block: int) -> list[tuple[_Gathering, _Gathering]]:
        """How to gather the samples of every group of facets: those in whole blocks, and the others."""
        if (n_channels, block) not in self._plans:
            samples = [
                (pixels[:, None] * n_channels + np.arange(n_channels)).ravel()
                for pixels in np.split(self._pixels, self._starts[1:])
            ]
            self._plans[n_channels, block] = [_planned([samples[i] for i in group], block) for group in self._groups]
        return self._plans[n_channels, block]

    def measure(self, frame: Frame, camera: CameraModel, exposure_s: float, rest_adu: float = 0.0) -> FacetLight:
        """The facets' light in a frame, shape (rows, columns) or (rows, columns, 3), of the reflector camera.

        Parameters
        ----------
        rest_adu
            What the frame still shows without light (`dark.dark_rest_adu`).

        Raises
        ------
        ConfigError
            When the frame is not of this camera, or the exposure is no positive number.
        """
        frame = checked_frame(frame, camera)
        factor = exposure_factor(camera.law, exposure_s)
        n_channels = 1 if frame.ndim == 2 else N_COLOURS
        table = response_table(camera, frame.dtype, rest_adu)
        samples = frame.reshape(-1)
        block = BLOCK_BYTES // frame.dtype.itemsize
        blocks = samples[: samples.size // block * block].view(f"V{BLOCK_BYTES}")
        totals = []
        brightest = 0
        for whole, single in self._plan(n_channels, block):
            total = np.zeros(whole.counts.size)
            for response, counts in (
                (blocks.take(whole.indices).view(frame.dtype), whole.counts),
                (samples.take(single.indices), single.counts),
            ):
                brightest = max(brightest, int(response.max(initial=0)))
                total += _sums(_looked_up(table, response), counts)
            totals.append(total)
        saturated_share = np.zeros(self.n_pixels.size)
        # Most frames have no saturated pixel at all, and one maximum is enough to know.
        if brightest >= saturation_adu(camera):
            is_saturated = np.any(frame.reshape(-1, n_channels)[self._pixels] >= saturation_adu(camera), axis=1)
            saturated_share = np.add.reduceat(is_saturated, self._starts, dtype=np.int64) / self.n_pixels
        return FacetLight(np.concatenate(totals) / (self.n_pixels * n_channels) * factor, saturated_share)


@dataclass(frozen=True, slots=True, eq=False)
class _Gathering:
    """Where the samples of a group of facets lie, sorted by facet, and how many samples each facet has of them."""

    indices: NDArray[np.intp]
    counts: NDArray[np.intp]


def _planned(samples: Sequence[NDArray[np.intp]], block: int) -> tuple[_Gathering, _Gathering]:
    """The blocks (of so many samples) that lie wholly in one of the facets, and their samples outside such blocks."""
    whole, single = [], []
    for of_facet in samples:
        numbers, counts = np.unique(of_facet // block, return_counts=True)
        full = numbers[counts == block]
        whole.append(full)
        single.append(of_facet[~np.isin(of_facet // block, full)])
    return (
        _Gathering(np.concatenate(whole), np.array([full.size * block for full in whole])),
        _Gathering(np.concatenate(single), np.array([rest.size for rest in single])),
    )


def _looked_up(table: Array, response: Frame) -> Array:
    """The table's entries; OpenCV's look-up is twice as fast, and knows 8 bit only."""
    if response.dtype == np.uint8 and response.size:
        return np.asarray(cv2.LUT(response[None, :], table)[0], dtype=np.float64)
    return table.take(response)


def _sums(values: Array, counts: NDArray[np.intp]) -> Array:
    """Sums of consecutive values, `counts` of them each; 0 of none."""
    sums = np.zeros(counts.size)
    is_any = counts > 0
    if is_any.any():
        sums[is_any] = np.add.reduceat(values, (np.cumsum(counts) - counts)[is_any])
    return sums


def pixels_of_polygon(polygon_px: Array, n_columns: int, n_rows: int, name: str) -> NDArray[np.intp]:
    """Indices into the raveled image, ascending, of the pixels whose centres lie inside the polygon.

    Parameters
    ----------
    polygon_px
        Shape (n_corners, 2), (x, y). Any simple polygon, convex or not, in either sense; a last corner that repeats
        the first one is allowed. A pixel centre on the outline belongs to the side with larger x or y.
    name
        What the polygon is, for messages.

    Raises
    ------
    ConfigError
        When it has fewer than 3 corners, corners outside the image (its outermost half pixels included), crosses or
        touches itself, or holds no pixel centre.
    """
    corners = np.asarray(polygon_px, dtype=np.float64)
    if corners.ndim == 2 and corners.shape[0] > 1 and np.array_equal(corners[0], corners[-1]):
        corners = corners[:-1]
    if corners.ndim != 2 or corners.shape[1:] != (2,) or corners.shape[0] < 3:
        raise ConfigError(f"{name}: a polygon of shape {corners.shape}; it needs 3 or more corners (x, y)")
    is_outside = ~np.all((corners >= -0.5) & (corners <= np.array([n_columns, n_rows]) - 0.5), axis=1)
    if is_outside.any():
        x, y = corners[int(np.argmax(is_outside))]
        raise ConfigError(
            f"{name}: the corner x = {x:g}, y = {y:g} of its polygon lies outside the image of "
            f"{n_columns} x {n_rows} pixel: correct the polygon or the size of the image"
        )
    crossing = crossing_sides(corners)
    if crossing is not None:
        raise ConfigError(
            f"{name}: its polygon crosses or touches itself (sides {crossing[0] + 1} and {crossing[1] + 1}): "
            "list its corners in their order around the facet, each once"
        )
    left, top = np.ceil(corners.min(axis=0)).astype(int)
    right, bottom = np.floor(corners.max(axis=0)).astype(int)
    x, y = np.arange(left, right + 1)[None, :], np.arange(top, bottom + 1)[:, None]
    is_inside = np.zeros((y.size, x.size), dtype=bool)
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y1 == y2:
            continue
        is_beside = (y < y1) != (y < y2)
        is_inside ^= is_beside & (x < x1 + (y - y1) * ((x2 - x1) / (y2 - y1)))
    rows, columns = np.nonzero(is_inside)
    if rows.size == 0:
        raise ConfigError(f"{name}: its polygon holds no pixel at all: draw it larger, or leave this facet out")
    pixels: NDArray[np.intp] = (rows + top) * n_columns + columns + left
    return pixels

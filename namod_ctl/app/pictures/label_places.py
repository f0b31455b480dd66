"""Where labels of crowded points find room."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_N_DIRECTIONS = 16
_N_RINGS = 10


@dataclass(slots=True)
class LabelPlaces:
    """Free places for labels; a place that was given stays taken.

    Attributes
    ----------
    frame_px
        (left, bottom, right, top) that labels must stay inside.
    marks_px
        Shape (n, 2). Points that labels must not cover.
    mark_radius_px
        Half the size of a mark.
    """

    frame_px: Array
    marks_px: Array
    mark_radius_px: float
    taken_px: list[Array] = field(default_factory=list)

    def place(self, size_px: Array, mark_px: Array) -> Array | None:
        """Centre of the free box of that size (width, height) near the mark, and take it; None if there is none."""
        angles_rad = 2.0 * np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS
        directions = np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])
        half = 0.5 * size_px
        for ring in range(1, _N_RINGS + 1):
            for direction in directions:
                centre = mark_px + direction * (half + self.mark_radius_px) * (1.0 + 0.5 * (ring - 1))
                box = np.concatenate([centre - half, centre + half])
                if self._is_free(box):
                    self.taken_px.append(box)
                    return np.asarray(centre)
        return None

    def _is_free(self, box: Array) -> bool:
        frame = self.frame_px
        if box[0] < frame[0] or box[1] < frame[1] or box[2] > frame[2] or box[3] > frame[3]:
            return False
        grown = box + 0.8 * self.mark_radius_px * np.array([-1.0, -1.0, 1.0, 1.0])
        x, y = self.marks_px.T
        if np.any((x > grown[0]) & (x < grown[2]) & (y > grown[1]) & (y < grown[3])):
            return False
        return not any(
            box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]
            for other in self.taken_px
        )

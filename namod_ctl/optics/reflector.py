"""The reflector: its facets as they are when perfectly aligned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class FacetShape(StrEnum):
    """Outline of a facet."""

    HEXAGON = "hexagon"
    SQUARE = "square"
    ROUND = "round"


@dataclass(frozen=True, slots=True, eq=False)
class Facet:
    """One mirror tile, a section of a sphere.

    Attributes
    ----------
    id
        Number of the facet, unique in its reflector.
    position_m
        Shape (3,). Centre of the mirror surface, telescope frame.
    focal_length_m
        Half the radius of curvature of the sphere.
    shape
        Outline, in the plane perpendicular to the facet's normal.
    width_m
        Flat to flat of a hexagon or square, diameter of a round facet.
    rotation_rad
        Turn of the outline about the normal: at 0 a hexagon has a corner at telescope +y (its flats face +-x)
        and a square has its flats along x and y.
    """

    id: int
    position_m: Array
    focal_length_m: float
    shape: FacetShape
    width_m: float
    rotation_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Reflector:
    """All facets of a telescope, in a fixed order, and where they must throw the light of an on-axis star.

    Attributes
    ----------
    focal_length_m
        The focal plane is at z = focal_length_m; aligned facets throw axis-parallel light on (0, 0, focal_length_m).
    """

    focal_length_m: float
    facets: tuple[Facet, ...]

    @property
    def ids(self) -> tuple[int, ...]:
        """Facet ids in the order of every [.., facet] array."""
        return tuple(facet.id for facet in self.facets)

    @property
    def positions_m(self) -> Array:
        """Shape (n_facets, 3), telescope frame."""
        return np.array([facet.position_m for facet in self.facets])

    def aligned_normals(self) -> Array:
        """Unit normals, shape (n_facets, 3), telescope frame, that reflect axis-parallel light on the focal point."""
        to_focus = np.array([0.0, 0.0, self.focal_length_m]) - self.positions_m
        to_focus /= np.linalg.norm(to_focus, axis=1, keepdims=True)
        bisector = to_focus + np.array([0.0, 0.0, 1.0])
        normals: Array = bisector / np.linalg.norm(bisector, axis=1, keepdims=True)
        return normals

    def subset(self, ids: Sequence[int]) -> Reflector:
        """The reflector of the named facets only, in the order of `ids`. Raises KeyError for an unknown id."""
        by_id = {facet.id: facet for facet in self.facets}
        return Reflector(self.focal_length_m, tuple(by_id[facet_id] for facet_id in ids))

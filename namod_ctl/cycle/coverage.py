"""Where the star has stood: how evenly the recorded directions fill the region, and where it should stand next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_CELLS = 11
"""Along the diameter of the region: at FACT, cells of 0.064 deg, three times the size of a facet's image."""


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Records per cell of the region.

    Attributes
    ----------
    radius_rad
        Of the region, a circle around the telescope's axis.
    counts
        Shape (N_CELLS, N_CELLS), [row from -y to +y, column from -x to +x].
    """

    radius_rad: float
    counts: NDArray[np.int64]

    @property
    def centres_rad(self) -> Array:
        """Shape (N_CELLS,). Middles of the cells along either axis."""
        middles: Array = ((np.arange(N_CELLS) + 0.5) / N_CELLS * 2.0 - 1.0) * self.radius_rad
        return middles

    @property
    def is_inside(self) -> NDArray[np.bool_]:
        """Shape of `counts`: cells whose middle lies in the region."""
        x, y = np.meshgrid(self.centres_rad, self.centres_rad)
        inside: NDArray[np.bool_] = np.hypot(x, y) <= self.radius_rad
        return inside

    @property
    def share(self) -> float:
        """Share of the region's cells that have a record."""
        return float(np.mean(self.counts[self.is_inside] > 0))

    @property
    def has_hole(self) -> bool:
        """Are there two by two empty cells side by side in the region?

        Facets that throw their light there are hardly seen, however well the rest is covered; and once the facets have
        been aligned, all of them throw it into one place.
        """
        dark = self.is_inside & (self.counts == 0)
        return bool(np.any(dark[1:, 1:] & dark[1:, :-1] & dark[:-1, 1:] & dark[:-1, :-1]))


def empty_coverage(radius_rad: float) -> Coverage:
    """The coverage of a recording that has no records yet."""
    return Coverage(radius_rad, np.zeros((N_CELLS, N_CELLS), dtype=np.int64))


def cell_of(coverage: Coverage, theta_rad: Array) -> tuple[int, int] | None:
    """Row and column of the cell of a direction, shape (2,); None outside the square of cells."""
    cell = np.floor((theta_rad / coverage.radius_rad + 1.0) / 2.0 * N_CELLS)
    if not np.all((cell >= 0) & (cell < N_CELLS)):  # NaN is outside as well
        return None
    return int(cell[1]), int(cell[0])


def with_record(coverage: Coverage, theta_rad: Array) -> Coverage:
    """The coverage with one record more, at that direction, shape (2,)."""
    cell = cell_of(coverage, theta_rad)
    if cell is None:
        return coverage
    counts = coverage.counts.copy()
    counts[cell] += 1
    return Coverage(coverage.radius_rad, counts)


def where_next(coverage: Coverage, theta_rad: Array) -> Array:
    """Direction, shape (2,), of the emptiest cell of the region; of several, the nearest to `theta_rad`.

    `theta_rad` with NaN (no star at the moment) counts as the middle of the region.
    """
    here = np.where(np.isfinite(theta_rad), theta_rad, 0.0)
    x, y = np.meshgrid(coverage.centres_rad, coverage.centres_rad)
    emptiest = coverage.is_inside & (coverage.counts == coverage.counts[coverage.is_inside].min())
    distance = np.where(emptiest, np.hypot(x - here[0], y - here[1]), np.inf)
    row, column = np.unravel_index(int(distance.argmin()), distance.shape)
    return np.array([x[row, column], y[row, column]])

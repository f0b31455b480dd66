"""Runs of one mirror at several zenith distances, seen relative to the mean of all facets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.gravity.sag_fit import Fit, basis_of_zenith, fit_facets, with_column, without_wander
from namod_ctl.calibration.gravity.zenith_path import ZenithPath

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NO_WANDER = 1e-12  # rounding


@dataclass(frozen=True, slots=True, eq=False)
class RelativeRuns:
    """What the runs say about the facets, the light-weighted mean of all taken off.

    Attributes
    ----------
    seen
        For each run, shape (n_facets, n_moments): in which shares each facet was seen at the moments of the run's path.
    share
        Shape (n_facets,). Of each facet in the mean; they add up to 1.
    relative_rad, weight
        Shapes (n_runs, n_facets, 2) and (n_runs, n_facets, 2, 2), as in `sag_fit.fit_facets`.
    is_even
        Shape (n_facets,). Facets that have a say in what is common to all.
    """

    names: Sequence[str]
    paths: Sequence[ZenithPath]
    seen: Sequence[Array]
    share: Array
    relative_rad: Array
    weight: Array
    is_even: Mask

    def basis(self, terms: tuple[str, ...], play_rad: float = 0.0) -> Array:
        """Constant and terms of every facet in every run, shape (n_runs, n_facets, 1 + n_terms)."""
        felt = (path.with_play(play_rad) for path in self.paths)
        return np.array([seen @ basis_of_zenith(zenith, terms) for zenith, seen in zip(felt, self.seen, strict=True)])

    def settled(
        self, terms: tuple[str, ...], play_rad: float = 0.0, of_run: Array | None = None
    ) -> tuple[Array, Array]:
        """Terms, with a further one `of_run` (n_runs,) if given, and directions freed from the image's wandering."""
        basis = self.basis(terms, play_rad)
        if of_run is not None:
            basis = with_column(basis, of_run)
        sine = self.basis(("sin",), play_rad)[..., 1]
        wander = sine - (sine @ self.share)[:, None]
        wander[np.abs(wander) < _NO_WANDER] = 0.0
        of_even = np.where(self.is_even[:, None, None], self.weight, 0.0)
        return basis, without_wander(basis, wander, self.relative_rad, of_even)

    def fit(self, terms: tuple[str, ...], play_rad: float = 0.0, of_run: Array | None = None) -> Fit:
        """Every facet's terms."""
        return fit_facets(*self.settled(terms, play_rad, of_run), self.weight)

    def sides(self) -> Array:
        """From where the telescope came, shape (n_runs,); see `ZenithPath.side`."""
        return np.array([path.side() for path in self.paths])

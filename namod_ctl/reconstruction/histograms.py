"""Two-dimensional histograms of responses over star directions: H_raw, H_exposure and H_psf.

Source: arXiv:1605.06274, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ResponseHistograms:
    """Histograms on one grid for all facets.

    Attributes
    ----------
    x_edges_rad, y_edges_rad
        Edges of the bins of theta_x (columns) and theta_y (rows, ascending).
    exposure
        Shape (n_rows, n_columns). Number of records per bin, H_exposure.
    raw
        Shape (n_facets, n_rows, n_columns). Sum of R_ij per bin, H_raw.
    """

    x_edges_rad: Array
    y_edges_rad: Array
    exposure: Array
    raw: Array

    @property
    def psf(self) -> Array:
        """H_psf = H_raw / H_exposure, shape of `raw`; NaN where no record fell."""
        with np.errstate(invalid="ignore", divide="ignore"):
            psf: Array = self.raw / self.exposure
        return psf

    @property
    def x_centres_rad(self) -> Array:
        """Centres of the bins of theta_x."""
        return 0.5 * (self.x_edges_rad[1:] + self.x_edges_rad[:-1])

    @property
    def y_centres_rad(self) -> Array:
        """Centres of the bins of theta_y."""
        return 0.5 * (self.y_edges_rad[1:] + self.y_edges_rad[:-1])


def histogram_responses(table: ResponseTable, bin_size_rad: float) -> ResponseHistograms:
    """Histograms of all facets on one square grid that covers every record and has a bin edge at (0, 0).

    A response that was not measured (NaN) counts as zero.
    """
    lowest = np.floor(table.theta_rad.min(axis=0) / bin_size_rad).astype(np.int64)
    n_columns, n_rows = np.floor(table.theta_rad.max(axis=0) / bin_size_rad).astype(np.int64) - lowest + 1
    ix, iy = (np.floor(table.theta_rad / bin_size_rad).astype(np.int64) - lowest).T
    flat = iy * n_columns + ix
    n_bins = int(n_rows * n_columns)
    response = np.nan_to_num(table.response)
    raw: Array = np.array([np.bincount(flat, weights=column, minlength=n_bins) for column in response.T])
    return ResponseHistograms(
        bin_size_rad * np.arange(lowest[0], lowest[0] + n_columns + 1),
        bin_size_rad * np.arange(lowest[1], lowest[1] + n_rows + 1),
        np.bincount(flat, minlength=n_bins).reshape(n_rows, n_columns).astype(np.float64),
        raw.reshape(-1, n_rows, n_columns),
    )

"""What facets show that does not come from the star, and how it changes during a run.

An unlit facet mirrors the scene around the telescope. Divided by a star that fades behind a cloud, the scene seems to
grow; and moonlight, twilight and a dewed lens change it slowly. A facet's own light says when it was unlit: the scene
between is what it showed then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from namod_ctl.reconstruction.facet_fit import FacetFit
from namod_ctl.reconstruction.facet_psf import CENTRE, covariance_of_light
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

VARIED = 1.2
"""Ratio of the brightest to the faintest star from which on the scene matters."""

_UNLIT_WIDTHS = 5.0  # from its centre; the tails of a facet's light end before
_WINDOW = 31  # unlit records over which the scene is the median: minutes, and a quarter of one record's noise


def without_scene(table: ResponseTable, fits: Sequence[FacetFit | None]) -> ResponseTable:
    """The table without what its unlit facets show; as it is where the star's brightness did not vary.

    `fits` in the order of the table's facets; a facet without a fit is taken to be unlit in all records. The scene of a
    facet is the running median over its unlit records in their order, interpolated to the others.
    """
    if not len(table.faintness) or np.ptp(np.log(table.faintness)) < np.log(VARIED):
        return table
    order = np.arange(table.n_records)
    response = table.response.copy()
    for j, fit in enumerate(fits):
        shown = response[:, j] / table.faintness  # as beside a star of typical brightness
        unlit = np.flatnonzero(np.isfinite(shown) & _is_unlit(fit, table.theta_rad))
        if len(unlit):
            level = median_filter(shown[unlit], size=min(_WINDOW, len(unlit)), mode="nearest")
            response[:, j] -= np.interp(order, unlit, level) * table.faintness
    return replace(table, response=response)


def _is_unlit(fit: FacetFit | None, theta_rad: Array) -> NDArray[np.bool_]:
    if fit is None:
        return np.ones(len(theta_rad), dtype=np.bool_)
    away = theta_rad - fit.parameters[CENTRE]
    square = np.einsum("ij,ij->i", away @ np.linalg.inv(covariance_of_light(fit.parameters)), away)
    unlit: NDArray[np.bool_] = square > _UNLIT_WIDTHS**2
    return unlit

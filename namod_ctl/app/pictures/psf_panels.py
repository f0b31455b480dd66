"""The pictures of the whole reflector's light: as fitted now, and as predicted after the correction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.pictures.figures import PsfPanel
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.optics.coordinates import theta_of_hit
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.raytrace import trace
from namod_ctl.reconstruction.facet_fit import FacetFit
from namod_ctl.reconstruction.facet_psf import evaluate
from namod_ctl.reconstruction.psf import area_of_covariance, light_of_fits
from namod_ctl.reconstruction.reconstruct import Reconstruction

Array = NDArray[np.float64]

_N_BINS = 161
_RAYS_PER_FACET = 4000


def psf_panels(result: Reconstruction, instrument: Instrument) -> tuple[PsfPanel, PsfPanel]:
    """Light of all facets now (robust fits) and after the correction (ray tracing), on one grid."""
    grid = _grid([result])
    return _measured_panel(result, grid, "now"), _predicted_panel(result, instrument, grid)


def measured_panels(results: Sequence[Reconstruction], titles: Sequence[str]) -> list[PsfPanel]:
    """Light of all facets as it was measured, one panel per reconstruction, on one grid."""
    grid = _grid(results)
    return [_measured_panel(result, grid, title) for result, title in zip(results, titles, strict=True)]


def _grid(results: Sequence[Reconstruction]) -> Array:
    """Offsets from the axis, rad, that show all light of all results."""
    reach = arcmin_to_rad(6.0)
    for result in results:
        centre, cov = light_of_fits(_seen(result)).combined()
        off_axis = np.abs(centre - result.alignment.axis_rad).max()
        reach = float(max(reach, 4.0 * np.sqrt(np.linalg.eigvalsh(cov)[-1]), 1.5 * off_axis))
    return np.linspace(-reach, reach, _N_BINS)


def _seen(result: Reconstruction) -> list[FacetFit]:
    """Fits of the facets that have an estimate."""
    flagged_out = {facet.facet_id for facet in result.alignment.facets if not np.isfinite(facet.theta_rad).all()}
    return [
        fit
        for facet_id, fit in zip(result.table.facet_ids, result.fits, strict=True)
        if fit is not None and facet_id not in flagged_out
    ]


def _measured_panel(result: Reconstruction, grid: Array, title: str) -> PsfPanel:
    seen, axis = _seen(result), result.alignment.axis_rad
    centre, cov = light_of_fits(seen).combined()
    x, y = np.meshgrid(axis[0] + grid, axis[1] + grid)
    directions = np.stack([x.ravel(), y.ravel()], axis=1)
    now = np.zeros(x.shape)
    for fit in seen:
        light, _ = evaluate(fit.parameters, directions)
        now += fit.scale * np.maximum(light.reshape(x.shape), 0.0)
    return PsfPanel(title, axis[0] + grid, axis[1] + grid, now, centre, cov, result.alignment.now)


def _predicted_panel(result: Reconstruction, instrument: Instrument, grid: Array) -> PsfPanel:
    """Ray-traced light of the facets, each off the axis by one draw of what the correction leaves."""
    alignment = result.alignment
    rng = np.random.default_rng(0)
    reflector = instrument.reflector.subset(result.table.facet_ids)
    rays = trace(reflector, _RAYS_PER_FACET)
    theta = theta_of_hit(rays.hit_m, reflector.focal_length_m, np.zeros(2))
    weight = rays.light_m2.copy()
    for j, facet in enumerate(alignment.facets):
        if not np.isfinite(facet.theta_rad).all():
            weight[j] = 0.0
        elif not np.isfinite(facet.leg_travel_m).all():
            theta[j] += facet.theta_rad - alignment.axis_rad
        elif np.isfinite(facet.theta_cov_rad2).all():
            theta[j] += rng.multivariate_normal(np.zeros(2), facet.theta_cov_rad2)
    step = grid[1] - grid[0]
    edges = np.append(grid - 0.5 * step, grid[-1] + 0.5 * step)
    flat, light = theta.reshape(-1, 2), weight.ravel()
    picture, _, _ = np.histogram2d(flat[:, 1], flat[:, 0], bins=(edges, edges), weights=light)
    centre = np.average(flat, axis=0, weights=light)
    offset = flat - centre
    cov = (offset.T * light) @ offset / light.sum()
    # the ellipse is drawn as large as the area that is quoted, in the shape of the traced light
    cov *= alignment.predicted.a_sigma_rad2 / area_of_covariance(cov)
    axis = alignment.axis_rad
    return PsfPanel(
        "predicted after the correction",
        axis[0] + grid,
        axis[1] + grid,
        picture,
        axis + centre,
        cov,
        alignment.predicted,
    )

"""The pictures of the whole reflector's light: as fitted now, and as predicted after the correction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.figures import PsfPanel
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.optics.coordinates import theta_of_hit
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.raytrace import trace
from namod_ctl.reconstruction.facet_psf import evaluate
from namod_ctl.reconstruction.psf import area_of_covariance, light_of_fits
from namod_ctl.reconstruction.reconstruct import Reconstruction

Array = NDArray[np.float64]

_N_BINS = 161
_RAYS_PER_FACET = 4000


def psf_panels(result: Reconstruction, instrument: Instrument) -> tuple[PsfPanel, PsfPanel]:
    """Light of all facets now (robust fits) and after the correction (ray tracing), on one grid."""
    flagged_out = {facet.facet_id for facet in result.alignment.facets if not np.isfinite(facet.theta_rad).all()}
    seen = [
        fit
        for facet_id, fit in zip(result.table.facet_ids, result.fits, strict=True)
        if fit is not None and facet_id not in flagged_out
    ]
    axis = result.alignment.axis_rad
    centre, cov = light_of_fits(seen).combined()
    reach = float(
        max(4.0 * np.sqrt(np.linalg.eigvalsh(cov)[-1]), np.abs(centre - axis).max() * 1.5, arcmin_to_rad(6.0))
    )
    grid = np.linspace(-reach, reach, _N_BINS)
    x, y = np.meshgrid(axis[0] + grid, axis[1] + grid)
    directions = np.stack([x.ravel(), y.ravel()], axis=1)
    now = np.zeros(x.shape)
    for fit in seen:
        light, _ = evaluate(fit.parameters, directions)
        now += fit.scale * np.maximum(light.reshape(x.shape), 0.0)
    now_panel = PsfPanel("now", axis[0] + grid, axis[1] + grid, now, centre, cov, result.alignment.now)
    return now_panel, _predicted_panel(result, instrument, grid)


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

"""The point spread function of the whole reflector: its area now, and the area it will have after the correction.

The area now is that of the facets' fitted light together: every facet contributes its flux, centre and covariance,
so the number rests neither on a histogram's bins nor on how evenly the sky was sampled. The area of the plain
sum of H_psf is kept beside it for comparison.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.reconstruction.facet_fit import FacetFit
from namod_ctl.reconstruction.facet_psf import (
    CENTRE,
    ELONGATION_1,
    ELONGATION_2,
    LOG_FLUX,
    LOG_SIZE,
    covariance_of_light,
    covariances_of,
)
from namod_ctl.reconstruction.histograms import histogram_responses
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

_N_DRAWS = 400  # the uncertainty of an area is then known to 4 %
_MAX_LOG_STEP = 0.7  # draws of flux and size beyond a factor 2 are the gaussian's tail, not knowledge


@dataclass(frozen=True, slots=True, eq=False)
class LightOfFacets:
    """Moments of every facet's light: flux (n,), centre_rad (n, 2), cov_rad2 (n, 2, 2)."""

    flux: Array
    centre_rad: Array
    cov_rad2: Array

    def combined(self) -> tuple[Array, Array]:
        """Centre (2,) and covariance (2, 2) of all light together, rad and rad^2."""
        share = self.flux / self.flux.sum()
        centre = share @ self.centre_rad
        offset = self.centre_rad - centre
        spread = np.einsum("j,ja,jb->ab", share, offset, offset)
        return centre, np.einsum("j,jab->ab", share, self.cov_rad2) + spread


def area_of_covariance(cov_rad2: Array) -> float:
    """A_sigma = pi sqrt(det cov), rad^2 (arXiv:1605.06274, section 4)."""
    return math.pi * math.sqrt(max(float(np.linalg.det(cov_rad2)), 0.0))


def light_of_fits(fits: Sequence[FacetFit]) -> LightOfFacets:
    """Moments of the fitted light, flux in units of normalized response times rad^2."""
    return LightOfFacets(
        np.array([fit.scale * math.exp(fit.parameters[LOG_FLUX]) for fit in fits]),
        np.array([fit.parameters[CENTRE] for fit in fits]),
        np.array([covariance_of_light(fit.parameters) for fit in fits]),
    )


def area_now(fits: Sequence[FacetFit], variance_factors: Array, seed: int = 0) -> AreaOfPsf:
    """Area of the light of all facets with the uncertainty that follows from those of the fits.

    `variance_factors` (n_facets,) multiply the covariances of the fits. Facets that lie outside of the recorded
    directions should be left out by the caller: nobody saw their light.
    """
    rng = np.random.default_rng(seed)
    basic = [LOG_FLUX, *range(CENTRE.start, CENTRE.stop), LOG_SIZE, ELONGATION_1, ELONGATION_2]
    flux, centre, cov = [], [], []
    for fit, factor in zip(fits, variance_factors, strict=True):
        step = rng.multivariate_normal(
            np.zeros(len(basic)), factor * fit.covariance[np.ix_(basic, basic)], _N_DRAWS, method="eigh"
        )
        step[:, [0, 3, 4, 5]] = np.clip(step[:, [0, 3, 4, 5]], -_MAX_LOG_STEP, _MAX_LOG_STEP)
        drawn = fit.parameters[basic] + step
        flux.append(fit.scale * np.exp(drawn[:, 0]))
        centre.append(drawn[:, 1:3])
        cov.append(covariances_of(drawn[:, 3], drawn[:, 4], drawn[:, 5]))
    draws = zip(*(np.stack(values, axis=1) for values in (flux, centre, cov)), strict=True)
    areas = [area_of_covariance(LightOfFacets(*draw).combined()[1]) for draw in draws]
    best = area_of_covariance(light_of_fits(fits).combined()[1])
    return AreaOfPsf(best, float(np.std(areas)))


def area_of_histograms(table: ResponseTable, bin_size_rad: float, background: Array | None = None) -> float:
    """A_sigma of the sum of H_psf over all facets, rad^2, as the paper's program takes it.

    `background` (n_facets,) is taken off every bin first, negative remainders count as zero.
    """
    histograms = histogram_responses(table, bin_size_rad)
    visited = histograms.exposure > 0
    psf = histograms.psf[:, visited]
    if background is not None:
        psf = np.maximum(psf - background[:, None], 0.0)
    x, y = np.meshgrid(histograms.x_centres_rad, histograms.y_centres_rad)
    theta, light = np.stack([x[visited], y[visited]], axis=1), psf.sum(axis=0)
    if light.sum() <= 0.0:
        return math.nan
    offset = theta - np.average(theta, axis=0, weights=light)
    return area_of_covariance((offset.T * light) @ offset / light.sum())


def area_predicted(
    flux: Array, perfect_cov_rad2: Array, residual_rad: Array, residual_cov_rad2: Array, seed: int = 0
) -> AreaOfPsf:
    """Area after the correction: perfect facets that miss the axis by what is left over.

    Parameters
    ----------
    flux
        Shape (n_facets,). Light of each facet.
    perfect_cov_rad2
        Shape (n_facets, 2, 2). Covariance of each facet's ray-traced light when it is aligned.
    residual_rad
        Shape (n_facets, 2). Known remainder: zero where the correction is carried out, the whole misalignment where it
        is not.
    residual_cov_rad2
        Shape (n_facets, 2, 2). Uncertainty of the remainder: of the estimate, and of the turning.
    """
    rng = np.random.default_rng(seed)
    roots = np.linalg.cholesky(residual_cov_rad2 + 1e-24 * np.eye(2))
    draws = residual_rad + np.einsum("jab,kjb->kja", roots, rng.standard_normal((_N_DRAWS, *residual_rad.shape)))
    areas = [area_of_covariance(LightOfFacets(flux, centre, perfect_cov_rad2).combined()[1]) for centre in draws]
    return AreaOfPsf(float(np.mean(areas)), float(np.std(areas)))

"""How widely the facets' tilts scatter, and how that grows when the telescope leans over.

The simulations draw every facet's misalignment at random. What they ask for is the standard deviation over the facets,
per axis, and its law of the zenith distance z:

    sigma^2(z) = constant^2 + cosine^2 (cos z - cos z0)^2 + sine^2 (sin z - sin z0)^2

Source: sim_telarray's parameters `mirror_align_random_horizontal` and `..._vertical`: constant and z0 in deg, both
other terms in deg too, as factors, and added in squares (obdeect 0.3 `docs/PHYSICS.md`, which follows `sim_config.c`;
the descriptions in gammasimtools 0.38 write the factors as divisors, which their defaults of 0 and 0.023 contradict).

The sag of every facet is fitted first, over all runs: what a run's noise adds to one facet's tilt is then told from
what gravity does better than by comparing one scatter per run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar, nnls

from namod_ctl.calibration.gravity.gravity_table import zenith_grid_rad
from namod_ctl.calibration.gravity.sag_fit import basis_of_zenith
from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets, SagFit, fit_sag
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.coordinates import correction_of_theta

Array = NDArray[np.float64]

MIN_FACETS = 3
GRID_STEP_RAD = float(deg_to_rad(2.0))
Z0_STEP_RAD = float(deg_to_rad(3.0))


@dataclass(frozen=True, slots=True, eq=False)
class TiltSpread:
    """Variance of the facets' tilts about their mean, without the noise of their estimates.

    Attributes
    ----------
    variance_rad2, uncertainty_rad2
        Shape (2,), telescope x and y. May be negative where noise is all there is. The uncertainty is that of the
        estimates alone: it speaks of these very facets, not of all that could have been built.
    noise_rad
        Shape (2,). Standard deviation of the estimates' noise that was taken off in squares.
    """

    variance_rad2: Array
    uncertainty_rad2: Array
    noise_rad: Array
    n_facets: int

    @property
    def sigma_rad(self) -> Array:
        """Shape (2,). Standard deviation of the tilts; 0 where noise explains all of it."""
        sigma: Array = np.sqrt(np.maximum(self.variance_rad2, 0.0))
        return sigma

    @property
    def sigma_uncertainty_rad(self) -> Array:
        """Shape (2,). Standard error of `sigma_rad`, upwards: it is finite where that is 0."""
        upper: Array = np.sqrt(np.maximum(self.variance_rad2, 0.0) + self.uncertainty_rad2) - self.sigma_rad
        return upper

    @property
    def drawn_share(self) -> float:
        """Relative scatter of the standard deviation of as many tilts that a simulation draws anew."""
        return 1.0 / math.sqrt(2.0 * (self.n_facets - 1))


@dataclass(frozen=True, slots=True)
class ZenithLaw:
    """sigma(z) of one axis; see the module. Without cosine and sine z0 has no meaning and is 0."""

    constant_rad: float
    z0_rad: float
    cosine_rad: float
    sine_rad: float

    def sigma_rad(self, zenith_rad: Array) -> Array:
        """Standard deviation of the tilts at zenith distances of any shape."""
        squares = np.array([self.constant_rad, self.cosine_rad, self.sine_rad]) ** 2
        sigma: Array = np.sqrt(_terms(np.asarray(zenith_rad, dtype=np.float64), self.z0_rad) @ squares)
        return sigma


@dataclass(frozen=True, slots=True, eq=False)
class ScatterOverZenith:
    """What several runs say together.

    Attributes
    ----------
    laws
        Along telescope x and y.
    at_runs
        The scatter at the mean zenith distance of every run, by the facets' sag.
    left_out
        Shape (n_facets,). Facets without a part in it.
    """

    laws: tuple[ZenithLaw, ZenithLaw]
    at_runs: tuple[TiltSpread, ...]
    left_out: NDArray[np.bool_]
    remarks: tuple[str, ...]


def spread_of_tilts(tilt_rad: Array, tilt_variance_rad2: Array) -> TiltSpread:
    """Scatter of the facets' tilts about their common mean.

    Parameters
    ----------
    tilt_rad
        Shape (n_facets, 2). A tilt common to all facets moves the image only: it counts as pointing, not as scatter.
    tilt_variance_rad2
        Shape (n_facets, 2). Squared standard errors of the tilts.

    Raises
    ------
    DataQualityError
        Fewer than `MIN_FACETS` facets.
    """
    n_facets = len(tilt_rad)
    if n_facets < MIN_FACETS:
        raise DataQualityError(
            f"only {n_facets} facets with a reliable estimate: a scatter needs {MIN_FACETS} at least; record more"
        )
    offset2 = (tilt_rad - tilt_rad.mean(axis=0)) ** 2
    noise2 = tilt_variance_rad2
    variance = offset2.sum(axis=0) / (n_facets - 1) - noise2.mean(axis=0)
    # Of a sum of squares of noisy numbers, 4 true^2 noise^2 + 2 noise^4 each; what is seen is true^2 + noise^2.
    of_sum = np.maximum((4.0 * offset2 * noise2 - 2.0 * noise2**2).sum(axis=0), 2.0 * (noise2**2).sum(axis=0))
    return TiltSpread(variance, np.sqrt(of_sum) / (n_facets - 1), np.sqrt(noise2.mean(axis=0)), n_facets)


def spread_of_run(run: RunOfFacets) -> TiltSpread:
    """Scatter of the facets' tilts as one run found them. Raises DataQualityError for too few facets."""
    known = np.isfinite(run.theta_rad).all(axis=1) & np.isfinite(run.cov_rad2).all(axis=(1, 2))
    variance = np.diagonal(run.cov_rad2[known], axis1=1, axis2=2)
    return spread_of_tilts(-correction_of_theta(run.theta_rad[known]), _of_tilt(variance))


def scatter_over_zenith(runs: Sequence[RunOfFacets], light: Array) -> ScatterOverZenith:
    """Scatter of the facets' tilts over zenith distance, from three runs on; `light` as in `fit_sag`.

    Raises
    ------
    DataQualityError
        As `fit_sag`: too few runs, a small span, runs between which facets were turned, too few facets.
    """
    fit = fit_sag(runs, light)
    is_used = np.asarray(np.isfinite(fit.beta_rad).all(axis=(1, 2)))
    is_used[list(fit.odd)] = False
    means = np.array([run.path.mean_rad for run in runs])
    grid = zenith_grid_rad(float(means.min()), float(means.max()), GRID_STEP_RAD)
    spreads = [_spread_of_sag(fit, is_used, float(zenith)) for zenith in grid]
    variance = np.array([spread.variance_rad2 for spread in spreads])
    uncertainty = np.array([spread.uncertainty_rad2 for spread in spreads])
    law_x, law_y = (fit_zenith_law(grid, variance[:, axis], uncertainty[:, axis], fit.terms) for axis in (0, 1))
    at_runs = tuple(_spread_of_sag(fit, is_used, float(zenith)) for zenith in means)
    return ScatterOverZenith((law_x, law_y), at_runs, ~is_used, fit.remarks)


def _spread_of_sag(fit: SagFit, is_used: NDArray[np.bool_], zenith_rad: float) -> TiltSpread:
    basis = basis_of_zenith(np.array(zenith_rad), fit.terms)
    theta = np.einsum("p,npa->na", basis, fit.beta_rad[is_used])
    variance = np.einsum("p,npaqa,q->na", basis, fit.cov_rad2[is_used], basis)
    return spread_of_tilts(-correction_of_theta(theta), _of_tilt(variance))


def _of_tilt(variance_of_theta_rad2: Array) -> Array:
    variance: Array = variance_of_theta_rad2 * correction_of_theta(np.ones(1))[0] ** 2
    return variance


def fit_zenith_law(
    zenith_rad: Array, variance_rad2: Array, uncertainty_rad2: Array, terms: tuple[str, ...]
) -> ZenithLaw:
    """The law that is nearest to a scatter of one axis over zenith distances, all arrays of shape (n,).

    `terms` are those of the facets' sag, "sin" and "cos": with none the law is a constant. Nearest means in relative
    variance, but no nearer than the uncertainty.
    """
    use = np.array([True, "cos" in terms, "sin" in terms])
    weight = 1.0 / np.hypot(variance_rad2, uncertainty_rad2)

    def solve(z0_rad: float) -> tuple[Array, float]:
        """Squares of constant, cosine and sine, none negative, and their misfit: with z0 given a linear problem."""
        found, misfit = nnls((_terms(zenith_rad, z0_rad) * weight[:, None])[:, use], variance_rad2 * weight)
        squares = np.zeros(3)
        squares[use] = found
        return squares, float(misfit)

    z0 = 0.0
    if terms:
        # a cosine does not tell z0 from -z0; a sine may grow from anywhere
        least = -math.pi / 2.0 if terms == ("sin",) else 0.0
        tried = zenith_grid_rad(least, math.pi / 2.0, Z0_STEP_RAD)
        near = float(tried[np.argmin([solve(float(z0))[1] for z0 in tried])])
        bounds = (max(near - Z0_STEP_RAD, least), min(near + Z0_STEP_RAD, math.pi / 2.0))
        fine = float(minimize_scalar(lambda z0: solve(z0)[1], bounds=bounds, method="bounded").x)
        z0 = min(near, fine, key=lambda z0: solve(z0)[1])
    constant, cosine, sine = np.sqrt(solve(z0)[0])
    return ZenithLaw(float(constant), z0, float(cosine), float(sine))


def _terms(zenith_rad: Array, z0_rad: float) -> Array:
    """Shape (..., 3). What the squares of constant, cosine and sine are multiplied with."""
    terms: Array = np.stack(
        [
            np.ones_like(zenith_rad),
            (np.cos(zenith_rad) - math.cos(z0_rad)) ** 2,
            (np.sin(zenith_rad) - math.sin(z0_rad)) ** 2,
        ],
        axis=-1,
    )
    return terms

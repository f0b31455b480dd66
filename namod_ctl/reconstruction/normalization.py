"""Do the responses still depend on how bright the star was?

A response is a facet's intensity over the star's, so it should not. Where a camera's radiometric calibration is
imperfect, or the two cameras' calibrations do not match, it grows as a small power of the star's intensity,

    R_ij = s_i ** exponent * mu_j(Theta_i),

which a plot over magnitudes shows as a slope: FACT's cameras had -6.9 % per magnitude (arXiv:1605.06274, section 3).

The exponent is a further parameter of the fits of all facets. What of its effect the facets' own parameters could take
over (a star that faded while the telescope moved on) says nothing about it and is projected out, so that intensity and
direction are not confounded; how much is left is the information that the records carry.

The star's intensity is itself measured, and it divides the response: its noise alone (a star scintillates in a small
lens) makes bright records respond too little, a slope of up to -1 where the star stood still. Clouds, air and another
star change the intensity for longer than one record, noise does not: the neighbouring records tell a record's intensity
without its noise, and serve as an instrumental variable.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.reconstruction.common_exponent import (
    Witness,
    common_factors,
    project,
    solve,
    told_by_neighbours,
)
from namod_ctl.reconstruction.facet_fit import FacetFit, student_weight
from namod_ctl.reconstruction.facet_psf import BACKGROUND, CENTRE, GRADIENT_Y, LOG_FLUX, evaluate
from namod_ctl.reconstruction.quality import has_signal
from namod_ctl.reconstruction.responses import ResponseTable

Array = NDArray[np.float64]

PER_MAGNITUDE = -0.4 * math.log(10.0)
"""Change of the log of an intensity when the star gets fainter by a magnitude."""

MIN_RANGE_MAG = 0.3
"""The star must have varied by as much, from record to record and not by noise: less is air and vignetting."""

GOOD_PER_MAGNITUDE = 0.01
"""Slopes that are known better are known well; a slope below is harmless."""

_SMOOTH_DEGREE = 4  # of a light's shape beyond a gaussian's: its tails and its skewness
_SHAPE_ERROR = 0.1  # of a response, by which a gaussian may be wrong at any one direction
_LIT = 0.1  # share of a facet's scale from which on its light is far above what else it shows
_MIN_INFORMATION = 10.0  # records whose common factor is less certain than 0.3 say nothing
_MIN_LIT_RECORDS = 20
_LEAST_SHARE = 0.1  # less is nothing
_MIN_FACETS = 3  # what is peculiar to one facet is not the cameras'
_BRIGHT = 0.3  # share of the brightest facet's response from which on the scene is nothing beside a facet's light
_MAD_TO_SIGMA, _LEAST_SCATTER = 1.4826, 0.01
_MIN_STRENGTH = 5.0  # sigma by which neighbours must tell a record's intensity
_SIGNIFICANT_SIGMA, _SIGNIFICANT_PER_MAGNITUDE = 3.0, 0.005
_MAX_EXPONENT = 0.5  # beyond, it is no calibration that is imperfect: something else is wrong
_MAX_BIAS = 0.02
_SELF_CALIBRATION = "self-calibration"
_MAX_SIGMA = 0.035  # of the exponent: a slope like FACT's could not be seen beyond


@dataclass(frozen=True, slots=True, eq=False)
class Normalization:
    """How responses depend on the star's intensity.

    Attributes
    ----------
    exponent, exponent_uncertainty
        Responses grow as the star's intensity to this power, and one standard deviation; NaN where it could not be
        worked out, and worth nothing where there is a doubt.
    range_mag
        By how much the star's intensity varied over the records that count here, from the faintest to the brightest
        5 %, without its noise.
    n_facets
        Facets that have a say.
    doubt
        Why nothing can be said; empty where something can.
    record_index, magnitude, steady_magnitude, log_factor, log_factor_uncertainty
        Shape (n_records,). The records that have a say: how many magnitudes fainter the star was than in the run's
        typical record, the same without the noise of its own measurement where the neighbouring records tell it, and
        the natural log of the factor by which all facets together responded more than they do with a star of typical
        intensity. All without a correction.
    """

    exponent: float
    exponent_uncertainty: float
    range_mag: float
    n_facets: int
    doubt: str
    record_index: NDArray[np.int64]
    magnitude: Array
    steady_magnitude: Array
    log_factor: Array
    log_factor_uncertainty: Array

    @property
    def is_known(self) -> bool:
        """True when the records carry the information."""
        return not self.doubt

    @property
    def per_magnitude(self) -> float:
        """Relative change of a response when the star gets fainter by one magnitude."""
        return math.expm1(PER_MAGNITUDE * self.exponent)

    @property
    def per_magnitude_uncertainty(self) -> float:
        """One standard deviation of `per_magnitude`."""
        return abs(PER_MAGNITUDE) * (1.0 + self.per_magnitude) * self.exponent_uncertainty

    @property
    def per_decade(self) -> float:
        """Relative change of a response when the star gets ten times brighter."""
        return math.expm1(math.log(10.0) * self.exponent)

    @property
    def per_decade_uncertainty(self) -> float:
        """One standard deviation of `per_decade`."""
        return math.log(10.0) * (1.0 + self.per_decade) * self.exponent_uncertainty

    @property
    def is_implausible(self) -> bool:
        """True for a slope that no calibration explains: the wrong star, a lamp that only one camera sees, ..."""
        return self.is_known and abs(self.exponent) > _MAX_EXPONENT

    @property
    def is_significant(self) -> bool:
        """True when there is a slope, by more than chance and by more than cameras repeat."""
        return (
            self.is_known
            and abs(self.exponent) > _SIGNIFICANT_SIGMA * self.exponent_uncertainty
            and abs(self.per_magnitude) > _SIGNIFICANT_PER_MAGNITUDE
        )

    @property
    def is_worth_removing(self) -> bool:
        """True when a self-calibration makes the responses better for sure."""
        return self.is_significant and not self.is_implausible

    def with_refits(self, share: float) -> Normalization:
        """The same, knowing that new fits follow a removed exponent so that only this share of it is noticed.

        Fits take up part of a slope where it went along with direction, more than is linear: the exponent is larger
        than it seems, and so is its uncertainty.
        """
        share = min(share, 1.0) if share > _LEAST_SHARE else _LEAST_SHARE  # also where it is not known
        more = self.exponent / share - self.exponent
        sigma = self.exponent_uncertainty / share
        return replace(
            self,
            exponent=self.exponent + more,
            exponent_uncertainty=sigma,
            doubt=self.doubt or _doubt(sigma, self.range_mag),
            log_factor=self.log_factor + more * PER_MAGNITUDE * self.magnitude,
        )

    def beside(self, removed_exponent: float) -> Normalization:
        """The same of records from which that exponent had been taken out before, as if it had not."""
        removed = removed_exponent * PER_MAGNITUDE * self.magnitude
        return replace(self, exponent=self.exponent + removed_exponent, log_factor=self.log_factor + removed)


def slope_in_words(normalization: Normalization) -> str:
    """The slope both ways with its uncertainty; of one that is known."""
    n = normalization
    return (
        f"{100.0 * n.per_magnitude:+.1f} +- {100.0 * n.per_magnitude_uncertainty:.1f} % per magnitude fainter "
        f"({100.0 * n.per_decade:+.1f} +- {100.0 * n.per_decade_uncertainty:.1f} % per decade of light)"
    )


def removal_in_words(normalization: Normalization) -> str:
    """What a self-calibration did."""
    return (
        f"{_SELF_CALIBRATION}: responses changed by {slope_in_words(normalization)} with the star's intensity, and "
        "that is taken out of them: the two cameras' radiometric calibrations do not match "
        "(namod-ctl calibrate radiometric)"
    )


def is_self_calibrated(remarks: Sequence[str]) -> bool:
    """True when these remarks of a reconstruction say that a self-calibration took a slope out."""
    return any(remark.startswith(f"{_SELF_CALIBRATION}:") for remark in remarks)


def without_slope(table: ResponseTable, exponent: float) -> ResponseTable:
    """The table as it would be if responses did not grow as that power; a star of typical intensity stays as it is."""
    return replace(table, response=table.response * table.faintness[:, None] ** exponent)


def measure_normalization(table: ResponseTable, fits: Sequence[FacetFit | None]) -> Normalization:
    """The exponent as the fits to that table show it; `fits` in the order of its facets.

    It is linear: how far the fits themselves would follow a removed exponent, new fits must tell (`with_refits`).
    """
    witnesses = [_witness_of(table, fit) for j, fit in enumerate(fits) if fit is not None and has_signal(fit, table, j)]
    return normalization_of(witnesses, table.record_index, table.faintness, _smooth_columns(table.theta_rad))


def _smooth_columns(theta_rad: Array) -> Array:
    """Polynomials of the records' directions without the constant, which is each facet's flux, shape (n, k)."""
    x, y = theta_rad.T / max(float(np.abs(theta_rad).max(initial=0.0)), 1e-12)
    powers = [(i, order - i) for order in range(1, _SMOOTH_DEGREE + 1) for i in range(order + 1)]
    return np.stack([x**i * y**j for i, j in powers], axis=1)


def centre_shift_per_exponent(table: ResponseTable, fit: FacetFit) -> Array:
    """By how much a facet's centre moves when an exponent of 1 is taken out of the responses, shape (2,), rad."""
    witness = _witness_of(table, fit)
    gain = -witness.gain * np.log(table.faintness[witness.records])
    _, taken = project(witness, student_weight(witness.residual, witness.variance), gain[:, None])
    shift: Array = -taken[CENTRE, 0]
    return shift


def measure_at_rest(table: ResponseTable) -> Normalization:
    """The exponent of records that all have the star, or a lamp, at one place, as it gets brighter and fainter.

    The table must be made with `is_at_rest`. Only well lit facets have a say, so that the scene does not matter.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a facet, or a record, that was never measured stays NaN
        typical = np.nan_to_num(np.nanmedian(table.response, axis=0))
        bright = table.response[:, typical > max(_BRIGHT * typical.max(initial=0.0), 0.0)]
        log_response = np.log(np.where(bright > 0.0, bright, np.nan))
        away = log_response - np.nanmedian(log_response, axis=0)
        own = away - np.nanmedian(away, axis=1, keepdims=True)  # what it does not have in common with the others
    witnesses = []
    for j in range(away.shape[1]):
        records = np.flatnonzero(np.isfinite(away[:, j]))
        residual = away[records, j]
        n = len(records)
        spread = np.abs(own[records, j] - np.median(own[records, j]))
        sigma = max(_MAD_TO_SIGMA * float(np.median(spread)), _LEAST_SCATTER)
        witnesses.append(
            Witness(
                records=records,
                residual=residual,
                variance=np.full(n, sigma**2),
                gain=np.ones(n),
                free=np.ones((n, 1)),
                belief=np.zeros((1, 1)),
                belief_pull=np.zeros(1),
            )
        )
    return normalization_of(witnesses, table.record_index, table.faintness, np.zeros((table.n_records, 0)))


def normalization_of(
    witnesses: Sequence[Witness], record_index: NDArray[np.int64], faintness: Array, smooth: Array
) -> Normalization:
    """The exponent that makes all witnesses agree best.

    `faintness` (n_records,) as in the response table, `smooth` (n_records, k) as in `common_exponent.solve`.
    """
    log_star = -np.log(faintness)
    n = len(log_star)
    factor, information = common_factors(witnesses, n)
    lit = np.flatnonzero(information > _MIN_INFORMATION)
    told = told_by_neighbours(log_star)
    range_mag, direct_range_mag = (_range_mag(column[lit]) for column in (told, log_star))
    solution = None
    if n and not np.any(log_star):
        doubt = "the records do not say how bright the star was (imported response maps do not), or it never changed"
    elif len(witnesses) < _MIN_FACETS:
        doubt = f"{len(witnesses)} facets were lit, {_MIN_FACETS} are needed to tell the cameras' doing from a facet's"
    elif len(lit) < _MIN_LIT_RECORDS:
        doubt = f"facets are lit in {len(lit)} records only, {_MIN_LIT_RECORDS} are needed: record longer"
    else:
        if range_mag >= MIN_RANGE_MAG:
            solution = solve(witnesses, log_star, told, smooth)
            if solution.strength < _MIN_STRENGTH:
                solution = None
        if solution is None and direct_range_mag >= MIN_RANGE_MAG:
            # Light that jumps from record to record: the scatter bounds what the noise of its intensity can do.
            direct = solve(witnesses, log_star, log_star, smooth)
            bias = float(np.var(direct.factor[lit]) / np.var(log_star[lit]))
            if bias < _MAX_BIAS:
                range_mag, told = direct_range_mag, log_star
                solution = replace(direct, sigma=math.hypot(direct.sigma, bias))
        if solution is None and range_mag >= MIN_RANGE_MAG:
            doubt = "the star's brightness jumped from record to record: its changes can not be told from its noise"
        else:
            doubt = _doubt(math.nan if solution is None else solution.sigma, range_mag)
    if solution is not None:
        factor = solution.factor + solution.exponent * log_star
    return Normalization(
        math.nan if solution is None else solution.exponent,
        math.nan if solution is None else solution.sigma,
        range_mag,
        len(witnesses),
        doubt,
        record_index[lit],
        log_star[lit] / PER_MAGNITUDE,
        told[lit] / PER_MAGNITUDE,
        factor[lit],
        1.0 / np.sqrt(information[lit]),
    )


def _range_mag(log_star: Array) -> float:
    """From the 5 % to the 95 % quantile, in magnitudes."""
    return float(np.ptp(np.quantile(log_star, [0.05, 0.95]))) / abs(PER_MAGNITUDE) if len(log_star) else 0.0


def _doubt(sigma: float, range_mag: float) -> str:
    """Why the records do not tell the exponent; empty when they do."""
    if range_mag < MIN_RANGE_MAG:
        return (
            f"the star's brightness varied by {range_mag:.2f} mag only, beyond its noise; {MIN_RANGE_MAG:g} mag are "
            "needed, of clouds, zenith distance or another star"
        )
    if not sigma < _MAX_SIGMA:
        return (
            f"the star's brightness varied by {range_mag:.1f} mag, but the same facets were hardly lit with it bright "
            f"and faint: the slope is known to {100.0 * abs(PER_MAGNITUDE) * sigma:.1f} % per magnitude only"
        )
    return ""


def _witness_of(table: ResponseTable, fit: FacetFit) -> Witness:
    """A facet's testimony from its fit: of the records in which it was lit, as a dark facet does not show the star.

    What the others say about its parameters is part of what is known of these beforehand.
    """
    lit = fit.light > _LIT
    records = fit.used[lit]
    _, jacobian = evaluate(fit.parameters, table.theta_rad[records])
    jacobian[:, BACKGROUND : GRADIENT_Y + 1] *= fit.faintness[lit, None]
    free = fit.slope[lit, None] * jacobian
    weighted = free.T * student_weight(fit.residual[lit], fit.variance[lit])
    belief = np.linalg.inv(fit.covariance) - weighted @ free
    pull = weighted @ fit.residual[lit]  # at the mode the records' pull is as strong as that of what is known
    # A facet's flux is taken as it comes: what its family expects of it must not look like a slope.
    belief[LOG_FLUX], belief[:, LOG_FLUX], pull[LOG_FLUX] = 0.0, 0.0, 0.0
    gain = free[:, LOG_FLUX]
    variance = fit.variance[lit] + (_SHAPE_ERROR * gain) ** 2
    return Witness(records, fit.residual[lit], variance, gain, free, belief, pull)

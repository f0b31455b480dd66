"""From a response table to the alignment of a telescope: the one path that every command takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad, rad2_to_arcmin2, rad_to_deg
from namod_ctl.optics.coordinates import theta_of_hit
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.raytrace import a_sigma_rad2, combine_moments, facet_moments, trace
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf, BadRecord, FacetAlignment
from namod_ctl.reconstruction.bad_records import find_bad_records
from namod_ctl.reconstruction.correction import FacetCorrection, common_centre, correct
from namod_ctl.reconstruction.estimators import DEFAULT_ESTIMATOR, ESTIMATOR_NAMES, SIMPLE_ESTIMATORS, Centres
from namod_ctl.reconstruction.facet_centres import brightest_is_bad, robust_centres, simple_flags, with_doubt_of_slope
from namod_ctl.reconstruction.facet_fit import FacetFit
from namod_ctl.reconstruction.facet_psf import CENTRE, background_of, covariance_of_light
from namod_ctl.reconstruction.normalization import (
    Normalization,
    measure_normalization,
    removal_in_words,
    without_slope,
)
from namod_ctl.reconstruction.psf import area_now, area_of_histograms, area_predicted, light_of_fits
from namod_ctl.reconstruction.quality import ScanRegion, n_lit_records
from namod_ctl.reconstruction.responses import ResponseTable
from namod_ctl.reconstruction.robust import Family, fit_reflector
from namod_ctl.reconstruction.scene import without_scene
from namod_ctl.reconstruction.uncertainty import misfit_factors, repetition_factor

Array = NDArray[np.float64]

DEFAULT_BIN_SIZE_RAD = deg_to_rad(0.01)
MIN_RECORDS = 10
_N_SCREENINGS = 3  # without the worst records the fits may show further ones
_N_SCENES = 2  # the first fits to a run under clouds are too wide, and hide some of the scene
_N_SELF_CALIBRATIONS = 2  # the first leaves a few per cent of what it removed
_LEFT_SIGMA = 0.2
_TRIAL_SIGMA, _TRIAL_LEAST = 2.0, 0.01  # far enough from nothing to see the difference
_RAYS_PER_FACET = 500


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """An alignment with what it was made of, for figures and reports.

    Attributes
    ----------
    table, used
        All accepted records, and those that are left when the bad ones are taken out.
    fits
        Robust fit of every facet, None without any response.
    histogram_areas
        A_sigma of the summed H_psf in rad^2: of all records, without the bad ones, and without background as well.
    limit
        Ray-traced area of the same reflector perfectly aligned.
    normalization
        How the responses depended on the star's intensity when they were recorded.
    removed_exponent
        What the self-calibration took out of `table` and `used`; 0 where it left them as they are.
    """

    alignment: Alignment
    table: ResponseTable
    used: ResponseTable
    family: Family
    fits: tuple[FacetFit | None, ...]
    histogram_areas: tuple[float, float, float]
    limit: AreaOfPsf
    normalization: Normalization
    removed_exponent: float


@dataclass(frozen=True, slots=True, eq=False)
class FittedRun:
    """A response table with the fits to it, see `Reconstruction` for the words."""

    table: ResponseTable
    used: ResponseTable
    bad: list[BadRecord]
    family: Family
    fits: list[FacetFit | None]
    normalization: Normalization
    removed_exponent: float


def reconstruct(
    table: ResponseTable,
    instrument: Instrument,
    estimator: str = DEFAULT_ESTIMATOR,
    bin_size_rad: float = DEFAULT_BIN_SIZE_RAD,
    *,
    self_calibration: bool = True,
) -> Reconstruction:
    """Alignment of all facets of a run.

    The light, its area and the bad records always come from the robust fits; `estimator` decides where the centres
    and with them the corrections come from. Whatever the estimator, `self_calibration` first takes out of the responses
    what the records show to depend on the star's intensity, where that is certain.

    Raises
    ------
    ConfigError
        Unknown estimator, or facets that the instrument does not have.
    DataQualityError
        Too few records, or no light at all.
    """
    if estimator not in ESTIMATOR_NAMES:
        raise ConfigError(f"unknown estimator {estimator!r}: choose one of {', '.join(ESTIMATOR_NAMES)}")
    fitted = fit_run(table, instrument, self_calibration=self_calibration)
    table, used, bad, family, fits = fitted.table, fitted.used, fitted.bad, fitted.family, fitted.fits
    expected_rad = expected_size_rad(instrument)
    factors = repetition_factor(used, family) * misfit_factors(fits)
    size_rad = min(float(np.exp(family.log_size)), expected_rad)
    region = ScanRegion(used.theta_rad)
    if estimator == DEFAULT_ESTIMATOR:
        centres, flags, remarks = robust_centres(used, fits, factors, region, size_rad)
        if fitted.removed_exponent:
            centres = with_doubt_of_slope(centres, used, fits, fitted.normalization)
    else:
        centres = SIMPLE_ESTIMATORS[estimator](table, bin_size_rad)
        flags, remarks = simple_flags(table, centres, bad, estimator)
    flux = np.array([np.nan if fit is None else light_of_fits([fit]).flux[0] for fit in fits])
    axis_rad = np.zeros(2)
    if not instrument.star_camera.axis_is_calibrated:
        axis_rad = common_centre(centres.theta_rad, np.where([flag.forbids_turning for flag in flags], 0.0, flux))
    corrections = correct(instrument, table.facet_ids, centres.theta_rad, flags, axis_rad)
    seen = [j for j, flag in enumerate(flags) if fits[j] is not None and not flag & FacetFlag.NO_SIGNAL]
    if not seen:
        raise DataQualityError("no facet shows light in the recorded directions: record again, further out")
    now = area_now([fit for j in seen if (fit := fits[j]) is not None], factors[seen])
    predicted, limit = _predict(instrument, table.facet_ids, centres, corrections, flux, axis_rad)
    doubt_rad2 = np.hypot(now.uncertainty_rad2, predicted.uncertainty_rad2)
    if now.a_sigma_rad2 - predicted.a_sigma_rad2 < doubt_rad2:
        flags = [flag | FacetFlag.NO_GAIN for flag in flags]
        corrections = correct(instrument, table.facet_ids, centres.theta_rad, flags, axis_rad)
    background = np.array([0.0 if fit is None else max(_background(fit), 0.0) for fit in fits])
    histogram_areas = (
        area_of_histograms(table, bin_size_rad),
        area_of_histograms(used, bin_size_rad),
        area_of_histograms(used, bin_size_rad, background),
    )
    alignment = Alignment(
        telescope=instrument.name,
        estimator=estimator,
        n_records=table.n_records,
        n_used=used.n_records if estimator == DEFAULT_ESTIMATOR else table.n_records,
        axis_rad=axis_rad,
        now=now,
        now_all_records=AreaOfPsf(histogram_areas[0], _bootstrap_area(table, bin_size_rad)),
        predicted=predicted,
        facets=tuple(
            _facet(j, table, used, centres, fits[j], corrections[j], flux[j], remarks[j])
            for j in range(len(table.facet_ids))
        ),
        bad_records=tuple(bad),
        facets_not_in_run=tuple(sorted(set(instrument.reflector.ids) - set(table.facet_ids))),
        remarks=_remarks(table, bad, histogram_areas, bin_size_rad)
        + ((removal_in_words(fitted.normalization),) if fitted.removed_exponent else ()),
    )
    return Reconstruction(
        alignment,
        table,
        used,
        family,
        tuple(fits),
        histogram_areas,
        limit,
        fitted.normalization,
        fitted.removed_exponent,
    )


def fit_run(table: ResponseTable, instrument: Instrument, *, self_calibration: bool = True) -> FittedRun:
    """The fits of all facets to the records that agree with each other, and how responses depend on the star.

    Raises
    ------
    ConfigError
        Facets that the instrument does not have.
    DataQualityError
        Too few records, or no light at all.
    """
    if table.n_records < MIN_RECORDS:
        raise DataQualityError(f"{table.n_records} records count, at least {MIN_RECORDS} are needed: record longer")
    unknown = sorted(set(table.facet_ids) - set(instrument.reflector.ids))
    if unknown:
        raise ConfigError(f"facet ids {unknown} of the run are not in the config of {instrument.name}")
    expected_rad = expected_size_rad(instrument)
    bad, used, family, fits = _screen(table, expected_rad)
    found = measure_normalization(used, fits)
    share = 1.0
    if found.is_known:
        share = _share_noticed(used, found, expected_rad)
        found = found.with_refits(share)
    fitted = FittedRun(table, used, bad, family, fits, found, 0.0)
    if not self_calibration or not found.is_worth_removing:
        return fitted
    removed, left = 0.0, found
    for _ in range(_N_SELF_CALIBRATIONS):
        removed += left.exponent
        steady = without_slope(table, removed)
        bad, used, family, fits = _screen(steady, expected_rad)
        left = measure_normalization(used, fits).with_refits(share)
        if not left.is_known:  # without it there is nothing to hold on to
            return fitted
        fitted = FittedRun(steady, used, bad, family, fits, left.beside(removed), removed)
        if abs(left.exponent) < _LEFT_SIGMA * left.exponent_uncertainty:
            break
    return fitted


def _share_noticed(used: ResponseTable, found: Normalization, expected_rad: float) -> float:
    """Share of an exponent that the measurement notices when it is taken out and the facets are fitted anew."""
    further = max(_TRIAL_SIGMA * found.exponent_uncertainty, _TRIAL_LEAST)
    trial = found.exponent + math.copysign(further, found.exponent)
    table = without_slope(used, trial)
    _, fits = fit_reflector(table, expected_rad)
    return (found.exponent - measure_normalization(table, fits).exponent) / trial


def expected_size_rad(instrument: Instrument) -> float:
    """Standard deviation per axis of one facet's light as the optics lead to expect, rad.

    Ray traced, and not less than half the image of a star in the star camera: real mirrors have figure errors, and
    the reflector camera an aperture.
    """
    moments = facet_moments(trace(instrument.reflector, _RAYS_PER_FACET))
    variance = np.trace(moments.cov_m2, axis1=1, axis2=2).mean() / 2.0
    return max(float(np.sqrt(variance)) / instrument.reflector.focal_length_m, instrument.star_size_rad / 2.0)


def _screen(
    table: ResponseTable, expected_rad: float
) -> tuple[list[BadRecord], ResponseTable, Family, list[FacetFit | None]]:
    """Bad records, the table without them, and the fits to it."""
    bad: list[BadRecord] = []
    family, fits = fit_reflector(table, expected_rad)
    for _ in range(_N_SCENES):
        steady = without_scene(table, fits)
        if steady is table:
            break
        table = steady
        family, fits = fit_reflector(table, expected_rad)
    used = table
    for _ in range(_N_SCREENINGS):
        found = find_bad_records(table, fits, family.noise, float(np.exp(family.log_size)))
        if {record.index for record in found} == {record.index for record in bad}:
            break
        bad = found
        used = table.select(~np.isin(table.record_index, [record.index for record in bad]))
        if used.n_records < MIN_RECORDS:
            raise DataQualityError(
                f"{len(bad)} of {table.n_records} records disagree with the others: check that the star camera "
                "followed one star, and record again"
            )
        family, fits = fit_reflector(used, expected_rad)
    return bad, used, family, fits


def _facet(
    j: int,
    table: ResponseTable,
    used: ResponseTable,
    centres: Centres,
    fit: FacetFit | None,
    correction: FacetCorrection,
    flux: float,
    remarks: tuple[str, ...],
) -> FacetAlignment:
    is_silent = fit is None or bool(correction.flags & FacetFlag.NO_SIGNAL)
    widths = np.full(2, np.nan)
    if fit is not None and not is_silent:
        widths = np.sqrt(np.linalg.eigvalsh(covariance_of_light(fit.parameters)))
    return FacetAlignment(
        facet_id=table.facet_ids[j],
        theta_rad=centres.theta_rad[j],
        theta_cov_rad2=centres.theta_cov_rad2[j],
        width_major_rad=float(widths[1]),
        width_minor_rad=float(widths[0]),
        flux=np.nan if is_silent else float(flux),
        background=np.nan if fit is None else _background(fit),
        n_records_in_psf=0 if fit is None or is_silent else n_lit_records(fit, used.response[:, j]),
        flags=correction.flags,
        tilt_correction_rad=correction.tilt_correction_rad,
        leg_travel_m=correction.leg_travel_m,
        bolt_turn_deg=correction.bolt_turn_deg,
        remarks=remarks + correction.remarks,
    )


def _background(fit: FacetFit) -> float:
    """Response of the unlit facet where its centre is."""
    return float(background_of(fit.parameters, fit.parameters[None, CENTRE])[0] * fit.scale)


def _predict(
    instrument: Instrument,
    facet_ids: Sequence[int],
    centres: Centres,
    corrections: Sequence[FacetCorrection],
    flux: Array,
    axis_rad: Array,
) -> tuple[AreaOfPsf, AreaOfPsf]:
    """Area after the correction, and that of the same facets perfectly aligned."""
    reflector = instrument.reflector.subset(facet_ids)
    rays = trace(reflector, _RAYS_PER_FACET)
    moments = facet_moments(rays)
    limit = a_sigma_rad2(combine_moments(moments).cov_m2, reflector.focal_length_m)
    known = np.isfinite(centres.theta_rad).all(axis=1)
    is_turned = np.array([np.isfinite(correction.leg_travel_m).all() for correction in corrections])
    mean_rad = theta_of_hit(moments.mean_m, reflector.focal_length_m, np.zeros(2))
    left = np.where(is_turned[:, None], 0.0, centres.theta_rad - axis_rad) + mean_rad
    left_cov = np.nan_to_num(centres.theta_cov_rad2) + np.where(
        is_turned[:, None, None],
        [turning_cov_rad2(instrument.mounts[facet_id], instrument.goniometer_resolution_rad) for facet_id in facet_ids],
        0.0,
    )
    light = np.where(known & np.isfinite(flux), flux, 0.0)
    if not np.any(light > 0.0) or not np.isfinite(centres.theta_cov_rad2[known]).all():
        # without light there is nothing to predict, and without uncertainties nothing could be promised
        return AreaOfPsf(float("nan"), float("nan")), AreaOfPsf(limit, 0.0)
    shine = light > 0.0
    perfect = moments.cov_m2[shine] / reflector.focal_length_m**2
    return area_predicted(light[shine], perfect, left[shine], left_cov[shine]), AreaOfPsf(limit, 0.0)


def turning_cov_rad2(mount: Mount, goniometer_resolution_rad: float) -> Array:
    """Covariance (2, 2) of Theta that turning to the goniometer's resolution leaves behind; 0 without bolts."""
    if mount.pitch_m_per_turn is None:
        return np.zeros((2, 2))
    step_m = mount.pitch_m_per_turn * goniometer_resolution_rad / (2.0 * np.pi)
    tilts = np.array([mount.tilt_of_travel(travel) for travel in step_m * np.eye(len(mount.legs_m))])
    cov: Array = 4.0 * tilts.T @ tilts / 12.0  # Theta is twice the tilt; a rounded value is uniform within a step
    return cov


def _bootstrap_area(table: ResponseTable, bin_size_rad: float, n_draws: int = 50) -> float:
    """Uncertainty of the histogram's area when records are drawn anew."""
    rng = np.random.default_rng(0)
    together = replace(table, facet_ids=(0,), response=np.nan_to_num(table.response).sum(axis=1, keepdims=True))
    areas = [
        area_of_histograms(together.select(rng.integers(0, table.n_records, table.n_records)), bin_size_rad)
        for _ in range(n_draws)
    ]
    return float(np.nanstd(areas))


def _remarks(
    table: ResponseTable, bad: Sequence[BadRecord], areas: tuple[float, float, float], bin_size_rad: float
) -> tuple[str, ...]:
    """What was left out, what that changes, and which simple estimates would rest on it."""
    everything, without_bad, without_background = (rad2_to_arcmin2(area) for area in areas)
    lines = [
        f"A_sigma of the summed H_psf in bins of {rad_to_deg(bin_size_rad):g} deg: {everything:.1f} arcmin2 with all "
        f"records, {without_bad:.1f} without the {len(bad)} bad ones, {without_background:.1f} without the facets' "
        "background as well"
    ]
    for j, record in brightest_is_bad(table, bad).items():
        lines.append(
            f"facet {table.facet_ids[j]}: its single brightest record is number {record.index} ({record.kind}): turns "
            "computed from it are wrong"
        )
    return tuple(lines)

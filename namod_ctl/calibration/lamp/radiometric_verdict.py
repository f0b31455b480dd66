"""From the responses of a lamp series to a radiometric calibration, or to the reason why there is none.

What cannot be trusted is refused in words; what is less than good is "limited", with remarks that say why.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.lamp_series import PatchDark, Placement, Response
from namod_ctl.calibration.lamp.lamp_visits import Visits, visits_of
from namod_ctl.calibration.lamp.radiometric_checks import (
    check_amount,
    check_exposure_units,
    check_fit,
    check_levels,
    plateau_share,
)
from namod_ctl.calibration.lamp.radiometric_choice import (
    chosen_form,
    drift_form,
    offset_form,
    trimmed,
    without_odd,
)
from namod_ctl.calibration.lamp.radiometric_fit import LampData, LawFit, fit_law
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import m_to_mm
from namod_ctl.imaging.dark import QUANTISATION_NOISE_ADU

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SURE_SHARE = 0.6
"""Of the response at which the camera saturates: below, the law's form is chosen; above, where cameras bend, tried."""

SATURATION_MARGIN = 0.98
"""Of that response: from here on a single pixel may be cut off."""

BIN_DEX = 0.15

DISTANCE_ERROR_M = 0.005
"""The error common to all distances where nobody says another: a filament's place in its bulb, a tape's loose end."""

GOOD_SHARE = 0.01
"""A calibration is good when intensities by its law are as sure as that."""


@dataclass(frozen=True, slots=True)
class ResidualBin:
    """Mean departure of the intensity from the law in a range of responses, as a share, with its standard error."""

    response_share: float
    departure_share: float
    error_share: float
    n_visits: int


@dataclass(frozen=True, slots=True, eq=False)
class RadiometricFinding:
    """A radiometric calibration and what it rests on.

    Attributes
    ----------
    is_used
        Shape (n_visits,): those that the law was fitted to.
    saturation_share, is_saturation_seen
        Responses from this share of full scale upwards are saturated; False: no frame was, and it is the digitizer's.
    intensity_error_share
        Largest standard error of an intensity by the law within the ranges of response and exposure of the series.
    drift_share, drift_error_share
        Of the lamp over the series; NaN when it cannot be told.
    smallest_share_for_pixel
        From this response on, one pixel's rounding is less than 5 % of it.
    """

    visits: Visits
    placements: tuple[Placement, ...]
    is_used: Mask
    fit: LawFit
    law_name: Literal["three_parameter", "curved"]
    curve_words: str
    saturation_share: float
    is_saturation_seen: bool
    usable_response_share: tuple[float, float]
    usable_exposure_s: tuple[float, float]
    smallest_share_for_pixel: float
    residual_rms_share: float
    bins: tuple[ResidualBin, ...]
    intensity_error_share: float
    drift_share: float
    drift_error_share: float
    verdict: Literal["good", "limited"]
    remarks: tuple[str, ...]


def calibrate_radiometric(
    responses: Sequence[Response],
    placements: Sequence[Placement],
    dark: PatchDark,
    n_pixels: int,
    full_scale_adu: float,
    distance_error_m: float = DISTANCE_ERROR_M,
) -> RadiometricFinding:
    """The law of the camera from responses to a lamp at known relative intensities.

    Parameters
    ----------
    placements
        By the numbers that responses name.
    n_pixels
        Of the patch.
    distance_error_m
        Standard deviation of the error that all distances have in common, as from another end of the tape.

    Raises
    ------
    DataQualityError
        The series makes no calibration; why, and what to do.
    """
    check_amount(responses, placements)
    r_resp = 1.0
    for _ in range(2):  # the channels of a colour frame are averaged with the exponent that is sought
        visits = visits_of(responses, placements, dark, n_pixels, full_scale_adu, r_resp)
        plateau, is_seen = plateau_share(visits)
        is_open = visits.is_usable & (visits.largest_share < 0.97 * plateau)
        check_levels(visits, is_open)
        data = _data(visits, placements, dark, distance_error_m)
        is_sure = is_open & (visits.largest_share <= SURE_SHARE * plateau)
        if is_sure.sum() < 0.5 * is_open.sum():
            is_sure = is_open
        is_good = is_sure & ~_odd_by_units(data, is_sure, visits)
        form = drift_form(data, visits, is_good)
        is_good, fit = without_odd(data, form, is_good)
        if len(responses[0].mean_adu) == 1:
            break
        r_resp = float(fit.parameters[0])
    form, curve_words = chosen_form(data, fit, is_good)
    is_good, fit = without_odd(data, form, is_good)
    is_used, _ = trimmed(data, form, is_good | (is_open & ~is_sure))
    form = offset_form(data.only(is_used), form)
    fit = fit_law(data.only(is_used), form)
    check_fit(fit, visits, is_used, placements)
    return _judged(visits, placements, data, dark, fit, is_used, curve_words, plateau, full_scale_adu, is_seen=is_seen)


def _data(visits: Visits, placements: Sequence[Placement], dark: PatchDark, distance_error_m: float) -> LampData:
    per_m = np.array([0.0 if one.distance_m is None else -2.0 / one.distance_m for one in placements])
    return LampData(
        log_share=visits.log_share,
        log_exposure=visits.log_exposure,
        log_level=visits.log_level,
        placement=visits.placement,
        variance=visits.variance,
        lever_per_adu=visits.lever_per_adu,
        dark_uncertainty_adu=dark.uncertainty_adu,
        time=visits.time,
        dex_per_m=per_m[visits.placement] / math.log(10.0),
        distance_error_m=distance_error_m,
    )


def _odd_by_units(data: LampData, is_kept: Mask, visits: Visits) -> Mask:
    """Visits far off any law: refused in words when their exposures look like those in another unit."""
    odd = check_exposure_units(
        data.only(is_kept), [name for name, kept in zip(visits.names, is_kept, strict=True) if kept]
    )
    mask = np.zeros_like(is_kept)
    mask[np.flatnonzero(is_kept)[odd]] = True
    return mask


def residual_bins(log_share: Array, residual_dex: Array, floor_dex: float) -> tuple[ResidualBin, ...]:
    """Mean departures from the law in bins of response."""
    bins = []
    number = np.floor((log_share - log_share.min()) / BIN_DEX).astype(int)
    for one in np.unique(number):
        own = residual_dex[number == one]
        spread = float(own.std(ddof=1)) if len(own) > 1 else floor_dex
        bins.append(
            ResidualBin(
                float(10.0 ** log_share[number == one].mean()),
                float(own.mean()) * math.log(10.0),
                max(spread, floor_dex) / len(own) ** 0.5 * math.log(10.0),
                len(own),
            )
        )
    return tuple(bins)


def _judged(
    visits: Visits,
    placements: Sequence[Placement],
    data: LampData,
    dark: PatchDark,
    fit: LawFit,
    is_used: Mask,
    curve_words: str,
    plateau: float,
    full_scale_adu: float,
    *,
    is_seen: bool,
) -> RadiometricFinding:
    used = data.only(is_used)
    r_resp = float(fit.parameters[0])
    least_sure = r_resp * dark.uncertainty_adu / (GOOD_SHARE * full_scale_adu)
    highest = float(visits.largest_share[is_used].max())
    tried = visits.is_usable & (visits.largest_share < 0.97 * plateau)
    is_bent_above = bool((tried & ~is_used & (visits.largest_share > highest + 0.01)).any())
    saturation = min(SATURATION_MARGIN * plateau, highest if is_bent_above else 1.0)
    response = (max(float(10.0 ** used.log_share.min()), least_sure), min(highest, saturation))
    if response[0] >= response[1]:
        raise DataQualityError(
            f"the dark level is known within {dark.uncertainty_adu:.2g} adu only, too little for 1 % at any response "
            "of this series; take dark frames with the cap on"
        )
    exposure = (float(10.0 ** used.log_exposure.min()), float(10.0 ** used.log_exposure.max()))
    error = float(fit.intensity_error_dex(used.log_share, used.log_exposure).max()) * math.log(10.0)
    drift, drift_error = math.nan, math.nan
    if fit.form.drift_degree:
        course = sum(value * used.time ** (power + 1) for power, value in enumerate(fit.drift_dex))
        drift = float(np.ptp(course)) * math.log(10.0) * (1.0 if fit.drift_dex[0] > 0 else -1.0)
        drift_error = float(fit.drift_error_dex[0]) * math.log(10.0)
    limits = _limits(visits, fit, dark, response, exposure, error, drift, is_seen=is_seen)
    remarks = [*limits, curve_words]
    if used.dex_per_m.any():
        remarks.append(
            f"distances from filament to diffuser were taken as right within {m_to_mm(data.distance_error_m):.2g} mm, "
            "each and all together; the uncertainties count that"
        )
    n_left = int((tried & ~is_used).sum())
    if n_left:
        remarks.append(f"{n_left} of {visits.n} exposures were left out: far off, or where the law does not hold")
    return RadiometricFinding(
        visits=visits,
        placements=tuple(placements),
        is_used=is_used,
        fit=fit,
        law_name="curved" if fit.form.is_curved else "three_parameter",
        curve_words=curve_words,
        saturation_share=saturation,
        is_saturation_seen=is_seen or is_bent_above,
        usable_response_share=response,
        usable_exposure_s=exposure,
        smallest_share_for_pixel=min(r_resp * QUANTISATION_NOISE_ADU / (0.05 * full_scale_adu), 1.0),
        residual_rms_share=float(np.sqrt(np.mean(fit.residual_dex**2))) * math.log(10.0),
        bins=residual_bins(used.log_share, fit.residual_dex, fit.visit_dex),
        intensity_error_share=error,
        drift_share=drift,
        drift_error_share=drift_error,
        verdict="limited" if limits else "good",
        remarks=tuple(remarks),
    )


def _limits(
    visits: Visits,
    fit: LawFit,
    dark: PatchDark,
    response: tuple[float, float],
    exposure_s: tuple[float, float],
    error_share: float,
    drift_share: float,
    *,
    is_seen: bool,
) -> list[str]:
    """What makes the calibration less than good, one text each."""
    limits = []
    if error_share > GOOD_SHARE:
        remedy = "measure distances better (--distance-error-mm), or use larger ones or more levels"
        limits.append(f"intensities are known within {error_share:.1%} only (aim {GOOD_SHARE:.0%}): {remedy}")
    if math.isnan(drift_share):
        limits.append("no exposure was repeated later at the same level: a drift of the lamp could not be seen")
    if fit.form.has_offset:
        limits.append(
            f"all distances look {m_to_mm(abs(fit.offset_m)):.0f} +- {m_to_mm(fit.offset_error_m):.0f} mm too "
            f"{'short' if fit.offset_m > 0 else 'long'}, which was taken off: measure from the filament to the diffuser"
        )
    if not dark.is_measured:
        limits.append("without dark frames: faint responses are uncertain")
    if response[1] < 10.0 * response[0]:
        limits.append(
            f"the law holds or was tried from {response[0]:.2g} to {response[1]:.2g} of full scale only: less than a "
            "decade"
        )
    if exposure_s[1] < 100.0 * exposure_s[0]:
        limits.append(f"exposures from {exposure_s[0]:.3g} to {exposure_s[1]:.3g} s only: not two decades")
    if len(fit.placement_error_dex) < 4:
        limits.append(
            f"{len(fit.placement_error_dex)} placements of the lamp cannot show errors of their levels; 1 % was assumed"
        )
    if not is_seen:
        limits.append("no frame was saturated: that point was not measured")
    return limits

"""Which terms the law of a lamp series gets, and which of its visits: all choices are made by evidence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.lamp_visits import Visits
from namod_ctl.calibration.lamp.radiometric_fit import LampData, LawFit, LawForm, fit_law
from namod_ctl.core.errors import DataQualityError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ONE_PERCENT_DEX = float(np.log10(1.01))
BIN_DEX = 0.15
BIN_SIGMAS = 4.0
MIN_BIN_VISITS = 3
ODD_SIGMAS = 4.5
MAX_ODD_SHARE = 0.1
MIN_KEPT_SHARE = 0.5
SIGNIFICANT = 4.0
"""Standard errors from which on a further term is taken for real: one in 16 000 by chance."""

MIN_BIC_GAIN = 10.0
MIN_PLACEMENTS_FOR_OFFSET = 6
MAX_DRIFT_ERROR_DEX = 0.02
"""With repetitions that tell less of the lamp's drift than this, it is not fitted."""


def drift_form(data: LampData, visits: Visits, is_kept: Mask) -> LawForm:
    """Whether the lamp's drift can be told by exposures that were repeated later at the same placement, and its
    shape."""
    if not _has_repetitions(visits, is_kept):
        return LawForm(drift_degree=0)
    linear = fit_law(data.only(is_kept), LawForm(drift_degree=1))
    if linear.drift_error_dex[0] > MAX_DRIFT_ERROR_DEX:
        return LawForm(drift_degree=0)
    bent = fit_law(data.only(is_kept), LawForm(drift_degree=2))
    is_bent = abs(bent.drift_dex[1]) > SIGNIFICANT * bent.drift_error_dex[1] and bent.bic < linear.bic - MIN_BIC_GAIN
    return bent.form if is_bent else linear.form


def _has_repetitions(visits: Visits, is_kept: Mask) -> bool:
    seen: set[tuple[int, float]] = set()
    for i in np.flatnonzero(is_kept):
        key = (int(visits.placement[i]), round(float(visits.log_exposure[i]), 4))
        if key in seen:
            return True
        seen.add(key)
    return False


def without_odd(data: LampData, form: LawForm, is_kept: Mask) -> tuple[Mask, LawFit]:
    """The fit without visits far off it, and which are left.

    Raises DataQualityError when these are too many.
    """
    kept = is_kept.copy()
    while True:
        fit = fit_law(data.only(kept), form)
        scale = max(1.4826 * float(np.median(np.abs(fit.standardized))), 0.3)
        is_odd = np.abs(fit.standardized) > ODD_SIGMAS * scale
        if not is_odd.any():
            return kept, fit
        worst = np.argsort(-np.abs(fit.standardized))[: max(int(is_odd.sum()) // 2, 1)]
        kept[np.flatnonzero(kept)[worst]] = False
        if kept.sum() < (1.0 - MAX_ODD_SHARE) * is_kept.sum():
            raise DataQualityError(
                f"more than {MAX_ODD_SHARE:.0%} of the exposures lie far off any law (up to "
                f"{np.abs(fit.residual_dex).max() * math.log(10.0):.0%} in intensity): the lamp flickers or was "
                "switched, the camera's gain or exposure was automatic, or exposures are wrong; record anew"
            )


def chosen_form(data: LampData, straight: LawFit, is_kept: Mask) -> tuple[LawForm, str]:
    """Straight unless a curve is significant, better by its BIC and in predicting placements, and larger than 1 %."""
    form = LawForm(True, straight.form.drift_degree)
    kept = data.only(is_kept)
    curved = fit_law(kept, form)
    value, error = float(curved.parameters[3]), float(curved.covariance[3, 3] ** 0.5)
    effect = float(np.ptp(kept.log_share)) ** 2 / 4.0 * abs(value)
    gain = straight.bic - curved.bic
    slope = curved.parameters[0] + 2.0 * value * kept.log_share
    words = f"r_curve = {value:+.4f} +- {error:.4f}, up to {_share(effect):.1%} in intensity, BIC {gain:+.1f}"
    if abs(value) < SIGNIFICANT * error or gain < MIN_BIC_GAIN or effect < ONE_PERCENT_DEX or slope.min() < 0.2:
        return straight.form, f"no curve is needed: {words}"
    before, after = _prediction_rms(kept, straight.form), _prediction_rms(kept, form)
    words += f"; placements predicted from the others within {_share(after):.2%} instead of {_share(before):.2%}"
    return (form, f"the law is curved: {words}") if after < before else (straight.form, f"no curve is taken: {words}")


def offset_form(data: LampData, form: LawForm) -> LawForm:
    """With an offset of all distances, as if they were not measured from the lamp's filament, where one is sure.

    Smaller ones than the person allows for are in the covariance.
    """
    if not data.dex_per_m.any() or len(np.unique(data.placement)) < MIN_PLACEMENTS_FOR_OFFSET:
        return form
    plain, wider = fit_law(data, form), fit_law(data, replace(form, has_offset=True))
    expected_m = math.hypot(wider.offset_error_m, data.distance_error_m)
    is_sure = abs(wider.offset_m) > SIGNIFICANT * expected_m and wider.bic < plain.bic - MIN_BIC_GAIN
    return wider.form if is_sure else form


def _prediction_rms(data: LampData, form: LawForm) -> float:
    """Of log10 of the intensities of each placement, as fits to all the others predict them."""
    squares: list[float] = []
    for placement in np.unique(data.placement):
        is_out = data.placement == placement
        others = data.only(~is_out)
        if len(np.unique(others.log_level)) < 2:
            continue
        fit = fit_law(others, form)
        predicted = fit.log_intensity(data.log_share[is_out], data.log_exposure[is_out])
        squares += list((predicted - data.log_level[is_out]) ** 2)
    return float(np.mean(squares)) ** 0.5 if squares else math.inf


def trimmed(data: LampData, form: LawForm, is_kept: Mask) -> tuple[Mask, LawFit]:
    """The fit without the ends of the ranges of response and exposure where the law does not hold.

    Raises DataQualityError when little is left.
    """
    kept = is_kept.copy()
    while kept.sum() >= max(MIN_KEPT_SHARE * is_kept.sum(), 8):
        fit = fit_law(data.only(kept), form)
        bad = _bad_end(data, fit, kept)
        if bad is None:
            return without_odd(data, form, kept)
        kept &= ~bad
    raise DataQualityError(
        "no law of the form log I = r_resp log C + r_expo log T + r_const holds for this series: it departs by more "
        "than 1 % at both ends; check that exposure is manual, that gamma and automatic gain are off, and the dark "
        "frames"
    )


def _bad_end(data: LampData, fit: LawFit, kept: Mask) -> Mask | None:
    """The visits of an outermost bin of response or exposure whose mean departs by more than 1 %; the worst of
    these."""
    index = np.flatnonzero(kept)
    worst: tuple[float, Mask] | None = None
    for values in (data.log_share[kept], data.log_exposure[kept]):
        for is_end in (values < values.min() + BIN_DEX, values > values.max() - BIN_DEX):
            if is_end.sum() < MIN_BIN_VISITS or is_end.sum() > 0.4 * len(index):
                continue
            own = fit.residual_dex[is_end]
            error = max(float(own.std(ddof=1)), fit.visit_dex) / len(own) ** 0.5
            departure = abs(float(own.mean()))
            if departure > max(ONE_PERCENT_DEX, BIN_SIGMAS * error) and (worst is None or departure > worst[0]):
                mask = np.zeros_like(kept)
                mask[index[is_end]] = True
                worst = departure, mask
    return None if worst is None else worst[1]


def _share(dex: float) -> float:
    return float(10.0 ** abs(dex) - 1.0)

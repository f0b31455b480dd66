"""What makes a lamp series useless, found before it makes a wrong calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.lamp_series import Placement, Response
from namod_ctl.calibration.lamp.lamp_visits import Visits
from namod_ctl.calibration.lamp.radiometric_fit import LampData, LawFit
from namod_ctl.core.errors import DataQualityError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_FRAMES = 10
MIN_VISITS = 8
MIN_LEVEL_RATIO = 1.5
MIN_EXPOSURE_RATIO = 3.0
SAME_RESPONSE = 0.01
LONGER = 1.25
MIN_PLATEAU_SHARE = 0.3
UNIT_DEX = 3.0
"""Between seconds and milliseconds, milliseconds and microseconds."""

UNIT_ROOM_DEX = 0.4
N_TRIPLES = 300
MAX_CONDITION = 200.0
ODD_DEX = 0.15
"""In response: no flicker makes that."""

SURE_SIGMAS = 4.0
MAX_DRIFT = 0.1
MAX_FLICKER = 0.1
MAX_VISIT = 0.03
MAX_PLACEMENT = 0.05
MAX_INTENSITY_ERROR = 0.1
R_RESP_RANGE = (0.4, 3.0)
R_EXPO_RANGE = (-2.5, -0.4)


def check_amount(responses: Sequence[Response], placements: Sequence[Placement]) -> None:
    """Raise DataQualityError for a series that is too small for any answer."""
    if len(responses) < MIN_FRAMES:
        raise DataQualityError(
            f"{len(responses)} frames of the lamp are too few (limit {MIN_FRAMES}); take several exposures from short "
            "to long at each of several distances"
        )
    kinds = {len(response.mean_adu) for response in responses}
    if len(kinds) > 1:
        raise DataQualityError("some frames are grey and some in colour: give those of one camera and mode")
    levels = [placements[number].level for number in {response.placement for response in responses}]
    if max(levels) < MIN_LEVEL_RATIO * min(levels):
        raise DataQualityError(
            f"{len(levels)} level(s) of the lamp, all alike: from one level alone only r_expo / r_resp can be told, "
            "not r_resp; record several distances or levels (or see --free-levels)"
        )


def check_levels(visits: Visits, is_open: Mask) -> None:
    """Raise DataQualityError when what is neither saturated nor dark does not suffice."""
    if visits.is_clipped.all():
        raise DataQualityError("all frames of the lamp are saturated; expose shorter, or move the lamp away or dim it")
    if visits.is_faint.all():
        raise DataQualityError("all frames of the lamp are dark; cap off? lamp on? expose longer, or move it nearer")
    words = (
        f"of {visits.n} exposures, {int(visits.is_clipped.sum())} are saturated and {int(visits.is_faint.sum())} too "
        f"dark; {int(is_open.sum())} are left"
    )
    if is_open.sum() < MIN_VISITS:
        raise DataQualityError(f"{words}, {MIN_VISITS} are needed; take more exposures between dark and saturated")
    if np.ptp(visits.log_level[is_open]) < math.log10(MIN_LEVEL_RATIO):
        raise DataQualityError(
            f"{words}, all of one level of the lamp: only r_expo / r_resp can be told from it; record other distances "
            "or levels, with exposures that suit them"
        )
    if np.ptp(visits.log_exposure[is_open]) < math.log10(MIN_EXPOSURE_RATIO):
        raise DataQualityError(
            f"{words}, all of about the same exposure: r_expo cannot be told; take exposures from short to long"
        )


def check_exposure_range(exposures_s: Sequence[float], times_s: Sequence[float], range_s: tuple[float, float]) -> None:
    """Raise DataQualityError when exposures cannot be seconds.

    Parameters
    ----------
    times_s
        When the frames were begun, s, in the order of the exposures; NaN where nobody knows.
    range_s
        Exposures that the config expects of its cameras.
    """
    remedy = "give them in seconds, or name their unit with --exposure-unit"
    order = np.argsort(times_s)
    gap_s = np.diff(np.array(times_s)[order])
    if len(gap_s) and np.isfinite(gap_s).all():
        before_s = np.array(exposures_s)[order][:-1]
        if (gap_s < 0.5 * before_s).sum() > max(0.3 * len(gap_s), 2):
            raise DataQualityError(
                f"the exposures cannot be seconds: frames of up to {max(exposures_s):g} s were begun "
                f"{np.median(gap_s):.3g} s after one another; {remedy}"
            )
    shortest_s, longest_s = min(exposures_s), max(exposures_s)
    if shortest_s >= range_s[1] or longest_s > 30.0 * range_s[1] or longest_s < range_s[0] or shortest_s < 1e-6:
        raise DataQualityError(
            f"exposures from {shortest_s:g} to {longest_s:g} s, but the config expects {range_s[0]:g} to "
            f"{range_s[1]:g} s of this camera: are they milliseconds or microseconds? {remedy}"
        )


def check_exposure_units(data: LampData, names: Sequence[str]) -> NDArray[np.intp]:
    """Which visits lie far off any law, as indices.

    Raises DataQualityError when they do so as exposures in another unit would.
    """
    design = np.stack([data.log_level, data.log_exposure, np.ones_like(data.log_level)], axis=1)
    line = _line_of_most(design, data.log_share)
    away = data.log_share - design @ line
    odd = np.flatnonzero(np.abs(away) > ODD_DEX)
    growth = max(abs(float(line[1])), 0.2)
    in_unit = [int(i) for i in odd if abs(abs(away[i]) / growth - UNIT_DEX) < UNIT_ROOM_DEX]
    if in_unit and len(in_unit) > 0.5 * len(odd):
        some = ", ".join(names[i] for i in in_unit[:4])
        raise DataQualityError(
            f"{len(in_unit)} exposures look 1000 times as long or short as they say, from {some} on: milliseconds "
            "beside seconds? Give all of them in seconds"
        )
    if len(odd) < 0.5 * len(names):
        a, b = float(line[0]), float(line[1])
        refuse_no_law(1.0 / max(a, 1e-3), -b / max(a, 1e-3))
    return odd


def _line_of_most(design: Array, log_share: Array) -> Array:
    """The straight law, shape (3,), that most visits follow, however far off the others are.

    Of laws through three visits each, that with the least median departure; then by least squares of those near it.
    """
    rng = np.random.default_rng(0)  # which triples are tried is no choice of anybody's
    best: Array = np.zeros(3)
    least = math.inf
    for _ in range(N_TRIPLES):
        chosen = rng.choice(len(log_share), 3, replace=False)
        if np.linalg.cond(design[chosen]) > MAX_CONDITION:
            continue
        line = np.linalg.solve(design[chosen], log_share[chosen])
        departure = float(np.median(np.abs(log_share - design @ line)))
        if departure < least:
            best, least = np.asarray(line, dtype=np.float64), departure
    is_near = np.abs(log_share - design @ best) <= max(4.0 * least, 0.02)
    refined, *_ = np.linalg.lstsq(design[is_near], log_share[is_near], rcond=None)
    return np.asarray(refined, dtype=np.float64)


def refuse_no_law(r_resp: float, r_expo: float) -> None:
    """Raise DataQualityError for what no camera has."""
    if not (R_RESP_RANGE[0] <= r_resp <= R_RESP_RANGE[1] and R_EXPO_RANGE[0] <= r_expo <= R_EXPO_RANGE[1]):
        raise DataQualityError(
            f"r_resp = {r_resp:.3g}, r_expo = {r_expo:.3g} is no camera's law (limits {R_RESP_RANGE[0]:g} to "
            f"{R_RESP_RANGE[1]:g} and {R_EXPO_RANGE[0]:g} to {R_EXPO_RANGE[1]:g}): the levels or distances are wrong, "
            "or the lamp was seen as a disc, which does not get fainter with distance (put a diffuser before the lens)"
        )


def plateau_share(visits: Visits) -> tuple[float, bool]:
    """The response, as a share of full scale, that no exposure exceeds, and whether it was seen.

    It is full scale where pixels reach that; else where longer exposures of a placement show no more light.
    """
    if visits.is_clipped.any():
        return 1.0, True
    plateaus = []
    for placement in np.unique(visits.placement):
        own = np.flatnonzero(visits.placement == placement)
        own = own[np.argsort(visits.log_exposure[own])]
        for i, short in enumerate(own):
            longer = own[i + 1 :][visits.log_exposure[own[i + 1 :]] > visits.log_exposure[short] + math.log10(LONGER)]
            here = visits.largest_share[short]
            if not len(longer) or here <= MIN_PLATEAU_SHARE:
                continue
            if np.all(np.abs(visits.largest_share[longer] / here - 1.0) < SAME_RESPONSE):
                plateaus.append(float(visits.largest_share[longer].max()))
                break
    return (min(float(np.median(plateaus)), 1.0), True) if plateaus else (1.0, False)


def check_fit(fit: LawFit, visits: Visits, is_used: Mask, placements: Sequence[Placement]) -> None:
    """Raise DataQualityError for a fit that nobody should use, in the order of what explains most."""
    to_share = math.log(10.0)
    r_resp, r_expo = float(fit.parameters[0]), float(fit.parameters[1])
    growth = float(np.sum(fit.drift_dex * 0.5 ** np.arange(1, len(fit.drift_dex) + 1)))
    steps = np.linspace(-0.5, 0.5, 21)
    course = (
        np.sum([v * steps ** (p + 1) for p, v in enumerate(fit.drift_dex)], axis=0) if len(fit.drift_dex) else steps * 0
    )
    drift = float(np.ptp(course)) * to_share
    is_seen = bool(np.any(np.abs(fit.drift_dex) > SURE_SIGMAS * fit.drift_error_dex))
    if drift > MAX_DRIFT and is_seen:
        raise DataQualityError(
            f"the lamp {'grew' if growth > 0 else 'faded'} by {drift:.0%} during the series (limit {MAX_DRIFT:.0%}): "
            "let it warm up for half an hour, feed it from a stabilized supply, and record anew"
        )
    if visits.flicker_share > MAX_FLICKER:
        raise DataQualityError(
            f"the lamp flickers by {visits.flicker_share:.0%} from frame to frame (limit {MAX_FLICKER:.0%}): feed it "
            "with direct current"
        )
    refuse_no_law(r_resp, r_expo)
    _check_placements(fit, visits, is_used, placements)
    if fit.visit_dex * to_share > MAX_VISIT:
        raise DataQualityError(
            f"repeated exposures differ by {fit.visit_dex * to_share:.1%} (limit {MAX_VISIT:.0%}): the lamp jumps, or "
            "the camera's gain or exposure is automatic"
        )
    log_share, log_exposure = visits.log_share[is_used], visits.log_exposure[is_used]
    error = float(fit.intensity_error_dex(log_share, log_exposure).max()) * to_share
    if error > MAX_INTENSITY_ERROR:
        raise DataQualityError(
            f"intensities would be known within {error:.0%} only (limit {MAX_INTENSITY_ERROR:.0%}): record more "
            "levels, further apart"
        )


def _check_placements(fit: LawFit, visits: Visits, is_used: Mask, placements: Sequence[Placement]) -> None:
    """Levels that contradict one another; one that contradicts all others is named."""
    error = fit.placement_error_dex * math.log(10.0)
    numbers = np.unique(visits.placement[is_used])
    if fit.placement_dex * math.log(10.0) <= MAX_PLACEMENT or len(error) < 4:
        return
    worst = int(np.argmax(np.abs(error)))
    others = np.delete(error, worst)
    named = placements[int(numbers[worst])].words
    if abs(error[worst]) > 3.0 * float(others.std()):
        raise DataQualityError(
            f"{named}: shows {error[worst]:+.0%} of light against what the other levels expect: measure this distance "
            "or level again, or leave it out"
        )
    raise DataQualityError(
        f"the levels of the lamp contradict one another by {fit.placement_dex * math.log(10.0):.0%} (limit "
        f"{MAX_PLACEMENT:.0%}), {named} most: measure distances from the lamp to the diffuser, and shade the room's "
        "walls"
    )

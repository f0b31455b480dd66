"""When to stop: whether another correction is worth it, or has made it worse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

from namod_ctl.core.units import rad2_to_arcmin2
from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.store.campaign_rows import Cycle

NEAR_LIMIT = 1.03
"""Of the ray-traced limit: so near to it nobody sees a difference."""

WORTH_SHARE = 0.03
"""Of the area: a correction that promises less is not worth the motion."""

WORSE_SIGMAS = 3.0

VAGUE_SHARE = 0.15
"""Of the area: a measurement more uncertain than that (a facet may be lost from sight) proves nothing converged."""

KEPT_SHARE = 0.25
"""Of the area: where facets that may not be turned keep so much from being won, a person must look at them."""


class Decision(StrEnum):
    """What a campaign does after a measurement."""

    CORRECT = "correct"
    CONVERGED = "converged"
    WORSE = "worse"
    VAGUE = "vague"
    STUCK = "stuck"
    TOO_MANY = "too_many"


@dataclass(frozen=True, slots=True)
class Measurement:
    """The point spread function of one cycle.

    Attributes
    ----------
    now
        As it was measured.
    forecast
        As the correction that follows from this measurement would leave it.
    possible
        As it would be left if every facet could be turned; None when nobody has worked it out.
    is_trying
        Facets are tried whose faults are not understood yet.
    """

    now: AreaOfPsf
    forecast: AreaOfPsf
    possible: AreaOfPsf | None = None
    is_trying: bool = False

    @classmethod
    def of(cls, cycle: Cycle, forecast_uncertainty_rad2: float) -> Self:
        """The measurement that a cycle's row in the campaign remembers."""
        return cls(
            AreaOfPsf(cycle.a_sigma_now_rad2, cycle.a_sigma_uncertainty_rad2),
            AreaOfPsf(cycle.a_sigma_predicted_rad2, forecast_uncertainty_rad2),
        )


def decide(history: Sequence[Measurement], limit_rad2: float | None, max_cycles: int) -> tuple[Decision, str]:
    """The decision after the last of the measurements, and why, for a person.

    Nothing has converged that was hardly measured, nor while facets that may not be turned keep much from being won.

    `limit_rad2` is the area of these facets perfectly aligned where it is known, by ray tracing of measured
    mirrors; that of mirrors without errors is no such limit, as real ones never reach it.
    """
    decision, why = _decide(history, limit_rad2, max_cycles)
    last = history[-1]
    area = last.now.a_sigma_rad2
    if decision is not Decision.CONVERGED:
        return decision, why
    if last.now.uncertainty_rad2 > VAGUE_SHARE * area:
        return Decision.VAGUE, f"{_area(last.now)} is too uncertain to tell whether it has converged"
    kept = 0.0 if last.possible is None else last.forecast.a_sigma_rad2 - last.possible.a_sigma_rad2
    text = f"{_area(last.now)}: facets that may not be turned keep it from {_area(last.possible or last.now)}"
    if kept <= KEPT_SHARE * area:
        return decision, why
    if last.is_trying and len(history) <= max_cycles:
        return Decision.CORRECT, f"{text}; small moves will tell what is wrong with them"
    return Decision.STUCK, text


def _decide(history: Sequence[Measurement], limit_rad2: float | None, max_cycles: int) -> tuple[Decision, str]:
    last = history[-1]
    area, doubt = last.now.a_sigma_rad2, last.now.uncertainty_rad2
    text = _area(last.now)
    if len(history) > 1:
        before = history[-2]
        joint = math.hypot(doubt, before.now.uncertainty_rad2)
        if area - before.now.a_sigma_rad2 > max(WORSE_SIGMAS * joint, WORTH_SHARE * before.now.a_sigma_rad2):
            return Decision.WORSE, f"{text} after {_area(before.now)}: the correction has made it worse"
        expected = before.forecast
        as_before = abs(area - before.now.a_sigma_rad2) <= joint
        if as_before and abs(area - expected.a_sigma_rad2) <= math.hypot(doubt, expected.uncertainty_rad2):
            return Decision.CONVERGED, f"{text}: as in the cycle before, and as was expected"
    if limit_rad2 is not None and area <= NEAR_LIMIT * limit_rad2:
        limit = rad2_to_arcmin2(limit_rad2)
        return Decision.CONVERGED, f"{text} is within 3 % of the limit of these mirrors, {limit:.2f} arcmin2"
    gain = area - last.forecast.a_sigma_rad2
    least = max(math.hypot(doubt, last.forecast.uncertainty_rad2), WORTH_SHARE * area)
    if gain < least:
        return Decision.CONVERGED, (
            f"{text}: another correction promises {rad2_to_arcmin2(gain):.2f} arcmin2, less than can be told or is "
            f"worth the motion ({rad2_to_arcmin2(least):.2f})"
        )
    if len(history) > max_cycles:
        return Decision.TOO_MANY, f"{text} after {max_cycles} corrections: it does not converge"
    return Decision.CORRECT, f"{text}; a correction promises {_area(last.forecast)}"


def _area(area: AreaOfPsf) -> str:
    return f"{rad2_to_arcmin2(area.a_sigma_rad2):.2f} +- {rad2_to_arcmin2(area.uncertainty_rad2):.2f} arcmin2"

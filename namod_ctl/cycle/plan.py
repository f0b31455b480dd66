"""The preview of a correction: which leg goes where, which facets stay as they are and why, what is to be won."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.motion import MoveOrder
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import m_to_mm
from namod_ctl.reconstruction.alignment import AreaOfPsf, FacetAlignment
from namod_ctl.reconstruction.facet_psf import CENTRE, covariance_of_light
from namod_ctl.reconstruction.psf import area_predicted, light_of_fits
from namod_ctl.reconstruction.reconstruct import Reconstruction

Array = NDArray[np.float64]

Travel = Callable[[FacetAlignment], Mapping[Leg, float]]
"""Travels, m, of the drives that turn a facet as it needs; drives that the program has learned are wired elsewhere
belong to other legs than the config says."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a correction would do.

    Attributes
    ----------
    orders
        Of all legs that are to move, by facet and leg.
    turned
        Facets that these orders turn.
    refused
        Facets that stay as they are, and why, for a person.
    forecast
        Area of the point spread function afterwards, from the facets' own measured light.
    possible
        The same if every facet that was seen could be turned.
    tried
        Facets that stay as they are, but for a small move that will tell what is wrong with them.
    """

    orders: tuple[MoveOrder, ...]
    turned: tuple[int, ...]
    refused: Mapping[int, str]
    forecast: AreaOfPsf
    possible: AreaOfPsf | None = None
    tried: tuple[int, ...] = ()


def plan_correction(
    result: Reconstruction,
    travel_of: Travel,
    states: Mapping[Leg, DriveState | str],
    drives: Mapping[Leg, Drive],
    settings: MotionSettings,
    disabled: Mapping[int, str],
    trials: Mapping[int, Mapping[Leg, float]],
) -> Plan:
    """The correction of an alignment by motors. A facet is turned by all of its legs or not at all.

    Parameters
    ----------
    states
        Of all drives now; a text says why a drive does not answer.
    disabled
        Facets that must not be corrected, and why.
    trials
        Small travels of disabled facets that will tell what is wrong with them.
    """
    orders: list[MoveOrder] = []
    refused: dict[int, str] = {}
    turned: list[int] = []
    for facet in result.alignment.facets:
        reason = disabled.get(facet.facet_id) or _reason_of_flags(facet)
        travels: Mapping[Leg, float] = {} if reason else travel_of(facet)
        reason = reason or _reason_of_drives(travels, states, drives, settings)
        if reason:
            refused[facet.facet_id] = reason
            continue
        turned.append(facet.facet_id)
        orders += _orders(travels, states, drives)
    taken = {order.leg for order in orders}
    tried = []
    for facet_id, travels in trials.items():
        can_move = not _reason_of_drives(travels, states, drives, settings) and not taken.intersection(travels)
        if facet_id in disabled and can_move:
            tried.append(facet_id)
            refused[facet_id] += "; a small move tries what is wrong with it"
            orders += _orders(travels, states, drives)
    possible = forecast(result, [facet.facet_id for facet in result.alignment.facets])
    return Plan(tuple(orders), tuple(turned), refused, forecast(result, turned), possible, tuple(tried))


def forecast(
    result: Reconstruction, turned: Sequence[int], turning_cov_rad2: Callable[[int], Array] | None = None
) -> AreaOfPsf:
    """Area when the facets `turned` throw the centre of their light on the axis and the others stay.

    From each facet's light as it was measured: a facet's own figure errors, which no alignment mends, are in it.
    `turning_cov_rad2` tells the covariance (2, 2) of Theta that turning a facet leaves behind.
    """
    seen = [
        (facet, fit)
        for facet, fit in zip(result.alignment.facets, result.fits, strict=True)
        if fit is not None and not facet.flags & FacetFlag.NO_SIGNAL
    ]
    light = light_of_fits([fit for _, fit in seen])
    is_turned = np.array([facet.facet_id in set(turned) for facet, _ in seen])
    left_rad = np.array([fit.parameters[CENTRE] for _, fit in seen]) - result.alignment.axis_rad
    left_cov = np.nan_to_num(np.array([facet.theta_cov_rad2 for facet, _ in seen]))
    if turning_cov_rad2 is not None:
        left_cov = left_cov + [turning_cov_rad2(facet.facet_id) for facet, _ in seen]
    cov = np.array([covariance_of_light(fit.parameters) for _, fit in seen])
    return area_predicted(light.flux, cov, np.where(is_turned[:, None], 0.0, left_rad), left_cov)


def _orders(
    travels: Mapping[Leg, float], states: Mapping[Leg, DriveState | str], drives: Mapping[Leg, Drive]
) -> list[MoveOrder]:
    """Orders of legs whose drives are known to be well; a travel of less than half a step is none."""
    orders = []
    for leg, travel_m in sorted(travels.items()):
        state = states[leg]
        assert isinstance(state, DriveState)  # the others were refused
        if abs(travel_m) >= drives[leg].resolution_m / 2.0:
            orders.append(MoveOrder(leg, state.position_m, state.position_m + travel_m))
    return orders


def _reason_of_flags(facet: FacetAlignment) -> str:
    if not facet.flags.forbids_turning:
        return ""
    names = [flag for flag in FacetFlag if flag & facet.flags and flag.forbids_turning]
    return "; ".join(f"{flag.name}: {FACET_FLAG_MEANING[flag]}" for flag in names)


def _reason_of_drives(
    travels: Mapping[Leg, float],
    states: Mapping[Leg, DriveState | str],
    drives: Mapping[Leg, Drive],
    settings: MotionSettings,
) -> str:
    """Why these legs may not travel so far; empty when they may."""
    reasons = []
    if not travels:
        reasons.append("it has no drives")
    for leg, travel_m in sorted(travels.items()):
        name = f"leg {leg.index + 1}"
        state = states.get(leg)
        if state is None:
            reasons.append(f"{name}: no drive is wired to it")
        elif isinstance(state, str):
            reasons.append(f"{name}: {state}")
        elif state.faults:
            reasons.append(f"{name}: {', '.join(state.faults)}")
        elif state.is_moving:
            reasons.append(f"{name}: its drive is moving")
        elif not state.is_homed or math.isnan(state.position_m):
            reasons.append(f"{name}: its drive is not homed; namod-ctl actuators home")
        elif not math.isfinite(travel_m):
            reasons.append(f"{name}: no travel is known for it")
        elif abs(travel_m) > settings.max_travel_per_cycle_m:
            limit_mm = m_to_mm(settings.max_travel_per_cycle_m)
            reasons.append(f"{name}: {m_to_mm(travel_m):+.3f} mm is beyond the {limit_mm:.3f} mm allowed in one cycle")
        else:
            low_m, high_m = drives[leg].range_m
            target_m = state.position_m + travel_m
            if not low_m <= target_m <= high_m:
                reasons.append(
                    f"{name}: its target {m_to_mm(target_m):+.3f} mm is outside its range of "
                    f"{m_to_mm(low_m):+.3f} to {m_to_mm(high_m):+.3f} mm"
                )
    return "; ".join(reasons)

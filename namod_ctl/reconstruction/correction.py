"""From misalignments to corrections: tilts, leg travels and bolt turns, and refusals with their reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.flags import FACET_FLAG_MEANING, FacetFlag
from namod_ctl.core.units import rad_to_deg
from namod_ctl.optics.coordinates import correction_of_theta
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FacetCorrection:
    """What is to be done to one facet.

    Attributes
    ----------
    tilt_correction_rad
        Shape (2,). Phi, to be added to the facet's normal; NaN without an estimate.
    leg_travel_m
        Shape (n_legs,). NaN where the facet must not be moved.
    bolt_turn_deg
        Shape (n_legs,), or empty for a mount without bolts. Positive clockwise as seen by the person who turns,
        not rounded; NaN where nobody should turn.
    flags
        The flags of the estimate, and those of the correction.
    remarks
        Lines for a person: why there is nothing to turn, or why turning is refused.
    """

    tilt_correction_rad: Array
    leg_travel_m: Array
    bolt_turn_deg: Array
    flags: FacetFlag
    remarks: tuple[str, ...]


def common_centre(theta_rad: Array, flux: Array) -> Array:
    """Light-weighted common centre of all facets, shape (2,), rad: the aim that moves bolts least.

    Parameters
    ----------
    theta_rad
        Shape (n_facets, 2). Star direction at which each facet is brightest; NaN without an estimate.
    flux
        Shape (n_facets,). Light of each facet. A facet of no, negative or unknown (NaN) flux has no say.

    Raises
    ------
    DataQualityError
        When no facet has a say.
    """
    has_say = np.all(np.isfinite(theta_rad), axis=1) & np.isfinite(flux) & (np.nan_to_num(flux) > 0.0)
    if not np.any(has_say):
        raise DataQualityError(
            "no facet has both an estimate and light, so there is no common centre to aim at: record again, or "
            "calibrate the star camera's optical axis"
        )
    centre: Array = np.average(theta_rad[has_say], axis=0, weights=flux[has_say])
    return centre


def correct(
    instrument: Instrument,
    facet_ids: Sequence[int],
    theta_rad: Array,
    flags: Sequence[FacetFlag],
    axis_rad: Array,
) -> tuple[FacetCorrection, ...]:
    """The correction of every facet, in the order of `facet_ids`.

    Parameters
    ----------
    theta_rad
        Shape (n_facets, 2). Star direction at which each facet is brightest, telescope frame; NaN without an estimate.
    flags
        What stands against each estimate. A facet whose flags forbid turning gets no travels and no turns.
    axis_rad
        Shape (2,). Direction to aim at: (0, 0) for a calibrated optical axis, else the `common_centre`.

    Raises
    ------
    ConfigError
        When a facet id has no mount in the instrument, or its mount cannot tilt it.
    """
    unknown = [facet_id for facet_id in facet_ids if facet_id not in instrument.mounts]
    if unknown:
        raise ConfigError(
            f"{instrument.name}: no mount for facet ids {unknown}; known are {sorted(instrument.mounts)}: "
            f"use the config of the telescope that was recorded"
        )
    tilts_rad = correction_of_theta(np.asarray(theta_rad, dtype=np.float64) - np.asarray(axis_rad, dtype=np.float64))
    goniometer_deg = rad_to_deg(instrument.goniometer_resolution_rad)
    return tuple(
        _correct_facet(facet_id, instrument.mounts[facet_id], tilt, flag, goniometer_deg)
        for facet_id, tilt, flag in zip(facet_ids, tilts_rad, flags, strict=True)
    )


def _correct_facet(
    facet_id: int, mount: Mount, tilt_rad: Array, flags: FacetFlag, goniometer_deg: float
) -> FacetCorrection:
    mount.check_geometry(f"mount of facet {facet_id}")
    if not np.all(np.isfinite(tilt_rad)):
        flags |= FacetFlag.NO_SIGNAL
    if flags & FacetFlag.NO_SIGNAL:
        tilt_rad = np.full(2, np.nan)
    travel_m = mount.travel_of_tilt(tilt_rad)
    remarks = [
        f"facet {facet_id}: do not turn: {FACET_FLAG_MEANING[reason]}"
        for reason in (FacetFlag.NO_SIGNAL, FacetFlag.UNRELIABLE)
        if flags & reason
    ]
    violations = mount.limit_violations(travel_m)
    if violations:
        flags |= FacetFlag.BEYOND_TRAVEL_LIMIT
        remarks += [f"facet {facet_id}: do not turn: {violation}" for violation in violations]
    if flags.forbids_turning:
        travel_m = np.full_like(travel_m, np.nan)
    turn_deg = mount.turn_deg_of_travel(travel_m)
    if len(turn_deg) and np.all(np.abs(turn_deg) <= 0.5 * goniometer_deg):
        remarks.append(
            f"facet {facet_id}: no turn needed: all turns are within half the goniometer's resolution of "
            f"{goniometer_deg:g} deg"
        )
    return FacetCorrection(tilt_rad, travel_m, turn_deg, flags, tuple(remarks))

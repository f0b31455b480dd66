"""Applying a look-up table: preview, approval, motion, and what came of it."""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Console

from namod_ctl.app.approval import ask_before_moving
from namod_ctl.app.build.lut_motion import TableRig, open_table_rig
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.end_signals import ended_in_order
from namod_ctl.app.views.actuator_tables import table_of_orders
from namod_ctl.app.views.number_ranges import counted
from namod_ctl.calibration.gravity.gravity_table import GravityTable, Side
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import deg_to_rad, m_to_mm, rad_to_deg
from namod_ctl.cycle.correct import StopAsked
from namod_ctl.cycle.plan import Plan
from namod_ctl.cycle.table_move import (
    Baseline,
    TablePlan,
    halted_legs,
    moved_legs,
    note_zenith,
    noted_baseline,
    noted_zenith_deg,
    plan_table_move,
    take_baseline,
)
from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.store.campaign_rows import Cycle
from namod_ctl.twin.settings import TwinSettings

_MOST_SHOWN, _MOST_MOVED = 30, 5
"""Signals that end the program in good order; the second comes when a terminal is closed or a line to it is lost."""
_SAME_ZENITH_RAD = deg_to_rad(0.05)


def apply_table(
    table: GravityTable,
    config: InstrumentConfig,
    to_rad: float,
    aligned_at_rad: float | None,
    side: Side | None,
    journal: Path,
    twin: tuple[TwinSettings, int] | None,
    console: Console,
    *,
    is_yes: bool,
) -> bool:
    """Turn the facets to zenith distance `to_rad`; False when not all of them went there.

    Parameters
    ----------
    aligned_at_rad
        The facets stand now as they were aligned at this zenith distance; None: the journal knows.
    side
        From which the telescope comes.

    Raises
    ------
    ConfigError
        Nobody knows where the facets were aligned, or legs were moved since; nothing has moved.
    """
    rig_of = open_table_rig(journal, config, SystemClock(), twin, is_new=aligned_at_rad is not None)
    with rig_of as rig, ended_in_order():
        if rig.twin is not None:
            console.print("The digital twin: a rehearsal, nothing real is moved.")
        if unfinished := rig.store.unfinished_orders():
            words = f"{counted(len(unfinished), 'leg')} had orders when the program was killed"
            ask_before_moving(f"{words}; those that stand on their way are brought to their end. Go on?", is_yes=is_yes)
        rig.corrector.recover(rig.poll)
        for remark in rig.corrector.check():
            console.print(remark, markup=False, style="yellow")
        baseline = _baseline(rig, aligned_at_rad, journal)
        plan = _plan(table, rig, baseline, to_rad, side)
        console.print(
            f"Facets were aligned at {rad_to_deg(baseline.zenith_rad):g} deg from zenith and stand "
            f"{_standing(rig)}; to go to {rad_to_deg(to_rad):g} deg."
        )
        _show(plan, table, baseline.zenith_rad, to_rad, console)
        if plan.orders:
            ask_before_moving(f"{counted(len(plan.orders), 'leg')} to move. Go on?", is_yes=is_yes)
            is_complete = _carry_out(rig, plan, to_rad, console)
        else:
            if not plan.refused:
                note_zenith(rig.store, to_rad)
                console.print("Nothing is to be moved: the facets stand as the table wants them.")
            is_complete = True
        _tell_truth(rig, to_rad, console)
        return is_complete and not plan.refused


def _standing(rig: TableRig) -> str:
    stands_for_deg = noted_zenith_deg(rig.store)
    return "in between, after a stop" if stands_for_deg is None else f"for {stands_for_deg:g} deg"


def _baseline(rig: TableRig, aligned_at_rad: float | None, journal: Path) -> Baseline:
    """Where the facets were aligned: what the journal knows, or what is said now and does not contradict it."""
    states = rig.mover.read_states()
    known = noted_baseline(rig.store)
    moved = [] if known is None else moved_legs(rig.store, known, states, 2.0 * rig.settings.arrival_tolerance_m)
    if aligned_at_rad is None:
        if known is None:
            raise ConfigError(
                f"{journal}: nobody knows at which zenith distance the facets were aligned as they stand: say it once, "
                "--aligned-at-deg 30"
            )
        if moved:
            raise ConfigError(
                f"{counted(len(moved), 'leg')} moved since, not by the table: {'; '.join(moved[:_MOST_MOVED])}. What "
                "they stand for now nobody knows: align anew, and say at which zenith distance that was: "
                "--aligned-at-deg"
            )
        return known
    if known is not None and not moved:
        if math.isclose(known.zenith_rad, aligned_at_rad, abs_tol=_SAME_ZENITH_RAD):
            return known  # the same words again, not the same legs
        stands_for_deg = noted_zenith_deg(rig.store)
        if stands_for_deg is None or abs(stands_for_deg - rad_to_deg(aligned_at_rad)) > rad_to_deg(_SAME_ZENITH_RAD):
            now = "in between" if stands_for_deg is None else f"for {stands_for_deg:g} deg"
            raise ConfigError(
                f"--aligned-at-deg {rad_to_deg(aligned_at_rad):g}: {journal} knows that the facets were aligned at "
                f"{rad_to_deg(known.zenith_rad):g} deg and that the table turned them since; they stand {now} and "
                "nobody else moved them. Leave --aligned-at-deg out, or name another --journal if that is wrong"
            )
    if rig.twin is not None:
        for _ in range(2):  # the first one is good to second order in the misalignment
            rig.twin.apply_correction(rig.twin.reflector.correction_at_rad(aligned_at_rad))
    return take_baseline(rig.store, aligned_at_rad, states)


def _plan(table: GravityTable, rig: TableRig, baseline: Baseline, to_rad: float, side: Side | None) -> TablePlan:
    tilts = table.tilt_change_rad(baseline.zenith_rad, to_rad, side)
    travels = {
        Leg(facet_id, index): float(travel_m)
        for facet_id, tilt in zip(table.facet_ids, tilts, strict=True)
        for index, travel_m in enumerate(rig.instrument.mounts[facet_id].travel_of_tilt(tilt))
    }
    return plan_table_move(travels, baseline, rig.mover.read_states(), rig.drives, rig.settings, halted_legs(rig.store))


def _show(plan: TablePlan, table: GravityTable, aligned_at_rad: float, to_rad: float, console: Console) -> None:
    limit = table.limit_rad2()
    left = float(table.area_rad2(table.change_rad(aligned_at_rad, to_rad))) / limit
    for facet_id, reason in plan.refused.items():
        console.print(f"Facet {facet_id} stays as it is: {reason}", markup=False, style="yellow")
    if not plan.orders:
        return
    if len(plan.orders) <= _MOST_SHOWN:
        console.print(table_of_orders(plan.orders))
    ways = [order.target_m - order.start_m for order in plan.orders]
    console.print(
        f"{counted(len(plan.turned), 'facet')} to turn by {counted(len(ways), 'leg')}, ways from "
        f"{m_to_mm(min(ways)):+.4f} to {m_to_mm(max(ways)):+.4f} mm. Without the table A_sigma would be {left:.3f} "
        "times its limit at that zenith distance."
    )


def _carry_out(rig: TableRig, plan: TablePlan, to_rad: float, console: Console) -> bool:
    unknown = AreaOfPsf(math.nan, math.nan)
    approved = Plan(plan.orders, plan.turned, plan.refused, unknown)
    if changed := rig.corrector.changed_since(approved):
        raise ConfigError(f"nothing was moved: {changed}; apply the table again")
    cycle = rig.store.begin_cycle()
    decision = f"look-up table, {rad_to_deg(to_rad):g} deg from zenith"
    rig.store.save_cycle(Cycle(cycle, "", 0, math.nan, math.nan, math.nan, math.nan, None, decision))
    rig.store.add_event("lut_apply", decision, {"cycle": cycle, "zenith_deg": rad_to_deg(to_rad)})
    note_zenith(rig.store, None)  # until all have arrived
    try:
        with console.status(f"{counted(len(plan.orders), 'leg')} on the way; Ctrl-C stops all drives"):
            summary = rig.corrector.carry_out(cycle, approved, rig.poll)
    except StopAsked as stop:
        _tell_stopped(rig, cycle, str(stop), console)
        return False
    except (KeyboardInterrupt, SystemExit) as end:  # the drives were stopped on the way here
        _tell_stopped(rig, cycle, "Ctrl-C" if isinstance(end, KeyboardInterrupt) else "the program was ended", console)
        raise
    rig.store.add_event("lut_applied", summary, {"cycle": cycle})
    is_complete = summary == f"{len(plan.orders)} of {len(plan.orders)} legs arrived"
    if is_complete:
        note_zenith(rig.store, to_rad)
    console.print(f"{summary}. On record in {rig.store.path}", markup=False)
    return is_complete


def _tell_stopped(rig: TableRig, cycle: int, why: str, console: Console) -> None:
    rig.store.add_event("lut_stopped", why, {"cycle": cycle})
    console.print(f"Stopped: {why}. Legs stand where they were halted, which is on record; apply it again to go on.")


def _tell_truth(rig: TableRig, to_rad: float, console: Console) -> None:
    """What the image of a twin is now, at the zenith distance that it was turned for."""
    if rig.twin is None:
        return
    rig.twin.update(rig.twin.clock.monotonic_s())
    reflector = rig.twin.reflector
    ratio = reflector.a_sigma_at_rad2(to_rad) / reflector.a_sigma_aligned_rad2()
    console.print(
        f"The twin's truth: at {rad_to_deg(to_rad):g} deg A_sigma is {ratio:.3f} times that of the same facets "
        "perfectly aligned."
    )

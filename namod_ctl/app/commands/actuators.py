"""`namod-ctl actuators`: look at the drives, move them by hand, stop them, test them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from namod_ctl.app.approval import ask_before_moving
from namod_ctl.app.build.actuators import build_bus_settings, build_motion_settings, open_actuators
from namod_ctl.app.build.twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.end_signals import ended_in_order
from namod_ctl.app.views.actuator_tables import (
    identity_lines,
    legs_named,
    table_of_drives,
    table_of_orders,
    table_of_results,
    table_of_tests,
    table_of_words,
)
from namod_ctl.app.views.number_ranges import counted, legs_in_words
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.drives import Drive, DriveState, Leg
from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.interfaces import MonotonicClock
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult, StopSwitch
from namod_ctl.core.motion_settings import MotionSettings
from namod_ctl.core.units import m_to_mm, mm_to_m
from namod_ctl.cycle.leg_course import refusal
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.selftest import self_test
from namod_ctl.devices.buses import open_bus
from namod_ctl.twin.clock import ManualClock
from namod_ctl.twin.drives import TwinDrives
from namod_ctl.twin.faults import FaultPlan

DEFAULT_CONFIG = "fact_actuated"
TWIN_SEED = 1
_STOP_REASON = "namod-ctl actuators stop"
EXIT_INCOMPLETE = 1
"""Not every leg did what it was asked to do."""
TEST_TRAVEL_MM = 0.1
MAX_TEST_TRAVEL_MM = 2.0

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Look at the drives of the legs, move, stop, test.",
    epilog="Example: namod-ctl actuators list --twin",
)

_Config = Annotated[str, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.")]
_IsTwin = Annotated[
    bool, typer.Option("--twin", help="A digital twin of the drives instead, new at every call, in its own time.")
]
_Legs = Annotated[
    list[str] | None, typer.Argument(metavar="[LEG]...", help="13.2 is leg 2 of facet 13, 13 all its legs.")
]
_IsAll = Annotated[bool, typer.Option("--all", help="All legs that have a drive.")]
_IsYes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before anything moves.")]


@dataclass(frozen=True, slots=True)
class _Rig:
    mover: Mover
    settings: MotionSettings
    console: Console
    bus_names: Mapping[Leg, str]
    drives: Mapping[Leg, Drive]

    def chosen(self, names: list[str] | None, *, is_all: bool) -> tuple[Leg, ...]:
        if bool(names) == is_all:
            raise ConfigError("name the legs, such as 13.2, or say --all for all of them")
        return self.mover.legs if is_all else legs_named(names or [], self.mover.legs)


@app.command("list")
def list_drives(config: _Config = DEFAULT_CONFIG, twin: _IsTwin = False) -> None:
    """Ask every drive of the config how it is; nothing moves.

    Example: namod-ctl actuators list --twin
    """
    with _rig(config, is_twin=twin) as rig:
        states = rig.mover.read_states()
        answering = [leg for leg, state in states.items() if not isinstance(state, str)]
        identities = rig.mover.identities(answering)
        names = {leg: rig.mover.drive_name(leg) for leg in states}
        rig.console.print(table_of_drives(states, names, rig.bus_names))
        for line in identity_lines(identities):
            rig.console.print(line, soft_wrap=True)
        n_ready = sum(
            isinstance(state, DriveState) and state.is_homed and not state.faults for state in states.values()
        )
        rig.console.print(f"{n_ready} of {counted(len(states), 'drive')} ready to move")
    _leave(is_complete=n_ready == len(states))


@app.command()
def home(
    legs: _Legs = None,
    all_: _IsAll = False,
    config: _Config = DEFAULT_CONFIG,
    twin: _IsTwin = False,
    yes: _IsYes = False,
) -> None:
    """Bring drives to their reference switches: after that they know where they are.

    Example: namod-ctl actuators home 13 --twin
    """
    with _rig(config, is_twin=twin) as rig:
        chosen = rig.chosen(legs, is_all=all_)
        states = rig.mover.read_states(chosen)
        rig.console.print(table_of_words("stands at", {leg: _standing(state) for leg, state in states.items()}))
        ask_before_moving(
            f"{counted(len(chosen), 'leg')} to be brought to the reference, wherever that is. Go on?", is_yes=yes
        )
        homed = rig.mover.home(chosen, lambda: None)
        rig.console.print(table_of_words("result", {leg: words or "homed" for leg, words in homed.items()}))
    _leave(is_complete=not any(homed.values()))


@app.command()
def move(
    legs: _Legs = None,
    to_mm: Annotated[float, typer.Option(help="Position along the leg, +z, from the drive's reference.")] = ...,  # type: ignore[assignment]
    all_: _IsAll = False,
    config: _Config = DEFAULT_CONFIG,
    twin: _IsTwin = False,
    yes: _IsYes = False,
) -> None:
    """Bring legs to a position. A facet moves whole or not at all.

    Example: namod-ctl actuators move 13 --to-mm 0.5 --twin
    """
    _refuse_no_number("--to-mm", to_mm)
    _carry_out(legs, lambda now_m: mm_to_m(to_mm), config, is_all=all_, is_twin=twin, is_yes=yes)


@app.command()
def jog(
    legs: _Legs = None,
    by_mm: Annotated[float, typer.Option(help="Travel along the leg, +z.")] = ...,  # type: ignore[assignment]
    all_: _IsAll = False,
    config: _Config = DEFAULT_CONFIG,
    twin: _IsTwin = False,
    yes: _IsYes = False,
) -> None:
    """Move legs by some way from where they stand. A facet moves whole or not at all.

    Example: namod-ctl actuators jog 13.2 --by-mm -0.05 --twin
    """
    _refuse_no_number("--by-mm", by_mm)
    _carry_out(legs, lambda now_m: now_m + mm_to_m(by_mm), config, is_all=all_, is_twin=twin, is_yes=yes)


@app.command()
def stop(config: _Config = DEFAULT_CONFIG, twin: _IsTwin = False) -> None:
    """Halt every drive of the config, on all lines that can be opened. While a campaign holds them: namod-ctl stop.

    Example: namod-ctl actuators stop
    """
    problems: list[str] = []
    if twin:
        with _rig(config, is_twin=True) as rig:
            words = rig.mover.stop_all(_STOP_REASON)
    else:
        words, problems = _stop_hardware(load_config(config))
    console = Console(highlight=False)
    console.print(table_of_words("result", words))
    if problems:
        raise ConfigError("\n".join(["these lines can not be opened, their drives were not stopped:", *problems]))
    _leave(is_complete=all(line.startswith("stands") for line in words.values()))


@app.command()
def selftest(
    legs: _Legs = None,
    all_: _IsAll = False,
    travel_mm: Annotated[
        float, typer.Option(min=0.01, max=MAX_TEST_TRAVEL_MM, help="So far each leg goes, and back.")
    ] = TEST_TRAVEL_MM,
    config: _Config = DEFAULT_CONFIG,
    twin: _IsTwin = False,
    yes: _IsYes = False,
) -> None:
    """Move each leg a little and back: does it get there, and do all others on its line stand still?

    The play of spindles can not be measured with drives that tell one position only.

    Example: namod-ctl actuators selftest 13 --twin
    """
    with _rig(config, is_twin=twin) as rig:
        chosen = rig.chosen(legs, is_all=all_)
        ask_before_moving(
            f"{counted(len(chosen), 'leg')} to go {travel_mm:g} mm up and back, one after the other. Go on?", is_yes=yes
        )
        tests = []
        with rig.console.status("") as status:
            for test in self_test(rig.mover, chosen, mm_to_m(travel_mm), rig.settings, lambda: None):
                tests.append(test)
                status.update(f"{len(tests)} of {counted(len(chosen), 'leg')} tested")
        rig.console.print(table_of_tests(tests))
        n_passed = sum(test.has_passed for test in tests)
        for line in identity_lines({test.leg: test.identity for test in tests}):
            rig.console.print(line, soft_wrap=True)
        rig.console.print(
            f"{n_passed} of {counted(len(chosen), 'leg')} passed. Play was not measured: drives tell one position."
        )
    _leave(is_complete=n_passed == len(chosen))


def _carry_out(
    names: list[str] | None,
    target_of: Callable[[float], float],
    config: str,
    *,
    is_all: bool,
    is_twin: bool,
    is_yes: bool,
) -> None:
    with _rig(config, is_twin=is_twin) as rig:
        states = rig.mover.read_states(rig.chosen(names, is_all=is_all))
        silent = {leg: state for leg, state in states.items() if isinstance(state, str)}
        if silent:
            rig.console.print(table_of_words("does not answer", silent))
            raise ConfigError(
                f"{len(silent)} of {counted(len(states), 'drive')} without an answer: nothing was moved; look at power "
                "and cable, or name the other legs only"
            )
        orders = [
            MoveOrder(leg, state.position_m, target_of(state.position_m))
            for leg, state in states.items()
            if isinstance(state, DriveState)
        ]
        rig.console.print(table_of_orders(orders))
        refused = _refused(rig, orders, states)
        allowed = [order for order in orders if order.leg not in refused]
        if refused:
            rig.console.print(table_of_words("refused", refused))
        if not allowed:
            rig.console.print("nothing was moved")
            _leave(is_complete=False)
        ask_before_moving(f"{counted(len(allowed), 'leg')} to move. Go on?", is_yes=is_yes)
        results = _execute(rig, allowed)
        rig.console.print(table_of_results(results))
    _leave(is_complete=not refused and all(result.outcome is MoveOutcome.ARRIVED for result in results))


def _refused(rig: _Rig, orders: Sequence[MoveOrder], states: Mapping[Leg, DriveState | str]) -> dict[Leg, str]:
    """Why legs will not move, before anybody is asked to agree: their own reasons, or a leg's of their facet."""
    own: dict[Leg, str] = {}
    for order in orders:
        state, way_m, most_m = states[order.leg], order.target_m - order.start_m, rig.settings.max_travel_per_cycle_m
        if isinstance(state, DriveState) and (words := refusal(order, state, rig.drives[order.leg], rig.settings)):
            low_m, high_m = rig.mover.range_m(order.leg)
            is_too_far = state.is_homed and not state.faults and not state.is_moving and abs(way_m) > most_m
            own[order.leg] = (
                f"{m_to_mm(abs(way_m)):.4f} mm is more than the {m_to_mm(most_m):.4f} mm that one move may be; its "
                f"range is {m_to_mm(low_m):.4f} to {m_to_mm(high_m):.4f} mm"
                if is_too_far
                else words
            )
    first_of_facet: dict[int, Leg] = {}
    for leg in own:
        first_of_facet.setdefault(leg.facet_id, leg)
    return {
        order.leg: own.get(order.leg)
        or f"its facet moves whole or not at all, and leg {first_of_facet[order.leg.facet_id].index + 1} is refused"
        for order in orders
        if order.leg.facet_id in first_of_facet
    }


def _stop_hardware(config: InstrumentConfig) -> tuple[dict[Leg, str], list[str]]:
    """What became of each drive, and lines that cannot be opened. Nothing is said on a line before the stop."""
    problems = []
    with ExitStack() as stack:
        buses = []
        for settings in build_bus_settings(config):
            try:
                bus = open_bus(settings)
            except (ConfigError, CommunicationError) as problem:
                problems.append(f"bus {settings.name!r}: {problem}")
            else:
                stack.callback(bus.close)
                buses.append(bus)
        mover = Mover(buses, SystemMonotonicClock(), build_motion_settings(config), StopSwitch())
        return mover.stop_all(_STOP_REASON), problems


def _execute(rig: _Rig, orders: Sequence[MoveOrder]) -> list[MoveResult]:
    told: list[MoveResult] = []
    try:
        with rig.console.status(f"{counted(len(orders), 'leg')} on the way; Ctrl-C stops all drives"):
            return rig.mover.execute(orders, told.append, lambda: None)
    except (KeyboardInterrupt, SystemExit):
        rig.console.print(table_of_results(told))
        raise


@contextmanager
def _rig(config: str, *, is_twin: bool) -> Iterator[_Rig]:
    """The drives of a config, or of a twin of it, and a mover; signals that end the program stop as Ctrl-C does."""
    loaded = load_config(config)
    settings = build_motion_settings(loaded)
    console = Console(highlight=False)
    with ExitStack() as stack:
        clock: MonotonicClock
        if is_twin:
            manual = ManualClock()
            clock = manual
            drives = TwinDrives(twin_wiring(loaded), manual, FaultPlan(), TWIN_SEED)
            buses = stack.enter_context(build_twin_actuators(loaded, drives))
        else:
            clock = SystemMonotonicClock()
            try:
                buses = stack.enter_context(open_actuators(loaded))
            except ConfigError as problem:
                raise ConfigError(f"{problem}\nTo try the command without hardware, add --twin") from None
        for bus in buses:
            if bus.unreachable:
                legs = legs_in_words(bus.unreachable)
                console.print(Text(f"{bus.name}: no proper answer from {legs}", style="yellow"), soft_wrap=True)
        stack.enter_context(ended_in_order())
        prefix = "twin/" if is_twin else ""
        bus_names = {drive.leg: f"{prefix}{bus.name}" for bus in build_bus_settings(loaded) for drive in bus.drives}
        drives_of_legs = {leg: drive for bus in buses for leg, drive in bus.drives.items()}
        yield _Rig(Mover(buses, clock, settings, StopSwitch()), settings, console, bus_names, drives_of_legs)


def _refuse_no_number(option: str, length_mm: float) -> None:
    if not math.isfinite(length_mm):
        raise ConfigError(f"{option} {length_mm}: is no length; give a number of mm")


def _standing(state: DriveState | str) -> str:
    if isinstance(state, str):
        return state
    return f"{m_to_mm(state.position_m):.4f} mm" if state.is_homed else "an unknown place: not homed"


def _leave(*, is_complete: bool) -> None:
    if not is_complete:
        raise typer.Exit(EXIT_INCOMPLETE)

"""Legs as people name them, and tables of what drives say and do."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from rich.table import Table
from rich.text import Text

from namod_ctl.app.views.number_ranges import legs_in_words, runs_in_words
from namod_ctl.core.drives import DriveState, Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion import MoveOrder, MoveOutcome, MoveResult
from namod_ctl.core.units import k_to_celsius, m_to_mm
from namod_ctl.cycle.selftest import LegTest

_LEG = re.compile(r"(?P<facet>[0-9]+)(\.(?P<leg>[0-9]+))?")


def short_name(leg: Leg) -> str:
    """Facet and leg, which is counted from 1: "13.2"."""
    return f"{leg.facet_id}.{leg.index + 1}"


def legs_named(names: Sequence[str], known: Iterable[Leg]) -> tuple[Leg, ...]:
    """Legs by their names: "13.2" is one leg, "13" all legs of a facet; each once, in the order of the names.

    Raises
    ------
    ConfigError
        A name is not understood, or there is no drive; says which there are.
    """
    legs = sorted(known)
    found: dict[Leg, None] = {}
    for name in names:
        match = _LEG.fullmatch(name)
        if match is None:
            raise ConfigError(f"{name!r} names no leg: write FACET.LEG, such as 13.2, or FACET for all its legs")
        facet_id = int(match["facet"])
        index = None if match["leg"] is None else int(match["leg"]) - 1
        chosen = [leg for leg in legs if leg.facet_id == facet_id and index in (None, leg.index)]
        if not chosen:
            of_facet = [short_name(leg) for leg in legs if leg.facet_id == facet_id]
            facet_ids = [leg.facet_id for leg in legs]
            there = f"legs {', '.join(of_facet)}" if of_facet else f"facets {runs_in_words(facet_ids)}"
            raise ConfigError(f"leg {name}: the config has no drive for it; with drives there are {there}")
        found.update(dict.fromkeys(chosen))
    return tuple(found)


def table_of_drives(
    states: Mapping[Leg, DriveState | str], names: Mapping[Leg, str], bus_names: Mapping[Leg, str]
) -> Table:
    """What each drive says of itself; a bus goes by its name in the config, as paths of lines are long."""
    table = _table("leg", "bus", "drive", "position mm", "homed", "state", "temp.")
    for leg, state in states.items():
        drive = names[leg].partition(" on ")[0]
        if isinstance(state, str):
            table.add_row(short_name(leg), bus_names[leg], drive, "-", "-", Text(state, style="red"), "-")
            continue
        faults = "; ".join(state.faults)
        table.add_row(
            short_name(leg),
            bus_names[leg],
            drive,
            _mm(state.position_m),
            "yes" if state.is_homed else Text("no", style="yellow"),
            Text(faults, style="red") if faults else "moves" if state.is_moving else "stands",
            "-" if state.temperature_k is None else f"{k_to_celsius(state.temperature_k):.0f} C",
        )
    return table


def identity_lines(identities: Mapping[Leg, str]) -> list[str]:
    """What kinds of drives there are, a line for each with its legs."""
    legs_of: dict[str, list[Leg]] = {}
    for leg, identity in identities.items():
        legs_of.setdefault(identity or "says nothing of itself", []).append(leg)
    return [f"{identity}: {legs_in_words(legs)}" for identity, legs in legs_of.items()]


def table_of_orders(orders: Sequence[MoveOrder]) -> Table:
    """What is to move how far, before it does."""
    table = _table("leg", "now mm", "target mm", "way mm")
    for order in orders:
        way = f"{m_to_mm(order.target_m - order.start_m):+.4f}"
        table.add_row(short_name(order.leg), _mm(order.start_m), _mm(order.target_m), way)
    return table


def table_of_results(results: Sequence[MoveResult]) -> Table:
    """What came of it."""
    table = _table("leg", "target mm", "readback mm", "outcome", "detail")
    for result in results:
        style = "green" if result.outcome is MoveOutcome.ARRIVED else "red"
        table.add_row(
            short_name(result.order.leg),
            _mm(result.order.target_m),
            _mm(result.readback_m),
            Text(result.outcome.value.replace("_", " "), style=style),
            Text(result.detail),
        )
    return table


def table_of_words(title: str, words: Mapping[Leg, str]) -> Table:
    """A line for each leg."""
    table = _table("leg", title)
    for leg, line in words.items():
        table.add_row(short_name(leg), Text(line))
    return table


def table_of_tests(tests: Sequence[LegTest]) -> Table:
    """What the self-test found."""
    table = _table("leg", "error up mm", "error back mm", "watched", "result")
    for test in tests:
        result = Text("passed", style="green") if test.has_passed else Text("; ".join(test.problems), style="red")
        table.add_row(short_name(test.leg), _mm(test.out_m), _mm(test.back_m), str(test.n_watched), result)
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right" if column.endswith(" mm") else "left", overflow="fold")
    return table


def _mm(length_m: float) -> str:
    return "-" if math.isnan(length_m) else f"{m_to_mm(length_m):.4f}"

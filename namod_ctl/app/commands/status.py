"""`namod-ctl status`: how a campaign or a recording stands, whether or not somebody works on it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.console import Console

from namod_ctl.app.campaign_choice import CAMPAIGN_HELP, choose_campaign
from namod_ctl.app.reconstruction_report import LIMIT_WORDS
from namod_ctl.app.views.number_ranges import counted, legs_in_words, runs_in_words
from namod_ctl.app.views.run_status import describe_run, run_lines
from namod_ctl.core.drives import Leg
from namod_ctl.core.motion import MoveOutcome
from namod_ctl.core.units import rad2_to_arcmin2
from namod_ctl.cycle.machine import FINAL, STATES
from namod_ctl.cycle.table_move import NOTE_JOURNAL
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_lock import running_pid
from namod_ctl.store.campaign_rows import TRANSITION
from namod_ctl.store.folders import is_run
from namod_ctl.store.run import RunStore

SCHEMA = "namod-status/1"
N_EVENTS = 10

_Said = TypeVar("_Said")


def status(
    campaign: Annotated[
        Path | None,
        typer.Argument(metavar="[CAMPAIGN|RUN]", help=f"Folder of a run, or: {CAMPAIGN_HELP}", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print it for a program.")] = False,
) -> None:
    """Show how a campaign stands: its state, its cycles, what is refused, and what happened last.

    Of a run: how many records it has, how fast they come, what is wrong, and what is waited for.

    Example: namod-ctl status CAMPAIGN --json
    """
    if campaign is not None and is_run(campaign):
        with RunStore.open(campaign) as run:
            of_run = describe_run(run)
        if as_json:
            typer.echo(json.dumps(of_run, indent=2, allow_nan=False))
        else:
            typer.echo("\n".join(run_lines(of_run)))
        return
    path = choose_campaign(campaign)
    pid = running_pid(path)
    with CampaignStore.open(path) as store:
        standing = describe(store, pid)
    if as_json:
        typer.echo(json.dumps(standing, indent=2, allow_nan=False))
    else:
        _print(standing)


def describe(store: CampaignStore, pid: int | None) -> dict[str, Any]:
    """Everything that `status` says, as it goes into JSON; areas in square minutes of arc, unknown ones None."""
    transition = store.last_transition()
    state = store.last_state() or "idle"
    turns = store.turns()
    return {
        "schema": SCHEMA,
        "campaign": str(store.path),
        "source": store.source,
        "state": state,
        "state_meaning": STATES.get(state, ""),
        "reason": str(transition.data.get("reason", "")) if transition else "",
        "since_utc": transition.time_utc if transition else store.created_utc,
        "is_running": pid is not None,
        "process": pid or None,
        "next": _next(store, state, is_running=pid is not None),
        "cycles": [
            {
                "cycle": cycle.number,
                "run": cycle.run_folder,
                "n_records": cycle.n_records,
                "a_sigma_arcmin2": {
                    "now": _arcmin2(cycle.a_sigma_now_rad2),
                    "now_uncertainty": _arcmin2(cycle.a_sigma_uncertainty_rad2),
                    "predicted_after_correction": _arcmin2(cycle.a_sigma_predicted_rad2),
                    "limit": _arcmin2(cycle.a_sigma_limit_rad2),
                },
                "decision": cycle.decision,
            }
            for cycle in store.cycles()
        ],
        "refused_facets": _refused_facets(store),
        "legs_not_arrived": _legs_not_arrived(store),
        "turns_to_do": [turn.facet_id for turn in turns if not turn.is_done],
        "turns_done": [turn.facet_id for turn in turns if turn.is_done],
        "events": [
            {"id": event.id, "time_utc": event.time_utc, "kind": event.kind, "text": event.text}
            for event in store.events()[-N_EVENTS:]
        ],
    }


def _next(store: CampaignStore, state: str, *, is_running: bool) -> str:
    if not is_running and store.note(NOTE_JOURNAL) is not None:
        return "nothing: this is the journal of a look-up table, 'namod-ctl lut apply' goes on with it"
    if state == "held":
        return f"somebody looks at the telescope, then 'namod-ctl release {store.path}'"
    if state == "awaiting_operator":
        waiting = sum(not turns.is_done for turns in store.turns())
        if waiting:
            facets = counted(waiting, "facet")
            return f"bolts of {facets} are turned; then 'namod-ctl done {store.path} --all' (or --facet IDS)"
    if not is_running:
        if state in FINAL:
            return "nothing: it has ended"
        return f"nobody is at work on it; 'namod-ctl align --resume {store.path}' goes on"
    return {
        "awaiting_approval": f"'namod-ctl approve {store.path}' or 'namod-ctl refuse {store.path}'",
        "paused": f"'namod-ctl resume {store.path}'",
    }.get(state, "it goes on by itself")


def _refused_facets(store: CampaignStore) -> dict[str, str]:
    """What the latest preview left alone, by facet id, and why."""
    refused: dict[str, str] = {}
    for event in store.events():
        if event.kind == TRANSITION and event.data.get("to") == "previewing":
            refused = {}
        elif event.kind == "refused":
            refused[str(event.data.get("facet_id"))] = str(event.data.get("why"))
    return refused


def _legs_not_arrived(store: CampaignStore) -> list[dict[str, Any]]:
    """Orders of the latest cycle that gave any, of which it is not certain that the leg is where it should be."""
    orders = store.orders()
    latest = max((order.cycle for order in orders), default=0)
    last_of_leg = {order.order.leg: order for order in orders if order.cycle == latest}
    return [
        {
            "facet_id": leg.facet_id,
            "leg": leg.index + 1,
            "outcome": (order.result.outcome if order.result else MoveOutcome.UNKNOWN).value,
            "detail": order.result.detail if order.result else "ordered, and not read back yet",
        }
        for leg, order in sorted(last_of_leg.items())
        if order.result is None or order.result.outcome is not MoveOutcome.ARRIVED
    ]


def _arcmin2(area_rad2: float) -> float | None:
    return float(rad2_to_arcmin2(area_rad2)) if math.isfinite(area_rad2) else None


def _print(standing: Mapping[str, Any]) -> None:
    console = Console(highlight=False, markup=False, soft_wrap=True)
    meaning = f" ({standing['state_meaning']})" if standing["state_meaning"] else ""
    console.print(f"{standing['campaign']}: {standing['source']}")
    console.print(f"State:   {standing['state'].replace('_', ' ')}{meaning}")
    if standing["reason"]:
        console.print(f"Because: {standing['reason']}")
    process = f"process {standing['process']}" if standing["process"] else "yes"
    console.print(f"Running: {process if standing['is_running'] else 'no'}")
    console.print(f"Next:    {standing['next']}")
    if standing["cycles"]:
        console.print("A_sigma, the area of the point spread function, in square minutes of arc:")
        console.print(f"({LIMIT_WORDS} in the last column)")
        _print_cycles(console, standing["cycles"])
    for why, facet_ids in _by_words((int(facet_id), why) for facet_id, why in standing["refused_facets"].items()):
        noun = "facet" if len(facet_ids) == 1 else "facets"
        console.print(f"Refused: {noun} {runs_in_words(facet_ids)}: {why}")
    for words, legs in _by_words(
        (Leg(leg["facet_id"], leg["leg"] - 1), f"{leg['outcome'].replace('_', ' ')}; {leg['detail']}".rstrip("; "))
        for leg in standing["legs_not_arrived"]
    ):
        console.print(f"Not where they should be: {legs_in_words(legs)}: {words}")
    if standing["turns_to_do"] or standing["turns_done"]:
        n_done, n_to_do = len(standing["turns_done"]), len(standing["turns_to_do"])
        to_do = f"; to do: {runs_in_words(standing['turns_to_do'])}" if n_to_do else ""
        console.print(f"Bolts:   {n_done} of {counted(n_done + n_to_do, 'facet')} done{to_do}")
    if standing["events"]:
        console.print("What happened last (UTC):")
    for event in standing["events"]:
        what, text = event["kind"].replace("_", " "), event["text"]
        if event["kind"] == TRANSITION:  # "this -> that: why"
            way, _, text = text.partition(": ")
            what = way.rpartition(" -> ")[2].replace("_", " ")
        console.print(f"  {event['time_utc'][:19].replace('T', ' ')}  {what}: {text}")


def _by_words(said: Iterable[tuple[_Said, str]]) -> list[tuple[str, list[_Said]]]:
    """Of what the same is said, together, in the order of first appearance."""
    groups: dict[str, list[_Said]] = {}
    for what, words in said:
        groups.setdefault(words, []).append(what)
    return list(groups.items())


def _print_cycles(console: Console, cycles: list[dict[str, Any]]) -> None:
    """Two lines per cycle: numbers below each other, and the whole decision, which is too long for a column."""
    console.print(f"{'cycle':>7}  {'records':>7}  {'measured':>16}  {'predicted':>9}  {'limit':>13}")
    for cycle in cycles:
        area = cycle["a_sigma_arcmin2"]
        spread = f" +- {area['now_uncertainty']:.2f}" if area["now_uncertainty"] is not None else ""
        console.print(
            f"{cycle['cycle']:>7}  {cycle['n_records']:>7}  {_area(area['now']) + spread:>16}  "
            f"{_area(area['predicted_after_correction']):>9}  {_area(area['limit']):>13}"
        )
        if cycle["decision"]:
            console.print(f"         {cycle['decision']}")


def _area(area_arcmin2: float | None) -> str:
    return "-" if area_arcmin2 is None else f"{area_arcmin2:.2f}"

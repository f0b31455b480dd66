"""What people say of the bolts they were asked to turn, and what they are answered.

The same words and the same refusals whether the campaign's program takes them or, while none runs, the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.turn_marks import unmark_done

FacetIds = Sequence[int] | Literal["all"]

_STILL_ASKED_IN: Final = frozenset({"idle", "checking", "awaiting_operator", "held"})
"""From these states a campaign asks for what is not done, at once or when it is released."""


def mark(store: CampaignStore, facet_ids: FacetIds) -> str:
    """Write down that the bolts of these facets are turned; an answer that names the facets and those left.

    Raises
    ------
    ConfigError
        No turns were asked for, or none of one of these facets; nothing is written.
    """
    _require_asked(store)
    news = store.mark_done(_chosen(facet_ids))
    said = f"{_counted(news)} marked as done: {_listed(news)}" if news else "all of these were marked before"
    return f"{said}; {left(store)}"


def unmark(store: CampaignStore, facet_ids: FacetIds) -> str:
    """Take back that the bolts of these facets are turned; an answer that names the facets and those left.

    Raises
    ------
    ConfigError
        As `mark`; or the campaign has gone on, so that its records were taken with the bolts as they are.
    """
    _require_asked(store)
    asked_in, state = store.turns()[0].cycle, store.last_state() or "idle"
    if state not in _STILL_ASKED_IN or store.cycles()[-1].number != asked_in:
        raise ConfigError(
            f"{store.path}: the campaign has gone on since the turns of cycle {asked_in}, its state is {state}; marks "
            "stay as they are. The next cycle measures every facet as it is, and asks anew for what is missing"
        )
    taken_back = unmark_done(store, _chosen(facet_ids))
    if not taken_back:
        return f"none of these was marked; {left(store)}"
    return f"{_counted(taken_back)} not done after all: {_listed(taken_back)}; {left(store)}"


def left(store: CampaignStore) -> str:
    """Which facets are not marked yet, in words."""
    ids = [turns.facet_id for turns in store.turns() if not turns.is_done]
    return f"{len(ids)} to go: {_listed(ids)}" if ids else "all are done"


def _require_asked(store: CampaignStore) -> None:
    if not store.turns():
        raise ConfigError(f"{store.path}: nobody was asked to turn bolts yet, so there is nothing to mark")


def _chosen(facet_ids: FacetIds) -> list[int] | None:
    return None if facet_ids == "all" else [int(facet_id) for facet_id in facet_ids]


def _counted(facet_ids: Sequence[int]) -> str:
    return f"{len(facet_ids)} facet{'' if len(facet_ids) == 1 else 's'}"


def _listed(facet_ids: Sequence[int]) -> str:
    return ", ".join(map(str, facet_ids))

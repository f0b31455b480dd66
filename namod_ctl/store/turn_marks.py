"""Taking back what was said to be turned: the other half of `CampaignStore.mark_done`."""

from __future__ import annotations

from collections.abc import Collection

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.database import store_errors, transaction


def unmark_done(store: CampaignStore, facet_ids: Collection[int] | None = None) -> list[int]:
    """Facets, of those given or all, whose turns of the last cycle that asked for any are not done after all.

    Journaled together with an event. What was not done before stays as it was. `store` is open for writing.

    Raises
    ------
    ConfigError
        No turn of one of these facets was asked for; nothing is written.
    """
    asked = store.turns()
    known = {turns.facet_id for turns in asked}
    wanted = known if facet_ids is None else set(facet_ids)
    if wanted - known:
        strangers = ", ".join(map(str, sorted(wanted - known)))
        hint = "none were asked for yet"
        if asked:
            hint = f"in cycle {asked[0].cycle} turns were asked for of facets {', '.join(map(str, sorted(known)))}"
        raise ConfigError(f"{store.path}: no turns were asked for of facet {strangers}; {hint}")
    taken_back = [turns.facet_id for turns in asked if turns.facet_id in wanted and turns.is_done]
    if not taken_back:
        return []
    cycle = asked[0].cycle
    # the store's own connection: marks and journal change together, in the one order in which things happened
    connection = store._connection
    with store_errors(store.path), transaction(connection):
        connection.executemany(
            "UPDATE turns SET done_utc = NULL WHERE cycle = ? AND facet_id = ?",
            [(cycle, facet_id) for facet_id in taken_back],
        )
        text = f"not done after all: facet {', '.join(map(str, taken_back))}"
        store.add_event("not_done", text, {"cycle": cycle, "facet_ids": taken_back})
    return taken_back

"""The state machine of a campaign: states and transitions as data; the diagram in docs is drawn from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from transitions import Machine, MachineError
from transitions.extensions import GraphMachine

STATES: Mapping[str, str] = {
    "idle": "nothing has happened yet, or a person has released the campaign",
    "checking": "drives and cameras are asked whether they are there and well",
    "recording": "image pairs are taken",
    "paused": "the recording waits for `resume`",
    "reconstructing": "orientations are worked out, and whether another correction is worth it",
    "previewing": "it is shown what would move how far, and what is refused",
    "awaiting_approval": "a person is asked before anything moves",
    "correcting": "drives move",
    "undoing": "the correction that made it worse is taken back",
    "instructing": "sheets for the people who turn the bolts are written",
    "awaiting_operator": "people turn bolts",
    "converged": "the area of the point spread function does not get smaller any more",
    "held": "all motion is stopped; a person must look and `release`",
    "failed": "the campaign cannot go on; the journal says why",
}
"""State and what it means, for people."""

FINAL = frozenset({"converged", "held", "failed"})
"""States in which the program ends."""

WORKING = tuple(state for state in STATES if state not in FINAL)


@dataclass(frozen=True, slots=True)
class Transition:
    """A trigger that leads from any of the sources to the destination."""

    trigger: str
    sources: tuple[str, ...]
    destination: str


TRANSITIONS: tuple[Transition, ...] = (
    Transition("start", ("idle",), "checking"),
    Transition("ready", ("checking",), "recording"),
    Transition("pause", ("recording",), "paused"),
    Transition("resume", ("paused",), "recording"),
    Transition("recorded", ("recording",), "reconstructing"),
    Transition("poor_data", ("reconstructing",), "recording"),
    Transition("correct", ("reconstructing",), "previewing"),
    Transition("converge", ("reconstructing",), "converged"),
    Transition("undo", ("reconstructing",), "undoing"),
    Transition("ask", ("previewing",), "awaiting_approval"),
    Transition("approve", ("previewing", "awaiting_approval"), "correcting"),
    Transition("changed", ("awaiting_approval", "correcting"), "previewing"),
    Transition("instruct", ("previewing",), "instructing"),
    Transition("wait", ("instructing", "checking"), "awaiting_operator"),
    Transition("done", ("awaiting_operator",), "recording"),
    Transition("corrected", ("correcting", "undoing"), "recording"),
    Transition("hold", WORKING, "held"),
    Transition("fail", WORKING, "failed"),
    Transition("release", ("held",), "idle"),
)


class CampaignMachine:
    """Where a campaign stands. `on_transition(source, trigger, destination, reason)` journals every step.

    A trigger that the table does not know in the present state raises transitions' `MachineError`: a bug.
    """

    state: str

    def __init__(self, initial: str, on_transition: Callable[[str, str, str, str], None]) -> None:
        self._on_transition = on_transition
        self._machine = Machine(
            model=self, states=list(STATES), transitions=_as_dicts(), initial=initial, auto_transitions=False
        )

    def fire(self, trigger: str, reason: str) -> None:
        """Go to the next state; it is journaled before anything is done in it."""
        source = self.state
        if not self._machine.get_triggers(source).count(trigger):
            raise MachineError(f"{trigger!r} leads nowhere from state {source!r}")
        destination = next(t.destination for t in TRANSITIONS if t.trigger == trigger and source in t.sources)
        self._on_transition(source, trigger, destination, reason)
        self.trigger(trigger)  # type: ignore[attr-defined]  # added by transitions


def diagram() -> str:
    """The table as a mermaid state diagram."""
    machine = GraphMachine(
        states=list(STATES),
        transitions=_as_dicts(),
        initial="idle",
        auto_transitions=False,
        graph_engine="mermaid",
        title="Campaign",
    )
    return str(machine.get_graph().draw(None))


def _as_dicts() -> list[dict[str, object]]:
    return [{"trigger": t.trigger, "source": list(t.sources), "dest": t.destination} for t in TRANSITIONS]

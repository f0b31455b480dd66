"""Who carries out a correction, motors or people: what the campaign asks of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, Protocol

from namod_ctl.cycle.plan import Plan
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction


class StopAsked(Exception):  # noqa: N818 - not an error: somebody wants it
    """Somebody asked for all motion to stop; the text says who or how."""


class Corrector(Protocol):
    """Turns facets as a plan says. For the campaign's thread only."""

    @property
    def are_people(self) -> bool:
        """People with sheets, instead of motors."""
        ...

    @property
    def can_undo(self) -> bool:
        """Can the last correction be taken back without a person?"""
        ...

    @property
    def has_learned(self) -> bool:
        """Did `learn` find anything that makes the next correction another one?"""
        ...

    def check(self) -> Sequence[str]:
        """What a person should know before anything begins. Raises SafetyStop when nothing could be turned."""
        ...

    def recover(self, poll: Callable[[], None]) -> None:
        """Bring orders of before a crash to their end. Raises SafetyStop when a leg stands where no order sent it."""
        ...

    def learn(self, alignments: Mapping[int, Alignment]) -> Sequence[str]:
        """What the last correction, as ordered and as seen, says about the wiring or the people; by cycle number."""
        ...

    def plan(self, result: Reconstruction) -> Plan:
        """The correction that follows from a reconstruction; nothing moves."""
        ...

    def changed_since(self, plan: Plan) -> str:
        """What is different from when the plan was made; empty when nothing is."""
        ...

    def carry_out(self, cycle: int, plan: Plan, poll: Callable[[], None]) -> str:
        """Turn the facets; a summary for a person. Whatever `poll` raises stops all motion first."""
        ...

    def undo(self, cycle: int, poll: Callable[[], None]) -> str:
        """Take back the correction of the cycle before; a summary for a person."""
        ...

    def instruct(self, cycle: int, run: Path, plan: Plan) -> str:
        """Write sheets for the people; says where they are."""
        ...

    def mark_done(self, facet_ids: Sequence[int] | Literal["all"]) -> str:
        """People say that they have turned these facets; an answer for them.

        Raises ConfigError, and writes nothing, when turns of one of them were not asked for.
        """
        ...

    def is_done(self) -> bool:
        """Have people turned all they were asked for?"""
        ...

    def stop(self, reason: str) -> None:
        """Halt everything that may be moving. Never raises."""
        ...

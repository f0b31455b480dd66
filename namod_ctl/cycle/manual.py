"""What a person did to the bolts: the turns that were asked for against the change of direction that was seen.

The same judge as for drives (`cycle.stories`), with the mistakes of people as stories. A turn of all bolts of a tripod
by the same angle moves the facet along the axis and shows nowhere: what is said here is up to such a turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.drives import Leg
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.cycle.evidence import Estimate, FacetHistory, Observation, histories
from namod_ctl.cycle.learn import RESPONSE_SPREAD
from namod_ctl.cycle.stories import LN_PRIOR_AS_ORDERED, GainPrior, Story, Verdict, judge
from namod_ctl.optics.mounts import Mount

Array = NDArray[np.float64]

# More possibilities help nobody on a ladder.
_N_TOLD = 3
# Less than this share counts as not done, more than the other as done.
_SHARE = GainPrior(0.2, 0.8, is_logarithmic=False)
# One bolt of several turned the wrong way, all bolts taken in turn from the wrong one, another facet's turns besides
# one's own: rarer than the plain mistakes.
_LN_PRIOR_RARE = math.log(0.3)
_LN_PRIOR_NEVER = -math.inf


class TurnKind(StrEnum):
    """What can be found of a facet that a person was to turn; the value is its name in tables."""

    RIGHT = "right"
    TOO_SMALL = "too_small"
    NOT_DONE = "not_done"
    WRONG_DIRECTION = "wrong_direction"
    WRONG_BOLT = "wrong_bolt"
    WRONG_FACET = "wrong_facet"
    HALF_DONE = "half_done"
    UNCLEAR = "unclear"

    @property
    def is_mistake(self) -> bool:
        """Was something else done than was asked?"""
        return self not in (TurnKind.RIGHT, TurnKind.TOO_SMALL)


@dataclass(frozen=True, slots=True, eq=False)
class TurnFinding:
    """What a person did to one facet.

    Attributes
    ----------
    bolts
        The bolts it is about, counted from 0; empty when it is about all. For `half_done`: those not turned.
    partner
        `wrong_facet`: the facet whose turns were made here; else None.
    share
        `half_done`: the share of every turn that was made; NaN otherwise.
    ln_evidence
        Ln of how much more probable it is than anything else.
    still_needed_deg
        Shape (n_bolts,). Turns that would complete what was asked, positive clockwise; NaN where that is not a
        matter of turning the same bolts again. The next alignment gives them in any case, and better.
    sentence
        The finding and its evidence, for a person.
    """

    facet_id: int
    kind: TurnKind
    bolts: tuple[int, ...]
    partner: int | None
    share: float
    ln_evidence: float
    still_needed_deg: Array
    sentence: str


def check_turns(
    mounts: Mapping[int, Mount],
    asked_deg: Mapping[int, Array],
    before: Mapping[int, Estimate],
    after: Mapping[int, Estimate],
    goniometer_sigma_rad: float,
) -> list[TurnFinding]:
    """One finding per facet that was to be turned and was seen before and after; others when they were turned.

    Parameters
    ----------
    asked_deg
        Per facet, shape (n_bolts,): turns as on the sheet, positive clockwise as seen by the person who turns.
    before, after
        Per facet: Theta (2,) in rad and its covariance (2, 2) in rad^2.
    goniometer_sigma_rad
        Standard deviation of one bolt's turn: reading, and the rounding of the sheet where `asked_deg` is not rounded.

    Raises
    ------
    ConfigError
        When turns are asked of a facet whose mount is not known, has no bolts, or has another number of them.
    """
    with_bolts = {facet_id: mount for facet_id, mount in mounts.items() if mount.pitch_m_per_turn is not None}
    travels = {}
    for facet_id, turns in asked_deg.items():
        mount = with_bolts.get(facet_id)
        if mount is None or len(turns) != len(mount.legs_m):
            raise ConfigError(
                f"facet {facet_id}: {len(turns)} bolt turns were asked for, but its mount has "
                f"{0 if mount is None else len(mount.legs_m)} bolts: use the config that the sheets were made with"
            )
        travels[facet_id] = np.asarray(turns, dtype=np.float64) / mount.turn_deg_of_travel(np.ones(len(turns)))
    sigma_m = {
        facet_id: goniometer_sigma_rad / math.tau * (mount.pitch_m_per_turn or 0.0)
        for facet_id, mount in with_bolts.items()
    }
    observations = [Observation(travels, before, after)]
    seen = histories(with_bolts, observations, sigma_m, RESPONSE_SPREAD)
    verdicts = judge(seen, observations, _single_stories, _pair_stories)
    return [
        _finding(
            seen[facet_id], verdict, np.asarray(asked_deg.get(facet_id, np.zeros(seen[facet_id].travel_m.shape[1])))
        )
        for facet_id, verdict in verdicts.items()
        if facet_id in asked_deg or verdict.story is None or verdict.story.kind != TurnKind.RIGHT
    ]


def _single_stories(history: FacetHistory) -> list[Story]:
    """All stories of one facet alone, "right" first."""
    n = history.travel_m.shape[1]
    own, ones = tuple(Leg(history.facet_id, k) for k in range(n)), (1.0,) * n
    every, pairs = tuple(range(n)), list(combinations(range(n), 2))

    def gains(bolts: tuple[int, ...], gain: float) -> tuple[float, ...]:
        return tuple(gain if k in bolts else 1.0 for k in range(n))

    stories = [
        Story(TurnKind.RIGHT, (), own, ones, LN_PRIOR_AS_ORDERED),
        Story(TurnKind.NOT_DONE, (), own, (0.0,) * n, 0.0),
        Story(TurnKind.WRONG_DIRECTION, (), own, (-1.0,) * n, 0.0),
        Story(TurnKind.HALF_DONE, (), own, ones, 0.0, _SHARE, every),
    ]
    for size in range(1, n):
        parts = list(combinations(every, size))
        prior = (_LN_PRIOR_RARE if size > 1 else 0.0) - math.log(len(parts))
        stories += [Story(TurnKind.HALF_DONE, bolts, own, gains(bolts, 0.0), prior) for bolts in parts]
    rare = _LN_PRIOR_RARE - math.log(n)
    stories += [Story(TurnKind.WRONG_DIRECTION, (k,), own, gains((k,), -1.0), rare) for k in every if n > 1]
    for i, j in pairs:
        order = list(own)
        order[i], order[j] = order[j], order[i]
        stories.append(Story(TurnKind.WRONG_BOLT, (i, j), tuple(order), ones, -math.log(len(pairs))))
    if n > 2:
        for step in (1, n - 1):
            order = [own[(k + step) % n] for k in every]
            stories.append(Story(TurnKind.WRONG_BOLT, every, tuple(order), ones, _LN_PRIOR_RARE - math.log(2.0)))
    return stories


def _pair_stories(a: FacetHistory, b: FacetHistory) -> list[tuple[Story, Story]]:
    """Turns made at the wrong one of two facets: exchanged (first), or those of one made at the other."""
    n = a.travel_m.shape[1]
    if n != b.travel_m.shape[1]:
        return []
    kind, ones, none = TurnKind.WRONG_FACET, (1.0,) * n, (0.0,) * n
    own_a, own_b = (tuple(Leg(one.facet_id, k) for k in range(n)) for one in (a, b))
    is_asked_a, is_asked_b = bool(np.any(a.travel_m)), bool(np.any(b.travel_m))
    # Where only one was asked for, an exchange is the same as its turns made at the other; that is told then.
    exchange = 0.0 if is_asked_a and is_asked_b else _LN_PRIOR_NEVER
    stories = [(Story(kind, (), own_b, ones, exchange), Story(kind, (), own_a, ones, exchange))]
    not_done = [Story(TurnKind.NOT_DONE, (), own, none, 0.0) for own in (own_a, own_b)]
    if is_asked_a:
        stories.append((not_done[0], Story(kind, (), own_a, ones, 0.0)))
    if is_asked_b:
        stories.append((Story(kind, (), own_b, ones, 0.0), not_done[1]))
    if is_asked_a and is_asked_b:
        stories.append((not_done[0], Story(kind, (), own_b, ones, _LN_PRIOR_RARE, on_top=a.facet_id)))
        stories.append((Story(kind, (), own_a, ones, _LN_PRIOR_RARE, on_top=b.facet_id), not_done[1]))
    return stories


def _finding(history: FacetHistory, verdict: Verdict, asked_deg: Array) -> TurnFinding:
    """The finding of a verdict, with its sentence."""
    facet_id, story = verdict.facet_id, verdict.story
    unknown = np.full(len(asked_deg), np.nan)
    seen, wanted = _arcmin(history.change_rad[0]), _arcmin(history.expected_rad[0])
    evidence = f"Theta changed by {seen}, {wanted} was asked for"
    if story is None:
        # the most probable come first; the same words may stand for several stories
        words = list(dict.fromkeys(_in_words(TurnKind(one.kind), one, history) for one in verdict.rivals))
        listed = "; or ".join(words[:_N_TOLD])
        could_be = f"it could be: {listed}; or something else" if words else "no single mistake explains it"
        sentence = f"facet {facet_id}: something else than asked was done; {could_be} ({evidence})"
        return TurnFinding(facet_id, TurnKind.UNCLEAR, (), None, math.nan, 0.0, unknown, sentence)
    kind = TurnKind(story.kind)
    if kind in (TurnKind.RIGHT, TurnKind.NOT_DONE) and not history.is_order_seen():
        kind = TurnKind.TOO_SMALL
    is_own = story.on_top is None and all(
        source == Leg(facet_id, k) or gain == 0.0
        for k, (source, gain) in enumerate(zip(story.sources, story.final_gains, strict=True))
    )
    needed = asked_deg * (1.0 - np.array(story.final_gains)) if is_own else unknown
    return TurnFinding(
        facet_id,
        kind,
        story.legs,
        _partner(story, facet_id),
        story.gain,
        verdict.ln_evidence,
        needed,
        f"facet {facet_id}: {_in_words(kind, story, history)} ({evidence})",
    )


def _partner(story: Story, facet_id: int) -> int | None:
    """The facet whose turns were made here."""
    others = {source.facet_id for source in story.sources} - {facet_id}
    return story.on_top if story.on_top is not None else next(iter(others), None)


def _in_words(kind: TurnKind, story: Story, history: FacetHistory) -> str:
    """What was done, to follow "facet 13:"."""
    bolts = " and ".join(str(k + 1) for k in story.legs)
    noun = "bolt" if len(story.legs) == 1 else "bolts"
    match kind:
        case TurnKind.RIGHT:
            return "turned as asked"
        case TurnKind.TOO_SMALL:
            return "the turns asked for are too small to tell"
        case TurnKind.NOT_DONE:
            return "not turned"
        case TurnKind.WRONG_DIRECTION if story.legs:
            return f"{noun} {bolts} turned in the wrong direction"
        case TurnKind.WRONG_DIRECTION:
            return "all bolts turned in the wrong direction"
        case TurnKind.WRONG_BOLT if len(story.legs) == 2:
            return f"bolts {bolts} mistaken for each other"
        case TurnKind.WRONG_BOLT:
            made = ", ".join(f"{source.index + 1} at bolt {k + 1}" for k, source in enumerate(story.sources))
            return f"bolts counted from the wrong one: the turn of bolt {made}"
        case TurnKind.WRONG_FACET if story.on_top is not None:
            return f"the turns of facet {story.on_top} were made here, besides its own"
        case TurnKind.WRONG_FACET:
            return f"the turns of facet {_partner(story, history.facet_id)} were made here instead of its own"
        case TurnKind.HALF_DONE if story.legs:
            return f"half done: {noun} {bolts} not turned"
        case TurnKind.HALF_DONE:
            return f"half done: {story.gain:.2f} +- {story.gain_sigma:.2f} of every turn"
        case TurnKind.UNCLEAR:
            raise AssertionError("an unclear facet has no story")


def _arcmin(angle_rad: Array) -> str:
    x, y = rad_to_arcmin(np.asarray(angle_rad))
    return f"({x:+.1f}, {y:+.1f}) arcmin"

"""What motion teaches: travels that were ordered against the tilts that were seen, and the fault that explains both.

Every correction is a test of the wiring. Per facet stories of what its legs did compete (see `cycle.stories`), with
"as ordered" as the null story. A tripod's three legs show in two numbers only, so two stories can be equally good:
then the facet is `unexplained`, with both named, until another correction decides.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.drives import Leg
from namod_ctl.core.units import m_to_mm, rad_to_arcmin
from namod_ctl.cycle.evidence import FacetHistory, Observation, histories
from namod_ctl.cycle.stories import LN_PRIOR_AS_ORDERED, GainPrior, Story, Verdict, judge
from namod_ctl.optics.mounts import Mount

Array = NDArray[np.float64]

# Tolerance of a sound mount: leg positions of a drawing and pitches of spindles are good to a few percent.
RESPONSE_SPREAD = 0.03
# A wrong pitch or number of steps: from a quarter to a step motor's 16 microsteps and more. What moves by less than a
# quarter of its orders is as good as stuck.
_SCALE = GainPrior(0.25, 20.0, is_logarithmic=True)
# Two independent faults of one facet are that much rarer than one.
_LN_PRIOR_SECOND_FAULT = math.log(0.01)


class FaultKind(StrEnum):
    """What can be found of a facet; the value is its name in tables."""

    AS_ORDERED = "as_ordered"
    TOO_SMALL = "too_small"
    NOT_MOVED = "not_moved"
    LEG_NOT_MOVED = "leg_not_moved"
    LEG_REVERSED = "leg_reversed"
    WRONG_SCALE = "wrong_scale"
    LEGS_SWAPPED = "legs_swapped"
    FOREIGN_DRIVE = "foreign_drive"
    UNEXPLAINED = "unexplained"

    @property
    def is_fault(self) -> bool:
        """Is anything wrong?"""
        return self not in (FaultKind.AS_ORDERED, FaultKind.TOO_SMALL)


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found of one facet.

    Attributes
    ----------
    legs
        The legs it is about, counted from 0; empty when it is about the whole facet.
    partners
        Facets whose drives move this one (`foreign_drive`).
    factor, factor_sigma
        `wrong_scale`: real travel per ordered travel; NaN otherwise.
    ln_evidence
        Ln of how much more probable it is than anything else; infinite for "as ordered", which is never compared
        unless it is refuted.
    story
        Which leg followed whose orders, with what gain; None when unexplained.
    rivals
        When unexplained: the stories between which nothing decides yet; empty when none fits.
    sentence
        The finding and its evidence, for a person.
    """

    facet_id: int
    kind: FaultKind
    legs: tuple[int, ...]
    partners: tuple[int, ...]
    factor: float
    factor_sigma: float
    ln_evidence: float
    story: Story | None
    rivals: tuple[Story, ...]
    sentence: str


def observed(
    mounts: Mapping[int, Mount], observations: Sequence[Observation], resolution_m: float
) -> dict[int, FacetHistory]:
    """What was seen of every facet, with the lost travel of its mount's legs (backlash and `resolution_m`) in it."""
    lost = {facet_id: math.hypot(mount.backlash_m, resolution_m) for facet_id, mount in mounts.items()}
    return histories(mounts, observations, lost, RESPONSE_SPREAD)


def diagnose(
    mounts: Mapping[int, Mount], observations: Sequence[Observation], *, resolution_m: float = 0.0
) -> list[Finding]:
    """One finding per facet that was seen before and after a correction in any observation, by facet.

    All observations of a campaign since its wiring was last touched belong in: they decide together. Travels are
    always those of the drives by their names in the config, whatever was learned meanwhile.

    Parameters
    ----------
    resolution_m
        Uncertainty of a leg's travel besides the backlash of its mount: the drive's step.
    """
    seen = observed(mounts, observations, resolution_m)
    verdicts = judge(seen, observations, _single_stories, _pair_stories)
    return [
        _finding(seen[facet_id], verdict, observations)
        for facet_id, verdict in verdicts.items()
        if verdict.story is None or verdict.story.kind != FaultKind.AS_ORDERED or np.any(seen[facet_id].travel_m)
    ]


def _single_stories(history: FacetHistory) -> list[Story]:
    """All stories of one facet alone, "as ordered" first."""
    n = history.travel_m.shape[1]
    own = tuple(Leg(history.facet_id, k) for k in range(n))
    ones = (1.0,) * n
    every, each, pairs = tuple(range(n)), [(k,) for k in range(n)], list(combinations(range(n), 2))

    def gains(legs: tuple[int, ...], gain: float) -> tuple[float, ...]:
        return tuple(gain if k in legs else 1.0 for k in range(n))

    stories = [
        Story(FaultKind.AS_ORDERED, (), own, ones, LN_PRIOR_AS_ORDERED),
        Story(FaultKind.NOT_MOVED, (), own, gains(every, 0.0), 0.0),
        Story(FaultKind.LEG_REVERSED, every, own, gains(every, -1.0), 0.0),
        Story(FaultKind.WRONG_SCALE, (), own, ones, 0.0, _SCALE, every),
    ]
    stories += [Story(FaultKind.LEG_NOT_MOVED, legs, own, gains(legs, 0.0), -math.log(n)) for legs in each]
    stories += [Story(FaultKind.LEG_REVERSED, legs, own, gains(legs, -1.0), -math.log(n)) for legs in each]
    stories += [Story(FaultKind.WRONG_SCALE, legs, own, ones, -math.log(n), _SCALE, legs) for legs in each]
    if n > 2:
        rare = _LN_PRIOR_SECOND_FAULT - math.log(len(pairs))
        stories += [Story(FaultKind.LEG_REVERSED, legs, own, gains(legs, -1.0), rare) for legs in pairs]
        stories += [Story(FaultKind.LEG_NOT_MOVED, legs, own, gains(legs, 0.0), rare) for legs in pairs]
    for i, j in pairs:
        order = list(own)
        order[i], order[j] = order[j], order[i]
        stories.append(Story(FaultKind.LEGS_SWAPPED, (i, j), tuple(order), ones, -math.log(len(pairs))))
    if n == 3:
        for turned in ((1, 2, 0), (2, 0, 1)):
            sources = tuple(own[k] for k in turned)
            rare = _LN_PRIOR_SECOND_FAULT - math.log(2.0)
            stories.append(Story(FaultKind.LEGS_SWAPPED, every, sources, ones, rare))
    return stories


def _pair_stories(a: FacetHistory, b: FacetHistory) -> list[tuple[Story, Story]]:
    """Crossed drives of two facets: of all legs (first), then of one leg each."""
    n, m = a.travel_m.shape[1], b.travel_m.shape[1]
    own_a, own_b = [Leg(a.facet_id, k) for k in range(n)], [Leg(b.facet_id, k) for k in range(m)]
    kind = FaultKind.FOREIGN_DRIVE
    stories = []
    if n == m:
        stories.append((Story(kind, (), tuple(own_b), (1.0,) * n, 0.0), Story(kind, (), tuple(own_a), (1.0,) * n, 0.0)))
    one_each = _LN_PRIOR_SECOND_FAULT / 2.0 - 0.5 * math.log(n * m)
    for i in range(n):
        for j in range(m):
            from_a, from_b = list(own_a), list(own_b)
            from_a[i], from_b[j] = own_b[j], own_a[i]
            stories.append(
                (
                    Story(kind, (i,), tuple(from_a), (1.0,) * n, one_each),
                    Story(kind, (j,), tuple(from_b), (1.0,) * m, one_each),
                )
            )
    return stories


def _finding(history: FacetHistory, verdict: Verdict, observations: Sequence[Observation]) -> Finding:
    """The finding of a verdict, with its sentence."""
    story, facet_id = verdict.story, verdict.facet_id
    if story is None:
        return Finding(
            facet_id, FaultKind.UNEXPLAINED, (), (), math.nan, math.nan, 0.0, None, verdict.rivals,
            _unexplained(history, verdict, observations),
        )  # fmt: skip
    kind = FaultKind(story.kind)
    if kind is FaultKind.AS_ORDERED and not history.is_order_seen():
        kind = FaultKind.TOO_SMALL
    partners = tuple(sorted({source.facet_id for source in story.sources} - {facet_id}))
    return Finding(
        facet_id,
        kind,
        story.legs,
        partners,
        story.gain,
        story.gain_sigma,
        verdict.ln_evidence,
        story,
        (),
        f"facet {facet_id}{_in_words(kind, story, history, observations)}",
    )


def _in_words(kind: FaultKind, story: Story, history: FacetHistory, observations: Sequence[Observation]) -> str:
    """What happened and how it shows, to follow "facet 13"; of the observation with the largest travel."""
    cycle = int(np.argmax(np.max(np.abs(history.travel_m), axis=1)))
    ordered, made = history.travel_m[cycle], story.travel_m(history, observations)[cycle]
    legs = " and ".join(str(k + 1) for k in story.legs)
    noun = "leg" if len(story.legs) == 1 else "legs"
    of_legs = ", ".join(f"{_mm(ordered[k])}" for k in story.legs)
    as_if = ", ".join(f"{_mm(made[k])}" for k in story.legs)
    seen = f"Theta changed by {_arcmin(history.change_rad[cycle])}"
    ordered_change = f"{_arcmin(history.expected_rad[cycle])} was ordered"
    match kind:
        case FaultKind.AS_ORDERED:
            return f" moved as ordered: {seen}, {ordered_change}"
        case FaultKind.TOO_SMALL:
            return f": the ordered change of Theta, {_arcmin(history.expected_rad[cycle])}, is too small to tell"
        case FaultKind.NOT_MOVED:
            return f" did not move: {seen}, {ordered_change}"
        case FaultKind.LEG_NOT_MOVED:
            return f" {noun} {legs} did not move: ordered {of_legs}, the facet tilted as if without"
        case FaultKind.LEG_REVERSED:
            return f" {noun} {legs} moved the wrong way: ordered {of_legs}, the facet tilted as if {as_if}"
        case FaultKind.WRONG_SCALE:
            which = f" {noun} {legs}" if story.legs else ""
            return (
                f"{which} moved by a factor {story.gain:.3g} +- {story.gain_sigma:.2g} of what was ordered "
                f"(pitch or steps in the config?): {seen}, {ordered_change}"
            )
        case FaultKind.LEGS_SWAPPED if len(story.legs) == 2:
            return f" legs {legs} have each other's address: ordered {of_legs}, the facet tilted as if {as_if}"
        case FaultKind.LEGS_SWAPPED:
            return f" legs {legs} have each other's addresses in turn: ordered {of_legs}, tilted as if {as_if}"
        case FaultKind.FOREIGN_DRIVE:
            foreign = [source for source in story.sources if source.facet_id != history.facet_id]
            if story.legs:
                return f" leg {legs} is moved by the drive of {foreign[0]}: ordered {of_legs}, tilted as if {as_if}"
            return (
                f" is moved by the drives of facet {foreign[0].facet_id}: {seen}, {ordered_change}, "
                f"and {_arcmin(made @ history.response_rad_per_m.T)} is what that facet's orders make here"
            )
        case FaultKind.UNEXPLAINED:
            raise AssertionError("an unexplained facet has no story")


def _unexplained(history: FacetHistory, verdict: Verdict, observations: Sequence[Observation]) -> str:
    """The sentence of a facet without a story; names the stories between which nothing decides."""
    cycle = int(np.argmax(np.linalg.norm(history.change_rad - history.expected_rad, axis=1)))
    sentence = (
        f"facet {history.facet_id} did something else than ordered: Theta changed by "
        f"{_arcmin(history.change_rad[cycle])}, {_arcmin(history.expected_rad[cycle])} was ordered"
    )
    if not verdict.rivals:
        return f"{sentence}; no single fault explains it"
    could_be = "; or facet ".join(
        f"{history.facet_id}{_in_words(FaultKind(story.kind), story, history, observations)}"
        for story in verdict.rivals
    )
    return f"{sentence}; nothing decides yet: perhaps facet {could_be}; or it is none of these"


def _mm(travel_m: float) -> str:
    return f"{m_to_mm(float(travel_m)):+.3f} mm"


def _arcmin(angle_rad: Array) -> str:
    x, y = rad_to_arcmin(np.asarray(angle_rad))
    return f"({x:+.1f}, {y:+.1f}) arcmin"

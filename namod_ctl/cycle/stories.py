"""Stories of what moved a facet's legs, and the judge that compares them: the null story wins ties, nothing is guessed.

A story says for every leg whose orders it followed, and with what gain. Gains that a story leaves open (a wrong pitch,
a share of a turn) are integrated out over their prior, so that a story that can fit anything has to pay for it.
Some stories are about several facets at once (crossed drives): they compete with all their facets' single stories.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp

from namod_ctl.core.drives import Leg
from namod_ctl.cycle.evidence import FacetHistory, Observation, deviation_limit

Array = NDArray[np.float64]

# A story is told when it is a hundred times as probable as every other one, and as no story at all.
LN_EVIDENCE = math.log(100.0)
# Prior of "as ordered", and of something that is none of the stories, relative to one kind of fault.
LN_PRIOR_AS_ORDERED = math.log(20.0)
LN_PRIOR_UNKNOWN = math.log(0.5)
# Points at which an open gain is integrated, and how many standard deviations around the best to go.
_N_GAINS = 61
_GAIN_REACH = 6.0


@dataclass(frozen=True, slots=True)
class GainPrior:
    """Prior of an open gain: between two limits, uniform in it or in its logarithm."""

    low: float
    high: float
    is_logarithmic: bool

    def ln_density(self, gain: Array) -> Array:
        """Ln of the density per gain."""
        if self.is_logarithmic:
            return -np.log(gain * math.log(self.high / self.low))
        return np.full_like(gain, -math.log(self.high - self.low))


@dataclass(frozen=True, slots=True)
class Story:
    """What moved the legs of one facet.

    Attributes
    ----------
    kind
        Name of the fault.
    legs
        The legs that the fault is about, counted from 0; empty when it is about all.
    sources
        For each leg: the leg whose orders it followed.
    gains
        For each leg: its travel per travel of the source; an open gain multiplies it.
    open_gain
        Prior of the gain of `open_legs`; None when nothing is open.
    on_top
        A facet whose orders were carried out here besides; None when there is none.
    ln_prior
        Ln of its probability relative to one kind of fault.
    gain, gain_sigma
        The open gain as found: best value and standard deviation.
    """

    kind: StrEnum
    legs: tuple[int, ...]
    sources: tuple[Leg, ...]
    gains: tuple[float, ...]
    ln_prior: float
    open_gain: GainPrior | None = None
    open_legs: tuple[int, ...] = ()
    on_top: int | None = None
    gain: float = math.nan
    gain_sigma: float = math.nan

    @property
    def final_gains(self) -> tuple[float, ...]:
        """For each leg: its travel per travel of the source, with the gain as found."""
        if self.open_gain is None:
            return self.gains
        return tuple(g * self.gain if k in self.open_legs else g for k, g in enumerate(self.gains))

    def travel_m(self, history: FacetHistory, observations: Sequence[Observation]) -> Array:
        """What the legs really travelled by this story, shape (n, n_legs); an open gain is taken as found, or as 1."""
        gains = self.gains if math.isnan(self.gain) else self.final_gains
        rows = np.zeros_like(history.travel_m)
        for row, cycle in zip(rows, history.cycles, strict=True):
            travels = observations[cycle].travels_m
            for k, (source, gain) in enumerate(zip(self.sources, gains, strict=True)):
                ordered = travels.get(source.facet_id)
                row[k] = 0.0 if ordered is None else gain * ordered[source.index]
            if self.on_top is not None and self.on_top in travels:
                row += travels[self.on_top]
        return rows


@dataclass(frozen=True, slots=True)
class Told:
    """A story and the ln of its probability, up to what is common to all stories of the facet."""

    story: Story
    ln_probability: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the judge says of one facet.

    Attributes
    ----------
    story
        The story that is told; None when none is.
    ln_evidence
        By how much it is more probable than the best rival (ln); without a story: 0.
    rivals
        The named stories among which the evidence does not decide, best first; empty when no story fits.
    """

    facet_id: int
    story: Story | None
    ln_evidence: float
    rivals: tuple[Story, ...] = ()


SingleStories = Callable[[FacetHistory], Sequence[Story]]
PairStories = Callable[[FacetHistory, FacetHistory], Sequence[tuple[Story, Story]]]


@dataclass(frozen=True, slots=True)
class _Group:
    """A story of several facets, by how much (ln) it beats their best single stories, and each part its rivals."""

    stories: Mapping[int, Story]
    gain: float
    margins: Mapping[int, float] = field(default_factory=dict)


def judge(
    seen: Mapping[int, FacetHistory],
    observations: Sequence[Observation],
    single_stories: SingleStories,
    pair_stories: PairStories,
) -> dict[int, Verdict]:
    """A verdict for every facet.

    A facet of which "as ordered" (the first of its single stories) is not refuted at four standard deviations gets
    that, unless it clearly has a part in what happened to another. For the others all stories compete, alone and in
    groups; told is what beats every rival by `LN_EVIDENCE`.

    Parameters
    ----------
    single_stories
        Stories of one facet, "as ordered" first.
    pair_stories
        Stories of two facets at once; the first of them must be that each followed the other's orders in full.
    """
    verdicts, suspects, best = {}, {}, {}
    for facet_id, history in seen.items():
        null = single_stories(history)[0]
        chi_square, ln_likelihood = history.deviation(null.travel_m(history, observations)[None])
        best[facet_id] = float(ln_likelihood[0]) + null.ln_prior
        if chi_square[0] <= deviation_limit(len(history.cycles)):
            verdicts[facet_id] = Verdict(facet_id, null, math.inf)
        else:
            suspects[facet_id] = history
    told = {facet_id: tell(history, observations, single_stories(history)) for facet_id, history in suspects.items()}
    unknown = {
        facet_id: history.ln_likelihood_of_anything() + LN_PRIOR_UNKNOWN for facet_id, history in suspects.items()
    }
    best |= {facet_id: max(told[facet_id][0].ln_probability, unknown[facet_id]) for facet_id in suspects}
    groups = _pairs(seen, suspects.keys(), observations, pair_stories, best)
    # With most facets astray the others may well be in the ring too, near their orders by chance.
    in_rings = seen if 2 * len(suspects) > len(seen) else suspects
    groups += _rings(in_rings, len(seen), observations, pair_stories, best)
    in_groups = _told_in_groups(groups, {facet_id: one[0].story for facet_id, one in told.items()})
    verdicts |= {
        facet_id: verdict
        for facet_id, verdict in in_groups.items()
        if verdict.story is not None or facet_id in suspects
    }
    for facet_id in suspects.keys() - verdicts.keys():
        verdicts[facet_id] = _verdict(facet_id, told[facet_id], unknown[facet_id])
    return dict(sorted(verdicts.items()))


def tell(history: FacetHistory, observations: Sequence[Observation], stories: Sequence[Story]) -> list[Told]:
    """Stories of one facet with open gains found, the most probable first."""
    fixed = [story for story in stories if story.open_gain is None]
    travels = np.array([story.travel_m(history, observations) for story in fixed])
    told = [
        Told(story, float(ln_likelihood) + story.ln_prior)
        for story, ln_likelihood in zip(fixed, history.deviation(travels)[1], strict=True)
    ]
    told += [_integrate(history, observations, story) for story in stories if story.open_gain is not None]
    return sorted(told, key=lambda one: -one.ln_probability)


def _integrate(history: FacetHistory, observations: Sequence[Observation], story: Story) -> Told:
    """A story with its open gain found, and its probability integrated over the gain."""
    assert story.open_gain is not None
    travel = story.travel_m(history, observations)
    is_open = np.isin(np.arange(travel.shape[1]), story.open_legs)
    if not np.all(np.isfinite(travel)) or not np.any(travel[:, is_open]):
        return Told(story, -math.inf)
    low, high = story.open_gain.low, story.open_gain.high
    # Twice: the covariance grows with the travel, and with it with the gain.
    gain = 1.0
    for _ in range(2):
        made = np.where(is_open, gain * travel, travel)
        weight = np.linalg.inv(history.covariance_rad2(made[None])[0])
        slope = (np.where(is_open, travel, 0.0) @ history.response_rad_per_m.T).reshape(-1)
        rest = (history.change_rad - np.where(is_open, 0.0, travel) @ history.response_rad_per_m.T).reshape(-1)
        information = float(slope @ weight @ slope)
        gain = float(np.clip(slope @ weight @ rest / information, low, high))
    sigma = information**-0.5
    grid = np.linspace(max(low, gain - _GAIN_REACH * sigma), min(high, gain + _GAIN_REACH * sigma), _N_GAINS)
    _, ln_likelihood = history.deviation(np.where(is_open, grid[:, None, None] * travel, travel))
    ln_weight = ln_likelihood + story.open_gain.ln_density(grid)
    total = float(logsumexp(ln_weight)) + math.log(grid[1] - grid[0])
    share = np.exp(ln_weight - logsumexp(ln_weight))
    mean = float(share @ grid)
    found = replace(story, gain=mean, gain_sigma=float(np.sqrt(share @ (grid - mean) ** 2)))
    return Told(found, total + story.ln_prior)


def _verdict(facet_id: int, told: Sequence[Told], unknown: float) -> Verdict:
    """The verdict on a facet from its single stories."""
    first = told[0].ln_probability
    rivals = [one for one in told if one.ln_probability > max(first, unknown) - LN_EVIDENCE]
    if len(rivals) == 1 and unknown < first - LN_EVIDENCE:
        other = max(unknown, told[1].ln_probability) if len(told) > 1 else unknown
        return Verdict(facet_id, told[0].story, first - other)
    return Verdict(facet_id, None, 0.0, tuple(one.story for one in rivals))


def _pairs(
    seen: Mapping[int, FacetHistory],
    suspects: Collection[int],
    observations: Sequence[Observation],
    pair_stories: PairStories,
    best: Mapping[int, float],
) -> list[_Group]:
    """Stories of a suspect and another facet that beat what can be told of each alone, or rival it."""
    pairs = [(a, b) for a, b in combinations(seen, 2) if a in suspects or b in suspects]
    groups = []
    for a, b in pairs:
        stories = pair_stories(seen[a], seen[b])
        if not stories:
            continue
        gain = _ln_prior_of_ring(2, len(seen)) - best[a] - best[b] + np.zeros(len(stories))
        for side, facet_id in enumerate((a, b)):
            travels = np.array([pair[side].travel_m(seen[facet_id], observations) for pair in stories])
            gain += seen[facet_id].deviation(travels)[1] + np.array([pair[side].ln_prior for pair in stories])
        groups += [
            _Group({a: pair[0], b: pair[1]}, float(one))
            for pair, one in zip(stories, gain, strict=True)
            if one > -LN_EVIDENCE
        ]
    return groups


def _ln_prior_of_ring(size: int, n_facets: int) -> float:
    """Ln prior of one fault that mixes up `size` facets, relative to as many independent faults.

    One fault instead of several, but any of the other facets could have been the next in the ring.
    """
    return (size - 1) * (LN_PRIOR_AS_ORDERED - math.log(n_facets - 1))


def _rings(
    suspects: Mapping[int, FacetHistory],
    n_facets: int,
    observations: Sequence[Observation],
    pair_stories: PairStories,
    best: Mapping[int, float],
) -> list[_Group]:
    """Rings of three and more facets, each moved by the next one's orders: the best assignment of orders to facets."""
    ids = list(suspects)
    if len(ids) < 3:
        return []
    score = np.full((len(ids), len(ids)), -1e9)
    crossed: dict[tuple[int, int], Story] = {}
    for i, a in enumerate(ids):
        followed = []
        for j, b in enumerate(ids):
            pairs = pair_stories(suspects[a], suspects[b]) if i != j else ()
            if pairs:
                crossed[i, j] = pairs[0][0]
                followed.append(j)
        travels = [crossed[i, j].travel_m(suspects[a], observations) for j in followed]
        if travels:
            prior = _ln_prior_of_ring(2, n_facets) / 2.0
            score[i, followed] = suspects[a].deviation(np.array(travels))[1] + prior
        score[i, i] = best[a]
    score = np.maximum(score, -1e9)
    rows, columns = linear_sum_assignment(score, maximize=True)
    total = float(score[rows, columns].sum())
    groups = []
    for ring in _cycles_of(columns):
        if len(ring) < 3:
            continue
        gain = float(sum(score[i, columns[i]] - score[i, i] for i in ring))
        margins = {}
        for i in ring:
            without = score.copy()
            without[i, columns[i]] = -1e9
            r, c = linear_sum_assignment(without, maximize=True)
            margins[ids[i]] = total - float(without[r, c].sum())
        groups.append(_Group({ids[i]: crossed[i, int(columns[i])] for i in ring}, gain, margins))
    return groups


def _cycles_of(permutation: Array) -> list[list[int]]:
    """The cycles of a permutation."""
    left, cycles = set(range(len(permutation))), []
    while left:
        cycle, i = [], min(left)
        while i in left:
            left.remove(i)
            cycle.append(i)
            i = int(permutation[i])
        cycles.append(cycle)
    return cycles


def _told_in_groups(groups: Sequence[_Group], best_single: Mapping[int, Story]) -> dict[int, Verdict]:
    """Verdicts on the facets of the groups that beat the single stories, the strongest group first.

    A group that does not clearly beat another one of some of the same facets, or the single stories, leaves its
    facets without a story: then nobody knows which of them it was.
    """
    verdicts: dict[int, Verdict] = {}
    for group in sorted(groups, key=lambda one: -one.gain):
        if not verdicts.keys().isdisjoint(group.stories):
            continue
        rivals = [
            other
            for other in groups
            if _names(other.stories) != _names(group.stories)
            and other.gain > group.gain - LN_EVIDENCE
            and not group.stories.keys().isdisjoint(other.stories)
            and verdicts.keys().isdisjoint(other.stories)
        ]
        all_margin = min([group.gain] + [group.gain - other.gain for other in rivals])
        for facet_id, story in group.stories.items():
            margin = min(all_margin, group.margins.get(facet_id, math.inf))
            possible = [story, *(other.stories[facet_id] for other in rivals if facet_id in other.stories)]
            if group.gain < LN_EVIDENCE and facet_id in best_single:
                possible.append(best_single[facet_id])
            is_one = len({_name(one) for one in possible}) == 1 and len(possible) > 1
            if margin >= LN_EVIDENCE or is_one:
                verdicts[facet_id] = Verdict(facet_id, story, max(margin, LN_EVIDENCE))
            else:
                verdicts[facet_id] = Verdict(facet_id, None, 0.0, tuple(possible))
    return verdicts


def _name(story: Story) -> tuple[object, ...]:
    """What a story is told as: stories of one name need not be told apart."""
    return story.kind, story.legs, frozenset(source.facet_id for source in story.sources) | {story.on_top}


def _names(stories: Mapping[int, Story]) -> dict[int, tuple[object, ...]]:
    return {facet_id: _name(story) for facet_id, story in stories.items()}

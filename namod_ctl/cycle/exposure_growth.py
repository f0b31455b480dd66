"""What frames at several exposures say of a camera: does the light grow with the exposure, as its law expects?"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from namod_ctl.imaging.exposure import ExposureRule

Array = NDArray[np.float64]

LEVEL_RATIO = 2.0
"""From one exposure to the next: the least of three still shows an eighth of full scale."""

MIN_STEPS = 2
"""Up, and as many down: with fewer of a step nothing is said of it."""

MIN_SHARE = 0.03
"""Of full scale, 8 of 255: light below is not compared."""

MAX_UNCERTAINTY = 0.12
"""Of the growth, in units of what is expected: the check goes on until it is known so well."""

FOLLOWS_FROM, FOLLOWS_TO = 0.6, 1.5
"""Growth of the light, in units of what is expected, of a camera that does what it is told: its law is known to some
10 %, offsets and sky that are taken for light make it smaller; a camera that ignores the exposure shows 0."""

SIGMAS = 3.5
ERROR_OF_MEDIAN = SIGMA_PER_MEAN_DEVIATION = 1.2533  # of normal noise, the first in units of the mean's: sqrt(pi / 2)
_REMEDY = (
    "Switch its automatic exposure, gain and gamma off, and end other programs that use it; a camera without a fixed "
    "exposure cannot be recorded with"
)
READBACK_TOLERANCE = 1.5
"""Cameras make exposures in steps, the coarsest (webcams) by factors of 2: what they report must grow at least so much
less, or at most so much more, than what they were asked for."""


class ExposureFinding(StrEnum):
    """What the check found."""

    FOLLOWS = "follows"
    REFUSED = "refused"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class ExposureLevel:
    """What frames of one exposure showed: the brightest light above the background, as a share of full scale."""

    asked_s: float
    reported_s: float
    light_share: float
    n_frames: int


@dataclass(frozen=True, slots=True)
class ExposureCheck:
    """The outcome for a camera.

    Attributes
    ----------
    text
        The verdict and what it rests on, for a person.
    growth, growth_uncertainty
        Logarithm of the light's growth over that of the expected one, where that is furthest from 1: 1 for a camera
        that follows, 0 for one that ignores the exposure; NaN when nothing could be measured.
    """

    verdict: ExposureFinding
    text: str
    growth: float
    growth_uncertainty: float
    levels: tuple[ExposureLevel, ...]


@dataclass(slots=True)
class ExposureFrames:
    """What was seen: asked and reported exposure, and light as a share of full scale, one entry per frame."""

    asked_s: list[float] = field(default_factory=list)
    reported_s: list[float] = field(default_factory=list)
    light: list[float] = field(default_factory=list)
    n_lost: int = 0


@dataclass(frozen=True, slots=True)
class _Step:
    """From one level to the next: growth of the reported exposure, of the light, and of the expected light, as logs."""

    low: ExposureLevel
    high: ExposureLevel
    reported: float
    expected: float
    seen: float
    sigma: float

    @property
    def growth(self) -> float:
        return self.seen / self.expected

    @property
    def growth_sigma(self) -> float:
        return self.sigma / self.expected

    @property
    def is_honest(self) -> bool:
        return abs(self.reported - math.log(LEVEL_RATIO)) <= math.log(READBACK_TOLERANCE)

    @property
    def is_wrong(self) -> bool:
        margin = SIGMAS * self.growth_sigma
        is_off = self.growth + margin < FOLLOWS_FROM or self.growth - margin > FOLLOWS_TO
        return is_off and self.growth_sigma <= MAX_UNCERTAINTY

    @property
    def is_right(self) -> bool:
        return self.growth_sigma <= MAX_UNCERTAINTY and FOLLOWS_FROM <= self.growth <= FOLLOWS_TO

    def __str__(self) -> str:
        return (
            f"from {self.low.asked_s:.4g} to {self.high.asked_s:.4g} s its light grew {math.exp(self.seen):.2f} times "
            f"(+- {math.expm1(self.sigma):.0%}), expected were {math.exp(self.expected):.2f} times"
        )


def judged(name: str, frames: ExposureFrames, levels_s: list[float], rule: ExposureRule) -> ExposureCheck:
    """What the frames so far say."""
    asked_s, reported_s, light = np.array(frames.asked_s), np.array(frames.reported_s), np.array(frames.light)
    light[~(light >= MIN_SHARE)] = np.nan
    levels = tuple(
        ExposureLevel(
            level_s,
            float(np.median(reported_s[asked_s == level_s])) if level_s in asked_s else math.nan,
            float(np.median(seen)) if len(seen) else math.nan,
            len(seen),
        )
        for level_s in levels_s
        for seen in [light[(asked_s == level_s) & np.isfinite(light)]]
    )
    table = "; ".join(_in_words(level) for level in levels)
    pairs = list(itertools.pairwise(levels))
    moves = [_moves(low, high, asked_s, light) for low, high in pairs]
    sigma = _sigma_of_a_move(moves)
    steps = [_step(low, high, *move, sigma, rule) for (low, high), move in zip(pairs, moves, strict=True)]
    worst = max(steps, key=lambda step: abs(step.growth - 1.0) if math.isfinite(step.sigma) else -1.0)
    verdict, text = ExposureFinding.UNKNOWN, f"{name}: cannot be told whether it makes the exposures it is asked for: "
    if not all(math.isfinite(step.sigma) for step in steps):
        text += f"the light came and went, or does not fit between dark and saturated ({table})"
    elif dishonest := [step for step in steps if not step.is_honest]:
        verdict, worst = ExposureFinding.REFUSED, dishonest[0]
        text = f"{name}: says itself that it makes other exposures than it is asked for ({table}). {_REMEDY}"
    elif wrong := [step for step in steps if step.is_wrong]:
        verdict, worst = ExposureFinding.REFUSED, wrong[0]
        text = f"{name}: does not follow its exposure setting: {worst} ({table}). {_REMEDY}"
    elif all(step.is_right for step in steps):
        verdict, text = ExposureFinding.FOLLOWS, f"{name}: follows its exposure setting: {worst}"
    else:
        text += f"the light changes too much ({worst}; {table}); try again under a steady sky, or with a lamp"
    return ExposureCheck(verdict, text, worst.growth, worst.growth_sigma, levels)


def _moves(low: ExposureLevel, high: ExposureLevel, asked_s: Array, light: Array) -> tuple[Array, Array]:
    """Growth of the light at every step up from one level to the next, and at every step down, as logarithms.

    They are kept apart: a light that grows meanwhile adds to the ones what it takes from the others.
    """
    change = np.diff(np.log(light))  # NaN where either frame shows too little or too much
    before, after = asked_s[:-1], asked_s[1:]
    ups = change[np.isfinite(change) & (before == low.asked_s) & (after == high.asked_s)]
    downs = -change[np.isfinite(change) & (before == high.asked_s) & (after == low.asked_s)]
    return ups, downs


def _sigma_of_a_move(moves: list[tuple[Array, Array]]) -> float:
    """Standard deviation of one step: from all together, as a few may be alike by chance.

    From the mean deviation: nearly as sure as from the squares, and a satellite counts less.
    """
    deviations = [steps - np.median(steps) for both in moves for steps in both if len(steps) >= MIN_STEPS]
    if not deviations:
        return math.inf
    n_free = sum(map(len, deviations)) - len(deviations)  # each median takes one
    share = n_free / sum(map(len, deviations))
    return float(SIGMA_PER_MEAN_DEVIATION * np.mean(np.abs(np.concatenate(deviations))) / math.sqrt(share))


def _step(low: ExposureLevel, high: ExposureLevel, ups: Array, downs: Array, sigma: float, rule: ExposureRule) -> _Step:
    """What all steps between two levels come to; its sigma is infinite with too few of either direction."""
    if min(len(ups), len(downs)) < MIN_STEPS:
        return _Step(low, high, math.nan, math.nan, math.nan, math.inf)
    reported = math.log(max(high.reported_s, 1e-9) / max(low.reported_s, 1e-9))
    expected = rule.response_per_exposure * max(reported, math.log(LEVEL_RATIO / READBACK_TOLERANCE))
    seen = 0.5 * float(np.median(ups) + np.median(downs))
    error = ERROR_OF_MEDIAN * sigma * math.hypot(len(ups) ** -0.5, len(downs) ** -0.5) / 2.0
    return _Step(low, high, reported, expected, seen, error)


def _in_words(level: ExposureLevel) -> str:
    is_same = abs(level.reported_s / level.asked_s - 1.0) < 0.01
    said = "" if is_same else f", it says {level.reported_s:.4g} s"
    light = f"{level.light_share:.1%} of full scale" if level.n_frames else "no usable light"
    return f"{light} at {level.asked_s:.4g} s{said}"

"""Whether a camera does what it is told: the brightness of its frames against the exposures it was asked for.

A camera that makes other exposures than those it reports (an automatic exposure that is not off, a webcam that keeps
its frame rate) spoils every intensity without a trace. So before a recording the exposure goes up and down between a
few lengths, and the growth of the light from one to the next is compared with what the radiometric law expects.

The light itself may change meanwhile. From one frame to the next clouds change it little, and what a change adds on the
way up it takes on the way down; where it changes more, the check says that it cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock
from namod_ctl.cycle.exposure_growth import (
    LEVEL_RATIO,
    ExposureCheck,
    ExposureFinding,
    ExposureFrames,
    judged,
)
from namod_ctl.cycle.frame_integrity import FrameFault, FrameGuard
from namod_ctl.imaging.exposure import (
    LOW_BACKGROUND_SHARE,
    ExposureRule,
    FrameStatistics,
    exposure_rule,
    frame_statistics,
    next_exposure_s,
)
from namod_ctl.optics.camera_model import CameraModel

LONGEST_S = 3.0
"""No frame is exposed longer: the check is to be over within a minute."""

N_SEARCH = 8
"""Frames to find the light: three jumps of the exposure law cross the range of 1 ms to 3 s."""

TARGET_SHARE = 0.6
"""Of full scale at the longest of the exposures: there is room for a light that grows."""

N_STARTS = 3
"""Where the light has left the camera's range meanwhile, it is looked for anew."""

MIN_LIGHT_SHARE = 0.1
"""Of full scale: with less at the longest of the exposures, too little is left at the shortest."""

N_LEVELS = 3
MIN_ROUNDS, MAX_ROUNDS = 3, 12
"""Up and down is a round, four steps of the exposure; 12 decide under light that jumps by 20 % from frame to frame."""

N_MISSES = 5


def refuse_disobedient(
    cameras: Iterable[tuple[Camera, CameraModel, NDArray[np.uint8] | None]], clock: MonotonicClock
) -> list[str]:
    """Check cameras (each with its model and region) before a recording; what was found of each, for a person.

    Raises
    ------
    ConfigError
        One does not make the exposures that it is asked for: the measured numbers. That it cannot be told is no reason.
    DeviceFaultError
        One is lost.
    """
    checks = [check_exposure(camera, model, clock, region) for camera, model, region in cameras]
    refused = [check.text for check in checks if check.verdict is ExposureFinding.REFUSED]
    if refused:
        raise ConfigError("\n".join(refused))
    return [check.text for check in checks]


def check_exposure(
    camera: Camera,
    model: CameraModel,
    clock: MonotonicClock,
    region: NDArray[np.uint8] | None = None,
    timeout_s: float = 2.0,
) -> ExposureCheck:
    """Take frames at several exposures, and judge; the scene is what the camera sees: a star, facets, a lamp.

    Parameters
    ----------
    region
        Where light matters in its frames, see `imaging.exposure.frame_statistics`.

    Raises
    ------
    DeviceFaultError
        The camera is lost.
    """
    shortest_s, longest_s = camera.exposure_range_s
    longest_s = min(longest_s, max(LONGEST_S, shortest_s))
    target_share = min(TARGET_SHARE, 0.8 * model.saturation_share)
    rule = exposure_rule(model, max(shortest_s, 1e-6), longest_s, target_share)
    for _ in range(N_STARTS):
        check = _checked_once(_Look(camera, model, clock, rule, region, timeout_s), camera.name, rule)
        if check.verdict is not ExposureFinding.UNKNOWN or not check.levels:
            break
    return check


def _checked_once(look: _Look, name: str, rule: ExposureRule) -> ExposureCheck:
    """Find the light, and go up and down between exposures there as often as it takes."""
    top_s = look.for_light()
    if top_s is None:
        return look.untold(look.why_no_light())
    levels_s = _levels(top_s, rule)
    if len(levels_s) < N_LEVELS:
        return look.untold(
            f"its exposures from {rule.shortest_s:.3g} to {rule.longest_s:.3g} s leave no room for the check here"
        )
    frames = ExposureFrames()
    for n_round in range(1, MAX_ROUNDS + 1):
        for level_s in _up_and_down(levels_s, is_first=n_round == 1):
            look.at(level_s, frames)
            if frames.n_lost >= N_MISSES:
                return look.untold(f"{frames.n_lost} of its frames did not come")
        if n_round >= MIN_ROUNDS:
            check = judged(name, frames, levels_s, rule)
            if check.verdict is not ExposureFinding.UNKNOWN or not math.isfinite(check.growth_uncertainty):
                break
    return check


class _Look:
    """Takes single frames of a camera and says what light they show."""

    def __init__(
        self,
        camera: Camera,
        model: CameraModel,
        clock: MonotonicClock,
        rule: ExposureRule,
        region: NDArray[np.uint8] | None,
        timeout_s: float,
    ) -> None:
        self._camera, self._model, self._clock, self._rule = camera, model, clock, rule
        self._guard = FrameGuard()
        self._region, self._timeout_s = region, timeout_s
        self._seen: list[tuple[float, FrameStatistics]] = []
        self._is_even = False

    def for_light(self) -> float | None:
        """An exposure in which the light stands well below saturation and well above the dark; None without one."""
        exposure_s = self._rule.clipped(math.sqrt(self._rule.shortest_s * self._rule.longest_s))
        best: tuple[float, float] | None = None
        for _ in range(N_SEARCH):
            taken = self._taken(exposure_s)
            if taken is None:
                continue
            statistics = frame_statistics(taken.image, self._model, self._region)
            self._seen.append((exposure_s, statistics))
            share = statistics.brightest_adu / self._rule.full_scale_adu
            if statistics.brightest_adu < self._rule.saturation_adu and share >= MIN_LIGHT_SHARE:
                distance = abs(share - self._rule.target_share)
                best = min(best or (distance, exposure_s), (distance, exposure_s))
                if distance < 0.15:
                    break
            before_s, exposure_s = exposure_s, next_exposure_s(statistics, exposure_s, self._rule)
            if best is None and len(self._seen) >= N_SEARCH // 2 and exposure_s == before_s:
                break  # at the end of its range
        return self._for_even_light() if best is None else best[1]

    def _for_even_light(self) -> float | None:
        """Where something in the frame is always saturated, the light of the rest of it serves."""
        self._is_even = True
        lit = [
            (abs(share - self._rule.target_share), exposure_s)
            for exposure_s, statistics in self._seen
            if (share := statistics.background_adu / self._rule.full_scale_adu) >= LOW_BACKGROUND_SHARE
            and statistics.background_adu < self._rule.saturation_adu
        ]
        return min(lit)[1] if lit else None

    def at(self, exposure_s: float, frames: ExposureFrames) -> None:
        """Add a frame of that exposure."""
        taken = self._taken(exposure_s)
        if taken is None:
            frames.n_lost += 1
            return
        statistics = frame_statistics(taken.image, self._model, self._region)
        is_offset = statistics.background_adu < LOW_BACKGROUND_SHARE * self._rule.full_scale_adu
        light_adu = seen_adu = statistics.background_adu if self._is_even else statistics.brightest_adu
        if is_offset and not self._is_even:
            light_adu -= statistics.background_adu
        is_saturated = seen_adu >= self._rule.saturation_adu
        frames.asked_s.append(exposure_s)
        frames.reported_s.append(taken.exposure_s)
        frames.light.append(math.nan if is_saturated else light_adu / self._rule.full_scale_adu)

    def why_no_light(self) -> str:
        """Why no exposure showed usable light, with the numbers."""
        if not self._seen:
            return "none of its frames came"
        shares = [statistics.brightest_adu / self._rule.full_scale_adu for _, statistics in self._seen]
        exposures_s = [exposure_s for exposure_s, _ in self._seen]
        span = f"from {min(exposures_s):.3g} to {max(exposures_s):.3g} s"
        if max(shares) < MIN_LIGHT_SHARE:
            return (
                f"it is too dark: its brightest pixel shows {max(shares):.0%} of full scale at most {span}; "
                "point it at a star or a lamp, take the cap off"
            )
        return (
            f"its frames are saturated or dark, nothing between, {span}; point it at a fainter light, or a steady one"
        )

    def untold(self, why: str) -> ExposureCheck:
        """The outcome when nothing could be measured."""
        text = f"{self._camera.name}: cannot be told whether it makes the exposures it is asked for: {why}"
        return ExposureCheck(ExposureFinding.UNKNOWN, text, math.nan, math.nan, ())

    def _taken(self, exposure_s: float) -> Exposure | None:
        begun_s = self._clock.monotonic_s()
        try:
            self._camera.start(exposure_s)
            exposure = self._camera.fetch(self._timeout_s)
        except CommunicationError:
            return None
        fault = self._guard.fault(exposure, begun_s)
        # copies are let pass: a camera that shows the same at every exposure is what is looked for here
        return None if fault is not None and fault[0] is not FrameFault.REPEATED else exposure


def _levels(top_s: float, rule: ExposureRule) -> list[float]:
    """Exposures to compare, ascending: downwards from where the light was found, upwards where there is no room."""
    down = [top_s / LEVEL_RATIO**n for n in range(N_LEVELS)]
    if down[-1] >= rule.shortest_s:
        return down[::-1]
    up = [rule.shortest_s * LEVEL_RATIO**n for n in range(N_LEVELS)]
    return [level_s for level_s in up if level_s <= rule.longest_s]


def _up_and_down(levels_s: list[float], *, is_first: bool) -> Iterator[float]:
    """One round, from the lowest level up and back to it; a later round begins where the last one ended."""
    yield from levels_s if is_first else levels_s[1:]
    yield from levels_s[-2::-1]

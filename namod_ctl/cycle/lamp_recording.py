"""Taking a lamp series with a camera: darks with the cap on, then exposures from long to short and back at every stand.

Who moves the lamp is a person, or the twin: a `LampBench`. Frames are measured as they come; only darks are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from namod_ctl.calibration.lamp.dark_frames import DarkFrame, refuse_light
from namod_ctl.calibration.lamp.lamp_series import (
    Patch,
    PatchDark,
    Placement,
    Response,
    lit_patch,
    measure_response,
    middle_of,
    patch_dark,
    refuse_wandering,
    without_hot,
)
from namod_ctl.core.errors import CommunicationError, DataQualityError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock
from namod_ctl.cycle.frame_integrity import FrameGuard

N_ATTEMPTS = 4
N_SEARCH = 16
TOP_SHARE = 0.85
TOP_RANGE = (0.6, 0.93)
"""Of full scale: where the brightest pixels are to be at the longest useful exposure."""

LEAST_SHARE = 0.015
STEP = 1.45
OVEREXPOSED = (1.06, 1.12, 1.6, 2.5)
"""Times the longest useful exposure: these, at the first stand, show where the camera saturates."""

JUMP = 4.0
VISIBLE_SHARE = 0.04
N_DARK_EXPOSURES = 4
MANY_ROWS = 200
SAMPLE_STEP = 4
"""Of rows and columns, to see how bright a frame is."""


class LampBench(Protocol):
    """Whoever handles lamp and cap."""

    def cap(self) -> None:
        """Return when the cap is on."""
        ...

    def place(self, placement: Placement) -> None:
        """Return when the lamp stands there, or gives that level, and the cap is off."""
        ...


@dataclass(frozen=True, slots=True)
class SeriesPlan:
    """What is to be recorded.

    Attributes
    ----------
    placements
        In any order; `walked` says in which they are visited.
    exposure_range_s
        Exposures are chosen from this range.
    response_per_exposure
        About which power of the exposure the response grows with.
    """

    placements: tuple[Placement, ...]
    exposure_range_s: tuple[float, float]
    response_per_exposure: float
    n_frames: int = 3


@dataclass(slots=True, eq=False)
class LampSeries:
    """What a series gave.

    Attributes
    ----------
    placements
        As they were visited; responses name them by their number.
    """

    placements: list[Placement] = field(default_factory=list)
    responses: list[Response] = field(default_factory=list)
    patch: Patch | None = None
    dark: PatchDark | None = None


def walked(placements: Sequence[Placement]) -> list[Placement]:
    """The order in which stands are visited: every other one going out, the rest coming back, and the first again.

    So a lamp that drifts does not look like one that moves, and the first stand tells how much it did.
    """
    return [*placements[::2], *placements[1::2][::-1], placements[0]]


def dark_exposures_s(exposure_range_s: tuple[float, float]) -> list[float]:
    """Exposures for dark frames: from the shortest to the longest in equal steps of the logarithm."""
    return [float(t) for t in np.geomspace(*exposure_range_s, N_DARK_EXPOSURES)]


def record_darks(camera: Camera, clock: MonotonicClock, exposures_s: Sequence[float], n_frames: int) -> list[DarkFrame]:
    """Frames at these exposures; the cap is on."""
    take = _Taker(camera, clock)
    frames = []
    for exposure_s in exposures_s:
        for number in range(n_frames):
            taken = take.frame(exposure_s)
            frames.append(DarkFrame(f"dark {exposure_s:.3g} s, {number + 1}", taken.image, taken.exposure_s))
    return frames


def record_lamp_series(
    camera: Camera,
    clock: MonotonicClock,
    bench: LampBench,
    plan: SeriesPlan,
    darks: Sequence[DarkFrame],
    full_scale_adu: float,
    say: Callable[[str], None],
) -> LampSeries:
    """The responses of a whole series.

    Raises
    ------
    DataQualityError
        The darks show light, the lamp cannot be seen, or its image wanders.
    CommunicationError, DeviceFaultError
        The camera does not deliver.
    """
    refuse_light(darks, full_scale_adu)
    take = _Taker(camera, clock)
    dark_adu = float(np.median(darks[0].image))
    series = LampSeries()
    exposure_s = math.sqrt(math.prod(plan.exposure_range_s))
    for number, placement in enumerate(walked(plan.placements)):
        bench.place(placement)
        series.placements.append(placement)
        top = _search(take, exposure_s, plan, full_scale_adu, dark_adu)
        exposure_s = top.exposure_s
        if brightness_adu(top.image) >= 0.97 * full_scale_adu:
            say(f"{placement.words}: saturated even at {exposure_s:.3g} s; left out")
            continue
        here = lit_patch(top.image, dark_adu, full_scale_adu, placement.words)
        if series.patch is None:
            series.patch = without_hot(middle_of(here), darks)
            series.dark = patch_dark(darks, series.patch)
        refuse_wandering(series.patch, here, placement)
        exposures = _exposures(
            exposure_s, brightness_adu(top.image) - dark_adu, plan, full_scale_adu, is_first=number == 0
        )
        for one_s in [*exposures[::-1], *exposures]:
            for _ in range(plan.n_frames):
                taken = take.frame(one_s)
                series.responses.append(
                    measure_response(
                        taken.image,
                        series.patch,
                        full_scale_adu,
                        f"{placement.words}, {one_s:.3g} s",
                        number,
                        taken.exposure_s,
                        taken.mid_exposure_s,
                    )
                )
        say(f"{placement.words}: {len(exposures)} exposures from {exposures[0]:.3g} to {exposures[-1]:.3g} s, twice")
    if series.patch is None:
        raise DataQualityError("the lamp saturates the camera at every stand; dim it, or move it away")
    return series


class _Taker:
    """Takes frames of a camera, again when one is lost or is none."""

    def __init__(self, camera: Camera, clock: MonotonicClock) -> None:
        self._camera, self._clock, self._guard = camera, clock, FrameGuard()

    def frame(self, exposure_s: float) -> Exposure:
        """One sound frame. Raises CommunicationError after some attempts."""
        trouble = ""
        for _ in range(N_ATTEMPTS):
            started_s = self._clock.monotonic_s()
            self._camera.start(exposure_s)
            try:
                taken = self._camera.fetch(2.0)
            except CommunicationError as error:
                trouble = str(error)
                continue
            fault = self._guard.fault(taken, started_s)
            if fault is None:
                return taken
            trouble = fault[1]
        raise CommunicationError(f"{self._camera.name}: no sound frame in {N_ATTEMPTS} attempts; {trouble}")


def brightness_adu(image: NDArray[Any]) -> float:
    """Response that a hundredth of the pixels exceeds: of the brightest channel, without single hot pixels."""
    image = image[::SAMPLE_STEP, ::SAMPLE_STEP] if image.shape[0] > MANY_ROWS else image
    pixels = image if image.ndim == 2 else image.max(axis=2)
    return float(np.percentile(pixels, 99.0))


def _search(take: _Taker, exposure_s: float, plan: SeriesPlan, full_scale_adu: float, dark_adu: float) -> Exposure:
    """A frame whose brightest pixels are well below saturation, as long exposed as can be."""
    shortest_s, longest_s = plan.exposure_range_s
    for _ in range(N_SEARCH):
        taken = take.frame(exposure_s)
        share = (brightness_adu(taken.image) - dark_adu) / full_scale_adu
        if TOP_RANGE[0] <= share <= TOP_RANGE[1]:
            return taken
        if share > TOP_RANGE[1]:
            factor = 1.0 / JUMP
        else:
            growth = min(TOP_SHARE / max(share, VISIBLE_SHARE), JUMP**2)
            factor = growth ** (1.0 / plan.response_per_exposure)
        wanted_s = min(max(exposure_s * factor, shortest_s), longest_s)
        if wanted_s == exposure_s:
            return taken
        exposure_s = wanted_s
    return taken


def _exposures(
    top_s: float, light_adu: float, plan: SeriesPlan, full_scale_adu: float, *, is_first: bool
) -> list[float]:
    """Exposures at one stand, ascending: in equal steps from the least useful response to the longest exposure."""
    shortest_s, longest_s = plan.exposure_range_s
    room = max(light_adu / (LEAST_SHARE * full_scale_adu), STEP) ** (1.0 / plan.response_per_exposure)
    least_s = max(top_s / room, shortest_s)
    n_steps = max(int(math.log(top_s / least_s) / math.log(STEP)), 1)
    exposures = list(np.geomspace(least_s, top_s, n_steps + 1)) if least_s < top_s else [top_s]
    if is_first:
        exposures += [top_s * factor for factor in OVEREXPOSED if top_s * factor <= longest_s]
    return [float(exposure_s) for exposure_s in exposures]

"""Image pairs of two cameras that expose at the same time, one after the other without a pause.

Each camera has a worker thread. The star camera's also keeps the two in step: it starts both exposures so that their
middles coincide, gathers both frames, judges their exposures, and takes the pair again when one is too bright or too
dark. It works ahead of whoever uses the pairs by at most `PAIRS_AHEAD`, so the next exposure runs while a pair is
being reduced, and memory stays as it is when the reduction is slower.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock
from namod_ctl.cycle.frame_integrity import FrameFault, FrameGuard
from namod_ctl.imaging.exposure import (
    ExposureRule,
    ExposureVerdict,
    frame_statistics,
    judge_exposure,
    next_exposure_s,
)
from namod_ctl.optics.camera_model import CameraModel

PAIRS_AHEAD = 3
"""Pairs that are kept or being made at a time: one to take, one to wait, one to expose; 7.3 MB each at FACT."""

LOST_CAMERA_RETRY_S = 1.0

LOOK_S = 0.5
"""Whoever waits for the next pair's moment looks so often whether the recording is to end."""


class DropCause(StrEnum):
    """Why an image pair was dropped and taken again; the value is what a person reads."""

    STAR_SATURATED = "star frame saturated"
    STAR_STARVED = "star frame too dark"
    REFLECTOR_SATURATED = "reflector frame saturated"
    REFLECTOR_STARVED = "reflector frame too dark"
    NO_FRAME = "frame lost or torn"
    STALE_FRAME = "the same frame twice"
    LATE_FRAME = "frame of an earlier exposure"
    CAMERA_LOST = "camera lost"


_VERDICT_CAUSE = {
    ("star", ExposureVerdict.SATURATED): DropCause.STAR_SATURATED,
    ("star", ExposureVerdict.STARVED): DropCause.STAR_STARVED,
    ("reflector", ExposureVerdict.SATURATED): DropCause.REFLECTOR_SATURATED,
    ("reflector", ExposureVerdict.STARVED): DropCause.REFLECTOR_STARVED,
}

_FAULT_CAUSE = {
    FrameFault.INCOMPLETE: DropCause.NO_FRAME,
    FrameFault.REPEATED: DropCause.STALE_FRAME,
    FrameFault.LATE: DropCause.LATE_FRAME,
}


class SourceExhaustedError(Exception):
    """A camera of stored frames has shown its last one."""


class TimeIsUpError(Exception):
    """The moment has come from which on no more pairs are begun."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two exposures made at the same time, and the time of day when they were done.

    `look` is a second exposure of the star right after them, where the pair before is too long ago to tell how fast
    the telescope moves.
    """

    star: Exposure
    reflector: Exposure
    done: datetime
    look: Exposure | None = None

    @property
    def end_s(self) -> float:
        """When the last of its exposures ended, on the cameras' clock."""
        exposures = [exposure for exposure in (self.star, self.reflector, self.look) if exposure is not None]
        return max(exposure.mid_exposure_s + exposure.exposure_s / 2.0 for exposure in exposures)


@dataclass(slots=True, eq=False)
class _Taking:
    """A pair that is being taken, or waits to be used, and what befell the cameras until it was good."""

    future: Future[Pair | None] = field(init=False)
    dropped: Counter[DropCause] = field(default_factory=Counter)
    n_frames_missed: int = 0


@dataclass(frozen=True, slots=True)
class SourceStatus:
    """How the cameras are doing. What befell pairs that nobody has asked for yet does not count.

    Attributes
    ----------
    dropped
        Pairs that were dropped, by cause, in the order of the causes.
    n_frames_missed
        Frames that a camera counted but never delivered.
    trouble
        What is wrong at this moment, for a person; empty when nothing is.
    """

    dropped: dict[DropCause, int]
    n_frames_missed: int
    trouble: str


class CameraLine:
    """One camera with its exposure law.

    Parameters
    ----------
    role
        "star" or "reflector".
    region
        Where light matters in its frames, see `imaging.exposure.frame_statistics`.

    Attributes
    ----------
    guard
        Looks for frames that are none; None for stored frames, which were looked at when they were taken.
    """

    def __init__(
        self,
        role: str,
        camera: Camera,
        model: CameraModel,
        rule: ExposureRule,
        first_exposure_s: float,
        region: NDArray[np.uint8] | None = None,
    ) -> None:
        self.role = role
        self.camera = camera
        self.exposure_s = rule.clipped(first_exposure_s)
        self.guard: FrameGuard | None = FrameGuard()
        self._model, self._rule, self._limited, self._region = model, rule, rule, region
        self._begun_s = -math.inf

    def limit(self, longest_s: float) -> None:
        """From now on expose no longer than `longest_s`, nor longer than the rule says."""
        longest_s = min(max(longest_s, self._rule.shortest_s), self._rule.longest_s)
        self._limited = replace(self._rule, longest_s=longest_s)
        self.exposure_s = self._limited.clipped(self.exposure_s)

    def begin(self, now_s: float) -> None:
        """Begin an exposure of `exposure_s`; `now_s` is on the cameras' clock. Raises DeviceFaultError."""
        self._begun_s = now_s
        self.camera.start(self.exposure_s)

    def finish(self, timeout_s: float) -> tuple[Exposure | None, DropCause | None, str]:
        """The exposure begun last, why it is to be dropped (None if it is good), and that in words.

        Sets `exposure_s` for the next one.
        """
        try:
            exposure = self.camera.fetch(timeout_s)
        except CommunicationError as error:
            return None, DropCause.NO_FRAME, str(error)
        except DeviceFaultError as error:
            return None, DropCause.CAMERA_LOST, str(error)
        fault = None if self.guard is None else self.guard.fault(exposure, self._begun_s)
        if fault is not None:
            return None, _FAULT_CAUSE[fault[0]], f"{self.camera.name}: {fault[1]}"
        statistics = frame_statistics(exposure.image, self._model, self._region)
        verdict = judge_exposure(statistics, exposure.exposure_s, self._limited)
        self.exposure_s = next_exposure_s(statistics, exposure.exposure_s, self._limited)
        detail = f"{self.camera.name}: {verdict} at {exposure.exposure_s:.4g} s"
        return exposure, _VERDICT_CAUSE.get((self.role, verdict)), detail


class PairSource:
    """Takes pairs from `__enter__` on until it is closed.

    Parameters
    ----------
    max_retakes
        So often a pair is taken again for its exposure; then it is delivered as it is, for the measurement to judge.
        0: stored frames, none of which may be left out.
    timeout_s
        How long after its exposure a frame is waited for.
    pace_s
        From the start of one pair to that of the next, at least.
    look_after_s
        A pair that comes so long after the one before gets a second look at the star; None: none does.

    Attributes
    ----------
    end_s
        On the cameras' clock: from then on no pair is begun.
    """

    def __init__(
        self,
        star: CameraLine,
        reflector: CameraLine,
        clock: MonotonicClock,
        wall_clock: Clock,
        max_retakes: int,
        timeout_s: float,
        pace_s: float = 0.0,
        look_after_s: float | None = None,
    ) -> None:
        self.end_s = math.inf
        self._star, self._reflector = star, reflector
        if max_retakes == 0:
            star.guard = reflector.guard = None
        self._clock, self._wall_clock = clock, wall_clock
        self._max_retakes, self._timeout_s, self._pace_s = max_retakes, timeout_s, pace_s
        self._look_after_s, self._star_seen_s = look_after_s, -math.inf
        self._next_start_s = clock.monotonic_s()
        self._star_worker = ThreadPoolExecutor(1, "star_camera")
        self._reflector_worker = ThreadPoolExecutor(1, "reflector_camera")
        self._in_flight: deque[_Taking] = deque()
        self._is_closing = threading.Event()
        self._lock = threading.Lock()
        self._dropped: Counter[DropCause] = Counter()
        self._n_frames_missed = 0
        self._is_awaited = False
        self._trouble = ""

    def __enter__(self) -> Self:
        for _ in range(PAIRS_AHEAD):
            self._submit(math.inf)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closing.set()
        self._star_worker.shutdown(wait=False, cancel_futures=True)
        for line in (self._star, self._reflector):
            line.camera.close()  # aborts what is being exposed
        self._star_worker.shutdown()
        self._reflector_worker.shutdown()

    def next(self, timeout_s: float, longest_s: float = math.inf) -> Pair | None:
        """The next pair; None when it has not come within `timeout_s`.

        The pair that is begun in its place is exposed for `longest_s` at most. So what limits a pair is known of those
        `PAIRS_AHEAD` before it, however fast they are reduced: a twin's recording can be repeated.

        Raises
        ------
        SourceExhaustedError
            There are no more.
        TimeIsUpError
            It would have begun after `end_s`.
        """
        self._is_awaited = True
        try:
            pair = self._in_flight[0].future.result(timeout_s)
        except TimeoutError:
            return None
        with self._lock:
            taken = self._in_flight.popleft()
            self._dropped.update(taken.dropped)
            self._n_frames_missed = taken.n_frames_missed
            self._is_awaited = False
        self._submit(longest_s)
        return pair

    @property
    def status(self) -> SourceStatus:
        """How the cameras are doing at this moment.

        Of pairs that are taken ahead, only that which is waited for counts: how far ahead the cameras are depends on
        how fast the computer is, and a twin's recording can be repeated.
        """
        with self._lock:
            dropped, missed = self._dropped.copy(), self._n_frames_missed
            if self._is_awaited:
                dropped.update(self._in_flight[0].dropped)
                missed = max(missed, self._in_flight[0].n_frames_missed)
            return SourceStatus({cause: dropped[cause] for cause in DropCause if dropped[cause]}, missed, self._trouble)

    def _submit(self, longest_s: float) -> None:
        taking = _Taking()
        taking.future = self._star_worker.submit(self._take, longest_s, taking)
        self._in_flight.append(taking)

    def _take(self, longest_s: float, taking: _Taking) -> Pair | None:
        """The next pair that is good; None when the source is being closed. Runs in the star camera's thread."""
        n_retakes = 0
        self._star.limit(longest_s)
        self._reflector.limit(longest_s)
        if self._next_start_s >= self.end_s:
            raise TimeIsUpError
        while (early_s := self._next_start_s - self._clock.monotonic_s()) > 0.0 and not self._is_closing.is_set():
            self._clock.wait_s(min(early_s, LOOK_S))
        self._next_start_s = max(self._next_start_s, self._clock.monotonic_s()) + self._pace_s
        while not self._is_closing.is_set():
            if self._clock.monotonic_s() >= self.end_s:
                raise TimeIsUpError
            if not self._start_both(taking):
                self._clock.wait_s(LOST_CAMERA_RETRY_S)
                continue
            reflector_done = self._reflector_worker.submit(self._reflector.finish, self._timeout_s)
            star, star_cause, star_detail = self._star.finish(self._timeout_s)
            reflector, reflector_cause, reflector_detail = reflector_done.result()
            causes = [cause for cause in (star_cause, reflector_cause) if cause is not None]
            is_complete = star is not None and reflector is not None
            if star is not None and reflector is not None and (not causes or n_retakes >= self._max_retakes):
                self._note(taking, (), "")
                return Pair(star, reflector, self._wall_clock.now(), self._second_look(star))
            details = [d for d, c in ((star_detail, star_cause), (reflector_detail, reflector_cause)) if c is not None]
            self._note(taking, causes, "; ".join(details))
            n_retakes += is_complete
            if DropCause.CAMERA_LOST in causes:
                self._clock.wait_s(LOST_CAMERA_RETRY_S)
        return None

    def _second_look(self, star: Exposure) -> Exposure | None:
        """The star once more, right after a pair that follows the one before too late; None elsewhere, or in vain."""
        since_s, self._star_seen_s = star.mid_exposure_s - self._star_seen_s, star.mid_exposure_s
        if self._look_after_s is None or since_s <= self._look_after_s:
            return None
        for _ in range(self._max_retakes + 1):
            try:
                self._star.begin(self._clock.monotonic_s())
            except DeviceFaultError:
                return None  # the next pair says so
            look, cause, _ = self._star.finish(self._timeout_s)
            if look is not None and cause is None:
                return look
        return None

    def _start_both(self, taking: _Taking) -> bool:
        """Start both exposures, the longer first and the shorter in its middle; False when a camera is lost."""
        first, second = sorted((self._reflector, self._star), key=lambda line: -line.exposure_s)
        lead_s = 0.5 * (first.exposure_s - second.exposure_s)
        for line in (first, second):
            if line is second and lead_s > 0.0:
                self._clock.wait_s(lead_s)
            try:
                line.begin(self._clock.monotonic_s())
            except DeviceFaultError as error:
                self._note(taking, (DropCause.CAMERA_LOST,), str(error))
                if line is second:
                    first.finish(self._timeout_s)
                return False
        return True

    def _note(self, taking: _Taking, causes: tuple[DropCause, ...] | list[DropCause], trouble: str) -> None:
        if self._is_closing.is_set():  # a camera that is closed delivers nothing, and that is no news
            return
        with self._lock:
            taking.dropped.update(causes)
            guards = [line.guard for line in (self._star, self._reflector) if line.guard is not None]
            taking.n_frames_missed = sum(guard.n_missed for guard in guards)
            self._trouble = trouble

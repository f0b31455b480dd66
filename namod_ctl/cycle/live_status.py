"""The state of a recording as other programs see it: a note in the run, replaced now and then while it is recorded.

It says what the records do not: what was taken again, what is wrong and what to do about it, what is waited for. The
records are there without it, and a run whose recording was killed keeps the last one.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from pydantic import TypeAdapter, ValidationError

from namod_ctl.core.errors import StoreError
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.pairs import DropCause, Pair
from namod_ctl.cycle.progress import Progress
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.store.frames import REFLECTOR_CAMERA, STAR_CAMERA
from namod_ctl.store.live_pictures import picture_of, put_live_picture

NOTE_LIVE = "record.live"

EVERY_S = 0.5
"""The note is replaced no more often, by the computer's clock;"""
HEARTBEAT_S = 5.0
"""and so often even when nothing has changed, so that everybody sees that somebody is still at work."""

PICTURE_EVERY_S = 2.0
"""A pair of FACT's frames is made into pictures and written in 8 ms (bench_live): half a percent of the time."""


@dataclass(frozen=True, slots=True)
class LiveStatus:
    """What the crew is told beside the records.

    Attributes
    ----------
    n_wanted
        Records that count, after which the recording ends; None when something else ends it.
    region_radius_rad
        Of the directions that are to be covered.
    exposure_limits_s
        Shortest and longest exposure, by the camera's role ("star", "reflector").
    longest_now_s
        What the telescope's motion allows at the moment; infinite while it is not known, or stands.
    elapsed_s, rate_per_min, dropped, n_frames_missed, trouble, warning, is_halted, estimate
        See `progress.Progress`.
    waits_for
        What happens next, for a person; empty when it has ended.
    ended
        Why the recording has ended; empty while it goes on.
    """

    n_wanted: int | None
    region_radius_rad: float
    exposure_limits_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    longest_now_s: float = math.inf
    elapsed_s: float = 0.0
    rate_per_min: float = 0.0
    dropped: Mapping[DropCause, int] = field(default_factory=dict)
    n_frames_missed: int = 0
    trouble: str = ""
    warning: str = ""
    is_halted: bool = False
    estimate: LiveEstimate | None = None
    waits_for: str = ""
    ended: str = ""

    @classmethod
    def of(
        cls,
        progress: Progress,
        exposure_limits_s: Mapping[str, tuple[float, float]],
        longest_now_s: float,
        waits_for: str,
        ended: str = "",
    ) -> LiveStatus:
        """The status that goes with a progress."""
        return cls(
            n_wanted=progress.n_wanted,
            region_radius_rad=progress.coverage.radius_rad,
            exposure_limits_s=exposure_limits_s,
            longest_now_s=longest_now_s,
            elapsed_s=progress.elapsed_s,
            rate_per_min=progress.rate_per_min,
            dropped=progress.source.dropped,
            n_frames_missed=progress.source.n_frames_missed,
            trouble=progress.trouble,
            warning=progress.warning,
            is_halted=progress.is_halted,
            estimate=progress.estimate,
            waits_for=waits_for,
            ended=ended,
        )

    def to_json(self) -> str:
        """One JSON object, in which NaN and Infinity stand for themselves, as Python's `json` writes and reads them."""
        return json.dumps(_AS_JSON.dump_python(self, mode="json"))

    @classmethod
    def from_json(cls, text: str) -> LiveStatus | None:
        """The status in such a text; None when it is of another version of the program."""
        try:
            return _AS_JSON.validate_json(text)
        except ValidationError:
            return None

    def says_the_same(self, other: LiveStatus | None) -> bool:
        """Do both say the same, but for the time that has passed?"""
        return other is not None and replace(other, elapsed_s=self.elapsed_s, rate_per_min=self.rate_per_min) == self


_AS_JSON = TypeAdapter(LiveStatus)


class Notebook(Protocol):
    """What a status is left in: a run."""

    def set_note(self, key: str, text: str, *, is_passing: bool = False) -> None:
        """Note something, in place of what stood under `key`."""
        ...


class LiveNote:
    """Keeps the note in a run up to date.

    Mostly it goes along with a record, in its transaction. In between it costs no fsync.
    """

    def __init__(self, run: Notebook, now_s: Callable[[], float] = time.monotonic) -> None:
        self._run, self._now_s = run, now_s
        self._written_s = -math.inf
        self._written: LiveStatus | None = None

    def with_record(self, status: Callable[[], LiveStatus]) -> dict[str, str]:
        """Notes to set with a record that is about to be stored: the status, if it is time for it."""
        return {NOTE_LIVE: self._taken(status())} if self._is_due(EVERY_S) else {}

    def tell(self, status: Callable[[], LiveStatus], *, now: bool = False) -> None:
        """Leave the status in the run if it is time for it and it says anything new, or `now`.

        Without a word where the disk refuses: whoever stores the records says so.
        """
        if not (now or self._is_due(EVERY_S)):
            return
        said = status()
        if now or self._is_due(HEARTBEAT_S) or not said.says_the_same(self._written):
            with suppress(StoreError):
                self._run.set_note(NOTE_LIVE, self._taken(said), is_passing=True)

    def _is_due(self, after_s: float) -> bool:
        return self._now_s() >= self._written_s + after_s

    def _taken(self, said: LiveStatus) -> str:
        self._written, self._written_s = said, self._now_s()
        return said.to_json()


class LivePictures:
    """Shows the newest pair of frames in the run's folder, now and then."""

    def __init__(self, run: Path, star: CameraModel, reflector: CameraModel) -> None:
        self._run, self._star, self._reflector = run, star, reflector
        self._shown_s = -math.inf

    def show(self, record_index: int, pair: Pair) -> None:
        """Show the pair of a record that is stored, if it is time for it."""
        now_s = time.monotonic()
        if now_s < self._shown_s + PICTURE_EVERY_S:
            return
        self._shown_s = now_s
        for camera, model, exposure in (
            (STAR_CAMERA, self._star, pair.star),
            (REFLECTOR_CAMERA, self._reflector, pair.reflector),
        ):
            picture = picture_of(exposure.image, model.full_scale_adu)
            put_live_picture(self._run, record_index, camera, picture)

"""What the crew sees while a run is recorded, and the warnings it gets; all from what has happened so far."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.flags import REJECT_REASON_MEANING, RejectReason
from namod_ctl.core.records import Record
from namod_ctl.cycle.coverage import Coverage, empty_coverage, where_next, with_record
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.pairs import DropCause, SourceStatus

WARN_AFTER_S = 30.0
WARN_AFTER_PACES = 4.0
"""With so many pairs at least behind it: one that is rejected by chance is no trouble."""
RATE_OVER_S = 60.0
MAX_RECENT = 10_000
"""Records looked back on: more than a minute has, and few enough to keep."""

_REMEDY_OF_REJECTION = {
    RejectReason.NO_STAR: "wait for the cloud to pass, or bring the star back into the star camera's field",
    RejectReason.SEVERAL_STARS: "choose a reference star that stands alone, or check for reflections and lamps",
    RejectReason.STAR_TOO_SMALL: "wait for the cloud to pass, or bring the star back into the field; is the cap off?",
    RejectReason.STAR_TOO_LARGE: "focus the star camera, wipe dew off its lens, or wait for the cloud to pass",
    RejectReason.STAR_SATURATED: "choose a fainter star, or close the star camera's aperture",
    RejectReason.STAR_UNDEREXPOSED: "choose a brighter star, or open the star camera's aperture",
    RejectReason.STAR_STREAK: "let the telescope wander more slowly, or wait for the satellite or aircraft to pass",
    RejectReason.STAR_AT_EDGE: "bring the star back to the middle of the star camera's field",
    RejectReason.REFLECTOR_SATURATED: "choose a fainter star, or close the reflector camera's aperture",
    RejectReason.TELESCOPE_MOVED: "let the telescope wander more slowly",
}
_REMEDY_OF_DROP = {
    DropCause.STAR_SATURATED: "choose a fainter star, or close the star camera's aperture",
    DropCause.STAR_STARVED: "wait for the cloud to pass, or choose a brighter star",
    DropCause.REFLECTOR_SATURATED: "choose a fainter star, or close the reflector camera's aperture",
    DropCause.REFLECTOR_STARVED: "choose a brighter star, or open the reflector camera's aperture",
    DropCause.NO_FRAME: "check the camera's cable and that no other program loads the network or the USB",
    DropCause.STALE_FRAME: "take the camera's plug out and in again",
    DropCause.LATE_FRAME: "check that no other program loads the network or the USB, and that none triggers the camera",
    DropCause.CAMERA_LOST: "check the camera's cable and power: the recording goes on when it is back",
}


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """The state of a recording.

    Attributes
    ----------
    n_accepted, n_wanted
        Records that count, in the whole run; wanted is None when something else ends the run.
    rejected
        Rejected records of this session by reason.
    elapsed_s
        Since this session began, on the cameras' clock.
    rate_per_min
        Accepted records during the last minute, per minute.
    star_magnitude
        Of the star as it is seen, behind air and clouds; NaN without a star.
    is_magnitude_relative
        True where the camera's zero point is not known: `star_magnitude` then counts from the brightest star that the
        run has seen, and is how much fainter it is at the moment.
    theta_rad, next_theta_rad
        Shape (2,). Where the star stands (NaN when it is not seen), and where it should stand next.
    estimate
        The last live estimate, None before the first.
    trouble
        What is wrong at this moment; empty when nothing is.
    warning
        What stops the recording, or has been wrong for `WARN_AFTER_S` and some pairs, and what to do about it; empty
        when nothing is.
    is_halted
        The recording stands still for something that is wrong with the computer, such as a full disk.
    """

    n_accepted: int
    n_wanted: int | None
    rejected: dict[RejectReason, int]
    source: SourceStatus
    elapsed_s: float
    rate_per_min: float
    star_exposure_s: float
    reflector_exposure_s: float
    star_magnitude: float
    is_magnitude_relative: bool
    theta_rad: NDArray[np.float64]
    next_theta_rad: NDArray[np.float64]
    coverage: Coverage
    estimate: LiveEstimate | None
    trouble: str
    warning: str
    is_halted: bool = False


@dataclass(slots=True)
class Tracker:
    """Counts what happens; `snapshot` says what it comes to."""

    region_radius_rad: float
    start_s: float
    star_zero_point_mag: float | None = None
    pace_s: float = 0.0
    n_wanted: int | None = None
    n_accepted: int = 0
    rejected: Counter[RejectReason] = field(default_factory=Counter)
    last: Record | None = None
    last_accepted_s: float = math.nan
    brightest_star: float = 0.0
    recent: deque[tuple[float, RejectReason | None]] = field(default_factory=lambda: deque(maxlen=MAX_RECENT))
    dropped_before: dict[DropCause, int] = field(default_factory=dict)
    coverage: Coverage = field(init=False)

    def __post_init__(self) -> None:
        self.coverage = empty_coverage(self.region_radius_rad)
        self.last_accepted_s = self.start_s

    def add_earlier(self, record: Record) -> None:
        """Count a record of an earlier session of the run."""
        if record.reject_reason is None:
            self._count(record)

    def add(self, record: Record, now_s: float, source: SourceStatus) -> None:
        """Count a record that has just been stored."""
        self.last = record
        self.recent.append((now_s, record.reject_reason))
        if record.reject_reason is None:
            self._count(record)
            self.last_accepted_s = now_s
            self.dropped_before = source.dropped
        else:
            self.rejected[record.reject_reason] += 1

    def snapshot(
        self, now_s: float, source: SourceStatus, estimate: LiveEstimate | None, trouble: str = ""
    ) -> Progress:
        """The state at this moment; `trouble` of the computer, which stops the recording, hides all other."""
        last = self.last
        theta_rad = np.full(2, np.nan) if last is None else last.theta_rad
        zero_point_mag = self.star_zero_point_mag
        if zero_point_mag is None:
            zero_point_mag = -magnitude(self.brightest_star)
        return Progress(
            n_accepted=self.n_accepted,
            n_wanted=self.n_wanted,
            rejected={reason: self.rejected[reason] for reason in RejectReason if self.rejected[reason]},
            source=source,
            elapsed_s=now_s - self.start_s,
            rate_per_min=rate_per_min(self.recent, self.start_s, now_s),
            star_exposure_s=math.nan if last is None else last.star_exposure_s,
            reflector_exposure_s=math.nan if last is None else last.reflector_exposure_s,
            star_magnitude=math.nan if last is None else zero_point_mag + magnitude(last.star_intensity),
            is_magnitude_relative=self.star_zero_point_mag is None,
            theta_rad=theta_rad,
            next_theta_rad=where_next(self.coverage, theta_rad),
            coverage=self.coverage,
            estimate=estimate,
            trouble=trouble or source.trouble,
            warning=trouble or self._warning(now_s, source),
            is_halted=bool(trouble),
        )

    def _count(self, record: Record) -> None:
        self.n_accepted += 1
        self.coverage = with_record(self.coverage, record.theta_rad)
        self.brightest_star = max(self.brightest_star, record.star_intensity)

    def _warning(self, now_s: float, source: SourceStatus) -> str:
        if now_s - self.last_accepted_s < max(WARN_AFTER_S, WARN_AFTER_PACES * self.pace_s):
            return ""
        since = Counter({cause: n - self.dropped_before.get(cause, 0) for cause, n in source.dropped.items()})
        rejected = Counter(
            reason for time_s, reason in self.recent if time_s > self.last_accepted_s and reason is not None
        )
        text = warning_text(now_s - self.last_accepted_s, rejected, since)
        # what is being tried to bring a camera back, and what a person can do
        return f"{text}; {source.trouble}" if since[DropCause.CAMERA_LOST] and source.trouble else text


def magnitude(intensity: float) -> float:
    """-2.5 log10 of an intensity; NaN for none."""
    return -2.5 * math.log10(intensity) if intensity > 0.0 else math.nan


def rate_per_min(recent: deque[tuple[float, RejectReason | None]], start_s: float, now_s: float) -> float:
    """Accepted records per minute over the last `RATE_OVER_S`, or since the start when that is less."""
    span_s = min(RATE_OVER_S, now_s - start_s)
    if span_s <= 0.0:
        return 0.0
    n = sum(reason is None for time_s, reason in recent if time_s > now_s - span_s)
    return 60.0 * n / span_s


def warning_text(wrong_for_s: float, rejected: Counter[RejectReason], dropped: Counter[DropCause]) -> str:
    """What stands in the way, the most frequent reason first, and what to do about it."""
    text = f"no record counted for {wrong_for_s:.0f} s"
    n_rejected, n_dropped = max(rejected.values(), default=0), max(dropped.values(), default=0)
    if n_rejected == 0 and n_dropped <= 0:
        return f"{text}: no frames arrive; check that the cameras are on and their cables in place"
    if n_rejected >= n_dropped:
        reason = rejected.most_common(1)[0][0]
        remedy = _REMEDY_OF_REJECTION.get(reason, "look at the frames")
        records = "1 record" if n_rejected == 1 else f"{n_rejected} records"
        return f"{text}: {REJECT_REASON_MEANING[reason]} ({records}); {remedy}"
    cause = dropped.most_common(1)[0][0]
    times = "once" if n_dropped == 1 else f"{n_dropped} times"
    return f"{text}: {cause} ({times}); {_REMEDY_OF_DROP[cause]}"

"""What the page shows of one run while it grows: counts, exposures, where the star stands and where it should go."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.dashboard.numbers import short, shorts
from namod_ctl.app.views.recording_view import star_brightness, steering
from namod_ctl.core.flags import REJECT_REASON_MEANING, RejectReason
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin, rad_to_deg
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.pairs import SourceStatus
from namod_ctl.cycle.progress import Progress, Tracker
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.database import DATABASE_NAME
from namod_ctl.store.frames import STAR_CAMERA
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_tail import Brightest, RunTail

_NO_WORD = SourceStatus({}, 0, "")  # what cameras drop before it becomes a record: `LiveStatus` has it
_NOWHERE = np.full(2, math.nan)
_MIN_ROUGH = 20  # records
_CLEARLY = 2.5  # times its mean over all directions, most of which do not light it

MAX_SAMPLES = 3000
"""Points of a facet's map that the page draws: the last ones."""


class RunGlance:
    """Follows one run; a context manager, for one thread.

    Parameters
    ----------
    key
        Name of the run on the page: the number of its cycle, 0 for a run that belongs to no campaign.
    """

    def __init__(self, path: Path, config: InstrumentConfig, instrument: Instrument, key: int) -> None:
        self.path, self.key, self._instrument = path, key, instrument
        self._settings = build_record_settings(config)
        self._tracker = self._new_tracker(self._settings.region_radius_rad)
        self._live_text: str | None = None
        self._live: LiveStatus | None = None
        self._tail = RunTail(path)
        self._n_seen = 0
        self._brightest: dict[int, Brightest] = {}
        self._time_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the run."""
        self._tail.close()

    def update(self) -> bool:
        """Read what has come; False when nothing was written since the last look."""
        if not self._tail.has_changed():
            return False
        self._look_at_live()
        for record in self._tail.new_records():
            if math.isfinite(record.star_mid_exposure_s):
                self._time_s = record.star_mid_exposure_s
            if self._n_seen == 0:
                self._tracker.start_s = self._time_s
            self._tracker.add(record, self._time_s, _NO_WORD)
            self._n_seen += 1
        for facet_id, found in self._tail.new_brightest().items():
            known = self._brightest.get(facet_id)
            self._brightest[facet_id] = found if known is None else known.joined(found)
        return True

    def _look_at_live(self) -> None:
        """What the recorder says beside its records; with another region the coverage is counted anew."""
        text = self._tail.note(NOTE_LIVE)
        if text == self._live_text:
            return
        self._live_text = text
        self._live = None if text is None else LiveStatus.from_json(text)
        if self._live is not None and self._live.region_radius_rad != self._tracker.region_radius_rad:
            self._tracker = self._new_tracker(self._live.region_radius_rad)
            self._tail.rewind()
            self._n_seen = 0

    def _new_tracker(self, region_radius_rad: float) -> Tracker:
        return Tracker(region_radius_rad, 0.0, self._settings.star_zero_point_mag)

    def rough_centres_rad(self) -> dict[int, NDArray[np.float64]]:
        """Direction of the record in which a facet shone most, shape (2,), by facet id; of those that shone clearly.

        Good to the distance of neighbouring records: for a first look while nothing better is known.
        Source: the instruction graphic of arXiv:1605.06274.
        """
        return {
            facet_id: found.theta_rad
            for facet_id, found in self._brightest.items()
            if found.n_records >= _MIN_ROUGH and found.intensity * found.n_records > _CLEARLY * found.total_intensity
        }

    def estimate_id(self) -> int:
        """Number of the run's latest estimate, 0 without one."""
        return self._tail.latest_estimate_id()

    def now(self) -> dict[str, Any]:
        """The state of the recording, for JSON."""
        tracker = self._tracker
        progress = tracker.snapshot(self._time_s, _NO_WORD, None)
        last = tracker.last
        coverage = progress.coverage
        most = max(int(coverage.counts.max()), 1)
        frames = self._tail.latest_frames()
        theta_of_picture_rad = self._tail.theta_rad(frames[STAR_CAMERA]) if STAR_CAMERA in frames else _NOWHERE
        return {
            "run": self.key,
            "name": self.path.name,
            "n_accepted": progress.n_accepted,
            "n_rejected": sum(progress.rejected.values()),
            "rejected": [
                {"reason": reason.value.replace("_", " "), "meaning": REJECT_REASON_MEANING[reason], "n": n}
                for reason, n in progress.rejected.items()
            ],
            "live": None if self._live is None else _live_section(self._live),
            "rate_per_min": short(progress.rate_per_min),
            "elapsed_s": short(progress.elapsed_s),
            "star_exposure_s": short(progress.star_exposure_s),
            "reflector_exposure_s": short(progress.reflector_exposure_s),
            "star": star_brightness(progress),
            "theta_deg": shorts(rad_to_deg(progress.theta_rad)),
            "next_deg": shorts(rad_to_deg(progress.next_theta_rad)),
            "steering": steering(progress),
            "last": None if last is None else self._last(progress),
            "written_utc_s": round(self._written_s(), 1),
            "star_px": _pixel(self._instrument, progress.theta_rad),
            "coverage": {
                "radius_deg": short(rad_to_deg(coverage.radius_rad)),
                "share": short(coverage.share),
                "most": most,
                "counts": coverage.counts.tolist(),
                "inside": coverage.is_inside.astype(int).tolist(),
            },
            "frames": frames,
            "frame_star_px": _pixel(self._instrument, theta_of_picture_rad),
        }

    def silent_s(self) -> float:
        """For how long nothing has been written to the run."""
        return max(time.time() - self._written_s(), 0.0)

    def samples(self, facet_id: int) -> list[list[float | None]]:
        """Star direction in arcmin and response of the facet in each record that counts: [x, y, response]."""
        found = self._tail.samples_of(facet_id)
        known = np.isfinite(found.intensity)
        table = np.column_stack([rad_to_arcmin(found.theta_rad), found.intensity])[known][-MAX_SAMPLES:]
        return [shorts(row) for row in table]

    def _last(self, progress: Progress) -> dict[str, Any]:
        last = self._tracker.last
        assert last is not None
        reason: RejectReason | None = last.reject_reason
        return {
            "index": last.index,
            "label": last.label,
            "is_accepted": reason is None,
            "why": "" if reason is None else last.detail or REJECT_REASON_MEANING[reason],
            "magnitude": short(progress.star_magnitude),
            "is_relative": progress.is_magnitude_relative,
        }

    def _written_s(self) -> float:
        """When the run was written last, by the computer's clock."""
        database = self.path / DATABASE_NAME
        written_s = 0.0
        for file in (database, database.with_name(database.name + "-wal")):
            try:
                if file == database or file.stat().st_size:
                    written_s = max(written_s, file.stat().st_mtime)
            except OSError:
                continue
        return written_s


def _live_section(live: LiveStatus) -> dict[str, Any]:
    """What the recorder says beside its records, for JSON."""
    estimate = live.estimate
    return {
        "n_wanted": live.n_wanted,
        "retaken": [{"cause": cause.value, "n": n} for cause, n in live.dropped.items()],
        "n_frames_missed": live.n_frames_missed,
        "rate_per_min": short(live.rate_per_min),
        "trouble": live.trouble,
        "warning": live.warning,
        "is_halted": live.is_halted,
        "waits_for": live.waits_for,
        "ended": live.ended,
        "exposure_limits_s": {role: shorts(limits_s) for role, limits_s in live.exposure_limits_s.items()},
        "longest_now_s": short(live.longest_now_s),
        "estimate": None
        if estimate is None
        else {
            "n_records": estimate.n_records,
            "worst_arcmin": short(rad_to_arcmin(estimate.worst_uncertainty_rad)),
            "worst_facet": estimate.worst_facet_id,
            "unseen": list(estimate.unseen_facet_ids),
            "area_arcmin2": short(rad2_to_arcmin2(estimate.a_sigma_rad2)),
            "area_uncertainty_arcmin2": short(rad2_to_arcmin2(estimate.a_sigma_uncertainty_rad2)),
        },
    }


def _pixel(instrument: Instrument, theta_rad: NDArray[np.float64]) -> list[float] | None:
    """Where the star's centroid lies in the star camera's picture, None without a star."""
    if not np.isfinite(theta_rad).all():
        return None
    return [round(float(value), 1) for value in instrument.star_camera.pixel_of_theta(theta_rad)]


def estimate_of(path: Path) -> str | None:
    """The alignment JSON of the run's latest estimate, None without one."""
    with RunStore.open(path) as run:
        return run.latest_estimate()

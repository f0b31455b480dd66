"""The recorder: image pairs become records of a run, one after the other, until enough of them count.

The cameras' threads (`pairs`) expose; this thread measures the pair before, stores it, and tells the crew. It is the
same path for the sky, the twin and stored frames (`replay`).
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.clock import Clock
from namod_ctl.core.errors import NamodError, StoreError
from namod_ctl.core.interfaces import Camera, MonotonicClock
from namod_ctl.core.records import Record
from namod_ctl.core.units import deg_to_rad
from namod_ctl.cycle.disk_trouble import is_mended_by_waiting
from namod_ctl.cycle.live_estimate import LiveEstimator
from namod_ctl.cycle.live_status import LiveNote, LivePictures, LiveStatus
from namod_ctl.cycle.measure_pairs import PairMeasurer
from namod_ctl.cycle.motion import MAX_SPEED_BASE_S
from namod_ctl.cycle.pairs import CameraLine, Pair, PairSource, SourceExhaustedError, TimeIsUpError
from namod_ctl.cycle.progress import Progress, Tracker
from namod_ctl.imaging.exposure import exposure_rule
from namod_ctl.optics.camera_model import CameraModel
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.run import RunStore

NOTE_SESSIONS = "record.sessions"

POLL_S = 0.2
"""How long a pair is waited for before the crew's display is refreshed."""

MIN_RECORDS_FOR_UNCERTAINTY = 100
MIN_COVERAGE_FOR_UNCERTAINTY = 0.8
"""With fewer records, or emptier regions, the facets that are known worst are those not seen at all."""

MIN_COVERAGE_FOR_UNSEEN = 0.95
"""A facet that was not seen holds the rule of uncertainty up until the star has been nearly everywhere: then it does
not throw its light into the region, and going on will not show it."""

MAX_FACTOR = 3
"""So many times the records that were wanted, at most, until the region is covered."""

SESSION_GAP_S = 60.0
"""Between two sessions of a run, in its own time: more than lies between two records."""


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What the crew may choose.

    Attributes
    ----------
    target_share
        Share of full scale at which each camera's brightest pixel is kept.
    shortest_s, longest_s
        Limits of the exposures; the cameras may have tighter ones.
    max_retakes
        So often a pair is taken again for its exposures.
    max_motion_share
        Of a star's image: a telescope that moves further during the longer exposure spoils the record. Half of it
        widens a facet's point spread function by 1 % at FACT.
    pace_s
        From one pair to the next, at least: a telescope that wanders slowly is not recorded at every step.
    keep_frames
        Keep the frames of every record.
    region_radius_rad
        Of the directions that are to be covered.
    store_retry_s
        A full disk is tried again after this time.
    star_zero_point_mag
        Magnitude of a star whose intensity, as records have it, is 1; None when nobody has found it out yet.
    """

    target_share: float = 0.8
    shortest_s: float = 1e-3
    longest_s: float = 3.0
    first_exposure_s: float = 0.1
    max_retakes: int = 3
    max_motion_share: float = 0.5
    fetch_timeout_s: float = 2.0
    pace_s: float = 0.0
    keep_frames: bool = False
    region_radius_rad: float = deg_to_rad(0.35)
    store_retry_s: float = 5.0
    star_zero_point_mag: float | None = None


@dataclass(frozen=True, slots=True)
class StopRule:
    """What ends a recording, whichever comes first; None for what does not.

    Attributes
    ----------
    n_records
        Records that count, in the whole run.
    duration_s
        Of this session, on the cameras' clock: pairs that were begun before count. The cameras keep it, see `pairs`.
    uncertainty_rad
        Of the facet that is known worst. Facets that were not seen hold it up until the region is covered.
    min_coverage
        Share of the region below which, as with a hole in it, up to `MAX_FACTOR` times `n_records` are taken: a
        recording with gaps misses facets.
    """

    n_records: int | None = None
    duration_s: float | None = None
    uncertainty_rad: float | None = None
    min_coverage: float = 0.0

    def reason_to_stop(self, progress: Progress) -> str:
        """Why the recording is complete, for a person; empty while it is not."""
        estimate = progress.estimate
        coverage = progress.coverage
        is_covered = not self.min_coverage or (coverage.share >= self.min_coverage and not coverage.has_hole)
        if self.n_records is not None and progress.n_accepted >= self.n_records * (1 if is_covered else MAX_FACTOR):
            is_more = self.min_coverage > 0.0 and progress.n_accepted > self.n_records
            return "all records wanted are there" + (", and more to cover the region" if is_more else "")
        if self.uncertainty_rad is None or estimate is None or estimate.n_records < MIN_RECORDS_FOR_UNCERTAINTY:
            return ""
        unseen = estimate.unseen_facet_ids
        least_coverage = MIN_COVERAGE_FOR_UNSEEN if unseen else MIN_COVERAGE_FOR_UNCERTAINTY
        if progress.coverage.share >= least_coverage and estimate.worst_uncertainty_rad <= self.uncertainty_rad:
            if not unseen:
                return "every facet is known well enough"
            ids = ", ".join(map(str, unseen))
            return f"every facet that was seen is known well enough, but these were never seen: {ids}"
        return ""


@dataclass(frozen=True, slots=True)
class Equipment:
    """What a recording works with.

    Attributes
    ----------
    clock
        The cameras' time.
    wall_clock
        Time of day, for labels only.
    """

    star_camera: Camera
    reflector_camera: Camera
    clock: MonotonicClock
    wall_clock: Clock


class Recorder:
    """Records into a run.

    Parameters
    ----------
    estimator
        For the live estimate; None does without.
    replayed
        The records whose frames the cameras replay; None records anew.

    Raises
    ------
    ConfigError
        A facet of the run has no polygon in the instrument, or an exposure wish cannot be met.
    """

    def __init__(
        self,
        equipment: Equipment,
        instrument: Instrument,
        store: RunStore,
        settings: RecordSettings,
        estimator: LiveEstimator | None = None,
        replayed: Iterator[Record] | None = None,
    ) -> None:
        self._equipment, self._instrument, self._store = equipment, instrument, store
        self._settings, self._estimator, self._replayed = settings, estimator, replayed
        earlier = store.records()
        now_s = equipment.clock.monotonic_s()
        times_s = [record.star_mid_exposure_s for record in earlier if np.isfinite(record.star_mid_exposure_s)]
        # A run's time begins with its first session and only ever grows; a replay has it already.
        offset_s = (max(times_s) + SESSION_GAP_S if times_s else 0.0) - now_s if replayed is None else 0.0
        self._measurer = PairMeasurer(
            instrument, store.facet_ids, earlier, settings.max_motion_share, offset_s, replayed
        )
        pace_s = settings.pace_s if replayed is None else 0.0
        self._tracker = Tracker(settings.region_radius_rad, now_s, settings.star_zero_point_mag, pace_s)
        for record in earlier:
            self._tracker.add_earlier(record)
        self._exposure_limits_s: dict[str, tuple[float, float]] = {}
        self._source = PairSource(
            self._line("star", equipment.star_camera, instrument.star_camera),
            self._line("reflector", equipment.reflector_camera, instrument.reflector_camera, self._facet_region()),
            equipment.clock,
            equipment.wall_clock,
            settings.max_retakes if replayed is None else 0,
            settings.fetch_timeout_s,
            pace_s,
            MAX_SPEED_BASE_S if replayed is None else None,
        )
        self._is_asked_to_stop = threading.Event()
        self._live = LiveNote(store)
        self._pictures = LivePictures(store.path, instrument.star_camera, instrument.reflector_camera)
        self.events = self._measurer.events
        """What befell the recording besides rejected records, one sentence each."""

    def ask_to_stop(self) -> None:
        """Stop at the next record's boundary; may be called from a signal handler."""
        self._is_asked_to_stop.set()

    def record(self, stop: StopRule, on_progress: Callable[[Progress], None] = lambda progress: None) -> str:
        """Record until a rule of `stop` is met or somebody asks to stop; the reason why it ended.

        Raises
        ------
        StoreError
            The run cannot be written for a reason that waiting does not mend.
        ConfigError
            The frames are not of the instrument's cameras.
        """
        self._tracker.n_wanted = stop.n_records
        progress = self.progress()
        reason = stop.reason_to_stop(progress)
        if reason:
            for camera in (self._equipment.star_camera, self._equipment.reflector_camera):
                camera.close()  # as after a recording: somebody opened them for this one
            return reason
        self._show(progress, "the first pair of frames", now=True)
        if stop.duration_s is not None:
            self._source.end_s = self._tracker.start_s + stop.duration_s
        try:
            with self._source:
                while not reason:
                    if self._is_asked_to_stop.is_set():
                        reason = "stopped by hand"
                        break
                    pair = self._source.next(POLL_S, self._longest_exposure_s())
                    if pair is not None:
                        record = self._measurer.record_of(pair)
                        if not self._store_patiently(record, pair, on_progress):
                            reason = "stopped by hand; the last record could not be stored"
                            break
                        self._tracker.add(record, self._end_s(pair), self._source.status)
                        if not self._settings.keep_frames:  # those that are kept can be looked at
                            self._pictures.show(record.index, pair)
                        self._wait_for_estimate(stop, on_progress)
                    progress = self.progress(pair=pair)
                    self._show(progress)
                    on_progress(progress)
                    reason = stop.reason_to_stop(progress)
        except SourceExhaustedError:
            reason = "all frames are replayed"
        except TimeIsUpError:
            reason = f"{(stop.duration_s or 0.0) / 60.0:.3g} minutes are over"
            on_progress(self.progress())
        except NamodError as error:
            self._show(self.progress(), ended=f"it broke off: {error}", now=True)
            raise
        self._note_session(reason)
        self._show(self.progress(), ended=reason, now=True)
        return reason

    def progress(self, trouble: str = "", pair: Pair | None = None) -> Progress:
        """The state of the recording, at the end of that pair or at this moment.

        With `trouble` the recording stands still.
        """
        estimate = None if self._estimator is None else self._estimator.update(self._tracker.n_accepted)
        now_s = self._equipment.clock.monotonic_s() if pair is None else self._end_s(pair)
        return self._tracker.snapshot(now_s, self._source.status, estimate, trouble)

    def _end_s(self, pair: Pair) -> float:
        """When the pair ended: the cameras may be ahead of us, and a twin's clock by far."""
        now_s = self._equipment.clock.monotonic_s()
        return pair.end_s if self._replayed is None and math.isfinite(pair.end_s) else now_s

    def _wait_for_estimate(self, stop: StopRule, on_progress: Callable[[Progress], None]) -> None:
        """Where the cameras' time stands still meanwhile, the rule of uncertainty waits for what it judges."""
        if stop.uncertainty_rad is None or self._estimator is None:
            return
        self._estimator.update(self._tracker.n_accepted)
        while not self._is_asked_to_stop.is_set() and not self._estimator.is_ready(POLL_S):
            progress = self.progress()
            self._show(progress, "the estimate of how well the facets are known")
            on_progress(progress)

    def _line(
        self, role: str, camera: Camera, model: CameraModel, region: NDArray[np.uint8] | None = None
    ) -> CameraLine:
        shortest_s, longest_s = camera.exposure_range_s
        settings = self._settings
        rule = exposure_rule(
            model, max(settings.shortest_s, shortest_s), min(settings.longest_s, longest_s), settings.target_share
        )
        self._exposure_limits_s[role] = (rule.shortest_s, rule.longest_s)
        return CameraLine(role, camera, model, rule, settings.first_exposure_s, region)

    def _facet_region(self) -> NDArray[np.uint8]:
        camera = self._instrument.reflector_camera
        region = np.zeros((camera.n_rows, camera.n_columns), dtype=np.uint8)
        polygons = [self._instrument.facet_polygons_px[facet_id] for facet_id in self._store.facet_ids]
        cv2.fillPoly(region, [np.rint(polygon).astype(np.int32) for polygon in polygons], 255)
        return region

    def _longest_exposure_s(self) -> float:
        """What the telescope's motion allows, but not less than a recording begins with."""
        return max(self._measurer.longest_exposure_s(), self._settings.first_exposure_s)

    def _show(self, progress: Progress, waits_for: str = "", *, ended: str = "", now: bool = False) -> None:
        """Leave in the run, for other programs, how it goes."""
        self._live.tell(lambda: self._status(progress, waits_for, ended), now=now)

    def _status(self, progress: Progress, waits_for: str = "", ended: str = "") -> LiveStatus:
        if not ended and not waits_for:
            waits_for = "a pair of frames that can be used" if progress.source.trouble else "the next pair of frames"
            if self._settings.pace_s and self._replayed is None:
                waits_for += f", one every {self._settings.pace_s:.3g} s"
        return LiveStatus.of(progress, self._exposure_limits_s, self._longest_exposure_s(), waits_for, ended)

    def _store_patiently(self, record: Record, pair: Pair, on_progress: Callable[[Progress], None]) -> bool:
        """Put the record on the disk; wait for a full one. False when somebody asks to stop meanwhile."""
        is_waiting = False
        while True:
            try:
                self._put(record, pair)
            except StoreError as error:
                if not is_mended_by_waiting(error):
                    raise
                if not is_waiting:
                    self.events.append(f"record {record.index} had to wait for the disk: {error}")
                is_waiting = True
                wait = f"NOTHING IS RECORDED; trying again every {self._settings.store_retry_s:g} s"
                progress = self.progress(f"{error}; {wait}")
                self._show(progress, "the disk", now=True)
                on_progress(progress)
                if self._is_asked_to_stop.wait(self._settings.store_retry_s):
                    return False
            else:
                self._measurer.next_index = record.index + 1
                return True

    def _put(self, record: Record, pair: Pair) -> None:
        if self._settings.keep_frames:
            for camera, exposure in (("star_camera", pair.star), ("reflector_camera", pair.reflector)):
                self._store.add_frame(record.index, camera, exposure.image)
        self._store.append([record], self._live.with_record(lambda: self._status(self.progress(pair=pair))))

    def _note_session(self, reason: str) -> None:
        """Leave what the records do not say with the run."""
        status = self._source.status
        sessions = json.loads(self._store.note(NOTE_SESSIONS) or "[]")
        sessions.append(
            {
                "ended": reason,
                "dropped_pairs": {cause.value: n for cause, n in status.dropped.items()},
                "frames_missed": status.n_frames_missed,
                "events": self.events,
            }
        )
        try:
            self._store.set_note(NOTE_SESSIONS, json.dumps(sessions))
        except StoreError as error:
            self.events.append(f"the session's counts could not be noted in the run: {error}")

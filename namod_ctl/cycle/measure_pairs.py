"""From a pair of frames to its record: numbers and labels, times of the run, and whether the telescope moved."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from namod_ctl.core.records import Record
from namod_ctl.cycle.motion import judge_motion, speed_from_before, speed_from_look, with_stored_verdict
from namod_ctl.cycle.pairs import Pair
from namod_ctl.cycle.wall_clock import WallClockWatch
from namod_ctl.imaging.facets import FacetPhotometer
from namod_ctl.imaging.measure import measure_record
from namod_ctl.optics.instrument import Instrument

N_SPEEDS = 5
"""The telescope's speed is the median of so many: one jump, or one wrong star, does not count."""

MOTION_MARGIN = 0.8
"""Of the longest exposure that the telescope's motion allows: it may quicken a little."""


class PairMeasurer:
    """Makes records of pairs, in order, after those that the run has.

    Parameters
    ----------
    max_motion_share
        Of a star's image: a telescope that moves further during the longer exposure spoils the record.
    offset_s
        Of the run's time from the cameras'.
    replayed
        The records whose frames come again; None for new ones.

    Attributes
    ----------
    next_index
        Number of the next record; whoever stores records counts it up.
    events
        What befell the measuring, one sentence each.

    Raises
    ------
    ConfigError
        A facet of the run has no polygon in the instrument.
    """

    def __init__(
        self,
        instrument: Instrument,
        facet_ids: Sequence[int],
        earlier: Sequence[Record],
        max_motion_share: float,
        offset_s: float,
        replayed: Iterator[Record] | None,
    ) -> None:
        self._instrument, self._replayed = instrument, replayed
        self._motion_limit_rad = max_motion_share * instrument.star_size_rad
        camera = instrument.reflector_camera
        self._photometer = FacetPhotometer(instrument.facet_polygons_px, facet_ids, camera.n_columns, camera.n_rows)
        self.next_index = earlier[-1].index + 1 if earlier else 0
        self.events: list[str] = []
        self._before = next((record for record in reversed(earlier) if np.isfinite(record.theta_rad).all()), None)
        self._offset_s = offset_s
        self._speeds: deque[float] = deque(maxlen=N_SPEEDS)
        self._wall_clock = WallClockWatch()

    def record_of(self, pair: Pair) -> Record:
        """The record of the next pair.

        Raises
        ------
        ConfigError
            The frames are not of the instrument's cameras.
        """
        stored = None if self._replayed is None else next(self._replayed)
        if stored is not None:
            index, label = stored.index, stored.label
        else:
            index = self.next_index
            label = f"{pair.done:%Y%m%dT%H%M%S}_{index:06d}"
            self.events += filter(None, [self._wall_clock.step(pair.done)])
        record = replace(
            measure_record(
                pair.star.image,
                pair.reflector.image,
                pair.star.exposure_s,
                pair.reflector.exposure_s,
                self._instrument,
                self._photometer,
                index,
                label,
            ),
            star_mid_exposure_s=pair.star.mid_exposure_s + self._offset_s,
            reflector_mid_exposure_s=pair.reflector.mid_exposure_s + self._offset_s,
        )
        if not np.isfinite(record.theta_rad).all():
            return record
        speed = speed_from_before(self._before, record)
        self._before = record
        if stored is not None and math.isnan(speed):
            return with_stored_verdict(record, stored)
        if math.isnan(speed):
            speed = speed_from_look(pair, record, self._instrument)
        self._speeds.append(speed)
        return judge_motion(record, speed, self._motion_limit_rad)

    def longest_exposure_s(self) -> float:
        """What the telescope's motion allows: a longer exposure would only be rejected. Infinite while not known."""
        known = [speed for speed in self._speeds if speed > 0.0]
        if not known:
            return math.inf
        return MOTION_MARGIN * self._motion_limit_rad / float(np.median(known))

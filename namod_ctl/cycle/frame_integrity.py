"""Frames that are none: incomplete ones, copies of earlier ones, and those that come when they are not wanted any more.

A copy is told by its number or by its bytes. The noise of a sensor never repeats, so two frames with the same noise are
one frame; two frames without any noise (a dark or a saturated one, a drawn one of a simulator) prove nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.core.interfaces import Exposure
from namod_ctl.imaging.radiometry import Frame

TORN_ROWS = 4
"""A camera that shows noise in every row but so many at the end has lost them on the way."""

SAMPLE_STEP = 16
"""Of the rows, that are compared: 120 of the largest camera, 0.3 ms."""

N_REMEMBERED = 8
"""Frames back: a driver's ring of buffers is rarely longer, and a camera that hangs shows them again in turn."""

MIN_TURNS = 50
MIN_TURN_SHARE = 0.01
"""Pixels above, or below, both of their neighbours in the row. Light without noise has slopes, but few of these; and
where each of 50 is one of two values at random, all are the same twice with a chance of 1e-15."""

LATE_S = 0.1
"""A frame of an earlier exposure ended a timeout (2 s) before this one began; clocks agree better than that."""


class FrameFault(StrEnum):
    """What is wrong with a frame."""

    INCOMPLETE = "incomplete"
    REPEATED = "repeated"
    LATE = "late"


class FrameGuard:
    """Looks at the frames of one camera, one after the other, as they are exposed.

    Attributes
    ----------
    n_missed
        Frames that the camera counted but never delivered.
    """

    def __init__(self) -> None:
        self.n_missed = 0
        self._last_frame_id: int | None = None
        self._last_rows: Frame | None = None
        self._has_changed = np.zeros(0, dtype=np.bool_)
        self._digests: deque[bytes] = deque(maxlen=N_REMEMBERED)

    def fault(self, exposure: Exposure, started_s: float = -math.inf) -> tuple[FrameFault, str] | None:
        """What is wrong with the frame, and that in words; None when nothing is.

        Parameters
        ----------
        started_s
            When the exposure was begun, on the cameras' clock.
        """
        if exposure.frame_id == self._last_frame_id:
            return FrameFault.REPEATED, f"frame {exposure.frame_id} came twice"
        if self._last_frame_id is not None:
            self.n_missed += max(0, exposure.frame_id - self._last_frame_id - 1)
        self._last_frame_id = exposure.frame_id
        early_s = started_s - (exposure.mid_exposure_s + exposure.exposure_s / 2.0)
        if early_s > LATE_S:
            return (
                FrameFault.LATE,
                f"frame {exposure.frame_id} ended {early_s:.2g} s before the exposure began that it came for: it came "
                "late, or the clock that dated it is wrong",
            )
        n_missing = _n_rows_missing(exposure.image)
        if n_missing:
            return (
                FrameFault.INCOMPLETE,
                f"frame {exposure.frame_id} arrived incomplete: {n_missing} of {len(exposure.image)} rows are empty",
            )
        return self._copied(exposure)

    def _copied(self, exposure: Exposure) -> tuple[FrameFault, str] | None:
        """Whether the frame, or its end, is that of an earlier one."""
        rows = np.ascontiguousarray(exposure.image[SAMPLE_STEP // 2 :: SAMPLE_STEP])
        digest = hashlib.blake2b(rows.tobytes(), digest_size=16, usedforsecurity=False).digest()
        is_known = digest in self._digests
        self._digests.append(digest)
        n_old = self._n_old_rows(rows)
        if is_known:
            if not _has_noise(rows):
                return None
            return (
                FrameFault.REPEATED,
                f"frame {exposure.frame_id} is an earlier one over again, with the same noise in every pixel",
            )
        if n_old and _has_noise(rows[-n_old:]):
            return (
                FrameFault.INCOMPLETE,
                f"frame {exposure.frame_id} arrived incomplete: its last {n_old * SAMPLE_STEP} rows are those of the "
                "frame before",
            )
        return None

    def _n_old_rows(self, rows: Frame) -> int:
        """Sampled rows at the end of a frame that are those of the frame before, and were others some time before.

        Rows that never change are no sensor's: some cameras and programs write into the last rows what they know.
        """
        before, self._last_rows = self._last_rows, rows
        if before is None or rows.shape != before.shape or rows.dtype != before.dtype:
            self._has_changed = np.zeros(len(rows), dtype=np.bool_)
            return 0
        is_old = (rows == before).reshape(len(rows), -1).all(axis=1)
        self._has_changed |= ~is_old
        is_suspect = is_old & self._has_changed
        return len(rows) if is_suspect.all() else int(np.argmin(is_suspect[::-1]))


def _n_rows_missing(image: Frame) -> int:
    """Rows that never arrived at the end of a frame: nothing but zeros, below rows that all show noise.

    A frame of nothing but zeros is a dark one: with the cap on, some cameras show no noise at all.
    """
    if image[-1].any():
        return 0
    has_light: NDArray[np.bool_] = np.asarray(image.reshape(len(image), -1).any(axis=1))
    if not has_light.any():
        return 0
    n_missing = int(np.argmax(has_light[::-1]))
    n_arrived = len(image) - n_missing
    return n_missing if n_missing >= TORN_ROWS and bool(has_light[:n_arrived].all()) else 0


def _has_noise(rows: NDArray[Any]) -> bool:
    """Whether pixels stand above and below their neighbours in the row as only noise or a drawn pattern makes them."""
    step = np.sign(np.diff(rows.astype(np.int32), axis=1))
    n_turns = int(np.count_nonzero(step[:, 1:] * step[:, :-1] < 0))
    return n_turns >= max(MIN_TURNS, MIN_TURN_SHARE * rows.size)

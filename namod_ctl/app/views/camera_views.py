"""Frames of one camera as a person at the bench looks at them: taken one after the other, in numbers, and as files."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from namod_ctl.app.build.camera_choice import ChosenCamera
from namod_ctl.core.errors import CommunicationError, ConfigError, DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.cycle.focus import FocusReading
from namod_ctl.cycle.frame_integrity import FrameFault, FrameGuard
from namod_ctl.imaging.exposure import (
    ExposureVerdict,
    FrameStatistics,
    exposure_rule,
    frame_statistics,
    judge_exposure,
    next_exposure_s,
)
from namod_ctl.store.frames import write_file_durably

LONGEST_S = 3.0
TARGET_SHARE = 0.8  # as the recorder's default
FETCH_TIMEOUT_S = 2.0
FIRST_EXPOSURE_S = 0.05
BAR_WIDTH = 40
BAR_SPAN = 4.0
"""A bar that is full stands for a star so many times as wide as the best one."""
LOST = "lost"


@dataclass(frozen=True, slots=True)
class Look:
    """One attempt to take a frame.

    Attributes
    ----------
    exposure, statistics
        None when no good frame came.
    verdict
        What its exposure was.
    trouble
        Why none came, for a person.
    """

    exposure: Exposure | None
    statistics: FrameStatistics | None
    verdict: ExposureVerdict | None
    trouble: str = ""


class Watch:
    """Takes frames of a camera, for ever; the exposure law of the recorder chooses exposures that nobody gave.

    Attributes
    ----------
    dropped
        Frames that were none, by what was wrong with them: `FrameFault`, or `LOST`.
    """

    def __init__(self, chosen: ChosenCamera, exposure_s: float | None) -> None:
        self.dropped: Counter[str] = Counter()
        self._chosen, self._is_automatic = chosen, exposure_s is None
        shortest_s, longest_s = chosen.camera.exposure_range_s
        longest_s = longest_s if not self._is_automatic else min(longest_s, max(LONGEST_S, shortest_s))
        target_share = min(TARGET_SHARE, 0.9 * chosen.model.saturation_share)
        self._rule = exposure_rule(chosen.model, max(shortest_s, 1e-6), longest_s, target_share)
        self._exposure_s = self._rule.clipped(FIRST_EXPOSURE_S) if exposure_s is None else exposure_s
        self._guard = FrameGuard()

    def looks(self) -> Iterator[Look]:
        """Attempt after attempt. Raises LimitError for an exposure the camera cannot make."""
        while True:
            yield self._look()

    def _look(self) -> Look:
        begun_s = self._chosen.clock.monotonic_s()
        try:
            self._chosen.camera.start(self._exposure_s)
            exposure = self._chosen.camera.fetch(FETCH_TIMEOUT_S)
        except (CommunicationError, DeviceFaultError) as error:  # the second: it may come back
            self.dropped[LOST] += 1
            return Look(None, None, None, str(error))
        fault = self._guard.fault(exposure, begun_s)
        if fault is not None:
            self.dropped[fault[0].value] += 1
            return Look(None, None, None, fault[1])
        statistics = frame_statistics(exposure.image, self._chosen.model)
        verdict = judge_exposure(statistics, exposure.exposure_s, self._rule)
        if self._is_automatic:
            self._exposure_s = next_exposure_s(statistics, exposure.exposure_s, self._rule)
        return Look(exposure, statistics, verdict)


def statistics_text(exposure: Exposure, statistics: FrameStatistics, chosen: ChosenCamera) -> str:
    """Brightness of a frame in one line."""
    full = chosen.model.full_scale_adu
    saturated = np.count_nonzero(exposure.image >= chosen.model.saturation_share * full)
    return (
        f"exposure {exposure.exposure_s:.4g} s, brightest {statistics.brightest_adu:.0f} of {full:.0f} "
        f"({statistics.brightest_adu / full:.0%}), background {statistics.background_adu:.1f}, "
        f"noise {statistics.noise_adu:.2f}, {saturated} saturated"
    )


def dropped_text(dropped: Counter[str]) -> str:
    """Frames that were none, counted by cause; "" when there were none."""
    order = [LOST, *(fault.value for fault in FrameFault)]
    return ", ".join(f"{dropped[cause]} {cause}" for cause in order if dropped[cause])


def focus_line(reading: FocusReading, best_px: float, remark: str, *, has_plate_scale: bool) -> str:
    """The size of the star, as numbers and as a bar that is short when it is sharp."""
    if not math.isfinite(reading.diameter_px):
        return f"  no star: {reading.trouble}"
    angle = f" {rad_to_arcmin(reading.diameter_rad):7.2f}'" if has_plate_scale else ""
    n_full = min(BAR_WIDTH, max(1, round(BAR_WIDTH * reading.diameter_px / (BAR_SPAN * best_px))))
    bar = "█" * n_full + "·" * (BAR_WIDTH - n_full)
    return f"{reading.diameter_px:7.2f} px{angle}  {bar}  peak {reading.peak_share:4.0%}  {remark}".rstrip()


def check_file(path: Path, *, force: bool) -> None:
    """Raise ConfigError when no frame can be written to that file."""
    if path.suffix.lower() not in (".png", ".fits"):
        raise ConfigError(f"--out {path}: frames are written as .png or .fits; choose one of these endings")
    if not path.parent.is_dir():
        raise ConfigError(f"--out {path}: the folder {path.parent} does not exist; make it first")
    if path.is_dir() or (path.exists() and not force):
        raise ConfigError(f"--out {path}: exists already; choose another, or replace a file with --force")


def write_frame(path: Path, exposure: Exposure, camera_name: str) -> None:
    """The frame as PNG (8 or 16 bit) or FITS, on the disk whole when this returns."""
    if path.suffix.lower() == ".png":
        is_encoded, data = cv2.imencode(".png", np.ascontiguousarray(exposure.image))
        if not is_encoded:
            raise ConfigError(
                f"--out {path}: a frame of shape {exposure.image.shape} cannot be written as PNG; use .fits"
            )
        write_file_durably(path, data.tobytes())
    else:
        write_file_durably(path, _fits(exposure, camera_name))


def _fits(exposure: Exposure, camera_name: str) -> bytes:
    from astropy.io import fits  # takes half a second: only who writes such files waits for it

    image = exposure.image if exposure.image.ndim == 2 else np.moveaxis(exposure.image[:, :, ::-1], 2, 0)  # BGR to RGB
    hdu = fits.PrimaryHDU(np.ascontiguousarray(image))
    hdu.header["EXPTIME"] = (exposure.exposure_s, "exposure / s")
    hdu.header["INSTRUME"] = "".join(c if " " <= c <= "~" else "?" for c in camera_name)[:68]
    hdu.header["ROWORDER"] = ("TOP-DOWN", "the first row is the uppermost")
    hdu.header["FRAMEID"] = (exposure.frame_id, "count of the camera")
    buffer = io.BytesIO()
    hdu.writeto(buffer)
    return buffer.getvalue()

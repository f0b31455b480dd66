"""How sharp a star is, for whoever turns the lens: its size frame by frame, and the best so far.

The recorder's star finder refuses stars that are far out of focus; here finders of several sizes are asked in turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import REJECT_REASON_MEANING, RejectReason
from namod_ctl.imaging.radiometry import Frame, checked_frame, grey_frame, saturation_adu
from namod_ctl.imaging.star import Star, StarRejection, star_finder
from namod_ctl.optics.camera_model import CameraModel

SIZES = (1.0, 3.0, 9.0, 27.0, 1.0 / 3.0)
"""Times the star's size in focus: each finder covers a factor of 12, from a quarter to three times its size."""


@dataclass(frozen=True, slots=True)
class FocusReading:
    """The star of one frame.

    Attributes
    ----------
    diameter_px, diameter_rad
        Full width at half maximum; NaN without a star.
    peak_share
        Its height above the background, of full scale; NaN without a star.
    trouble
        Why there is none, for a person; "" when there is one.
    """

    diameter_px: float
    diameter_rad: float
    peak_share: float
    trouble: str = ""


def read_focus(frame: Frame, camera: CameraModel, star_size_rad: float) -> FocusReading:
    """The size of the star in a frame, which may be far out of focus.

    Raises
    ------
    ConfigError
        The frame is not of the camera.
    """
    grey = grey_frame(checked_frame(frame, camera), saturation_adu(camera))
    first: StarRejection | None = None
    for size in SIZES:
        try:
            found = star_finder(camera, size * star_size_rad, grey.dtype).find(grey)
        except ConfigError:  # a star of that size does not fit into the frame
            break
        if isinstance(found, Star):
            return FocusReading(
                found.diameter_px, found.diameter_px * camera.plate_scale_rad, found.peak_adu / camera.full_scale_adu
            )
        first = first or found
        if found.reason is RejectReason.STAR_SATURATED:
            first = found
            break
    reason = first.reason if first is not None else RejectReason.NO_STAR
    return FocusReading(math.nan, math.nan, math.nan, f"{REJECT_REASON_MEANING[reason]}")


@dataclass(slots=True)
class FocusCourse:
    """The readings so far, as far as they matter: the best one and the last."""

    best_px: float = math.inf
    last_px: float = math.nan

    def add(self, reading: FocusReading) -> str:
        """Note a reading; what a person should do about it: "best so far", "better", "worse", or ""."""
        size_px, before_px = reading.diameter_px, self.last_px
        if not math.isfinite(size_px):
            return ""
        self.last_px = size_px
        if size_px < self.best_px:
            self.best_px = size_px
            return "best so far"
        if not math.isfinite(before_px) or abs(size_px - before_px) < 0.02 * before_px:
            return ""
        return "better" if size_px < before_px else "worse"

"""What a person at the lens should know about a frame."""

from __future__ import annotations

from namod_ctl.app.build.camera_choice import ChosenCamera
from namod_ctl.app.dashboard.numbers import short
from namod_ctl.app.focus_page.news import FocusNews
from namod_ctl.app.views.camera_views import Look
from namod_ctl.core.units import rad_to_arcmin
from namod_ctl.cycle.focus import FocusReading
from namod_ctl.imaging.exposure import ExposureVerdict


def news_of(
    at_s: float,
    look: Look,
    reading: FocusReading | None,
    best_px: float,
    chosen: ChosenCamera,
    *,
    is_exposure_given: bool,
) -> FocusNews:
    """The news of a frame, or of one that did not come (`reading` is None)."""
    return FocusNews(
        at_s=at_s,
        size_px=None if reading is None else short(reading.diameter_px),
        best_px=short(best_px),
        arcmin_per_px=short(rad_to_arcmin(chosen.model.plate_scale_rad)) if chosen.has_plate_scale else None,
        peak_share=None if reading is None else short(reading.peak_share),
        exposure_s=None if look.exposure is None else short(look.exposure.exposure_s),
        warning=_warning(look, reading, chosen.camera.exposure_range_s[0], is_exposure_given=is_exposure_given),
    )


def _warning(look: Look, reading: FocusReading | None, shortest_s: float, *, is_exposure_given: bool) -> str:
    if look.exposure is None or reading is None:
        return f"No frame: {look.trouble}"
    if look.verdict is ExposureVerdict.SATURATED:
        if look.exposure.exposure_s <= shortest_s:
            return "Saturated even at the shortest exposure: take a fainter star, or stop the lens down"
        return "Saturated: " + ("give a shorter --exposure" if is_exposure_given else "trying a shorter exposure")
    if reading.trouble:
        return f"No star to measure: {reading.trouble}"
    if look.verdict is ExposureVerdict.STARVED:
        return "Dim: " + ("give a longer --exposure" if is_exposure_given else "trying a longer exposure")
    return ""

"""The recorder's settings, from the instrument's config."""

from __future__ import annotations

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.schema import RecordingSection
from namod_ctl.core.units import deg_to_rad
from namod_ctl.cycle.record import RecordSettings


def build_record_settings(config: InstrumentConfig) -> RecordSettings:
    """How a recording exposes and what it lets pass, as the config says; defaults where it does not."""
    section = config.recording or RecordingSection()
    return RecordSettings(
        target_share=section.brightest_pixel_share,
        shortest_s=section.shortest_exposure_s,
        longest_s=section.longest_exposure_s,
        max_motion_share=section.max_motion_share,
        fetch_timeout_s=section.frame_timeout_s,
        region_radius_rad=deg_to_rad(section.region_radius_deg),
        star_zero_point_mag=section.star_zero_point_mag,
    )

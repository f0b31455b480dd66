"""The PSF camera: of the config, or of the twin."""

from __future__ import annotations

from collections.abc import Callable

from namod_ctl.app.build.cameras import open_camera
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.config.parts import psf_camera_of
from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.config.schema import RecordingSection
from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.psf_check import OpenPsfEquipment, PsfEquipment
from namod_ctl.twin.focal_screen import Screen, focal_camera
from namod_ctl.twin.twin import Twin

TWIN_PSF_CAMERA = PsfCameraSection(
    model="PSF camera of the twin",
    columns=1280,
    rows=960,
    plate_scale_mdeg_per_px=1.05,
    full_scale_adu=4095.0,
    saturation_share=0.98,
)
"""Of a config that names none."""


def sky_psf_equipment(config: InstrumentConfig) -> OpenPsfEquipment | None:
    """What opens the config's PSF camera; None where the config names no device for it."""
    section = config.psf_camera
    if section is None or section.device is None:
        return None

    def open_equipment() -> PsfEquipment:
        clock = SystemMonotonicClock()
        return PsfEquipment(
            camera=open_camera(config, "psf", clock),
            model=psf_camera_of(section),
            clock=clock,
            exposure_s=section.exposure_s,
            n_frames=section.n_frames,
            reflector=build_instrument(config).reflector,
            fetch_timeout_s=(config.recording or RecordingSection()).frame_timeout_s,
        )

    return open_equipment


def twin_psf_equipment(
    config: InstrumentConfig, twin: Twin, seed: int, screen: Screen | None = None
) -> OpenPsfEquipment | None:
    """What opens the PSF camera of a twin of that config; None where the config has no [psf_camera]."""
    section = config.psf_camera
    return None if section is None else twin_equipment_of(section, twin, seed, screen)


def twin_equipment_of(
    section: PsfCameraSection, twin: Twin, seed: int, screen: Screen | None = None
) -> Callable[[], PsfEquipment]:
    """What opens the PSF camera of that section on a twin.

    Its law is that of the config: calibrations are of the real camera.
    """
    true_model = psf_camera_of(section.model_copy(update={"calibrations": None}))

    def open_equipment() -> PsfEquipment:
        camera = focal_camera(twin, true_model, seed, screen)
        return PsfEquipment(
            camera,
            psf_camera_of(section),
            twin.clock,
            section.exposure_s,
            section.n_frames,
            twin.instrument.reflector,
        )

    return open_equipment


def psf_section_of(config: InstrumentConfig, name: str) -> PsfCameraSection:
    """The config's [psf_camera]. Raises ConfigError when it has none."""
    if config.psf_camera is None:
        raise ConfigError(
            f"{name}: the config has no [psf_camera]; add model, columns, rows, plate_scale_mdeg_per_px, "
            "full_scale_adu and saturation_share, or give --plate-scale-mdeg with stored frames"
        )
    return config.psf_camera

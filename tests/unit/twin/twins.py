"""Twins for tests: FACT's own, and a small telescope that is built and rendered in no time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.twin.settings import PERFECT, CameraSettings, FaultSpec, SkySettings, TwinSettings
from namod_ctl.twin.twin import Twin

CALM = SkySettings(scintillation=0.0)
STILL = replace(TwinSettings().telescope, jitter_rad=0.0, radius_rad=arcmin_to_rad(0.001), spacing_rad=1e-3)
"""A telescope that holds its star on the axis."""


def quiet(settings: CameraSettings) -> CameraSettings:
    """The same camera without noise and hot pixels."""
    return replace(settings, read_noise_adu=0.0, electrons_per_adu=1e12, n_hot_pixels=0)


def small_config() -> InstrumentConfig:
    """Mini FACT with cameras of a few thousand pixels."""
    raw = load_config("mini_fact").model_dump(exclude_none=True)
    raw["star_camera"] |= {"columns": 400, "rows": 320}
    raw["reflector_camera"] |= {"columns": 256, "rows": 192, "plate_scale_mdeg_per_px": 240.0}
    return InstrumentConfig.model_validate(raw)


def small_twin(seed: int = 1, faults: tuple[FaultSpec, ...] = (), **changes: object) -> Twin:
    """A small twin under a calm sky; `changes` are fields of `TwinSettings`."""
    settings = replace(TwinSettings(sky=CALM, telescope=STILL, faults=faults), **changes)
    return build_twin(small_config(), settings, seed)


def aligned_twin(seed: int = 1, **changes: object) -> Twin:
    """A small perfect twin without noise."""
    settings = TwinSettings()
    quiet_cameras = {
        "star_camera": quiet(settings.star_camera),
        "reflector_camera": quiet(settings.reflector_camera),
        "reflector": PERFECT,
    }
    return small_twin(seed, **{**quiet_cameras, **changes})


def pair(twin: Twin, star_s: float = 0.02, reflector_s: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """The images of one record."""
    twin.star_camera.start(star_s)
    twin.reflector_camera.start(reflector_s)
    return twin.star_camera.fetch(1.0).image, twin.reflector_camera.fetch(1.0).image

"""The twin's cameras behind the contract of all cameras: on a clock of their own, in which waiting takes no time."""

from __future__ import annotations

import pytest
from camera_contract import CameraContract, CameraRig

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.twin.settings import TwinSettings

STAR_COLUMNS, STAR_ROWS = 400, 320
REFLECTOR_COLUMNS, REFLECTOR_ROWS = 256, 192


def small_config() -> InstrumentConfig:
    """Mini FACT with cameras of a few thousand pixels."""
    raw = load_config("mini_fact").model_dump(exclude_none=True)
    raw["star_camera"] |= {"columns": STAR_COLUMNS, "rows": STAR_ROWS}
    raw["reflector_camera"] |= {
        "columns": REFLECTOR_COLUMNS,
        "rows": REFLECTOR_ROWS,
        "plate_scale_mdeg_per_px": 240.0,
    }
    return InstrumentConfig.model_validate(raw)


def twin_rig(role: str) -> CameraRig:
    twin = build_twin(small_config(), TwinSettings(), seed=1)
    is_star = role == "star"
    camera = twin.star_camera if is_star else twin.reflector_camera

    def lose_next_frame() -> None:
        twin.inject("dropped_frame", duration_s=0.03, camera=role)  # over when the frame after it ends

    def take_away() -> None:
        twin.inject("camera_lost", camera=role)

    return CameraRig(
        camera=camera,
        clock=twin.clock,
        columns=STAR_COLUMNS if is_star else REFLECTOR_COLUMNS,
        rows=STAR_ROWS if is_star else REFLECTOR_ROWS,
        is_colour=not is_star,
        short_s=0.02,
        other_s=0.05,
        long_s=3.0,
        quantum_s=1e-4,
        timeout_s=1.0,
        mid_error_s=1e-9,
        reopen=lambda: camera,
        lose_next_frame=lose_next_frame,
        take_away=take_away,
    )


class _TwinContract(CameraContract):
    is_real = False
    is_closed_for_good = False


class TestStarCameraOfTheTwin(_TwinContract):
    @pytest.fixture
    def rig(self) -> CameraRig:
        return twin_rig("star")


class TestReflectorCameraOfTheTwin(_TwinContract):
    @pytest.fixture
    def rig(self) -> CameraRig:
        return twin_rig("reflector")

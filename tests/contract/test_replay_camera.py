"""A stored run's frames behind the contract of all cameras, as far as it applies to what is over already."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_contract import CameraContract, CameraRig

from namod_ctl.core.clock import SystemClock
from namod_ctl.core.records import Record
from namod_ctl.cycle.replay import CAMERAS, ReplayCamera, ReplayClock, replayable_records
from namod_ctl.store.run import RunStore

COLUMNS, ROWS = 48, 32
N_RECORDS = 8
BLANK = Record(
    index=0,
    label="",
    theta_rad=np.zeros(2),
    theta_uncertainty_rad=1e-6,
    star_intensity=1.0,
    facet_intensity=np.ones(1),
    facet_saturated_share=np.zeros(1),
    star_exposure_s=0.02,
    reflector_exposure_s=0.3,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few frames, every one of them different."""
    path = tmp_path_factory.mktemp("stored") / "run"
    rng = np.random.default_rng(6)
    with RunStore.create(path, [1], "{}", "made for a test", SystemClock()) as store:
        for index in range(N_RECORDS):
            for camera in CAMERAS:
                shape = (ROWS, COLUMNS) if camera == CAMERAS[0] else (ROWS, COLUMNS, 3)
                store.add_frame(index, camera, rng.integers(0, 256, shape, dtype=np.uint8))
            store.append([replace(BLANK, index=index, label=f"{index}", star_mid_exposure_s=math.sqrt(index))])
    return path


@pytest.mark.parametrize("camera", CAMERAS)
class TestReplayCamera(CameraContract):
    is_real = False
    is_closed_for_good = False
    obeys = False

    @pytest.fixture
    def rig(self, run: Path, camera: str) -> Iterator[CameraRig]:
        with RunStore.open(run) as store:

            def reopen() -> ReplayCamera:
                return ReplayCamera(store, replayable_records(store), camera)

            yield CameraRig(
                camera=reopen(),
                clock=ReplayClock(),
                columns=COLUMNS,
                rows=ROWS,
                is_colour=camera == CAMERAS[1],
                short_s=0.02,
                other_s=0.05,
                long_s=3.0,
                quantum_s=0.0,
                timeout_s=1.0,
                mid_error_s=0.0,
                reopen=reopen,
            )

    def test_every_frame_is_the_stored_one(self, rig: CameraRig, run: Path, camera: str) -> None:
        with RunStore.open(run) as store:
            records = store.records()
            for record in records:
                exposure = rig.take()
                assert np.array_equal(exposure.image, store.frame(record.index, camera))
                assert exposure.exposure_s == (0.02 if camera == CAMERAS[0] else 0.3)

"""A camera with a lifeline is a camera like any other: the twin's behind it, with the twin's faults."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest
from camera_contract import CameraContract, CameraRig
from test_twin_camera import twin_rig

from namod_ctl.core.clock import SystemMonotonicClock
from namod_ctl.core.errors import DeviceFaultError
from namod_ctl.core.interfaces import Exposure
from namod_ctl.devices.cameras.lifeline import Lifeline
from namod_ctl.devices.cameras.pylon_camera import PylonCamera
from namod_ctl.devices.cameras.settings import CameraSettings
from namod_ctl.devices.usb_reset import reset_for


class TestCameraWithLifeline(CameraContract):
    is_real = False

    @pytest.fixture
    def rig(self) -> CameraRig:
        rig = twin_rig("star")

        def open_again() -> Lifeline:
            return Lifeline(lambda: rig.camera, rig.clock)

        return replace(rig, camera=open_again(), reopen=open_again)


def test_an_emulated_camera_that_its_makers_library_calls_removed_comes_back() -> None:
    """Basler's library tells the loss, and opens the camera again, as it does with a plug."""
    os.environ["PYLON_CAMEMU"] = "2"
    pytest.importorskip("pypylon.pylon", reason="pypylon is not installed: pip install 'namod-ctl[pylon]'")
    settings = CameraSettings("star", "pylon", 64, 48, 255.0, serial_number="0815-0001")
    clock = SystemMonotonicClock()
    opened: list[PylonCamera] = []

    def open_camera() -> PylonCamera:
        opened.append(PylonCamera(settings, clock))
        return opened[-1]

    camera = Lifeline(open_camera, clock, reset_for("pylon", settings.serial_number))
    try:
        camera.start(0.01)
        first = camera.fetch(2.0)
        opened[0].device.FirePnPCallback.Execute()
        frames: list[Exposure] = []
        said: list[str] = []
        deadline_s = clock.monotonic_s() + 20.0
        while not frames and clock.monotonic_s() < deadline_s:
            try:
                camera.start(0.01)
                frames.append(camera.fetch(2.0))
            except DeviceFaultError as error:
                said.append(str(error))
                clock.wait_s(0.2)
        assert [frame.frame_id for frame in frames] == [first.frame_id + 1]
        assert len(opened) == 2
        assert "attempt 1 of 6 to bring it back" in said[0]
        assert all(camera.name in text for text in said)
    finally:
        camera.close()

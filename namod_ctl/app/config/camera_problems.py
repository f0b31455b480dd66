"""What is wrong between the devices of the two cameras and the rest of a config."""

from __future__ import annotations

from pathlib import Path

from namod_ctl.app.config.schema import InstrumentSections, ReflectorCameraSection, StarCameraSection
from namod_ctl.core.errors import ConfigError
from namod_ctl.devices.cameras.pixel_formats import full_scale_of

GENICAM_NAMES = frozenset({"pylon", "genicam", "folder"})
"""Drivers whose pixel formats have GenICam's names."""


def camera_problems(config: InstrumentSections, source: str) -> list[str]:
    """One text per problem; without devices there are none."""
    cameras: tuple[tuple[str, StarCameraSection | ReflectorCameraSection], ...] = (
        ("star_camera", config.star_camera),
        ("reflector_camera", config.reflector_camera),
    )
    problems = []
    for name, camera in cameras:
        device = camera.device
        if device is None or device.pixel_format is None or device.driver not in GENICAM_NAMES:
            continue
        try:
            full_scale_adu = full_scale_of(device.pixel_format)
        except ConfigError as problem:
            problems.append(f"{source}: {name}.device.pixel_format: {problem}")
            continue
        if camera.full_scale_adu > full_scale_adu:
            problems.append(
                f"{source}: {name}.device.pixel_format: {device.pixel_format} ends at {full_scale_adu:g}, but "
                f"{name}.full_scale_adu = {camera.full_scale_adu:g}; correct one of them"
            )
    star, reflector = config.star_camera, config.reflector_camera
    if star.device is not None and reflector.device is not None:
        identities = [
            (device.driver, camera.serial_number, device.address, device.device)
            for camera, device in ((star, star.device), (reflector, reflector.device))
        ]
        if identities[0] == identities[1]:
            problems.append(
                f"{source}: star_camera.device and reflector_camera.device are the same device, or nothing tells them "
                "apart: give each its serial_number, beside model, or its address"
            )
    return problems


def with_whole_folder(
    camera: StarCameraSection | ReflectorCameraSection, folder: Path
) -> StarCameraSection | ReflectorCameraSection:
    """The section; the folder of frames that it names, if it does, written out from `folder` on."""
    device = camera.device
    if device is None or device.driver != "folder" or device.address is None:
        return camera
    address = str((folder / Path(device.address).expanduser()).resolve())
    return camera.model_copy(update={"device": device.model_copy(update={"address": address})})

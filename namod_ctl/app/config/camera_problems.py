"""What is wrong between the devices of the two cameras and the rest of a config."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from namod_ctl.app.config.camera_schema import DeviceCameraSection
from namod_ctl.app.config.schema import InstrumentSections, ReflectorCameraSection, StarCameraSection
from namod_ctl.core.errors import ConfigError
from namod_ctl.devices.cameras.pixel_formats import full_scale_of

CameraSection = TypeVar("CameraSection", bound=DeviceCameraSection)

GENICAM_NAMES = frozenset({"pylon", "genicam", "folder"})
"""Drivers whose pixel formats have GenICam's names."""


def camera_problems(config: InstrumentSections, source: str) -> list[str]:
    """One text per problem; without devices there are none."""
    cameras: tuple[tuple[str, StarCameraSection | ReflectorCameraSection], ...] = (
        ("star_camera", config.star_camera),
        ("reflector_camera", config.reflector_camera),
    )
    problems = [problem for name, camera in cameras for problem in _format_problems(name, camera, source)]
    star, reflector = config.star_camera, config.reflector_camera
    if star.device is not None and _identity(star) == _identity(reflector):
        problems.append(
            f"{source}: star_camera.device and reflector_camera.device are the same device, or nothing tells them "
            "apart: give each its serial_number, beside model, or its address"
        )
    return problems


def psf_camera_problems(config: InstrumentSections, source: str) -> list[str]:
    """One text per problem of the PSF camera; without one there are none."""
    camera = config.psf_camera
    if camera is None or camera.device is None:
        return []
    problems = _format_problems("psf_camera", camera, source)
    if camera.device.fed_by_twin:
        problems.append(
            f"{source}: psf_camera.device.fed_by_twin: the twin has a PSF camera of its own; take [psf_camera.device] "
            "out, then it serves"
        )
    for name, other in (("star_camera", config.star_camera), ("reflector_camera", config.reflector_camera)):
        if other.device is not None and _identity(camera) == _identity(other):
            problems.append(
                f"{source}: psf_camera.device and {name}.device are the same device, or nothing tells them apart: give "
                "each its serial_number, beside model, or its address"
            )
    return problems


def _format_problems(name: str, camera: DeviceCameraSection, source: str) -> list[str]:
    """Whether the pixels that the device sends reach the full scale that the camera has."""
    device = camera.device
    if device is None or device.pixel_format is None or device.driver not in GENICAM_NAMES:
        return []
    try:
        full_scale_adu = full_scale_of(device.pixel_format)
    except ConfigError as problem:
        return [f"{source}: {name}.device.pixel_format: {problem}"]
    if camera.full_scale_adu <= full_scale_adu:
        return []
    return [
        f"{source}: {name}.device.pixel_format: {device.pixel_format} ends at {full_scale_adu:g}, but "
        f"{name}.full_scale_adu = {camera.full_scale_adu:g}; correct one of them"
    ]


def _identity(camera: DeviceCameraSection) -> tuple[str | None, ...]:
    """By what a device is found."""
    device = camera.device
    return () if device is None else (device.driver, camera.serial_number, device.address, device.device)


def with_whole_folder(camera: CameraSection, folder: Path) -> CameraSection:
    """The section; the folder of frames that it names, if it does, written out from `folder` on."""
    device = camera.device
    if device is None or device.driver != "folder" or device.address is None:
        return camera
    address = str((folder / Path(device.address).expanduser()).resolve())
    return camera.model_copy(update={"device": device.model_copy(update={"address": address})})

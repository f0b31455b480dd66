"""What a camera driver is told: which device, and how its frames must reach the program."""

from __future__ import annotations

from dataclasses import dataclass

from namod_ctl.core.errors import LimitError


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """One camera as the config wants it; a driver uses every value or refuses it, and reads back what it has set.

    Attributes
    ----------
    role
        "star" or "reflector"; for names and messages.
    driver
        "pylon", "genicam", "ueye", "alpaca", "indi", "opencv" or "folder".
    columns, rows
        Of the frame that reaches the program, after ROI and binning.
    full_scale_adu
        The brightest value of a pixel, right-aligned: 255, 1023, 4095, 65535.
    serial_number
        Of the device; None: the only one there is.
    address
        host:port (alpaca, indi), IP address (genicam), device path or index (opencv), folder (folder).
    device
        On a server: the device's number (alpaca) or name (indi).
    pixel_format
        The vendor's name; None: the driver chooses grey, or else colour, of the depth that `full_scale_adu` says.
    gain
        In the device's own unit, fixed; None: the camera's lowest.
    offset_px
        The ROI's upper left corner (x, y) on the sensor, in binned pixels; None: centred.
    binning
        Pixels of the sensor per pixel of the frame, along each axis.
    exposure_range_s
        Shortest and longest exposure, for devices that cannot tell theirs (opencv, folder); None: what the driver
        documents, or what the device says.
    """

    role: str
    driver: str
    columns: int
    rows: int
    full_scale_adu: float
    serial_number: str | None = None
    address: str | None = None
    device: str | None = None
    pixel_format: str | None = None
    gain: float | None = None
    offset_px: tuple[int, int] | None = None
    binning: int = 1
    exposure_range_s: tuple[float, float] | None = None


def refuse_outside(name: str, exposure_s: float, exposure_range_s: tuple[float, float]) -> None:
    """Raise LimitError for an exposure that the camera of that name cannot make."""
    shortest_s, longest_s = exposure_range_s
    if not shortest_s <= exposure_s <= longest_s:
        raise LimitError(
            f"{name}: an exposure of {exposure_s:g} s was asked for; it makes {shortest_s:g} to {longest_s:g} s"
        )

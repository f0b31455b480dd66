"""A camera that a driver can see."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """What a driver knows of a camera it has found; a text is "" where it is not known.

    `address` is what the config's key `address` takes to open this camera.
    """

    driver: str
    vendor: str
    model: str
    serial_number: str
    address: str

    def __str__(self) -> str:
        """For people: 'Basler acA2500-14gm, serial number 21838345, at 192.168.1.7 (pylon)'."""
        parts = [" ".join(part for part in (self.vendor, self.model) if part) or "unnamed camera"]
        if self.serial_number:
            parts.append(f"serial number {self.serial_number}")
        if self.address:
            parts.append(f"at {self.address}")
        return f"{', '.join(parts)} ({self.driver})"

"""A leg on an axis of a Zaber controller."""

from __future__ import annotations

import math

from firmware_protocols import zaber_ascii
from namod_ctl.core.drives import DriveState
from namod_ctl.core.errors import CommunicationError, DeviceFaultError
from namod_ctl.core.units import celsius_to_k
from namod_ctl.devices.links import ZaberLink
from namod_ctl.devices.steps import StepScale

_MAX_STEPS = 10**9
"""Positions reach +-1e9 (manual, setting `limit.max`)."""
_N_READINGS = 5


class ZaberDrive:
    """One axis of one device.

    Parameters
    ----------
    link
        The device's line.
    device, axis
        Address on the line, and axis of the device, both from 1.
    steps_per_m, range_m
        See `StepScale`; steps are the device's microsteps.
    speed_m_per_s, acceleration_m_per_s2
        Of the leg.
    name
        For a person; None: from the address.
    """

    def __init__(
        self,
        link: ZaberLink,
        device: int,
        axis: int,
        *,
        steps_per_m: float,
        range_m: tuple[float, float],
        speed_m_per_s: float,
        acceleration_m_per_s2: float,
        name: str | None = None,
    ) -> None:
        self._link = link
        self._device = device
        self._axis = axis
        self._scale = StepScale(steps_per_m, range_m, _MAX_STEPS)
        self._speed_data = self._scale.magnitude(speed_m_per_s * zaber_ascii.SPEED_DATA_PER_STEP_PER_S)
        self._acceleration_data = self._scale.magnitude(
            acceleration_m_per_s2 * zaber_ascii.ACCELERATION_DATA_PER_STEP_PER_S2
        )
        self._name = name or f"Zaber device {device} axis {axis} on {link.name}"
        self._has_thermometer = True

    @property
    def name(self) -> str:
        """Device, axis and line, for a person."""
        return self._name

    @property
    def range_m(self) -> tuple[float, float]:
        """Soft limits of the position."""
        return self._scale.range_m

    @property
    def resolution_m(self) -> float:
        """Travel of one microstep."""
        return self._scale.resolution_m

    def configure(self) -> None:
        """Tell the device the leg's speed and acceleration; done anew before every homing."""
        self._accepted(f"set maxspeed {self._speed_data}")
        self._accepted(f"set accel {self._acceleration_data}")

    def identity(self) -> str:
        """Device id, firmware and serial number."""
        device_id, version, serial = (
            self._accepted(f"get {setting}", axis=0).data for setting in ("device.id", "version", "system.serial")
        )
        return f"Zaber device id {device_id} firmware {version} serial number {serial}"

    def state(self) -> DriveState:
        """The drive's state now. A standing drive's position is read until two readings agree."""
        reply = self._accepted("get pos")
        is_moving = reply.status is zaber_ascii.Status.BUSY
        for _ in range(0 if is_moving else _N_READINGS):
            # the checksum misses some pairs of wrong bits, and a target is corrected by this number
            before, reply = reply, self._accepted("get pos")
            if before.data == reply.data:
                break
        flags = self._flags(reply.warning)
        is_homed = not flags & zaber_ascii.UNHOMED_FLAGS
        faults = tuple(
            zaber_ascii.warning_words(flag)
            for flag in sorted(flags - zaber_ascii.UNHOMED_FLAGS)
            if not flag.startswith("N")
        )
        position_m = self._scale.position_m_at(self._steps(reply)) if is_homed else math.nan
        return DriveState(position_m, is_moving, is_homed, faults, None if is_moving else self._temperature_k())

    def start_move(self, position_m: float) -> None:
        """Begin to move to an absolute position."""
        self._accepted(f"move abs {self._scale.steps_at(position_m, self._name)}")

    def start_homing(self) -> None:
        """Begin to seek the home sensor."""
        self.configure()
        self._accepted("home")

    def stop(self) -> None:
        """Decelerate to a halt."""
        self._accepted("stop")

    def clear_faults(self) -> None:
        """Clear the warnings that stay until somebody has seen them, and give the motor current again."""
        flags = self._flags(self._accepted("warnings clear").warning)
        if flags & zaber_ascii.DRIVER_OFF_FLAGS:
            self._accepted("driver enable")

    def _flags(self, first: str) -> frozenset[str]:
        """All warning flags of the axis; a reply shows the most important one only."""
        if first == zaber_ascii.NO_WARNING:
            return frozenset()
        return frozenset(self._accepted("warnings").data.split()[1:]) | {first}

    def _steps(self, reply: zaber_ascii.Reply) -> int:
        try:
            return int(reply.data)
        except ValueError:
            raise CommunicationError(f"{self._name}: position {reply.data!r} is no number") from None

    def _temperature_k(self) -> float | None:
        if not self._has_thermometer:
            return None
        reply = self._link.exchange(self._device, self._axis, "get driver.temperature")
        if not reply.is_ok:
            self._has_thermometer = False
            return None
        try:
            return celsius_to_k(float(reply.data))
        except ValueError:
            raise CommunicationError(f"{self._name}: temperature {reply.data!r} is no number") from None

    def _accepted(self, words: str, axis: int | None = None) -> zaber_ascii.Reply:
        reply = self._link.exchange(self._device, self._axis if axis is None else axis, words)
        if not reply.is_ok:
            reason = zaber_ascii.rejection_words(reply.data)
            raise DeviceFaultError(f"{self._name} refuses '{words}': {reason} ({reply.data}, flag {reply.warning})")
        return reply

"""What the cycle expects of a drive that moves one leg, and what a drive's link expects of a transport."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, order=True)
class Leg:
    """One leg of one facet's mount; legs are counted from 0 here and from 1 towards people."""

    facet_id: int
    index: int

    def __str__(self) -> str:
        return f"facet {self.facet_id} leg {self.index + 1}"


@dataclass(frozen=True, slots=True)
class DriveState:
    """What a drive says of itself.

    Attributes
    ----------
    position_m
        Readback along the leg, +z positive, zero at the drive's reference; the drive's own count of steps or its
        encoder, whichever it has. NaN when the drive does not know (never homed, power lost).
    is_moving
        It moves, or has still to settle at its target.
    is_homed
        Its position refers to its reference switch. A drive that lost power is not homed any more.
    faults
        Faults it reports, in words for a person; empty when it is well.
    temperature_k
        None when it does not say.
    """

    position_m: float
    is_moving: bool
    is_homed: bool
    faults: tuple[str, ...] = ()
    temperature_k: float | None = None


class Drive(Protocol):
    """One drive on one bus. Not thread-safe: only the worker of its bus calls it.

    Every method may raise `CommunicationError` (no usable answer after bounded retries) or `DeviceFaultError` (the
    drive refuses, and says why). Repeating any of them does no harm: targets are absolute.
    """

    @property
    def name(self) -> str:
        """Drive, address and bus, for a person: "TMCL module 5 motor 0 on /dev/ttyUSB0"."""
        ...

    @property
    def range_m(self) -> tuple[float, float]:
        """Soft limits of the position. A target outside is refused, never clipped."""
        ...

    @property
    def resolution_m(self) -> float:
        """Travel of one step."""
        ...

    def identity(self) -> str:
        """Model, firmware and serial number as the drive tells them, so that a swapped drive is noticed."""
        ...

    def state(self) -> DriveState:
        """The drive's state now."""
        ...

    def start_move(self, position_m: float) -> None:
        """Begin to move to an absolute position and return.

        Raises
        ------
        LimitError
            The position is outside of `range_m`, or not a number; nothing was sent.
        """
        ...

    def start_homing(self) -> None:
        """Begin to seek the reference and return."""
        ...

    def stop(self) -> None:
        """Halt as fast as the drive can; harmless when it stands."""
        ...

    def clear_faults(self) -> None:
        """Acknowledge the drive's faults, for a person who has seen to them."""
        ...


class ByteTransport(Protocol):
    """A line with bytes on it: serial port, TCP connection, or memory."""

    @property
    def name(self) -> str:
        """Its URL or port, for a person."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`.

        Raises
        ------
        CommunicationError
            The line is gone.
        """
        ...

    def read(self, n_max: int, timeout_s: float) -> bytes:
        """Up to `n_max` bytes: what is there as soon as there is any; empty when nothing came within `timeout_s`.

        Raises
        ------
        CommunicationError
            The line is gone.
        """
        ...

    def discard_input(self) -> None:
        """Throw away what has arrived and was not read."""
        ...

    def reopen(self) -> None:
        """Close and open the line again, after a failure.

        Raises
        ------
        CommunicationError
            It can still not be opened.
        """
        ...

    def close(self) -> None:
        """Let go of the line; harmless when closed already."""
        ...


class Bus(Protocol):
    """Drives that share a line; one worker at a time speaks on it."""

    @property
    def name(self) -> str:
        """Name from the config and its line."""
        ...

    @property
    def drives(self) -> dict[Leg, Drive]:
        """The drives by the legs that they are wired to according to the config."""
        ...

    @property
    def max_moving(self) -> int:
        """So many drives may move at once (supply current)."""
        ...

    def scan(self) -> Sequence[str]:
        """What answers on the line at any address that the config names, one line each, for a person."""
        ...

    def hurry(self, is_hurried: bool) -> None:
        """Give every question one short attempt from now on, the one under way included; or as many as usual again.

        For orders to stop: they must reach all drives, whoever answers. Safe from any thread.
        """
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...

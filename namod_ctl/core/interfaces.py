"""What the cycle expects of hardware; the twin and every driver stand behind the same interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One finished exposure of one camera.

    Attributes
    ----------
    image
        Shape (rows, columns) grey or (rows, columns, 3) blue-green-red, unsigned integers.
    exposure_s
        The exposure that was really made (cameras quantise what they are asked for).
    mid_exposure_s
        Middle of the exposure on the cameras' common monotonic clock, s.
    frame_id
        Count of the camera, or of its starts where it has none; a gap is a lost frame, a repetition a stale one.
    """

    image: NDArray[np.unsignedinteger[Any]]
    exposure_s: float
    mid_exposure_s: float
    frame_id: int


class Camera(Protocol):
    """One camera: exposures are started, and fetched when they are done.

    One thread starts and fetches; another one may `close` meanwhile. What every camera keeps to is tested by one suite,
    `tests/contract/camera_contract.py`.
    """

    @property
    def name(self) -> str:
        """Name of the device for people: role, model, serial number."""
        ...

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera can make, s."""
        ...

    def start(self, exposure_s: float) -> None:
        """Begin an exposure and return at once; one that runs is given up, and its frame never delivered.

        Raises
        ------
        LimitError
            The exposure is outside of `exposure_range_s`; nothing has happened, an exposure that runs goes on.
        DeviceFaultError
            The camera is lost or closed.
        """
        ...

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for.

        Raises
        ------
        CommunicationError
            No frame, an incomplete or a torn one, within `timeout_s` after the exposure's end: try again. Also when no
            exposure was begun, or the camera is closed meanwhile.
        DeviceFaultError
            The camera is lost, which it stays until it is opened again, or was closed before.
        """
        ...

    def close(self) -> None:
        """Abort a running exposure and let go of the device, within half a second; harmless when closed already."""
        ...


class MonotonicClock(Protocol):
    """Seconds that never go back, and waiting for them."""

    def monotonic_s(self) -> float:
        """Seconds since some fixed moment."""
        ...

    def wait_s(self, duration_s: float) -> None:
        """Return when `duration_s` has passed."""
        ...

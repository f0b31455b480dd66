"""A camera that comes back: one that is lost is closed, reset and opened again, while whoever uses it waits.

Nothing here waits, and no thread is begun: every `start` while the camera is away makes one attempt at most, when it is
due, and says how things stand. So the recording that tries again every second waits for the camera, tells the crew, and
can be stopped at any time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from namod_ctl.core.errors import CommunicationError, DeviceFaultError, NamodError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock
from namod_ctl.devices.usb_reset import UsbReset

RETRY_AFTER_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
"""From one attempt to the next: a device that was reset is back within a second, a hub within some. After all of these
the camera is not reset any more, as that may disturb its neighbours."""

LOOK_EVERY_S = 30.0
"""After the attempts: somebody may have put the plug in again. Looking disturbs nobody."""

FORGIVEN_AFTER_S = 60.0
"""A camera that has worked so long is worth as many attempts as before; one that comes and goes is not."""

MAX_SILENCES = 5
"""Exposures in a row of which no frame came: a camera that drops some frames is there, one that drops all is not."""


class Lifeline:
    """A `core.interfaces.Camera` that is opened again when it is lost. See the module.

    Parameters
    ----------
    open_camera
        Opens and configures the camera, found by its serial number; raises a `NamodError` when it is not there.
    reset
        Resets the device, and says what came of it; None for cameras that cannot be reset from here (network, server).

    Attributes
    ----------
    n_recoveries
        How often the camera was brought back.
    """

    def __init__(
        self, open_camera: Callable[[], Camera], clock: MonotonicClock, reset: Callable[[], UsbReset] | None = None
    ) -> None:
        self.n_recoveries = 0
        self._open_camera, self._clock, self._reset = open_camera, clock, reset
        self._camera: Camera | None = open_camera()
        self._name, self._range_s = self._camera.name, self._camera.exposure_range_s
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._cause = ""
        self._lost_s = 0.0
        self._n_attempts = self._n_silences = self._n_resets = 0
        self._next_attempt_s = 0.0
        self._last_detail = self._reset_detail = ""
        self._id_shift = self._last_id = 0
        self._is_new, self._opened_s = False, clock.monotonic_s()

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self._name

    @property
    def exposure_range_s(self) -> tuple[float, float]:
        """Shortest and longest exposure the camera can make, s."""
        return self._range_s

    def start(self, exposure_s: float) -> None:
        """Begin an exposure; a camera that is away is looked for first.

        Raises
        ------
        LimitError
            The exposure is outside of `exposure_range_s`.
        DeviceFaultError
            The camera is away: since when, what was tried, when it is tried again and what a person can do.
        """
        camera = self._present()
        try:
            camera.start(exposure_s)
        except (CommunicationError, DeviceFaultError) as error:
            raise self._lose(str(error)) from error

    def fetch(self, timeout_s: float) -> Exposure:
        """The exposure begun last, waited for.

        Frames are counted on where a camera that comes back begins with 1 again.

        Raises
        ------
        CommunicationError
            No frame, or an incomplete one: try again.
        DeviceFaultError
            The camera is lost; from now on `start` tries to bring it back.
        """
        with self._lock:
            camera = self._camera
        if camera is None:
            raise DeviceFaultError(self._closed_text() if self._closed.is_set() else f"{self._name}: {self._cause}")
        try:
            exposure = camera.fetch(timeout_s)
        except CommunicationError as error:
            self._n_silences += 1
            if self._n_silences < MAX_SILENCES or self._closed.is_set():
                raise
            raise self._lose(f"no frame of {MAX_SILENCES} exposures in a row; the last time: {error}") from error
        except DeviceFaultError as error:
            raise self._lose(str(error)) from error
        if self._is_new:
            self._id_shift = self._last_id + 1 - exposure.frame_id
        self._is_new = False
        self._n_silences = 0
        if self._clock.monotonic_s() - self._opened_s >= FORGIVEN_AFTER_S:
            self._n_attempts = self._n_resets = 0
        self._last_id = exposure.frame_id + self._id_shift
        return replace(exposure, frame_id=self._last_id)

    def close(self) -> None:
        """Abort a running exposure and let go of the camera; harmless when closed already."""
        with self._lock:
            self._closed.set()
            camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()

    def _present(self) -> Camera:
        """The camera, brought back if it is away and an attempt is due."""
        with self._lock:
            if self._closed.is_set():
                raise DeviceFaultError(self._closed_text())
            if self._camera is not None:
                return self._camera
        now_s = self._clock.monotonic_s()
        if now_s < self._next_attempt_s:
            raise self._away(now_s)
        self._n_attempts += 1
        try:
            camera = self._open_camera()
        except NamodError as error:
            self._last_detail = str(error)
            raise self._reset_and_wait() from error
        with self._lock:
            if self._closed.is_set():
                camera.close()
                raise DeviceFaultError(self._closed_text())
            self._camera = camera
        self._range_s = camera.exposure_range_s
        self._is_new, self._opened_s = True, self._clock.monotonic_s()
        self._n_silences = 0
        self.n_recoveries += 1
        return camera

    def _lose(self, cause: str) -> DeviceFaultError:
        """Let go of the camera, reset it where that can be done, and say that it is lost."""
        with self._lock:
            if self._closed.is_set():
                return DeviceFaultError(self._closed_text())
            camera, self._camera = self._camera, None
        self._cause = cause
        if not self._is_new:
            self._lost_s = self._clock.monotonic_s()
        if camera is not None:
            with suppress(NamodError):  # it is lost: that it cannot be closed is no news
                camera.close()
        self._last_detail = ""
        return self._reset_and_wait()

    def _reset_and_wait(self) -> DeviceFaultError:
        """Reset the device, if it may still be reset, so that it opens at the next attempt; and how things stand."""
        if self._reset is not None and not self._has_given_up:
            done = self._reset()
            self._reset_detail = done.detail
            self._n_resets += done.is_done
        now_s = self._clock.monotonic_s()
        self._next_attempt_s = now_s + (LOOK_EVERY_S if self._has_given_up else RETRY_AFTER_S[self._n_attempts])
        return self._away(now_s)

    @property
    def _has_given_up(self) -> bool:
        return self._n_attempts >= len(RETRY_AFTER_S)

    def _away(self, now_s: float) -> DeviceFaultError:
        """How things stand, for a person."""
        parts = [f"lost {now_s - self._lost_s:.0f} s ago ({self._cause})"]
        if self._n_attempts or self._n_resets:
            parts.append(f"tried so far: reset {_times(self._n_resets)}, opened {_times(self._n_attempts)}")
        parts += [detail for detail in (self._last_detail, self._reset_detail) if detail]
        wait_s = max(self._next_attempt_s - now_s, 0.0)
        if self._has_given_up:
            parts.append(
                "given up bringing it back: check its cable and power, take its plug out and in again, or end another "
                f"program that uses it; it is looked for again every {LOOK_EVERY_S:.0f} s"
            )
        else:
            parts.append(f"attempt {self._n_attempts + 1} of {len(RETRY_AFTER_S)} to bring it back in {wait_s:.0f} s")
        return DeviceFaultError(f"{self._name}: {'; '.join(parts)}")

    def _closed_text(self) -> str:
        return f"{self._name}: is closed; open it again before using it"


def _times(n: int) -> str:
    return {0: "never", 1: "once"}.get(n, f"{n} times")

"""What every `Camera` must do, whatever it is: subclass `CameraContract`, give it a `rig`, and pytest runs it all.

class TestMyCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> Iterator[CameraRig]:
        rig = CameraRig(camera=MyCamera(settings, clock), ...)
        yield rig
        rig.camera.close()
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from namod_ctl.core.errors import CommunicationError, DeviceFaultError, LimitError
from namod_ctl.core.interfaces import Camera, Exposure, MonotonicClock

AT_ONCE_S = 0.05
"""`start` returns within this, however long it exposes."""
STOPPED_S = 0.5
"""`close`, and a `fetch` that waits meanwhile, return within this."""
N_TRIES = 3
"""The best of so many counts where a busy computer could hold up something that is meant to be fast."""


@dataclass
class CameraRig:
    """An open camera and what is known of it from elsewhere.

    Attributes
    ----------
    camera
        The camera under test, just opened.
    clock
        The clock that its times are on.
    columns, rows, is_colour, full_scale_adu
        Of its images.
    short_s, other_s
        Two exposures that it makes, at least a factor of 1.5 apart and both soon over.
    long_s
        An exposure that takes so long that it can be given up; 3 s where the camera makes that.
    quantum_s
        So far an exposure made may be from the one asked for.
    timeout_s
        So long after an exposure's end its frame is there for sure.
    mid_error_s
        So far a `mid_exposure_s` may be wrong: transmission of the order, resolution of the device's clock.
    reopen
        Opens the same device again, after `camera` was closed.
    lose_next_frame
        From now on, until a frame has been lost, frames of this camera do not arrive or arrive incomplete.
        None: there is no way to make that happen.
    take_away
        The device is gone from now on. None: there is no way to make that happen.
    """

    camera: Camera
    clock: MonotonicClock
    columns: int
    rows: int
    short_s: float
    other_s: float
    long_s: float
    quantum_s: float
    timeout_s: float
    mid_error_s: float
    reopen: Callable[[], Camera]
    full_scale_adu: float = 255.0
    is_colour: bool = False
    lose_next_frame: Callable[[], None] | None = None
    take_away: Callable[[], None] | None = None

    def take(self, exposure_s: float | None = None) -> Exposure:
        """One exposure, of `short_s` unless something else is asked for."""
        self.camera.start(self.short_s if exposure_s is None else exposure_s)
        return self.camera.fetch(self.timeout_s)


class CameraContract:
    """The suite. Kinds that differ by their nature say so in the class attributes.

    Attributes
    ----------
    is_real
        Its time is the computer's; on a twin's clock waiting takes no time, so there is nothing to interrupt.
    is_closed_for_good
        There is a device that `close` lets go of.
    obeys
        It makes the exposure that it is asked for; stored frames do not.
    """

    is_real = True
    is_closed_for_good = True
    obeys = True

    def test_what_it_says_of_itself(self, rig: CameraRig) -> None:
        assert rig.camera.name
        shortest_s, longest_s = rig.camera.exposure_range_s
        assert 0.0 <= shortest_s <= rig.short_s
        assert rig.other_s <= longest_s
        assert rig.camera.exposure_range_s == (shortest_s, longest_s)

    def test_an_image_has_the_shape_and_depth_that_were_asked_for(self, rig: CameraRig) -> None:
        image = rig.take().image
        assert image.shape == ((rig.rows, rig.columns, 3) if rig.is_colour else (rig.rows, rig.columns))
        assert image.dtype == (np.uint8 if rig.full_scale_adu <= 255.0 else np.uint16)
        assert image.max() <= rig.full_scale_adu

    def test_an_image_stays_as_it_is_when_others_follow(self, rig: CameraRig) -> None:
        first = rig.take().image
        as_it_was = first.copy()
        for _ in range(4):
            rig.take()
        assert np.array_equal(first, as_it_was)

    def test_the_exposure_is_the_one_asked_for(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("shows what is stored, whatever it is asked for")
        for exposure_s in (rig.short_s, rig.other_s, rig.short_s):
            assert rig.take(exposure_s).exposure_s == pytest.approx(exposure_s, abs=rig.quantum_s, rel=0.0)

    def test_the_middle_of_the_exposure_is_on_the_common_clock(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("tells the time at which the frame was stored")
        for exposure_s in (rig.short_s, rig.other_s):
            before_s = rig.clock.monotonic_s()
            rig.camera.start(exposure_s)
            started_s = rig.clock.monotonic_s()
            exposure = rig.camera.fetch(rig.timeout_s)
            half_s = exposure.exposure_s / 2.0
            middle_s = exposure.mid_exposure_s
            assert before_s + half_s - rig.mid_error_s <= middle_s <= started_s + half_s + rig.mid_error_s
            assert middle_s + half_s <= rig.clock.monotonic_s() + rig.mid_error_s

    def test_frames_are_counted(self, rig: CameraRig) -> None:
        counts = [rig.take(exposure_s).frame_id for exposure_s in (rig.short_s, rig.other_s) * 2]
        assert [after - before for before, after in pairwise(counts)] == [1, 1, 1]

    def test_what_is_beyond_its_range_is_refused_and_nothing_happens(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("takes any exposure, as it uses none")
        shortest_s, longest_s = rig.camera.exposure_range_s
        beyond = [shortest_s / 2.0, -1.0, math.nan, math.inf, longest_s * 1.01 + 1e-3]
        for exposure_s in (value_s for value_s in beyond if not shortest_s <= value_s <= longest_s):
            with pytest.raises(LimitError, match="exposure"):
                rig.camera.start(exposure_s)
        with pytest.raises(CommunicationError):
            rig.camera.fetch(0.0)
        rig.camera.start(rig.other_s)
        with pytest.raises(LimitError, match="exposure"):
            rig.camera.start(math.nan)
        exposure = rig.camera.fetch(rig.timeout_s)  # the one that ran goes on
        assert exposure.exposure_s == pytest.approx(rig.other_s, abs=rig.quantum_s, rel=0.0)

    def test_nothing_comes_without_a_start(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("has its frames already")
        began_s = time.monotonic()
        for _ in range(2):
            with pytest.raises(CommunicationError):
                rig.camera.fetch(60.0)
        rig.take()
        with pytest.raises(CommunicationError):
            rig.camera.fetch(60.0)
        assert time.monotonic() - began_s < 30.0  # there is nothing to wait for

    def test_a_start_returns_at_once(self, rig: CameraRig) -> None:
        durations_s = []
        for _ in range(N_TRIES):
            began_s = time.monotonic()
            rig.camera.start(rig.long_s)
            durations_s.append(time.monotonic() - began_s)
        assert min(durations_s) < AT_ONCE_S

    def test_a_new_start_gives_the_running_exposure_up(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("has no exposure that runs")
        for given_up_s, share in ((rig.long_s, 0.1), (rig.other_s, 0.1), (rig.other_s, 0.4)):
            rig.camera.start(given_up_s)
            rig.clock.wait_s(share * given_up_s)  # so that it has really begun, wherever that is
            for _ in range(3):  # what was given up must come neither as the next frame nor as one after it
                assert rig.take(rig.short_s).exposure_s == pytest.approx(rig.short_s, abs=rig.quantum_s, rel=0.0)

    def test_a_frame_is_waited_for_until_its_exposure_is_done(self, rig: CameraRig) -> None:
        if not self.obeys:
            pytest.skip("has its frames already")
        before_s = rig.clock.monotonic_s()
        exposure = rig.take(rig.other_s)
        assert rig.clock.monotonic_s() - before_s >= exposure.exposure_s - rig.mid_error_s

    def test_it_works_in_another_thread(self, rig: CameraRig) -> None:
        with ThreadPoolExecutor(1) as worker:
            counts = [worker.submit(rig.take).result(60.0).frame_id for _ in range(3)]
        assert [after - before for before, after in pairwise(counts)] == [1, 1]

    def test_it_can_be_closed_while_a_frame_is_waited_for(self, rig: CameraRig) -> None:
        if not self.is_real:
            pytest.skip("waiting takes no time here")
        rig.camera.start(rig.long_s)
        is_fetching = threading.Event()

        def fetch() -> float:
            is_fetching.set()
            with pytest.raises(CommunicationError):
                rig.camera.fetch(rig.timeout_s)
            return time.monotonic()

        with ThreadPoolExecutor(1) as worker:
            done = worker.submit(fetch)
            is_fetching.wait(60.0)
            rig.clock.wait_s(0.1)  # now it is in the middle of waiting; if it were not, that would be as well
            began_s = time.monotonic()
            rig.camera.close()
            closed_s = time.monotonic()
            assert closed_s - began_s < STOPPED_S
            assert done.result(60.0) - began_s < STOPPED_S

    def test_it_can_be_closed_while_it_exposes(self, rig: CameraRig) -> None:
        rig.camera.start(rig.long_s)
        began_s = time.monotonic()
        rig.camera.close()
        assert time.monotonic() - began_s < STOPPED_S

    def test_it_can_be_closed_twice_and_then_does_nothing_any_more(self, rig: CameraRig) -> None:
        rig.take()
        rig.camera.close()
        rig.camera.close()
        if not self.is_closed_for_good:
            return
        with pytest.raises(DeviceFaultError):
            rig.camera.start(rig.short_s)
        with pytest.raises(DeviceFaultError):
            rig.camera.fetch(rig.timeout_s)
        rig.camera.close()
        assert rig.camera.name

    def test_a_closed_camera_can_be_opened_again(self, rig: CameraRig) -> None:
        rig.take()
        rig.camera.start(rig.long_s)
        rig.camera.close()
        rig.camera = rig.reopen()
        exposure = rig.take()
        assert exposure.image.shape[:2] == (rig.rows, rig.columns)
        if self.obeys:
            assert exposure.exposure_s == pytest.approx(rig.short_s, abs=rig.quantum_s, rel=0.0)

    def test_a_lost_frame_is_told_and_the_next_one_comes(self, rig: CameraRig) -> None:
        if rig.lose_next_frame is None:
            pytest.skip("no frame of this camera can be lost at will")
        last = rig.take().frame_id
        rig.lose_next_frame()
        with pytest.raises(CommunicationError) as caught:
            rig.take()
        assert rig.camera.name in str(caught.value)
        exposure = rig.take()
        assert exposure.image.shape[:2] == (rig.rows, rig.columns)
        assert exposure.frame_id >= last + 2

    def test_a_camera_that_is_gone_says_so_from_then_on(self, rig: CameraRig) -> None:
        if rig.take_away is None:
            pytest.skip("this camera cannot be taken away at will")
        rig.take()
        rig.take_away()
        with pytest.raises(DeviceFaultError) as caught:
            rig.take()
        assert rig.camera.name in str(caught.value)
        with pytest.raises(DeviceFaultError):
            rig.camera.start(rig.short_s)
        if self.is_closed_for_good:  # elsewhere it may come back by itself
            with pytest.raises(DeviceFaultError):
                rig.camera.fetch(rig.timeout_s)
        began_s = time.monotonic()
        rig.camera.close()
        assert time.monotonic() - began_s < STOPPED_S

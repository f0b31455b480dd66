"""What every `Drive` must do, whatever it speaks: subclass `DriveContract`, give it a `rig`, and pytest runs it all.

class TestMyDrive(DriveContract):
    @pytest.fixture
    def rig(self) -> DriveRig: ...
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from namod_ctl.core.drives import Drive, DriveState
from namod_ctl.core.errors import CommunicationError, LimitError

START_M = 0.0012
"""Where a rig's leg stands when it is handed over, homed."""
RANGE_M = (-0.004, 0.004)
"""Soft limits of a rig's drive; its reference lies in between, its limit switches outside."""
ARRIVED_M = 2e-5
"""Play of the twin's legs and some steps: so far a leg may truly stand from where its drive says it is."""
STEP_S = 0.05


@dataclass
class DriveRig:
    """A drive on a line with the true leg behind it.

    Attributes
    ----------
    drive
        The drive under test: homed, at rest at `START_M`, speed about 1 mm/s, soft limits `RANGE_M`.
    advance
        Lets so many seconds pass for the leg.
    true_position_m
        Where the leg truly is, from its reference.
    reset
        Takes the drive's power away for a moment.
    trip_limit_switch
        Makes the limit switch tell the end of the way, which is met by a drive that moves towards +z.
    n_written
        So many bytes were sent to the drive until now.
    unplug
        From now on nothing answers.
    """

    drive: Drive
    advance: Callable[[float], None]
    true_position_m: Callable[[], float]
    reset: Callable[[], None]
    trip_limit_switch: Callable[[], None]
    n_written: Callable[[], int]
    unplug: Callable[[], None]

    def wait(self) -> DriveState:
        """The state when the drive does not move any more; a motion of 60 s has failed."""
        for _ in range(round(60.0 / STEP_S)):
            state = self.drive.state()
            if not state.is_moving:
                return state
            self.advance(STEP_S)
        raise AssertionError(f"{self.drive.name} never ends its motion")


class DriveContract:
    """The suite. Homing needs a drive that has it; absolute encoders override `is_absolute`."""

    is_absolute = False

    def test_what_it_says_of_itself(self, rig: DriveRig) -> None:
        drive = rig.drive
        assert drive.name
        assert drive.range_m == RANGE_M
        assert 0.0 < drive.resolution_m < ARRIVED_M
        assert drive.identity()
        assert drive.identity() == drive.identity()

    def test_a_homed_drive_at_rest(self, rig: DriveRig) -> None:
        state = rig.drive.state()
        assert state.is_homed
        assert not state.is_moving
        assert state.faults == ()
        assert state.position_m == pytest.approx(START_M, abs=rig.drive.resolution_m)
        assert state.temperature_k is None or 250.0 < state.temperature_k < 350.0

    @pytest.mark.parametrize("target_m", [-0.0031, 0.0, 0.00121, 0.0039, *RANGE_M])
    def test_goes_where_it_was_told(self, rig: DriveRig, target_m: float) -> None:
        rig.drive.start_move(target_m)
        state = rig.wait()
        assert state.position_m == pytest.approx(target_m, abs=rig.drive.resolution_m)
        assert rig.true_position_m() == pytest.approx(target_m, abs=ARRIVED_M)
        assert state.is_homed
        assert state.faults == ()

    def test_moves_while_it_is_under_way(self, rig: DriveRig) -> None:
        rig.drive.start_move(START_M + 0.002)
        assert rig.drive.state().is_moving
        rig.advance(0.3)
        state = rig.drive.state()
        assert state.is_moving
        assert START_M < state.position_m < START_M + 0.002

    def test_an_order_given_twice_is_carried_out_once(self, rig: DriveRig) -> None:
        for _ in range(3):
            rig.drive.start_move(START_M + 0.0005)
            rig.advance(0.1)
        assert rig.wait().position_m == pytest.approx(START_M + 0.0005, abs=rig.drive.resolution_m)
        rig.drive.start_move(START_M + 0.0005)
        assert rig.wait().position_m == pytest.approx(START_M + 0.0005, abs=rig.drive.resolution_m)

    def test_a_new_target_replaces_the_old_one(self, rig: DriveRig) -> None:
        rig.drive.start_move(START_M + 0.002)
        rig.advance(0.3)
        rig.drive.start_move(START_M - 0.001)
        rig.wait()
        assert rig.true_position_m() == pytest.approx(START_M - 0.001, abs=ARRIVED_M)

    @pytest.mark.parametrize("target_m", [0.00401, -0.00401, 1e9, math.nan, math.inf, -math.inf])
    def test_a_target_out_of_range_is_refused_before_anything_is_sent(self, rig: DriveRig, target_m: float) -> None:
        n_written = rig.n_written()
        with pytest.raises(LimitError, match="outside of its range"):
            rig.drive.start_move(target_m)
        assert rig.n_written() == n_written

    def test_stops_in_mid_move_and_stays(self, rig: DriveRig) -> None:
        rig.drive.start_move(START_M + 0.002)
        rig.advance(0.5)
        at_stop_m = rig.true_position_m()
        rig.drive.stop()
        rig.advance(0.5)
        state = rig.drive.state()
        assert not state.is_moving
        assert state.is_homed
        # from 1 mm/s with 5 mm/s2 a leg needs 0.1 mm
        assert rig.true_position_m() - at_stop_m < 0.0002
        stopped_m = rig.true_position_m()
        rig.advance(5.0)
        assert rig.true_position_m() == stopped_m
        assert rig.drive.state() == state
        rig.drive.start_move(START_M)
        assert rig.wait().position_m == pytest.approx(START_M, abs=rig.drive.resolution_m)

    def test_stop_at_rest_does_nothing(self, rig: DriveRig) -> None:
        before = rig.drive.state()
        rig.drive.stop()
        rig.drive.stop()
        rig.advance(1.0)
        assert rig.drive.state() == before
        assert rig.true_position_m() == pytest.approx(START_M, abs=ARRIVED_M)

    def test_homing_makes_it_homed_at_the_end_only(self, rig: DriveRig) -> None:
        rig.reset()
        assert rig.drive.state().is_homed is self.is_absolute
        rig.drive.start_homing()
        rig.advance(0.2)
        state = rig.drive.state()
        assert state.is_moving
        assert not state.is_homed
        assert math.isnan(state.position_m)
        state = rig.wait()
        assert state.is_homed
        assert state.position_m == pytest.approx(rig.true_position_m(), abs=ARRIVED_M)
        rig.drive.start_move(0.002)
        rig.wait()
        assert rig.true_position_m() == pytest.approx(0.002, abs=ARRIVED_M)

    def test_a_search_that_was_stopped_leaves_it_not_homed(self, rig: DriveRig) -> None:
        rig.drive.start_homing()
        rig.advance(0.2)
        rig.drive.stop()
        rig.advance(0.5)
        for _ in range(3):
            state = rig.wait()
            assert not state.is_homed
            assert math.isnan(state.position_m)

    def test_a_reset_in_mid_move_is_noticed(self, rig: DriveRig) -> None:
        rig.drive.start_move(START_M + 0.002)
        rig.advance(0.5)
        rig.reset()
        state = rig.wait()
        assert state.is_homed is self.is_absolute
        assert math.isnan(state.position_m) is not self.is_absolute

    def test_a_reset_in_mid_search_is_noticed(self, rig: DriveRig) -> None:
        rig.drive.start_homing()
        rig.advance(0.2)
        rig.reset()
        assert rig.wait().is_homed is self.is_absolute

    def test_a_limit_switch_is_told_in_words_and_left_again(self, rig: DriveRig) -> None:
        rig.drive.start_move(START_M + 0.002)
        rig.advance(0.3)
        rig.trip_limit_switch()
        state = rig.wait()
        assert any("limit" in fault for fault in state.faults)
        rig.drive.clear_faults()
        rig.drive.start_move(START_M - 0.001)
        state = rig.wait()
        assert state.position_m == pytest.approx(START_M - 0.001, abs=rig.drive.resolution_m)

    def test_nothing_answers(self, rig: DriveRig) -> None:
        rig.unplug()
        for order in (rig.drive.state, rig.drive.stop, rig.drive.identity, lambda: rig.drive.start_move(0.0)):
            with pytest.raises(CommunicationError, match=r"no usable answer|gone"):
                order()

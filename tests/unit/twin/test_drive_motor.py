"""One motor against what mechanics says: trapezoids, play, lost steps, switches, warmth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from namod_ctl.core.units import mm_to_m, um_to_m
from namod_ctl.twin.drive_motor import Conditions, DriveMotor, MotorFault
from namod_ctl.twin.drive_ramp import plan_move
from namod_ctl.twin.drive_settings import MotorSettings

STEP_M = um_to_m(3.0)
SPEED, ACCELERATION = 300.0, 1500.0
SETTINGS = MotorSettings()
TIGHT = replace(SETTINGS, backlash_m=0.0)
PLAY_STEPS = 10.0 / 3.0


def moved(motor: DriveMotor, target: int, now_s: float) -> float:
    """The moment at which the motor has arrived."""
    motor.start_move(target, SPEED, ACCELERATION)
    end_s = motor.end_s
    motor.update(end_s)
    assert end_s > now_s
    assert not motor.is_moving
    return end_s


@pytest.mark.parametrize(
    ("steps", "expected_s"),
    [
        (3000, 3000 / SPEED + SPEED / ACCELERATION),  # trapezoid: way / v + v / a
        (-3000, 3000 / SPEED + SPEED / ACCELERATION),
        (10, 2.0 * math.sqrt(10 / ACCELERATION)),  # triangle: too short to reach the speed
        (60, 2.0 * math.sqrt(60 / ACCELERATION)),  # exactly as long as both ramps
    ],
)
def test_a_move_takes_as_long_as_a_trapezoid(steps: int, expected_s: float) -> None:
    motor = DriveMotor(TIGHT)
    motor.start_move(steps, SPEED, ACCELERATION)
    motor.update(expected_s - 1e-6)
    assert motor.is_moving
    motor.update(expected_s + 1e-6)
    assert (motor.is_moving, motor.count, motor.true_leg_steps) == (False, steps, steps)


def test_half_way_through_a_long_move_it_runs_at_full_speed() -> None:
    motor = DriveMotor(TIGHT)
    motor.start_move(3000, SPEED, ACCELERATION)
    motor.update(5.1)  # half of 10.2 s
    assert motor.count == 1500
    assert motor.speed == pytest.approx(SPEED)


@given(
    position=st.floats(-1e4, 1e4),
    speed=st.floats(-400.0, 400.0),
    target=st.integers(-10000, 10000),
    max_speed=st.floats(1.0, 400.0),
    acceleration=st.floats(10.0, 5000.0),
)
@settings(max_examples=300, deadline=None)
def test_every_ramp_is_smooth_and_ends_at_rest_on_its_target(
    position: float, speed: float, target: int, max_speed: float, acceleration: float
) -> None:
    pieces = plan_move(2.0, position, speed, float(target), max_speed, acceleration)
    at_s, at, v = 2.0, position, speed
    for piece in pieces:
        assert piece.start_s == pytest.approx(at_s, abs=1e-9)
        assert piece.position == pytest.approx(at, abs=1e-5)
        assert piece.speed == pytest.approx(v, abs=1e-3)
        assert abs(piece.acceleration) <= acceleration
        at_s, at, v = piece.end_s, piece.position_at(piece.end_s), piece.speed_at(piece.end_s)
        assert abs(v) <= max(max_speed, abs(speed)) * (1.0 + 1e-9)
    assert at == pytest.approx(target, abs=1e-4)
    assert v == pytest.approx(0.0, abs=2e-2 * math.sqrt(acceleration))


@given(moments=st.lists(st.floats(0.0, 12.0), max_size=15), lost=st.sampled_from([0.0, 0.25, 1.0]))
@settings(max_examples=60, deadline=None)
def test_where_it_gets_does_not_depend_on_how_often_one_looks(moments: list[float], lost: float) -> None:
    often, once = DriveMotor(SETTINGS), DriveMotor(SETTINGS)
    for motor in (often, once):
        motor.conditions = Conditions(lost_share=lost)
        motor.start_move(2500, SPEED, ACCELERATION)
    for moment in sorted(moments):
        often.update(moment)
    for motor in (often, once):
        motor.update(12.0)
    assert often.count == once.count == 2500
    assert often.true_leg_steps == pytest.approx(once.true_leg_steps, abs=1e-9)
    assert once.true_spindle_steps == pytest.approx(2500 * (1.0 - lost))


def test_the_leg_follows_when_the_play_is_taken_up() -> None:
    """Up, down, up: each turn loses 10 um, which is 3.33 steps; going on in the same direction loses nothing."""
    motor = DriveMotor(SETTINGS)
    legs, now_s = [], 0.0
    for target in (100, 200, 150, 148, 200):
        now_s = moved(motor, target, now_s)
        legs.append(motor.true_leg_steps)
    ways = np.diff(legs)
    assert legs[0] == pytest.approx(100 - PLAY_STEPS / 2)  # it began in the middle of its play
    np.testing.assert_allclose(ways, [100, -(50 - PLAY_STEPS), -2, 52 - PLAY_STEPS], atol=1e-9)


def test_play_that_has_tripled_loses_three_times_as_much() -> None:
    motor = DriveMotor(SETTINGS)
    motor.conditions = Conditions(backlash_factor=3.0)
    now_s = moved(motor, 100, 0.0)
    up = motor.true_leg_steps
    moved(motor, 0, now_s)
    assert up - motor.true_leg_steps == pytest.approx(100 - 3 * PLAY_STEPS)


def test_lost_steps_show_in_the_spindle_and_not_in_the_count() -> None:
    motor = DriveMotor(TIGHT)
    motor.conditions = Conditions(lost_share=0.25)
    moved(motor, 1000, 0.0)
    assert (motor.count, motor.position, motor.true_spindle_steps) == (1000, 1000, 750)
    assert motor.is_homed  # the drive knows nothing of it


def test_an_encoder_sees_lost_steps_and_the_drive_gives_up_at_its_limit() -> None:
    """60 um are 20 steps: a quarter lost reaches them after 80."""
    few, many = (DriveMotor(replace(TIGHT, has_encoder=True)) for _ in range(2))
    for motor, target in ((few, 60), (many, 1000)):
        motor.conditions = Conditions(lost_share=0.25)
        motor.start_move(target, SPEED, ACCELERATION)
        motor.update(10.0)
    assert (few.position, few.following_error, few.faults) == (45, 15, frozenset())
    assert many.faults == {MotorFault.FOLLOWING_ERROR}
    assert many.true_spindle_steps == pytest.approx(60.0)
    assert many.position == 60


def test_an_encoder_trails_the_ramp_while_it_moves() -> None:
    motor = DriveMotor(replace(TIGHT, has_encoder=True, following_lag_s=0.02))
    motor.start_move(3000, SPEED, ACCELERATION)
    motor.update(5.0)
    assert motor.following_error == 6  # 300 steps/s times 20 ms
    motor.update(20.0)
    assert motor.following_error == 0


@pytest.mark.parametrize("start", [-2000, -20, 0, 700])
def test_homing_finds_the_reference_from_either_side(start: int) -> None:
    motor = DriveMotor(TIGHT, start, is_homed=False)
    assert (motor.count, motor.is_homed) == (0, False)
    motor.start_homing()
    motor.update(60.0)
    assert (motor.is_homed, motor.count, motor.true_spindle_steps, motor.is_moving) == (True, 0, 0, False)
    moved(motor, 500, 60.0)
    assert motor.true_spindle_steps == 500


def test_homing_reproduces_the_leg_whatever_the_play() -> None:
    legs = []
    for start in (-900, 40, 900):
        motor = DriveMotor(SETTINGS, start, is_homed=False)
        motor.start_homing()
        motor.update(60.0)
        legs.append(motor.true_leg_steps)
    np.testing.assert_allclose(legs, -PLAY_STEPS / 2)


def test_homing_repairs_lost_steps() -> None:
    motor = DriveMotor(TIGHT)
    motor.conditions = Conditions(lost_share=0.5)
    moved(motor, 400, 0.0)
    motor.conditions = Conditions()
    motor.start_homing()
    motor.update(60.0)
    assert motor.true_spindle_steps == motor.count == 0


def test_a_stuck_spindle_finds_no_reference() -> None:
    motor = DriveMotor(TIGHT, 300)
    motor.conditions = Conditions(lost_share=1.0)
    motor.start_homing()
    motor.update(200.0)
    assert (motor.is_homed, motor.is_moving, motor.faults) == (False, False, {MotorFault.NO_REFERENCE})
    assert motor.true_spindle_steps == 300


@pytest.mark.parametrize(("target", "fault"), [(5000, MotorFault.HIGH_LIMIT), (-5000, MotorFault.LOW_LIMIT)])
def test_a_limit_switch_stops_it_and_lets_it_back(target: int, fault: MotorFault) -> None:
    motor = DriveMotor(TIGHT)
    end = math.copysign(mm_to_m(10.0) / STEP_M, target)
    motor.start_move(target, SPEED, ACCELERATION)
    motor.update(60.0)
    assert motor.true_spindle_steps == pytest.approx(end)
    assert (motor.is_moving, motor.faults) == (False, {fault})
    motor.start_move(target, SPEED, ACCELERATION)
    motor.update(120.0)
    assert motor.true_spindle_steps == pytest.approx(end)
    motor.start_move(0, SPEED, ACCELERATION)
    motor.update(180.0)
    assert motor.true_spindle_steps == pytest.approx(0.0, abs=1e-9)
    assert not motor.faults


def test_a_limit_is_met_when_the_ramp_says() -> None:
    """3333.33 steps at 300 steps/s after a ramp of 0.2 s that covers 30."""
    motor = DriveMotor(TIGHT)
    motor.start_move(5000, SPEED, ACCELERATION)
    expected_s = 0.2 + (mm_to_m(10.0) / STEP_M - 30.0) / SPEED
    motor.update(expected_s - 1e-3)
    assert motor.is_moving
    motor.update(expected_s + 1e-3)
    assert not motor.is_moving


def test_a_limit_switch_that_sticks_blocks_one_direction() -> None:
    motor = DriveMotor(TIGHT)
    motor.conditions = Conditions(is_high_limit_stuck=True)
    motor.start_move(100, SPEED, ACCELERATION)
    motor.update(5.0)
    assert (motor.count, motor.faults) == (0, {MotorFault.HIGH_LIMIT})
    motor.start_move(-100, SPEED, ACCELERATION)
    motor.update(10.0)
    assert (motor.count, motor.faults) == (-100, frozenset())


def test_stop_halts_within_its_ramp() -> None:
    motor = DriveMotor(TIGHT)
    motor.start_move(3000, SPEED, ACCELERATION)
    motor.update(5.0)
    before = motor.true_spindle_steps
    motor.stop(ACCELERATION)
    motor.update(5.0 + SPEED / ACCELERATION + 1e-9)
    assert not motor.is_moving
    assert motor.true_spindle_steps - before == pytest.approx(SPEED**2 / (2 * ACCELERATION))
    motor.update(50.0)
    assert motor.true_spindle_steps - before == pytest.approx(SPEED**2 / (2 * ACCELERATION))


def test_a_new_target_in_mid_move_turns_it_back_without_a_jump() -> None:
    motor = DriveMotor(TIGHT)
    motor.start_move(3000, SPEED, ACCELERATION)
    motor.update(1.0)
    at, speed = motor.true_spindle_steps, motor.speed
    motor.start_move(0, SPEED, ACCELERATION)
    motor.update(1.001)
    assert motor.true_spindle_steps - at == pytest.approx(speed * 0.001, abs=0.01)
    motor.update(10.0)
    assert motor.true_spindle_steps == 0.0


def test_a_reset_in_mid_move_loses_the_count_and_not_the_leg() -> None:
    motor = DriveMotor(TIGHT, 100)
    motor.start_move(3100, SPEED, ACCELERATION)
    motor.update(5.1)
    motor.reset()
    motor.update(60.0)
    assert (motor.count, motor.is_homed, motor.is_moving) == (0, False, False)
    assert motor.true_spindle_steps == pytest.approx(1600)


def test_motion_warms_and_rest_cools() -> None:
    motor = DriveMotor(TIGHT)
    cold_k = motor.temperature_k
    motor.start_move(3000, SPEED, ACCELERATION)
    motor.update(10.2)
    warm_k = motor.temperature_k
    assert warm_k - cold_k == pytest.approx(30.0 * (1.0 - math.exp(-10.2 / 600.0)))
    motor.update(610.2)
    assert motor.temperature_k - cold_k == pytest.approx((warm_k - cold_k) / math.e)


def test_it_turns_until_it_is_stopped() -> None:
    motor = DriveMotor(TIGHT)
    motor.start_rotation(-150.0, ACCELERATION)
    motor.update(10.0)
    assert motor.count == round(-150.0 * (10.0 - 0.05))  # the ramp of 0.1 s loses half of its way
    motor.stop(ACCELERATION)
    motor.update(20.0)
    assert not motor.is_moving


def test_every_order_is_noted_once() -> None:
    notes: list[tuple[float, str, float, float]] = []
    motor = DriveMotor(TIGHT, 7, note=lambda *note: notes.append(note))
    motor.start_move(107, SPEED, ACCELERATION)
    motor.update(9.0)
    assert [(what, start, end) for _, what, start, end in notes] == [("move", 7, 107), ("arrived", 7, 107)]
    assert notes[1][0] == pytest.approx(100 / SPEED + SPEED / ACCELERATION)

"""Metres and steps."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from namod_ctl.core.errors import ConfigError, LimitError
from namod_ctl.devices.steps import StepScale

SCALES = st.floats(10.0, 1e7) | st.floats(-1e7, -10.0)


@given(steps_per_m=SCALES, share=st.floats(0.0, 1.0))
def test_the_nearest_step_is_within_half_a_resolution(steps_per_m, share):
    scale = StepScale(steps_per_m, (-0.01, 0.02), 2**31 - 1)
    position_m = -0.01 + 0.03 * share
    steps = scale.steps_at(min(max(position_m, -0.01), 0.02), "drive")
    assert abs(scale.position_m_at(steps) - position_m) <= 0.5001 * scale.resolution_m
    assert scale.resolution_m > 0.0


def test_a_negative_scale_turns_the_leg_round():
    scale = StepScale(-1000.0, (0.0, 0.01), 100)
    assert scale.steps_at(0.01, "drive") == -10
    assert scale.position_m_at(-10) == 0.01


@pytest.mark.parametrize("position_m", [-1e-9, 0.0100001, math.nan, math.inf, -math.inf])
def test_outside_is_refused_by_name(position_m):
    with pytest.raises(LimitError, match=r"leg 1: position .* mm is outside of its range 0.0000 to 10.0000 mm"):
        StepScale(1000.0, (0.0, 0.01), 100).steps_at(position_m, "leg 1")


@pytest.mark.parametrize(
    ("steps_per_m", "range_m", "text"),
    [
        (0.0, (0.0, 0.01), "other than 0"),
        (math.nan, (0.0, 0.01), "other than 0"),
        (math.inf, (0.0, 0.01), "other than 0"),
        (1000.0, (0.01, 0.0), "first must be below"),
        (1000.0, (0.01, 0.01), "first must be below"),
        (1000.0, (math.nan, 0.01), "first must be below"),
        (1e6, (0.0, 0.01), "counts to 100"),
        (-1e6, (-0.01, 0.0), "counts to 100"),
    ],
)
def test_bad_settings(steps_per_m, range_m, text):
    with pytest.raises(ConfigError, match=text):
        StepScale(steps_per_m, range_m, 100)


def test_rates_are_never_above_what_was_asked_and_never_0():
    scale = StepScale(-333333.333, (0.0, 0.01), 10**9)
    assert scale.magnitude(0.005) == 1666
    assert scale.magnitude(1e-9) == 1

"""What looks as if nothing were left to win, and yet has not converged."""

from __future__ import annotations

import pytest

from namod_ctl.core.units import arcmin2_to_rad2
from namod_ctl.cycle.convergence import Decision, Measurement, decide
from namod_ctl.reconstruction.alignment import AreaOfPsf


def area(arcmin2: float, doubt_arcmin2: float) -> AreaOfPsf:
    return AreaOfPsf(arcmin2_to_rad2(arcmin2), arcmin2_to_rad2(doubt_arcmin2))


@pytest.mark.parametrize(
    ("doubt", "possible", "is_trying", "expected"),
    [
        (0.1, 7.0, False, Decision.CONVERGED),
        (3.0, 7.0, False, Decision.VAGUE),  # a recording that missed the middle, say
        (0.1, 6.0, False, Decision.CONVERGED),  # one facet is left out: the rest is done
        (0.1, 3.0, False, Decision.STUCK),  # half of them
        (0.1, 3.0, True, Decision.CORRECT),  # but something can be tried
    ],
)
def test_decision(doubt: float, possible: float, is_trying: bool, expected: Decision) -> None:
    last = Measurement(area(7.1, doubt), area(7.0, 0.05), area(possible, 0.05), is_trying)
    decision, why = decide([last], None, max_cycles=2)
    assert decision is expected
    assert "7.10" in why

"""When a campaign stops, on histories whose right answer is plain."""

from __future__ import annotations

import pytest

from namod_ctl.core.units import arcmin2_to_rad2
from namod_ctl.cycle.convergence import Decision, Measurement, decide
from namod_ctl.reconstruction.alignment import AreaOfPsf


def _measured(now: float, doubt: float, forecast: float, forecast_doubt: float = 0.05) -> Measurement:
    return Measurement(
        AreaOfPsf(arcmin2_to_rad2(now), arcmin2_to_rad2(doubt)),
        AreaOfPsf(arcmin2_to_rad2(forecast), arcmin2_to_rad2(forecast_doubt)),
    )


@pytest.mark.parametrize(
    ("history", "limit", "expected"),
    [
        ([_measured(60.0, 1.0, 7.0)], None, Decision.CORRECT),
        ([_measured(60.0, 1.0, 7.0), _measured(9.0, 0.1, 7.0)], None, Decision.CORRECT),
        ([_measured(60.0, 1.0, 7.0), _measured(7.1, 0.1, 7.0)], None, Decision.CONVERGED),  # nothing left to win
        ([_measured(60.0, 1.0, 7.0), _measured(7.3, 0.1, 6.5)], 7.1, Decision.CONVERGED),  # within 3 % of the limit
        ([_measured(60.0, 1.0, 7.0), _measured(7.4, 0.1, 6.5)], 7.1, Decision.CORRECT),
        ([_measured(7.6, 0.2, 7.5), _measured(7.5, 0.2, 6.9)], None, Decision.CONVERGED),  # as before, as expected
        ([_measured(60.0, 1.0, 7.0), _measured(90.0, 1.0, 7.0)], None, Decision.WORSE),
        ([_measured(7.0, 0.1, 6.0), _measured(7.15, 0.1, 6.0)], None, Decision.CORRECT),  # not significantly worse
        ([_measured(60.0, 1.0, 7.0), _measured(40.0, 1.0, 7.0), _measured(30.0, 1.0, 7.0)], None, Decision.TOO_MANY),
    ],
)
def test_decision(history: list[Measurement], limit: float | None, expected: Decision) -> None:
    limit_rad2 = None if limit is None else arcmin2_to_rad2(limit)
    decision, why = decide(history, limit_rad2, max_cycles=2)
    assert decision is expected
    assert f"{history[-1].now.a_sigma_rad2 / arcmin2_to_rad2(1.0):.2f}" in why

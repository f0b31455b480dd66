"""Runs compared with each other, on made runs: a common factor of their responses, and facets that were moved."""

from __future__ import annotations

import numpy as np
import pytest
from response_maker import ARCMIN, MadeRun, disc, make_run

from namod_ctl.core.errors import DataQualityError
from namod_ctl.reconstruction.run_comparison import RunComparison, compare_runs

EXPECTED_RAD = 1.3 * ARCMIN


def two_runs(seed: int, factor: float, n_second: int = 300) -> tuple[MadeRun, np.ndarray]:
    """A telescope of 12 facets recorded 300 times, then `n_second` times with responses larger by `factor`."""
    made = make_run(seed, 300 + n_second, n_facets=12, misalignment_rad=3 * ARCMIN)
    run_of_record = np.repeat([0, 1], [300, n_second])
    return made.with_response(made.table.response * np.where(run_of_record == 1, factor, 1.0)[:, None]), run_of_record


def compared(made: MadeRun, run_of_record: np.ndarray, reference: int = 0) -> RunComparison:
    return compare_runs(made.table, run_of_record, reference, EXPECTED_RAD)[1]


@pytest.mark.parametrize(("seed", "factor"), [(11, 1.3), (12, 0.5), (13, 20.0)])
def test_a_factor_is_found_within_its_uncertainty(seed: int, factor: float) -> None:
    found = compared(*two_runs(seed, factor))
    # 12 facets, each lit some dozen times to 4 %: 1 to 3 % are possible
    assert found.factor_uncertainty < 0.05 * factor
    assert abs(found.factor - factor) < 4.0 * found.factor_uncertainty
    assert found.is_factor_significant
    assert found.moved_facet_ids == ()


@pytest.mark.parametrize(("seed", "n_second"), [(14, 300), (15, 40), (16, 15)])
def test_equal_cameras_are_left_alone(seed: int, n_second: int) -> None:
    assert not compared(*two_runs(seed, 1.0, n_second)).is_factor_significant


def test_moonlight_on_the_mirrors_is_no_factor() -> None:
    made, run_of_record = two_runs(20, 1.0)
    moonlit = made.table.response + np.where(run_of_record == 1, 0.01, 0.0)[:, None]
    assert not compared(made.with_response(moonlit), run_of_record).is_factor_significant


def test_a_factor_is_told_from_either_side() -> None:
    made, run_of_record = two_runs(11, 1.3)
    first, second = compare_runs(made.table, run_of_record, 1, EXPECTED_RAD)
    assert (second.factor, second.factor_uncertainty) == (1.0, 0.0)
    assert abs(first.factor - 1.0 / 1.3) < 4.0 * first.factor_uncertainty


def test_a_run_beside_the_light_has_no_factor() -> None:
    made, run_of_record = two_runs(17, 1.0)
    theta_rad = made.table.theta_rad + np.where(run_of_record == 1, 60 * ARCMIN, 0.0)[:, None]
    response = np.where(run_of_record[:, None] == 1, 3e-4, made.table.response)
    found = compared(made.with_theta(theta_rad).with_response(response), run_of_record)
    assert np.isnan(found.factor)
    assert not found.is_factor_significant


def test_facets_that_were_turned_in_between_are_named() -> None:
    before, after = (make_run(18, 1000, path=narrow_disc, centres_rad=centres_rad) for centres_rad in _turned())
    run_of_record = np.repeat([0, 1], 500)  # of one seed, so along one path
    response = np.where(run_of_record[:, None] == 1, after.table.response, before.table.response)
    found = compared(before.with_response(response), run_of_record)
    assert found.n_compared >= 8
    assert found.moved_facet_ids == (3, 7)


def narrow_disc(rng: np.random.Generator, n: int) -> np.ndarray:
    """Directions in which every facet is lit some dozen times in each of two runs of 500 records."""
    return disc(rng, n, 15 * ARCMIN)


def _turned() -> tuple[np.ndarray, np.ndarray]:
    """Centres of 12 facets, and the same after facets 3 and 7 were turned by 4 arcmin."""
    centres = np.random.default_rng(18).normal(0, 3 * ARCMIN, (12, 2))
    turned = centres.copy()
    turned[[2, 6]] += 4 * ARCMIN / np.sqrt(2.0)
    return centres, turned


def test_darkness_is_refused() -> None:
    made, run_of_record = two_runs(19, 1.0)
    with pytest.raises(DataQualityError, match="no facet responded"):
        compared(made.with_response(np.zeros_like(made.table.response)), run_of_record)

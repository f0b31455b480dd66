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
    assert found.is_other_mirror is False  # ten of twelve stand where they stood


def sparse_pair(seed: int, other: int, n_each: int = 150) -> RunComparison:
    """Two runs so sparse that a facet is lit a few times only; of one mirror where the seeds of the mirrors agree."""
    centres = [np.random.default_rng(mirror).normal(0, 4 * ARCMIN, (12, 2)) for mirror in (seed, other)]
    path = make_run(seed, 2 * n_each, centres_rad=centres[0])
    second = make_run(seed, 2 * n_each, centres_rad=centres[1])
    run_of_record = np.repeat([0, 1], n_each)
    response = np.where(run_of_record[:, None] == 1, second.table.response, path.table.response)
    return compared(path.with_response(response), run_of_record)


@pytest.mark.parametrize("seed", [31, 32])
def test_sparse_runs_of_one_mirror_combine_and_of_two_do_not(seed: int) -> None:
    same, other = sparse_pair(seed, seed), sparse_pair(seed, seed + 100)
    assert same.is_other_mirror is False
    assert other.is_other_mirror is True
    # the distance of two normal deviates of 4 arcmin in two axes: a median of 4 sqrt(2) 1.18 = 6.7 arcmin
    assert 4 * ARCMIN < other.distance_rad < 10 * ARCMIN
    assert same.distance_rad < 1 * ARCMIN


def test_runs_with_too_little_light_in_common_are_not_judged() -> None:
    made, run_of_record = two_runs(17, 1.0)
    response = np.where(run_of_record[:, None] == 1, 3e-4, made.table.response)
    assert compared(made.with_response(response), run_of_record).is_other_mirror is None


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

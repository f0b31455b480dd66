"""What a look-up table promises and asks for, and the best facets that stand still, against brute force."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from leaning_dish import N_FACETS, Dish, dish, runs, table
from scipy.optimize import minimize

from namod_ctl.calibration.gravity.bias_alignment import Aim, best_compromise
from namod_ctl.calibration.gravity.gravity_table import GravityTable, table_of_fit, zenith_grid_rad
from namod_ctl.calibration.gravity.sag_of_runs import fit_sag
from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_arcmin

WIDTH_RAD = arcmin_to_rad(1.4)
GRID_RAD = zenith_grid_rad(deg_to_rad(5.0), deg_to_rad(65.0), deg_to_rad(5.0))
IN_STEPS = np.ones(len(GRID_RAD))


def area_by_samples(of: Dish, theta_rad: np.ndarray) -> float:
    """A_sigma of the light of all facets, every one a thousand points of a gaussian: no formula of moments."""
    rng = np.random.default_rng(0)
    points = np.concatenate([t + WIDTH_RAD * rng.standard_normal((4000, 2)) for t in theta_rad])
    weights = np.repeat(of.light, 4000)
    return float(math.pi * np.sqrt(np.linalg.det(np.cov(points.T, aweights=weights))))


def fitted(of: Dish, zeniths: tuple[float, ...] = (10.0, 25.0, 40.0, 60.0), seed: int = 1) -> GravityTable:
    fit = fit_sag(runs(of, zeniths, seed=seed), of.light)
    reach = (deg_to_rad(zeniths[0]), deg_to_rad(zeniths[-1]))
    variance = np.full(N_FACETS, WIDTH_RAD**2)
    return table_of_fit(fit, "Leaning dish", tuple(range(N_FACETS)), of.light, variance, reach)


def test_the_area_is_that_of_the_light() -> None:
    of = dish(1)
    for theta in (np.zeros((N_FACETS, 2)), of.theta_rad(0.5)):
        assert float(table(of).area_rad2(theta)) == pytest.approx(area_by_samples(of, theta), rel=0.02)


def test_the_table_keeps_the_image_at_its_limit_where_the_sag_spoils_it() -> None:
    """From 5 to 65 deg with a table of four runs from 10 to 60 deg; the truth is the dish, not the table."""
    of = dish(2, sine_arcmin=2.0)
    found, perfect = fitted(of), table(of)
    aligned_rad = deg_to_rad(30.0)
    for zenith in GRID_RAD:
        moved = of.relative(of.theta_rad(float(zenith)) - of.theta_rad(aligned_rad))
        corrected = moved + 2.0 * found.tilt_change_rad(aligned_rad, float(zenith))
        assert float(perfect.area_rad2(corrected)) < 1.02 * perfect.limit_rad2()
    ends = perfect.areas_without_rad2(GRID_RAD[[0, -1]], aligned_rad) / perfect.limit_rad2()
    assert ends.min() > 1.25
    mean, _ = found.areas_with(GRID_RAD, aligned_rad)
    assert mean.max() < 1.03 * found.limit_rad2()


def test_what_the_table_promises_without_correction_is_what_happens() -> None:
    of = dish(3, sine_arcmin=1.5)
    promised = fitted(of).areas_without_rad2(GRID_RAD, deg_to_rad(30.0))
    happens = [area_by_samples(of, of.theta_rad(float(z)) - of.theta_rad(deg_to_rad(30.0))) for z in GRID_RAD]
    np.testing.assert_allclose(promised, happens, rtol=0.05)


def test_going_there_and_back_is_no_way_at_all() -> None:
    made = table(dish(4))
    there = made.tilt_change_rad(0.3, 0.9)
    np.testing.assert_allclose(made.tilt_change_rad(0.9, 0.3), -there, atol=1e-18)
    np.testing.assert_allclose(made.tilt_change_rad(0.3, 0.6) + made.tilt_change_rad(0.6, 0.9), there, atol=1e-18)
    # a facet whose light wanders by 2 arcmin is turned by 1 arcmin, the other way
    np.testing.assert_allclose(there, -made.change_rad(0.3, 0.9) / 2.0, atol=1e-18)


def test_facets_at_rest_are_left_alone() -> None:
    still = np.arange(N_FACETS) == 3
    made = replace(table(dish(5)), is_moving=~still)
    assert not made.change_rad(0.2, 1.0)[3].any()
    assert made.change_rad(0.2, 1.0)[4].any()


def test_the_side_counts_by_the_play() -> None:
    of = dish(6)
    made = replace(table(of), play_rad=deg_to_rad(2.0))
    above = made.motion_rad(np.array(deg_to_rad(40.0)), "above")
    np.testing.assert_allclose(above, made.motion_rad(np.array(deg_to_rad(38.0))))
    below = made.motion_rad(np.array(deg_to_rad(40.0)), "below")
    np.testing.assert_allclose(below, made.motion_rad(np.array(deg_to_rad(42.0))))


@pytest.mark.parametrize("zenith_deg", [-1.0, 71.0, 88.0, math.nan])
def test_beyond_its_runs_a_table_is_silent(zenith_deg: float) -> None:
    with pytest.raises(ConfigError, match="rests on runs from 10 to 60 deg"):
        table(dish()).check_zenith(deg_to_rad(zenith_deg), "--zenith-deg")


def test_the_mean_compromise_is_the_best_of_all() -> None:
    """A dish of few facets, every number of every facet free, by a minimizer that knows nothing of the formula."""
    of = dish(7, sine_arcmin=2.0, cosine_arcmin=2.0)
    few = slice(0, 4)
    made = table(of)
    made = replace(
        made, facet_ids=made.facet_ids[few], beta_rad=made.beta_rad[few], cov_rad2=made.cov_rad2[few],
        is_moving=made.is_moving[few], light=made.light[few], variance_rad2=made.variance_rad2[few],
    )  # fmt: skip
    motion = made.motion_rad(GRID_RAD)
    best = best_compromise(made, GRID_RAD, IN_STEPS, Aim.MEAN)

    def mean_area(numbers: np.ndarray) -> float:
        return float(made.area_rad2(motion - arcmin_to_rad(numbers.reshape(4, 2))).mean() / made.limit_rad2())

    free = minimize(mean_area, np.zeros(8), method="BFGS", options={"gtol": 1e-7})
    assert mean_area(rad_to_arcmin(best.offset_rad).ravel()) == pytest.approx(float(free.fun), rel=1e-4)
    alone = [float(made.areas_without_rad2(GRID_RAD, float(z)).mean()) / made.limit_rad2() for z in GRID_RAD]
    assert free.fun < min(alone)


def test_the_worst_compromise_is_better_at_its_worst_and_no_other_is_much_better() -> None:
    of = dish(8, sine_arcmin=2.0, cosine_arcmin=2.0)
    made = table(of)
    motion, limit = made.motion_rad(GRID_RAD), made.limit_rad2()
    mean, worst = (best_compromise(made, GRID_RAD, IN_STEPS, aim).area_rad2 / limit for aim in (Aim.MEAN, Aim.WORST))
    assert worst.max() < mean.max()
    assert mean.mean() < worst.mean()

    def largest(numbers: np.ndarray) -> float:
        # offsets between those of single zenith distances: where the best ones must lie, as the sag has two terms
        offset = np.tensordot(numbers, made.beta_rad[:, 1:], axes=(0, 1))
        return float(made.area_rad2(motion - offset).max() / limit)

    free = minimize(largest, [0.5, -0.2], method="Nelder-Mead")
    assert worst.max() < 1.01 * free.fun


def test_observing_time_pulls_the_compromise_there() -> None:
    made = table(dish(9, sine_arcmin=2.0))
    high = best_compromise(made, GRID_RAD, np.where(deg_to_rad(20.0) > GRID_RAD, 10.0, 1.0), Aim.MEAN)
    low = best_compromise(made, GRID_RAD, np.where(deg_to_rad(50.0) < GRID_RAD, 10.0, 1.0), Aim.MEAN)
    assert high.area_rad2[0] < low.area_rad2[0]
    assert low.area_rad2[-1] < high.area_rad2[-1]


def test_a_stiff_dish_needs_no_compromise() -> None:
    made = replace(table(dish(10)), is_moving=np.zeros(N_FACETS, dtype=np.bool_))
    with pytest.raises(DataQualityError, match="nothing to compromise"):
        best_compromise(made, GRID_RAD, IN_STEPS, Aim.MEAN)

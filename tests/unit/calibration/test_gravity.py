"""The sag of facets from runs at several zenith distances, against an analytic dish."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from leaning_dish import ERROR_RAD, FOUR, N_FACETS, Dish, dish, runs

from namod_ctl.calibration.gravity.sag_of_runs import RunOfFacets, SagFit, fit_sag
from namod_ctl.calibration.gravity.zenith_path import ZenithPath
from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_deg

SIX = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
TO_AND_FRO = ("above", "below") * 3


def pulls(fit: SagFit, of: Dish) -> np.ndarray:
    truth = {"sin": of.relative(of.sine), "cos": of.relative(of.cosine)}
    found = [
        (fit.beta_rad[:, i] - truth[term]) / np.sqrt(np.diagonal(fit.cov_rad2[:, i, :, i, :], axis1=1, axis2=2))
        for i, term in enumerate(fit.terms, start=1)
    ]
    return np.concatenate(found).ravel()


def test_the_sag_is_found_within_its_stated_errors() -> None:
    found = []
    for seed in range(20):
        of = dish(seed)
        fit = fit_sag(runs(of, seed=seed), of.light)
        assert fit.terms == ("sin",)
        assert not fit.odd
        found.append(pulls(fit, of))
    together = np.concatenate(found)
    assert abs(together.mean()) < 0.1
    assert 0.9 < together.std() < 1.1
    assert np.mean(np.abs(together) > 3.0) < 0.01


def test_a_cosine_is_taken_in_when_the_dish_has_one_and_only_then() -> None:
    with_cosine, without = dish(2, cosine_arcmin=3.0), dish(2)
    fit = fit_sag(runs(with_cosine, SIX), with_cosine.light)
    assert fit.terms == ("sin", "cos")
    assert 0.85 < pulls(fit, with_cosine).std() < 1.15
    assert fit_sag(runs(without, SIX), without.light).terms == ("sin",)


def test_a_stiff_dish_gets_no_terms() -> None:
    stiff = dish(3, sine_arcmin=0.0)
    fit = fit_sag(runs(stiff), stiff.light)
    assert fit.terms == ()
    assert not fit.is_moving.any()
    assert any("no sag" in remark for remark in fit.remarks)


def test_facets_that_do_not_move_are_told_from_those_that_do() -> None:
    of = dish(4)
    still = np.arange(N_FACETS) < 10
    sine = np.where(still[:, None], 0.0, of.sine)
    sine[~still] -= of.light @ sine / of.light[~still].sum()  # so that the mean of all stands still as well
    of = replace(of, sine=sine)
    small = np.linalg.norm(of.relative(of.sine), axis=1) < arcmin_to_rad(0.05)
    large = np.linalg.norm(of.relative(of.sine), axis=1) > arcmin_to_rad(0.4)
    fit = fit_sag(runs(of), of.light)
    assert fit.is_moving[large].all()
    assert np.mean(fit.is_moving[small]) < 0.4
    assert np.all(fit.chance[large] < 1e-3)


def test_what_the_whole_image_does_is_told_apart() -> None:
    """The star camera points elsewhere in each run: the facets' sag does not notice, and it is reported."""
    of = dish(5)
    still = runs(of, seed=7)
    moved = [replace(run, theta_rad=run.theta_rad + arcmin_to_rad(30.0) * k) for k, run in enumerate(still)]
    here, there = fit_sag(still, of.light), fit_sag(moved, of.light)
    np.testing.assert_allclose(there.beta_rad, here.beta_rad, atol=1e-12)
    step = (there.common_rad - here.common_rad)[:, 0]
    np.testing.assert_allclose(step, arcmin_to_rad(30.0) * np.arange(4), atol=1e-12)
    # 24 facets of 0.05 arcmin each
    assert here.common_sigma_rad.max() == pytest.approx(ERROR_RAD / math.sqrt(N_FACETS), rel=0.1)


def test_play_is_measured_from_both_sides_and_its_error_is_honest() -> None:
    found = []
    for seed in range(10):
        of = dish(seed)
        play = fit_sag(runs(of, SIX, TO_AND_FRO, play_deg=2.0, seed=seed), of.light).play
        assert play is not None
        found.append((play.play_rad - deg_to_rad(2.0)) / play.sigma_rad)
        assert play.is_significant
        # sine of rms 1.4 arcmin long: its slope at 45 deg times twice the play
        assert play.difference_rad == pytest.approx(2.0 * play.play_rad * arcmin_to_rad(1.0), rel=0.4)
    assert abs(np.mean(found)) < 0.8
    assert 0.5 < np.std(found) < 1.7


def test_no_play_is_not_claimed() -> None:
    of = dish(6)
    fit = fit_sag(runs(of, SIX, TO_AND_FRO), of.light)
    assert fit.play is not None
    assert not fit.play.is_significant
    assert fit.play.own_chance > 1e-3


def test_sides_that_were_exchanged_are_noticed() -> None:
    of = dish(7)
    right = runs(of, SIX, TO_AND_FRO, play_deg=3.0)
    wrong = [
        replace(run, path=replace(run.path, came_from_rad=math.pi / 2.0 - run.path.came_from_rad)) for run in right
    ]
    fit = fit_sag(wrong, of.light)
    assert any("exchanged" in remark for remark in fit.remarks)
    assert fit.play is not None
    assert fit.play.used_rad == 0.0


def test_hysteresis_that_differs_from_facet_to_facet_is_reported() -> None:
    of, rng = dish(8), np.random.default_rng(8)
    own = arcmin_to_rad(0.2) * rng.standard_normal((N_FACETS, 2))
    still = runs(of, (10.0, 12.0, 30.0, 32.0, 60.0, 62.0), TO_AND_FRO)
    jumping = [replace(run, theta_rad=run.theta_rad + (1 - 2 * (k % 2)) * own) for k, run in enumerate(still)]
    fit = fit_sag(jumping, of.light)
    assert fit.play is not None
    assert fit.play.own_chance < 1e-3
    assert fit.play.own_rms_rad == pytest.approx(2.0 * math.sqrt(2.0) * arcmin_to_rad(0.2), rel=0.35)


def test_without_sides_hysteresis_is_said_not_to_be_measured() -> None:
    of = dish(9)
    fit = fit_sag(runs(of), of.light)
    assert fit.play is None
    assert any("hysteresis was not measured" in remark for remark in fit.remarks)


def test_a_facet_turned_between_runs_is_left_out_and_the_others_are_not_harmed() -> None:
    of = dish(10)
    taken = runs(of, SIX)
    turned = arcmin_to_rad(np.array([3.0, -2.0]))
    for k in (3, 4, 5):
        taken[k].theta_rad[7] += turned
    fit = fit_sag(taken, of.light)
    assert list(fit.odd) == [7]
    assert not fit.is_moving[7]
    others = np.arange(N_FACETS) != 7
    light = np.where(others, of.light, 0.0)
    truth = of.sine - light @ of.sine / light.sum()
    sigma = np.sqrt(np.diagonal(fit.cov_rad2[:, 1, :, 1, :], axis1=1, axis2=2))
    assert np.abs((fit.beta_rad[:, 1] - truth) / sigma)[others].max() < 4.5


def test_a_correction_between_the_runs_is_a_verdict_not_a_table() -> None:
    of = dish(11)
    taken = runs(of)
    for run in taken[2:]:
        run.theta_rad[:] -= of.stand
    with pytest.raises(DataQualityError, match=r"one state of the mirror.*between run_at_25 and run_at_40"):
        fit_sag(taken, of.light)


@pytest.mark.parametrize(
    ("zeniths", "words"),
    [((10.0, 60.0), "at least 3"), ((30.0, 35.0, 40.0), "span of 10 deg"), ((10.0, 11.0, 60.0), "2 different")],
)
def test_too_few_or_too_near_runs_are_a_verdict(zeniths: tuple[float, ...], words: str) -> None:
    of = dish(12)
    with pytest.raises(DataQualityError, match=words):
        fit_sag(runs(of, zeniths), of.light)


def test_a_small_span_is_limited() -> None:
    of = dish(13)
    fit = fit_sag(runs(of, (30.0, 37.0, 44.0, 51.0)), of.light)
    assert not fit.is_good
    assert any("span only 21 deg" in remark for remark in fit.remarks)


def test_facets_seen_in_too_few_runs_are_not_guessed() -> None:
    of = dish(14)
    taken = runs(of)
    for k in (0, 1, 2):
        taken[k].theta_rad[5] = np.nan
    taken[0].cov_rad2[6] = np.nan
    fit = fit_sag(taken, of.light)
    assert np.isnan(fit.beta_rad[5]).all()
    assert not fit.is_moving[5]
    assert np.isfinite(fit.beta_rad[6]).all()


def test_errors_stated_too_small_are_widened() -> None:
    of = dish(15)
    honest, boasting = (fit_sag(runs(of, SIX, stated=stated), of.light) for stated in (1.0, 0.4))
    assert boasting.scatter == pytest.approx(2.5, rel=0.15)
    assert not boasting.is_good
    ratio = np.sqrt(boasting.cov_rad2[:, 1, 0, 1, 0] / honest.cov_rad2[:, 1, 0, 1, 0])
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_a_telescope_without_common_facets_is_refused() -> None:
    of = dish(16)
    taken = runs(of)
    for k in range(4):
        taken[k].theta_rad[k::4] = np.nan
    with pytest.raises(DataQualityError, match="known well in all runs"):
        fit_sag(taken, of.light)


@pytest.mark.parametrize(("came_from_deg", "side"), [(0.0, 1.0), (90.0, -1.0), (math.nan, 0.0)])
def test_a_path_knows_its_side(came_from_deg: float, side: float) -> None:
    assert ZenithPath(np.array([0.5]), deg_to_rad(came_from_deg)).side() == side


def test_play_lags_behind_a_star_that_culminates() -> None:
    """Down to 30 deg, up to 26 and down again, with a play of 1 deg: worked out by hand."""
    path = ZenithPath(deg_to_rad(np.array([30.0, 29.0, 28.0, 26.0, 27.0, 28.0, 29.0])))
    path = replace(path, came_from_rad=0.0)
    np.testing.assert_allclose(rad_to_deg(path.with_play(deg_to_rad(1.0))), [29.0, 29.0, 29.0, 27.0, 27.0, 27.0, 28.0])
    mirrored = 2.0 * path.zenith_rad - path.with_play(deg_to_rad(1.0))
    np.testing.assert_allclose(path.with_play(deg_to_rad(-1.0)), mirrored)
    assert path.with_play(0.0) is path.zenith_rad


def test_four_runs_suffice_as_named() -> None:
    of = dish(17)
    fit = fit_sag(runs(of, FOUR), of.light)
    assert isinstance(runs(of)[0], RunOfFacets)
    assert fit.is_good


def test_facets_seen_one_after_the_other_while_the_telescope_leans_over() -> None:
    """In a run the sky turns by 6 deg, each facet is lit at a moment of its own, and the whole image sags too."""
    found, without_moments = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        of = dish(seed)
        of = replace(of, sine=of.sine + arcmin_to_rad(np.array([1.0, 6.0])))
        taken, blind = [], []
        for zenith in SIX:
            path = ZenithPath(deg_to_rad(np.linspace(zenith - 3.0, zenith + 3.0, 12)))
            moments = rng.integers(0, 12, N_FACETS)
            theta = np.array([of.theta_rad(float(path.zenith_rad[m]))[j] for j, m in enumerate(moments)])
            theta += rng.normal(0.0, arcmin_to_rad(1.0), 2) + rng.normal(0.0, ERROR_RAD, theta.shape)
            cov = np.tile(ERROR_RAD**2 * np.eye(2), (N_FACETS, 1, 1))
            taken.append(RunOfFacets(f"{zenith:g}", path, theta, cov, np.eye(12)[moments]))
            blind.append(replace(taken[-1], seen=np.full((N_FACETS, 12), 1.0 / 12.0)))
        found.append(pulls(fit_sag(taken, of.light), of))
        without_moments.append(fit_sag(blind, of.light).scatter)
    together = np.concatenate(found)
    assert abs(together.mean()) < 0.15
    assert 0.85 < together.std() < 1.15
    assert np.mean(without_moments) > 2.0

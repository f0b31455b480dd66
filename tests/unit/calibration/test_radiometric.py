"""Radiometric calibration on the twin's lamp, whose law is known; `benchmarks/bench_radiometric.py` has statistics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from lamp_rig import FULL_SCALE_ADU, LAWS, Case, intensity_departure, recorded, series_of_twin

from namod_ctl.calibration.lamp.exposure_ratio import exposure_ratio
from namod_ctl.calibration.lamp.lamp_series import Response, at_distance
from namod_ctl.calibration.lamp.lamp_visits import visits_of
from namod_ctl.calibration.lamp.radiometric_checks import check_exposure_range
from namod_ctl.calibration.lamp.radiometric_fit import LampData, LawForm, fit_law
from namod_ctl.calibration.lamp.radiometric_verdict import RadiometricFinding, calibrate_radiometric
from namod_ctl.core.errors import DataQualityError
from namod_ctl.cycle.lamp_recording import LampSeries

STAR = Case("star", "star", distance_error_m=0.002)
REFLECTOR = Case("reflector", "reflector", distance_error_m=0.002)
SIX = tuple(float(d) for d in np.geomspace(0.5, 5.0, 6))
SHORT = Case("short", "star", distance_error_m=0.002, distances_m=SIX)


def calibrated(series: LampSeries) -> RadiometricFinding:
    assert series.patch is not None
    assert series.dark is not None
    return calibrate_radiometric(
        series.responses, series.placements, series.dark, series.patch.n_pixels, FULL_SCALE_ADU
    )


def changed(series: LampSeries, change: Callable[[Response], Response | None]) -> LampSeries:
    """The series with other responses; None leaves one out."""
    responses = [new for response in series.responses if (new := change(response)) is not None]
    return replace(series, responses=responses)


@pytest.fixture(scope="module")
def short_series() -> LampSeries:
    return recorded(SHORT, 1)[0]


@pytest.mark.parametrize("case", [STAR, REFLECTOR], ids=lambda case: case.name)
def test_laws_of_the_paper_are_recovered_within_their_errors(case: Case) -> None:
    pulls = []
    for seed in range(2):
        finding, truth = series_of_twin(case, seed)
        pulls.append((finding.fit.parameters - truth)[:3] / np.sqrt(np.diag(finding.fit.covariance))[:3])
        assert finding.law_name == "three_parameter"
        assert finding.verdict == "good"
        assert intensity_departure(finding, truth) < 0.01
    assert np.abs(pulls).max() < 4.0
    assert 0.2 < np.sqrt(np.mean(np.square(pulls))) < 1.9  # of 2 x 3 numbers that hang together


def test_curved_law_is_found_where_there_is_one() -> None:
    finding, truth = series_of_twin(replace(SHORT, r_curve=0.06), 2)
    assert finding.law_name == "curved"
    assert np.all(np.abs(finding.fit.parameters - truth) < 4.0 * np.sqrt(np.diag(finding.fit.covariance)))
    assert intensity_departure(finding, truth) < 0.015


def test_uneven_field_and_colour_leave_the_slopes_of_the_law() -> None:
    finding, truth = series_of_twin(replace(SHORT, law="reflector", fall_off_share=0.3, n_channels=3), 3)
    error = np.sqrt(np.diag(finding.fit.covariance))
    assert np.all(np.abs(finding.fit.parameters - truth)[:2] < 3.5 * error[:2])


def test_black_level_and_drift_are_taken_off() -> None:
    finding, truth = series_of_twin(replace(SHORT, black_level_adu=6.0, drift=0.3), 4)
    assert finding.drift_share > 0.02
    assert np.all(np.abs(finding.fit.parameters - truth)[:3] < 3.5 * np.sqrt(np.diag(finding.fit.covariance))[:3])


def test_saturation_below_full_scale_is_measured(short_series: LampSeries) -> None:
    def cut(response: Response) -> Response:
        mean = min(response.mean_adu[0], 190.0)
        return replace(response, mean_adu=(mean,), clipped_share=0.0)

    finding = calibrated(changed(short_series, cut))
    assert finding.is_saturation_seen
    assert 0.65 < finding.saturation_share < 190.0 / 255.0
    assert finding.usable_response_share[1] <= finding.saturation_share


def test_compression_of_bright_responses_ends_the_usable_range(short_series: LampSeries) -> None:
    def compressed(response: Response) -> Response:
        mean = response.mean_adu[0]
        return replace(response, mean_adu=(mean - 0.25 * max(mean - 180.0, 0.0),))

    finding, honest = calibrated(changed(short_series, compressed)), calibrated(short_series)
    assert finding.usable_response_share[1] < 0.75
    assert finding.saturation_share < 0.75
    error = np.sqrt(np.diag(honest.fit.covariance))[:3]
    assert np.all(np.abs(finding.fit.parameters - honest.fit.parameters)[:3] < 3.0 * error)


def test_single_flashes_change_nothing(short_series: LampSeries) -> None:
    def flashing(response: Response) -> Response:
        is_hit = response.time_s * 1000.0 % 47.0 < 1.0
        return replace(response, mean_adu=(response.mean_adu[0] * 1.3,)) if is_hit else response

    finding, honest = calibrated(changed(short_series, flashing)), calibrated(short_series)
    error = np.sqrt(np.diag(honest.fit.covariance))[:3]
    assert np.all(np.abs(finding.fit.parameters - honest.fit.parameters)[:3] < 2.0 * error)


def _refused(series: LampSeries, match: str) -> None:
    with pytest.raises(DataQualityError, match=match):
        calibrated(series)


def test_two_frames_only(short_series: LampSeries) -> None:
    _refused(replace(short_series, responses=short_series.responses[:2]), "2 frames of the lamp are too few")


def test_one_level_only_tells_the_ratio(short_series: LampSeries) -> None:
    one = changed(short_series, lambda response: response if response.placement == 1 else None)
    _refused(one, "only r_expo / r_resp can be told")
    assert one.patch is not None
    assert one.dark is not None
    visits = visits_of(one.responses, one.placements, one.dark, one.patch.n_pixels, FULL_SCALE_ADU, 1.0)
    ratio = exposure_ratio(visits)
    r_resp, r_expo, _ = LAWS["star"]
    assert abs(ratio.value - r_expo / r_resp) < 4.0 * ratio.uncertainty
    assert ratio.uncertainty < 0.01


def test_all_frames_saturated(short_series: LampSeries) -> None:
    _refused(changed(short_series, lambda r: replace(r, mean_adu=(255.0,), clipped_share=1.0)), "all frames.*saturated")


def test_all_frames_dark(short_series: LampSeries) -> None:
    _refused(changed(short_series, lambda r: replace(r, mean_adu=(0.2,), empty_share=0.8)), "all frames.*dark")


def test_lamp_that_fades(short_series: LampSeries) -> None:
    end_s = short_series.responses[-1].time_s

    def faded(response: Response) -> Response:
        light = 1.0 - 0.3 * response.time_s / end_s
        return replace(response, mean_adu=(response.mean_adu[0] * light ** (1.0 / 1.2),))

    _refused(changed(short_series, faded), "the lamp faded by 2.%")


def test_wrong_distance_is_named() -> None:
    series, _ = recorded(STAR, 5)
    wrong = list(series.placements)
    wrong[3] = replace(wrong[3], level=wrong[3].level / 1.44, words="the wrong one")
    _refused(replace(series, placements=wrong), "the wrong one: shows")


def test_distances_not_measured_from_the_filament() -> None:
    """The person believes 40 mm less than what is true."""
    series, truth = recorded(STAR, 6)
    believed = [at_distance((placement.distance_m or 0.0) - 0.04) for placement in series.placements]
    finding = calibrated(replace(series, placements=believed))
    assert finding.verdict == "limited"
    assert any("mm too short" in remark for remark in finding.remarks)
    assert finding.fit.offset_m == pytest.approx(0.04, abs=4.0 * finding.fit.offset_error_m)
    error = np.sqrt(np.diag(finding.fit.covariance))[:3]
    assert np.all(np.abs(finding.fit.parameters - truth)[:3] < 3.5 * error)


def test_common_error_of_all_distances_is_in_the_uncertainties() -> None:
    """The person believes 8 mm less than what is true, and said 5 mm: law and intensities are as sure as they say."""
    series, truth = recorded(SHORT, 7)
    believed = [at_distance((placement.distance_m or 0.0) - 0.008) for placement in series.placements]
    finding = calibrated(replace(series, placements=believed))
    assert not finding.fit.form.has_offset
    error = np.sqrt(np.diag(finding.fit.covariance))[:3]
    assert np.all(np.abs(finding.fit.parameters - truth)[:3] < 3.0 * error)
    assert any("right within 5 mm" in remark for remark in finding.remarks)


def test_an_offset_larger_than_was_said_is_taken_off_only_where_it_is_sure() -> None:
    """Seven placements with errors of 2 mm look, by chance, as if all distances were 6 mm too short."""
    finding, truth = series_of_twin(SHORT, 4)
    assert not finding.fit.form.has_offset
    error = np.sqrt(np.diag(finding.fit.covariance))[:3]
    assert np.all(np.abs(finding.fit.parameters - truth)[:3] < 3.0 * error)


def test_lamp_seen_as_a_disc(short_series: LampSeries) -> None:
    far = [at_distance(5.0 if i % 2 else 0.5) for i in range(len(short_series.placements))]
    level = np.array([placement.level for placement in short_series.placements])

    def as_bright_as_ever(response: Response) -> Response:
        return replace(response, mean_adu=(response.mean_adu[0] * float(level[response.placement]) ** (-1.0 / 1.2),))

    series = changed(short_series, as_bright_as_ever)
    _refused(replace(series, placements=far), "seen as a disc|contradict")


def test_milliseconds_beside_seconds(short_series: LampSeries) -> None:
    def mixed(response: Response) -> Response:
        return replace(response, exposure_s=1e3 * response.exposure_s) if response.placement == 2 else response

    _refused(changed(short_series, mixed), "milliseconds beside seconds")


def test_frames_that_follow_too_fast_have_no_seconds() -> None:
    exposures = [1.0, 10.0, 100.0, 1000.0, 3000.0] * 4
    starts = [5.0 * i for i in range(20)]
    with pytest.raises(DataQualityError, match="cannot be seconds"):
        check_exposure_range(exposures, starts, (1e-3, 3.0))
    with pytest.raises(DataQualityError, match="milliseconds or microseconds"):
        check_exposure_range(exposures, [math.nan] * 20, (1e-3, 3.0))
    with pytest.raises(DataQualityError, match="milliseconds or microseconds"):
        check_exposure_range([1e-6 * t for t in (1.0, 10.0, 300.0)], [math.nan] * 3, (1e-3, 3.0))
    check_exposure_range([0.001, 0.1, 3.0], [0.0, 1.0, 2.0], (1e-3, 3.0))


def test_fit_gives_the_closed_form_of_generalized_least_squares() -> None:
    """Of the response on what is known, with the covariance that the fit found, through dense matrices."""
    rng = np.random.default_rng(5)
    placement = np.repeat(np.arange(6), 10)
    log_level = np.linspace(0.8, -1.2, 6)[placement]
    log_exposure = np.tile(np.linspace(-1.0, 0.2, 10), 6) - 0.8 * log_level - 0.8
    true_light = log_level + 0.01 * rng.standard_normal(6)[placement]
    log_share = (true_light + 1.15 * log_exposure + 0.19) / 1.03 + 0.002 * rng.standard_normal(60)
    data = LampData(
        log_share=log_share,
        log_exposure=log_exposure,
        log_level=log_level,
        placement=placement,
        variance=np.full(60, 1e-7),
        lever_per_adu=np.zeros(60),
        dark_uncertainty_adu=0.0,
        time=np.zeros(60),
        dex_per_m=np.zeros(60),
    )
    fit = fit_law(data, LawForm(drift_degree=0))
    r_resp = fit.parameters[0]
    belongs = placement[:, None] == placement
    cov = belongs * (fit.placement_dex / r_resp) ** 2 + np.eye(60) * (1e-7 + (fit.visit_dex / r_resp) ** 2)
    design = np.stack([log_level, log_exposure, np.ones(60)], axis=1)
    inverse = np.linalg.inv(cov)
    a, b, c = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ log_share)
    assert fit.parameters[:3] == pytest.approx([1.0 / a, -b / a, -c / a], abs=2e-5)
    assert fit.placement_dex == pytest.approx(0.01, rel=0.7)

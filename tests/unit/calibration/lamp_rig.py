"""Whole lamp series on the twin, with small images: what the calibration finds, and how far it is from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from namod_ctl.calibration.lamp.lamp_series import Placement, at_distance, at_level
from namod_ctl.calibration.lamp.radiometric_verdict import RadiometricFinding, calibrate_radiometric
from namod_ctl.cycle.lamp_recording import LampSeries, SeriesPlan, dark_exposures_s, record_darks, record_lamp_series
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.twin.lamp import LampSettings, TwinLamp
from namod_ctl.twin.settings import CameraSettings

LAWS = {"reflector": (1.03, -1.15, -0.19), "star": (1.20, -1.23, 0.99)}
"""arXiv:1605.06274, section 3."""

INTENSITY_AT_1M = {"reflector": 10.0, "star": 100.0}
DISTANCES_M = tuple(float(d) for d in np.geomspace(0.5, 5.0, 10))
FULL_SCALE_ADU = 255.0
ROWS, COLUMNS = 48, 64


@dataclass(frozen=True)
class Case:
    """One kind of series: a law of the paper, and what is not perfect."""

    name: str
    law: str
    uses_levels: bool = False
    distance_error_m: float = 0.0
    common_distance_error_m: float = 0.0
    level_error_share: float = 0.0
    n_channels: int = 1
    black_level_adu: float = 0.0
    drift: float = 0.0
    flicker_share: float = 0.003
    r_curve: float = 0.0
    fall_off_share: float = 0.0
    distances_m: tuple[float, ...] = DISTANCES_M

    @property
    def stated_distance_error_m(self) -> float:
        """What the person says of the distances: the truth, of each and of all together."""
        return max(self.distance_error_m, self.common_distance_error_m)

    @property
    def true_parameters(self) -> np.ndarray:
        """r_resp, r_expo, r_const (of the lamp at 1 m = 1), r_curve."""
        r_resp, r_expo, r_const = LAWS[self.law]
        return np.array([r_resp, r_expo, r_const - np.log10(INTENSITY_AT_1M[self.law]), self.r_curve])

    @property
    def true_law(self) -> RadiometricLaw:
        """In the twin's unit of intensity."""
        return RadiometricLaw(*LAWS[self.law], self.r_curve)


class TwinBench:
    """The person at the twin's bench."""

    def __init__(self, lamp: TwinLamp) -> None:
        self.lamp = lamp

    def cap(self) -> None:
        self.lamp.cap()

    def place(self, placement: Placement) -> None:
        if placement.distance_m is None:
            self.lamp.set_level(placement.level)
        else:
            self.lamp.place(placement.distance_m)


def camera_model(law: RadiometricLaw, name: str) -> CameraModel:
    """A small camera."""
    axis = np.array([COLUMNS / 2.0, ROWS / 2.0])
    return CameraModel(name, COLUMNS, ROWS, 1e-4, axis, False, CameraOrientation(0.0, False), law, FULL_SCALE_ADU)


def twin_lamp(case: Case, seed: int) -> TwinLamp:
    """The bench of a case."""
    settings = CameraSettings(0.05, 1e-4, n_hot_pixels=6, black_level_adu=case.black_level_adu)
    lamp = LampSettings(
        intensity_at_1m=INTENSITY_AT_1M[case.law],
        flicker_share=case.flicker_share,
        drift_share_per_hour=case.drift,
        level_error_share=case.level_error_share,
        distance_error_m=case.distance_error_m,
        distance_offset_m=case.common_distance_error_m * np.random.default_rng([seed, 1]).standard_normal(),
        cosmic_rays_per_s=0.2,
        fall_off_share=case.fall_off_share,
    )
    model = camera_model(RadiometricLaw(*LAWS[case.law]), case.law)
    return TwinLamp(model, settings, lamp, case.true_law, seed, case.n_channels)


def recorded(case: Case, seed: int) -> tuple[LampSeries, np.ndarray]:
    """A guided series with darks, and the true parameters for the lamp as it is in the middle of it."""
    lamp = twin_lamp(case, seed)
    bench = TwinBench(lamp)
    placements = tuple(at_level(d**-2.0) if case.uses_levels else at_distance(d) for d in case.distances_m)
    r_resp, r_expo, _ = LAWS[case.law]
    plan = SeriesPlan(placements, lamp.exposure_range_s, -r_expo / r_resp)
    bench.cap()
    darks = record_darks(lamp, lamp.clock, dark_exposures_s(plan.exposure_range_s), 3)
    series = record_lamp_series(lamp, lamp.clock, bench, plan, darks, FULL_SCALE_ADU, lambda _: None)
    middle_s = (series.responses[0].time_s + series.responses[-1].time_s) / 2.0
    truth = case.true_parameters
    truth[2] -= case.drift * middle_s / 3600.0 / np.log(10.0)
    return series, truth


def series_of_twin(case: Case, seed: int) -> tuple[RadiometricFinding, np.ndarray]:
    """What is found from such a series, and the truth."""
    series, truth = recorded(case, seed)
    assert series.patch is not None
    assert series.dark is not None
    finding = calibrate_radiometric(
        series.responses,
        series.placements,
        series.dark,
        series.patch.n_pixels,
        FULL_SCALE_ADU,
        case.stated_distance_error_m,
    )
    return finding, truth


def intensity_departure(finding: RadiometricFinding, truth: np.ndarray) -> float:
    """Largest departure of an intensity by the found law from the true one over three decades, as a share.

    Of the lamp's light from 0.01 to 10 times that at 1 m, exposures of 1 ms to 3 s, responses of 3 to 90 %.
    """
    log_share, log_exposure = np.meshgrid(np.log10(np.geomspace(0.03, 0.9, 25)), np.log10(np.geomspace(1e-3, 3.0, 60)))
    r_resp, r_expo, r_const, r_curve = truth
    true = (r_resp + r_curve * log_share) * log_share + r_expo * log_exposure + r_const
    found = finding.fit.log_intensity(log_share, log_exposure)
    is_meant = (true > -2.0) & (true < 1.0)
    return float(np.max(np.abs(10.0 ** (found - true)[is_meant] - 1.0)))

"""Responses of facets when the star dims tenfold, through both cameras, the exposure loop and the measurement.

Source: arXiv:1605.06274, section 3: with the paper's cameras a response changes by 17.2 % per decade of light (-6.9 %
per magnitude), because their radiometric calibration is imperfect; with a perfect one it would not change.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.app.build.twin import build_twin
from namod_ctl.app.config.instrument import load_config
from namod_ctl.core.units import arcmin_to_rad
from namod_ctl.cycle.record import Equipment, Recorder, RecordSettings, StopRule
from namod_ctl.reconstruction.normalization import Normalization, measure_at_rest
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.run import RunStore
from namod_ctl.twin.settings import REFLECTOR_CAMERA, ReflectorSettings, SkySettings, TelescopeSettings, TwinSettings

ON_AXIS = TelescopeSettings(radius_rad=1e-9, spacing_rad=1e-3, jitter_rad=0.0)
ALL_LIT = ReflectorSettings(misalignment_rad=arcmin_to_rad(0.7))


def _responses(folder: Path, extinction_mag: float, law_error_per_decade: float) -> np.ndarray:
    """Mean response of every facet to a star that the air dims by so many magnitudes at zenith."""
    camera = replace(REFLECTOR_CAMERA, law_error_per_decade=law_error_per_decade)
    sky = SkySettings(extinction_mag=extinction_mag, scintillation=0.0)
    config = load_config("fact")
    twin = build_twin(config, TwinSettings(ALL_LIT, sky, ON_AXIS, reflector_camera=camera), seed=8)
    with RunStore.create(folder, [facet.id for facet in config.facets], config.to_json(), "", twin.wall_clock) as store:
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        Recorder(equipment, twin.instrument, store, RecordSettings()).record(StopRule(n_records=6))
        return tabulate_responses(store.records(), store.facet_ids).response.mean(axis=0)


def _lamp_series(folder: Path, law_error_per_decade: float) -> Normalization:
    """Stars of 0, 2.3 and 1.2 mag at rest, one after the other, as the check of a run sees them.

    The mirror is stiff: stars at different heights would otherwise show it bent differently.
    """
    camera = replace(REFLECTOR_CAMERA, law_error_per_decade=law_error_per_decade)
    sky = SkySettings(scintillation=0.0, star_changes=((30.0, "Mizar"), (60.0, "Deneb")))
    config = load_config("fact")
    stiff = replace(ALL_LIT, sag_rad=0.0, drift_rad_per_kelvin=0.0)
    twin = build_twin(config, TwinSettings(stiff, sky, ON_AXIS, reflector_camera=camera), seed=8)
    with RunStore.create(folder, [facet.id for facet in config.facets], config.to_json(), "", twin.wall_clock) as store:
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        Recorder(equipment, twin.instrument, store, RecordSettings(pace_s=3.0)).record(StopRule(n_records=27))
        return measure_at_rest(tabulate_responses(store.records(), store.facet_ids, is_at_rest=True))


@pytest.mark.parametrize("per_magnitude", [0.0, -0.069])
def test_the_check_measures_the_slope_to_a_third_of_a_per_cent(tmp_path: Path, per_magnitude: float) -> None:
    """At rest exposures follow the star, so a slope per magnitude is (1 + error per decade) ** -0.4 - 1.

    They follow a new star one record later, which therefore has the old one's error: hence the uncertainty.
    """
    found = _lamp_series(tmp_path / "run", (1.0 + per_magnitude) ** -2.5 - 1.0)
    assert found.is_known
    assert found.per_magnitude == pytest.approx(per_magnitude, abs=0.003)
    assert found.per_magnitude_uncertainty < 0.01


def test_response_of_a_star_ten_times_fainter_is_the_same(tmp_path: Path) -> None:
    bright, faint = (_responses(tmp_path / f"{mag}", mag, 0.0) for mag in (0.0, 2.5))
    lit = bright > 0.3 * bright.max()
    assert np.count_nonzero(lit) > 20
    assert np.abs(faint[lit] / bright[lit] - 1.0).max() < 0.02


def test_the_paper_s_calibration_shows_the_paper_s_slope(tmp_path: Path) -> None:
    bright, faint = (_responses(tmp_path / f"{mag}", mag, 0.172) for mag in (0.0, 2.5))
    lit = bright > 0.3 * bright.max()
    assert np.median(faint[lit] / bright[lit]) in (pytest.approx(1.172, abs=0.03), pytest.approx(1 / 1.172, abs=0.03))

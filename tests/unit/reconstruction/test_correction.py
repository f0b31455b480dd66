"""Corrections: signs, refusals and remarks, with turns worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from namod_ctl.core.errors import ConfigError, DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Facet, FacetShape, Reflector
from namod_ctl.reconstruction.correction import common_centre, correct

AZIMUTH = np.radians([0.0, 120.0, 240.0])
TRIPOD = Mount(0.295 * np.column_stack([np.cos(AZIMUTH), np.sin(AZIMUTH)]), False, 0.002, pitch_m_per_turn=0.001)
ACTUATORS = Mount(np.array([[0.3, 0.0], [0.0, 0.3]]), True, 0.002)
CAMERA = CameraModel(
    "camera", 640, 480, 4e-5, np.array([319.5, 239.5]), True, CameraOrientation(), RadiometricLaw(1.0, -1.0, 0.0)
)
INSTRUMENT = Instrument(
    "test bench",
    Reflector(5.0, tuple(Facet(i, np.zeros(3), 5.0, FacetShape.HEXAGON, 0.6) for i in (7, 3))),
    {7: TRIPOD, 3: ACTUATORS},
    CAMERA,
    CAMERA,
    {},
    np.radians(5.0),
    np.radians(0.025),
)
CENTRE = np.zeros(2)


def test_the_correction_is_minus_half_of_theta() -> None:
    """Theta = (2, 0) mrad: Phi = (-1, 0) mrad, the leg at +x rises by 0.295 mm = 106.2 deg of a 1 mm bolt."""
    (facet,) = correct(INSTRUMENT, [7], np.array([[0.002, 0.0]]), [FacetFlag.NONE], CENTRE)
    np.testing.assert_allclose(facet.tilt_correction_rad, [-0.001, 0.0])
    np.testing.assert_allclose(facet.leg_travel_m, [0.295e-3, -0.1475e-3, -0.1475e-3], atol=1e-12)
    np.testing.assert_allclose(facet.bolt_turn_deg, [106.2, -53.1, -53.1])
    assert facet.flags == FacetFlag.NONE
    assert facet.remarks == ()


def test_the_aim_is_taken_off_first_and_facets_keep_their_order() -> None:
    theta = np.array([[0.003, 0.001], [0.001, 0.001]])
    first, second = correct(INSTRUMENT, [3, 7], theta, [FacetFlag.NONE] * 2, np.array([0.001, 0.001]))
    np.testing.assert_allclose(first.tilt_correction_rad, [-0.001, 0.0], atol=1e-15)
    np.testing.assert_allclose(first.leg_travel_m, [0.0003, 0.0], atol=1e-12)
    assert first.bolt_turn_deg.shape == (0,)
    np.testing.assert_allclose(second.bolt_turn_deg, 0.0, atol=1e-12)


@pytest.mark.parametrize("flag", [FacetFlag.NO_SIGNAL, FacetFlag.UNRELIABLE])
def test_nobody_turns_on_a_bad_estimate(flag: FacetFlag) -> None:
    theta = np.full((1, 2), np.nan if flag is FacetFlag.NO_SIGNAL else 0.002)
    (facet,) = correct(INSTRUMENT, [7], theta, [flag | FacetFlag.FEW_RECORDS], CENTRE)
    assert np.isnan(facet.bolt_turn_deg).all()
    assert facet.bolt_turn_deg.shape == facet.leg_travel_m.shape == (3,)
    assert np.isnan(facet.leg_travel_m).all()
    assert np.isnan(facet.tilt_correction_rad).all() == (flag is FacetFlag.NO_SIGNAL)
    assert facet.flags == flag | FacetFlag.FEW_RECORDS
    assert len(facet.remarks) == 1
    assert facet.remarks[0].startswith("facet 7: do not turn: ")


def test_an_estimate_of_nan_says_why_it_has_no_turns() -> None:
    (facet,) = correct(INSTRUMENT, [7], np.array([[np.nan, 0.0]]), [FacetFlag.NONE], CENTRE)
    assert FacetFlag.NO_SIGNAL in facet.flags
    assert np.isnan(facet.tilt_correction_rad).all()
    assert np.isnan(facet.bolt_turn_deg).all()


def test_beyond_the_limit_is_refused_with_leg_travel_and_limit() -> None:
    (facet,) = correct(INSTRUMENT, [7], np.array([[0.02, 0.0]]), [FacetFlag.NONE], CENTRE)
    assert FacetFlag.BEYOND_TRAVEL_LIMIT in facet.flags
    assert np.isnan(facet.leg_travel_m).all()
    assert np.isnan(facet.bolt_turn_deg).all()
    np.testing.assert_allclose(facet.tilt_correction_rad, [-0.01, 0.0])
    assert facet.remarks == ("facet 7: do not turn: leg 1 would travel +2.950 mm, beyond its limit of 2.000 mm",)


@pytest.mark.parametrize(("turn_deg", "is_needed"), [(2.4, False), (2.6, True)])
def test_turns_within_half_the_goniometers_resolution_are_not_needed(turn_deg: float, is_needed: bool) -> None:
    theta_x = 2.0 * turn_deg / 360.0 * 0.001 / 0.295
    (facet,) = correct(INSTRUMENT, [7], np.array([[theta_x, 0.0]]), [FacetFlag.NONE], CENTRE)
    assert any("no turn needed" in remark for remark in facet.remarks) == (not is_needed)
    assert np.max(np.abs(facet.bolt_turn_deg)) == pytest.approx(turn_deg)


def test_an_unknown_facet_is_named() -> None:
    with pytest.raises(ConfigError, match=r"test bench: no mount for facet ids \[9\]; known are \[3, 7\]"):
        correct(INSTRUMENT, [7, 9], np.zeros((2, 2)), [FacetFlag.NONE] * 2, CENTRE)


def test_the_common_centre_is_weighted_by_light_and_deaf_to_nan() -> None:
    theta = np.array([[1.0, 0.0], [4.0, 3.0], [np.nan, 1.0], [100.0, 100.0], [50.0, 50.0]])
    np.testing.assert_allclose(common_centre(theta, np.array([2.0, 1.0, 5.0, np.nan, -3.0])), [2.0, 1.0])


def test_no_common_centre_without_any_estimate() -> None:
    with pytest.raises(DataQualityError, match="no facet has both"):
        common_centre(np.full((3, 2), np.nan), np.ones(3))


def test_the_common_centre_moves_bolts_least() -> None:
    """Among aims, equal fluxes: the sum of squared travels over all facets is least at the common centre."""
    theta = np.array([[0.001, 0.002], [0.003, -0.001], [-0.002, 0.0005]])
    centre = common_centre(theta, np.ones(3))

    def total(aim: np.ndarray) -> float:
        moved = correct(INSTRUMENT, [7, 7, 7], theta, [FacetFlag.NONE] * 3, aim)
        return sum(float(np.sum(facet.leg_travel_m**2)) for facet in moved)

    for step in ((1e-4, 0.0), (-1e-4, 0.0), (0.0, 1e-4), (0.0, -1e-4)):
        assert total(centre + step) > total(centre)

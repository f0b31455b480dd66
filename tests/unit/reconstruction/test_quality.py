"""Flags of facets with a known defect, all in one made run; the healthy rest must not be touched."""

from __future__ import annotations

import numpy as np
import pytest
from response_maker import ARCMIN, DEG, instrument, make_run

from namod_ctl.core.errors import DataQualityError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.reconstruction.quality import ScanRegion
from namod_ctl.reconstruction.reconstruct import reconstruct

DISH = instrument()
OUTSIDE, AT_THE_EDGE, FAR_OUT, DEAD, DARK, ONE_FLASH, NOT_MEASURED = range(7)
N_FACETS = 16


@pytest.fixture(scope="module")
def made():
    """600 records over 0.35 deg radius; seven facets with a defect each, nine healthy ones."""
    rng = np.random.default_rng(20)
    centres = rng.normal(0, 4 * ARCMIN, (N_FACETS, 2))
    centres[OUTSIDE] = [0.365 * DEG, 0.0]
    centres[AT_THE_EDGE] = [0.0, 0.335 * DEG]
    centres[FAR_OUT] = [-0.8 * DEG, 0.0]
    run = make_run(2, 600, centres_rad=centres)
    response = run.table.response.copy()
    response[:, DEAD] = 0.0
    response[:, DARK] = np.abs(rng.normal(3e-4, 1e-4, 600))
    response[:, ONE_FLASH] = np.abs(rng.normal(3e-4, 1e-4, 600))
    response[17, ONE_FLASH] = 0.5
    response[:, NOT_MEASURED] = np.nan
    return run.with_response(response)


@pytest.fixture(scope="module")
def facets(made):
    return reconstruct(made.table, DISH).alignment.facets


def error_arcmin(made, facet):
    return np.linalg.norm(facet.theta_rad - made.centre_rad[facet.facet_id - 1]) / ARCMIN


@pytest.mark.parametrize("which", [FAR_OUT, DEAD, DARK, NOT_MEASURED])
def test_no_signal_gives_nothing(facets, which):
    """Never left out, never guessed."""
    facet = facets[which]
    assert FacetFlag.NO_SIGNAL in facet.flags
    assert facet.flags.forbids_turning
    for number in (facet.theta_rad, facet.theta_cov_rad2, facet.tilt_correction_rad, facet.bolt_turn_deg):
        assert np.isnan(number).all()
    assert np.isnan([facet.width_major_rad, facet.flux]).all()
    assert facet.remarks


def test_one_flash_is_not_trusted(facets):
    facet = facets[ONE_FLASH]
    assert facet.flags & (FacetFlag.FEW_RECORDS | FacetFlag.NO_SIGNAL)
    assert facet.flags.forbids_turning
    assert np.isnan(facet.bolt_turn_deg).all()


def test_a_centre_outside_the_scan_is_given_but_not_to_be_turned(made, facets):
    facet = facets[OUTSIDE]
    assert {"PSF_OUTSIDE_SCAN", "UNRELIABLE"} <= set(facet.flags.names)
    assert error_arcmin(made, facet) < 2.0  # a width; its sunny side is all that was seen
    assert np.isnan(facet.bolt_turn_deg).all()
    assert any("outside" in remark for remark in facet.remarks)


def test_a_psf_cut_by_the_edge_says_so_and_is_usable(made, facets):
    facet = facets[AT_THE_EDGE]
    assert facet.flags == FacetFlag.PSF_CUT_BY_SCAN_EDGE
    assert error_arcmin(made, facet) < 1.0
    assert np.isfinite(facet.bolt_turn_deg).all()


def test_healthy_facets_carry_no_flag(made, facets):
    for facet in facets[NOT_MEASURED + 1 :]:
        assert facet.flags == FacetFlag.NONE, facet.remarks
        assert error_arcmin(made, facet) < 0.5


def test_few_records():
    """A facet measured in one lit record only has a direction, not a centre."""
    run = make_run(4, 300, n_facets=6)
    response = run.table.response.copy()
    lit = np.argsort(-run.light[:, 0])
    response[lit[1:][run.light[lit[1:], 0] > 0.0], 0] = np.nan
    facet = reconstruct(run.with_response(response).table, DISH).alignment.facets[0]
    assert facet.flags & (FacetFlag.FEW_RECORDS | FacetFlag.NO_SIGNAL)
    assert facet.flags.forbids_turning


def test_scan_region():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    asked = np.array([[0.2, 0.7], [1.2, 0.5], [-0.1, -0.1]])
    assert ScanRegion(square).contains(asked).tolist() == [True, False, False]


@pytest.mark.parametrize("theta", [np.zeros((5, 2)), np.outer(np.arange(5.0), [1.0, 2.0]), np.zeros((1, 2))])
def test_directions_without_an_area_are_refused(theta):
    with pytest.raises(DataQualityError, match="wander"):
        ScanRegion(theta)

"""Gravity on the twin's dish: the bending of the dish, and the side from which the telescope came."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from twins import small_config, small_twin

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import PERFECT, ReflectorSettings, TelescopeSettings
from namod_ctl.twin.surface_map import outline_m

INSTRUMENT = build_instrument(small_config())


def reflector(settings: ReflectorSettings, came_from_rad: float = 0.0) -> TwinReflector:
    outlines = [outline_m(facet) for facet in INSTRUMENT.reflector.facets]
    return TwinReflector(INSTRUMENT.reflector, INSTRUMENT.mounts, outlines, settings, 3, came_from_rad)


def test_a_dish_that_bends_turns_its_facets_outwards_as_the_weight_along_the_axis_goes() -> None:
    made = reflector(replace(PERFECT, bending_rad=1e-3))
    assert not made.sag_rad(0.0).any()
    at_horizon = made.sag_rad(math.pi / 2.0)
    np.testing.assert_allclose(made.sag_rad(math.pi / 3.0), 0.5 * at_horizon, atol=1e-18)
    across = INSTRUMENT.reflector.positions_m[:, :2]
    outwards = np.sum(at_horizon * across, axis=1) / np.linalg.norm(across, axis=1)
    rim = np.argmax(np.linalg.norm(across, axis=1))
    assert outwards.mean() > 0.0
    assert outwards[rim] == pytest.approx(1e-3, rel=0.6)  # a fifth of it is the facet's own, per axis


def test_where_the_telescope_came_from_decides_the_side_of_the_play() -> None:
    settings = replace(PERFECT, sag_rad=1e-3, sag_hysteresis_rad=deg_to_rad(2.0))
    for came_from_deg, felt_deg in ((0.0, 38.0), (90.0, 42.0), (39.0, 39.0)):
        made = reflector(settings, deg_to_rad(came_from_deg))
        made.update(100.0, lambda _: deg_to_rad(40.0))
        np.testing.assert_allclose(made.moved_rad(100.0), made.sag_rad(deg_to_rad(felt_deg)), rtol=1e-12)


def test_the_correction_at_a_zenith_distance_aligns_the_twin_there() -> None:
    """Against ray tracing: A_sigma is at its limit there, and not elsewhere."""
    settings = ReflectorSettings(sag_rad=arcmin_to_rad(8.0), drift_rad_per_kelvin=0.0)
    twin = small_twin(reflector=settings, telescope=TelescopeSettings())
    made = twin.reflector
    for _ in range(2):
        made.apply_correction(made.correction_at_rad(deg_to_rad(50.0)))
    limit = made.a_sigma_aligned_rad2()
    assert made.a_sigma_at_rad2(deg_to_rad(50.0)) == pytest.approx(limit, rel=1e-3)
    assert made.a_sigma_at_rad2(deg_to_rad(5.0)) > 1.2 * limit

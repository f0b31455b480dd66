"""The true reflector: sag, drift, corrections, and its truth against the response that rays really give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from twins import aligned_twin, small_config, small_twin

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.core.units import arcmin_to_rad, deg_to_rad, rad_to_arcmin
from namod_ctl.optics.raytrace import a_sigma_rad2, combine_moments, facet_moments, tilted_normals, trace
from namod_ctl.optics.reflector import Reflector
from namod_ctl.twin.reflector import TwinReflector
from namod_ctl.twin.settings import PERFECT, ReflectorSettings
from namod_ctl.twin.surface_map import outline_m

INSTRUMENT = build_instrument(small_config())
STIFF = replace(ReflectorSettings(), sag_rad=0.0, drift_rad_per_kelvin=0.0)


def reflector(settings: ReflectorSettings = STIFF, seed: int = 1) -> TwinReflector:
    outlines = [outline_m(facet) for facet in INSTRUMENT.reflector.facets]
    made = TwinReflector(INSTRUMENT.reflector, INSTRUMENT.mounts, outlines, settings, seed)
    if settings.sag_rad == 0.0:
        made.update(0.0, lambda _: 0.0)
    return made


def test_without_figure_errors_rays_arrive_where_the_plain_tracer_says() -> None:
    made = reflector(replace(PERFECT, misalignment_rad=arcmin_to_rad(4.0)))
    theta = np.array([2e-3, -1e-3])
    plain = trace(INSTRUMENT.reflector, 1500, theta, made.true_tilt_rad)
    normals = tilted_normals(INSTRUMENT.reflector, made.true_tilt_rad)
    hits = np.array([s.hits(s.samples_m, n, theta) for s, n in zip(made.surfaces, normals, strict=True)])
    np.testing.assert_allclose(hits, plain.hit_m, atol=1e-12)


def test_perfect_facets_have_the_area_of_the_plain_tracer() -> None:
    expected = a_sigma_rad2(
        combine_moments(facet_moments(trace(INSTRUMENT.reflector, 1500))).cov_m2, INSTRUMENT.reflector.focal_length_m
    )
    perfect = reflector(PERFECT)
    # The twin takes a facet's rays as equally strong, the tracer each with its own cosine.
    assert perfect.a_sigma_now_rad2() == pytest.approx(expected, rel=3e-3)
    # Aiming each facet's centroid instead of its centre at the focal point takes the coma of the outer ones away.
    assert 0.85 * expected < perfect.a_sigma_aligned_rad2() < expected


def test_roughness_widens_the_light_by_twice_its_slopes() -> None:
    rough = replace(PERFECT, roughness_rad=1e-3)
    smooth, area = reflector(PERFECT).a_sigma_now_rad2(), reflector(rough).a_sigma_now_rad2()
    # Variances of both add up: nearly round light, so the areas do.
    assert area - smooth == pytest.approx(np.pi * (2e-3) ** 2, rel=0.01)


def test_true_theta_is_the_centre_of_gravity_of_the_response_over_star_directions() -> None:
    """Found the hard way: a star is put on a grid of directions, and rays that reach a small lens are counted."""
    made = reflector()
    surface, theta = made.surfaces[3], made.true_theta_rad[3]
    normal = tilted_normals(INSTRUMENT.reflector, made.true_tilt_rad)[3]
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-2.5e-3, 2.5e-3, 41)], indexing="ij"), axis=-1).reshape(-1, 2)
    samples = surface.samples_m
    lens_m = 2.5e-4
    response = np.array(
        [np.mean(np.linalg.norm(surface.hits(samples, normal, theta + step), axis=1) < lens_m) for step in grid]
    )
    assert response.reshape(41, 41)[[0, -1]].sum() == 0.0  # the grid holds all of it
    centre = response @ grid / response.sum()
    np.testing.assert_allclose(rad_to_arcmin(centre), 0.0, atol=0.02)


def test_facets_differ_and_scatter_as_asked() -> None:
    parts = np.concatenate([reflector(seed=seed).true_tilt_rad for seed in range(10)])
    np.testing.assert_allclose(rad_to_arcmin(2.0 * parts.std(axis=0)), 4.0, rtol=0.15)
    made = reflector()
    assert len({s.facet.focal_length_m for s in made.surfaces}) == len(made.surfaces)
    assert np.std([s.figure_rad for s in made.surfaces]) == pytest.approx(STIFF.figure_blur_rad / 2.0, rel=0.2)


def test_a_correction_of_minus_half_theta_aligns() -> None:
    made = reflector()
    before = made.a_sigma_now_rad2()
    made.apply_correction(-made.true_theta_rad / 2.0)
    assert np.abs(rad_to_arcmin(made.true_theta_rad)).max() < 0.3  # obliquity of the facets remains: a few percent
    made.apply_correction(-made.true_theta_rad / 2.0)
    assert np.abs(rad_to_arcmin(made.true_theta_rad)).max() < 0.03
    assert made.a_sigma_now_rad2() == pytest.approx(made.a_sigma_aligned_rad2(), rel=1e-3)
    assert before > 3.0 * made.a_sigma_now_rad2()


def test_a_facet_without_a_correction_stays() -> None:
    made = reflector()
    before = made.true_theta_rad
    correction = np.full_like(before, np.nan)
    correction[0] = 1e-3
    made.apply_correction(correction)
    np.testing.assert_array_equal(made.true_theta_rad[1:], before[1:])
    np.testing.assert_allclose(made.true_theta_rad[0] - before[0], 2e-3, rtol=0.05)


def test_legs_tilt_their_facet_only() -> None:
    made = reflector(PERFECT)
    facet_id = made.ids[5]
    travel = INSTRUMENT.mounts[facet_id].travel_of_tilt(np.array([5e-4, -2e-4]))
    made.move_legs(facet_id, travel)
    np.testing.assert_allclose(made.true_tilt_rad[5], [5e-4, -2e-4], atol=1e-12)
    assert not np.delete(made.true_tilt_rad, 5, axis=0).any()


def test_sag_is_one_sided_grows_with_zenith_distance_and_lags_when_it_turns_back() -> None:
    made = reflector(replace(PERFECT, sag_rad=1e-4, sag_hysteresis_rad=deg_to_rad(2.0)))
    zenith_rad = deg_to_rad(np.array([10.0, 40.0, 39.0, 30.0, 10.0]))
    made.update(4.0, lambda time_s: float(zenith_rad[int(time_s)]))
    sags = [made.moved_rad(float(number))[:, 1] for number in range(5)]
    assert (sags[1] < 0.0).all()
    assert (sags[1] < sags[0]).all()
    np.testing.assert_array_equal(sags[2], sags[1])  # 1 deg back: within the hysteresis
    assert (sags[3] > sags[2]).all()
    assert (sags[4] < sags[0]).all()  # the same zenith distance from the other side: more sag


def test_cooling_moves_facets_slowly() -> None:
    moved = []
    for seed in range(6):
        made = reflector(replace(PERFECT, drift_rad_per_kelvin=1e-5, cooling_kelvin_per_hour=2.0), seed)
        made.update(3600.0, lambda _: 0.0)
        moved.append(made.moved_rad(3600.0))
    assert np.std(moved) == pytest.approx(2e-5, rel=0.15)


def test_an_unknown_facet_has_no_legs() -> None:
    with pytest.raises((KeyError, ValueError)):
        reflector(PERFECT).move_legs(99, np.zeros(3))


def test_after_a_correction_the_camera_sees_other_facets() -> None:
    twin = small_twin(reflector=STIFF)
    twin.apply_correction(-twin.true_theta_rad / 2.0)
    twin.reflector_camera.start(0.05)
    aligned = twin.reflector_camera.fetch(1.0).image
    again = small_twin(reflector=STIFF)
    again.reflector_camera.start(0.05)
    assert aligned.mean() > 1.5 * again.reflector_camera.fetch(1.0).image.mean()


def test_the_reflector_may_have_a_single_facet() -> None:
    one = Reflector(INSTRUMENT.reflector.focal_length_m, INSTRUMENT.reflector.facets[:1])
    made = TwinReflector(one, INSTRUMENT.mounts, [outline_m(one.facets[0])], STIFF, 1)
    made.update(0.0, lambda _: 0.0)
    assert made.true_theta_rad.shape == (1, 2)
    assert aligned_twin().reflector.a_sigma_now_rad2() > 0.0

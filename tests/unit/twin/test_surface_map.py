"""Which pixel sees which point of a facet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.build.twin import project_polygons, with_facet_map
from namod_ctl.app.config.instrument import load_config
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.polygons import polygon_fault
from namod_ctl.twin.facet_surface import N_RAYS, seen_samples
from namod_ctl.twin.surface_map import map_facets

PRESETS = ("fact", "mini_fact", "mst_like", "lst_like")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_facet_of_every_preset_has_sound_pixels(preset: str) -> None:
    instrument = with_facet_map(build_instrument(load_config(preset)))
    camera = instrument.reflector_camera
    for polygon in instrument.facet_polygons_px.values():
        assert polygon_fault(polygon, camera.n_columns, camera.n_rows) is None
    pixels = map_facets(instrument.reflector, camera, instrument.facet_polygons_px)
    all_pixels = np.concatenate([p.index for p in pixels])
    assert len(np.unique(all_pixels)) > 0.998 * len(all_pixels)  # outlines drawn by hand touch
    for facet, seen in zip(instrument.reflector.facets, pixels, strict=True):
        assert len(seen.index) > 500
        if len(instrument.facet_polygons_px[facet.id]) != 6:
            continue  # FACT's facet 13, half behind a mast
        radius_m = np.linalg.norm(seen.across_m, axis=1)
        assert radius_m.max() == pytest.approx(facet.width_m / np.sqrt(3.0), rel=0.06)
        # Evenly spread over the facet: a hexagon's mean square radius is 5/36 of its width^2.
        assert np.mean(radius_m**2) == pytest.approx(5.0 / 36.0 * facet.width_m**2, rel=0.02)
        np.testing.assert_allclose(seen.across_m.mean(axis=0), 0.0, atol=0.01 * facet.width_m)


def test_the_camera_at_the_focus_sees_the_dish_as_its_orientation_says() -> None:
    instrument = build_instrument(load_config("mini_fact"))
    upright = project_polygons(instrument.reflector, instrument.reflector_camera)
    mirrored_camera = replace(instrument.reflector_camera, orientation=CameraOrientation(is_mirrored=True))
    mirrored = project_polygons(instrument.reflector, mirrored_camera)
    for facet in instrument.reflector.facets:
        x, y = upright[facet.id].mean(axis=0) - instrument.reflector_camera.axis_pixel
        assert np.sign(np.round(x, 6)) == np.sign(np.round(facet.position_m[0], 9))
        assert np.sign(np.round(-y, 6)) == np.sign(np.round(facet.position_m[1], 9))
        np.testing.assert_allclose(
            mirrored[facet.id].mean(axis=0) - instrument.reflector_camera.axis_pixel, [-x, y], atol=1e-6
        )


def test_points_in_the_facets_frame_lie_where_the_image_shows_them() -> None:
    """+x of the telescope is to the right, +y up: so are the points of a facet at the vertex."""
    instrument = with_facet_map(build_instrument(load_config("mini_fact")))
    camera = instrument.reflector_camera
    for seen in map_facets(instrument.reflector, camera, instrument.facet_polygons_px):
        column, row = seen.index % camera.n_columns, seen.index // camera.n_columns
        assert np.corrcoef(column, seen.across_m[:, 0])[0, 1] > 0.99
        assert np.corrcoef(-row, seen.across_m[:, 1])[0, 1] > 0.99


def test_what_a_mast_hides_of_a_facet_throws_no_light() -> None:
    """FACT's facet 13: its top corner is hidden, so the light it has left comes from further down."""
    instrument = build_instrument(load_config("fact"))
    pixels = map_facets(instrument.reflector, instrument.reflector_camera, instrument.facet_polygons_px)
    counts = {}
    for facet, seen in zip(instrument.reflector.facets, pixels, strict=True):
        samples = seen_samples(facet, seen.outline_m)
        counts[facet.id] = len(samples)
        if facet.id == 13:
            np.testing.assert_allclose(samples.mean(axis=0), seen.across_m.mean(axis=0), atol=3e-3)
            assert samples[:, 1].mean() < -5e-3
    assert counts.pop(13) < 0.985 * N_RAYS
    assert set(counts.values()) == {N_RAYS}


def test_a_facet_without_a_polygon_has_no_pixels() -> None:
    instrument = with_facet_map(build_instrument(load_config("mini_fact")))
    polygons = dict(instrument.facet_polygons_px)
    hidden = instrument.reflector.ids[2]
    del polygons[hidden]
    pixels = map_facets(instrument.reflector, instrument.reflector_camera, polygons)
    assert [len(p.index) == 0 for p in pixels].index(True) == 2
    assert sum(len(p.index) == 0 for p in pixels) == 1

"""instructions.png: text where it belongs, nothing over anything else, in the geometry of the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from output_samples import (
    FACT_DATA,
    alignment_of,
    facet_alignment,
    hexagon_px,
    honeycomb,
    instrument_of,
    published_fact,
    random_alignment,
    tripod,
)

from namod_ctl.app.sheets.facet_map import locate_facets, polygon_area, polygon_centre, polygons_of_facet_list
from namod_ctl.app.sheets.instructions import facet_instructions
from namod_ctl.app.sheets.overlay import draw_instructions, scale_polygons
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.coordinates import CameraOrientation

TEN_DEG = deg_to_rad(10.0)


def texts_of(figure):
    """Texts with their boxes (left, bottom, right, top), pixel."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    return [
        (text.get_text(), text.get_window_extent(renderer).extents, text)
        for text in [*figure.axes[0].texts, *figure.texts]
    ]


def overlaps(texts):
    boxes = np.array([box for _, box, _ in texts])
    # boxes of fonts hold room for descenders, which digits do not have
    shrink = 0.15 * (boxes[:, 3] - boxes[:, 1])
    boxes = boxes + np.column_stack([0 * shrink, shrink, 0 * shrink, -shrink])
    left, bottom, right, top = boxes.T
    hit = (left[:, None] < right) & (left < right[:, None]) & (bottom[:, None] < top) & (bottom < top[:, None])
    return [(texts[i][0], texts[j][0]) for i, j in zip(*np.nonzero(np.triu(hit, 1)), strict=True)]


needs_fact = pytest.mark.skipif(not FACT_DATA.is_dir(), reason="the FACT records of 2014 are not beside the project")


@needs_fact
def test_the_published_geometry_with_large_turns_stays_legible():
    instrument = published_fact()
    rng = np.random.default_rng(5)
    facets = [facet_alignment(i, rng.normal(0, 0.15, 2)) for i in instrument.reflector.ids]
    facets[3] = facet_alignment(facets[3].facet_id, flags=FacetFlag.UNRELIABLE)
    facets[4] = facet_alignment(facets[4].facet_id, (0.0, 0.0))
    instructions = facet_instructions(alignment_of(facets), TEN_DEG)
    image = np.zeros((911, 1215, 3), np.uint8)
    figure = draw_instructions(instrument, instructions, image, "headline")
    texts = texts_of(figure)
    assert overlaps(texts) == []
    words = [text for text, _, _ in texts]
    for instruction in instructions:
        assert str(instruction.facet_id) in words
    assert words.count("DO NOT") == words.count("ok") == 1
    n_turned = len(facets) - 2
    assert sum(word.endswith("°") for word in words) + words.count("leave") == 3 * n_turned
    assert {int(word[1:-1]) % 10 for word in words if word.endswith("°")} == {0}  # as the goniometer can be set
    assert min(text.get_fontsize() for word, _, text in texts if word.endswith("°")) > 18  # pixels


@needs_fact
def test_every_turn_lies_in_its_facet_beside_its_own_arm():
    instrument = published_fact()
    rng = np.random.default_rng(6)
    facets = [facet_alignment(i, rng.normal(0, 0.1, 2)) for i in instrument.reflector.ids]
    instructions = facet_instructions(alignment_of(facets), deg_to_rad(1.0))
    figure = draw_instructions(instrument, instructions, np.zeros((911, 1215, 3), np.uint8), "headline")
    zoom = 2
    texts = [(text.get_text(), np.array(text.get_position())) for text in figure.axes[0].texts]
    for located, instruction in zip(locate_facets(instrument, instrument.facet_polygons_px), instructions, strict=True):
        in_facet = [
            (word, at / zoom - located.centre_px)
            for word, at in texts
            if np.linalg.norm(at / zoom - located.centre_px) < 0.5 * located.width_px and word.endswith("°")
        ]
        assert sorted(word for word, _ in in_facet) == sorted(
            f"{turn_deg:+g}°".replace("-", "−") for turn_deg in instruction.settable_deg
        )
        for bolt, turn_deg in enumerate(instruction.settable_deg):
            if list(instruction.settable_deg).count(turn_deg) > 1:
                continue
            at = next(at for word, at in in_facet if word == f"{turn_deg:+g}°".replace("-", "−"))
            ahead_deg = np.rad2deg(np.arctan2(-at[1], at[0])) - 120.0 * bolt  # counter-clockwise of its arm
            assert 0.0 < (ahead_deg + 180.0) % 360.0 - 180.0 < 65.0  # half-way to the next arm is 60


def test_legs_follow_the_orientation_of_the_camera():
    reflector = honeycomb(1, 1.0, 28.0)
    hexagon = hexagon_px((400.0, 300.0), 200.0)
    for orientation, first_leg in [
        (CameraOrientation(), (1, 0)),
        (CameraOrientation(is_mirrored=True), (-1, 0)),
        (CameraOrientation(rotation_rad=np.pi / 2), (0, 1)),  # telescope +x lies along the image's rows
    ]:
        instrument = instrument_of(reflector, {1: hexagon}, mount=tripod(radius_m=0.4), orientation=orientation)
        (located,) = locate_facets(instrument, instrument.facet_polygons_px)
        np.testing.assert_allclose(located.centre_px, (400, 300), atol=1e-9)
        # a facet of 1 m is 200 pixels wide, so the leg at 0.4 m is 80 pixels from the centre
        np.testing.assert_allclose(located.legs_px[0] - located.centre_px, 80 * np.array(first_leg), atol=1e-6)


def test_polygons_of_another_size_of_the_same_picture():
    old = {1: np.array([[-0.5, -0.5], [1023.5, -0.5], [1023.5, 767.5]])}
    new = scale_polygons(old, (1024, 768), (1215, 911))
    np.testing.assert_allclose(new[1], [[-0.5, -0.5], [1214.5, -0.5], [1214.5, 910.5]])
    with pytest.raises(ConfigError, match=r"1280 x 720 .* 1024 x 768"):
        scale_polygons(old, (1024, 768), (1280, 720))


def test_image_needs_a_map_of_the_facets():
    instrument = instrument_of(honeycomb(7, 1.0, 28.0), {})
    with pytest.raises(ConfigError, match="polygons"):
        draw_instructions(instrument, (), np.zeros((768, 1024, 3), np.uint8), "headline")


def test_facets_drawn_from_the_list_keep_their_places():
    reflector = honeycomb(29, 0.6, 4.9)
    polygons = polygons_of_facet_list(instrument_of(reflector, {}), 1024, 768)
    corners = np.concatenate(list(polygons.values()))
    assert corners.min() > 0
    assert corners[:, 0].max() < 1024
    assert corners[:, 1].max() < 768
    by_height = sorted(reflector.facets, key=lambda facet: facet.position_m[1])
    centres = {i: polygon_centre(outline) for i, outline in polygons.items()}
    assert centres[by_height[-1].id][1] < centres[by_height[0].id][1]  # up in the telescope is up in the image
    rightmost = max(reflector.facets, key=lambda facet: facet.position_m[0])
    assert centres[rightmost.id][0] == max(centre[0] for centre in centres.values())


def test_area_and_centre_of_a_polygon():
    triangle = np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 5.0]])
    assert polygon_area(triangle) == pytest.approx(6.0)
    np.testing.assert_allclose(polygon_centre(triangle), [2.0, 7.0 / 3.0])
    np.testing.assert_allclose(polygon_centre(triangle[::-1]), [2.0, 7.0 / 3.0])


@pytest.mark.parametrize(("n_facets", "has_turns"), [(198, True), (1000, False)])
def test_large_telescopes_stay_sane(n_facets, has_turns):
    reflector = honeycomb(n_facets, 1.51, 28.0)
    instrument = instrument_of(reflector, {}, mount=tripod(radius_m=0.5))
    instructions = facet_instructions(random_alignment(reflector), TEN_DEG)
    figure = draw_instructions(instrument, instructions, None, "headline")
    assert max(figure.get_size_inches()) * figure.dpi <= 4700
    words = [text.get_text() for text in figure.axes[0].texts]
    assert any(word.endswith("°") for word in words) == has_turns
    assert any("too small" in text.get_text() for text in figure.texts) != has_turns
    if has_turns:
        assert overlaps(texts_of(figure)) == []


@pytest.mark.parametrize("side", ["front", "back"])
def test_the_picture_says_from_which_side_bolts_are_turned(side):
    reflector = honeycomb(7, 1.0, 28.0)
    instrument = replace(instrument_of(reflector, {}, mount=tripod(radius_m=0.4)), bolts_seen_from=side)
    instructions = facet_instructions(random_alignment(reflector), TEN_DEG)
    legend = [text.get_text() for text in draw_instructions(instrument, instructions, None, "headline").figure.texts]
    (line,) = [text for text in legend if "Bolts are turned from" in text]
    assert ("BEHIND" in line) == ("exchanged" in line) == (side == "back")
    assert "clockwise as you see the bolt" in line


def test_a_telescope_without_bolts_says_so():
    reflector = honeycomb(7, 1.0, 28.0)
    driven = tripod(pitch_m=None)
    instrument = instrument_of(reflector, {}, mount=driven)
    alignment = alignment_of([facet_alignment(i, mount=driven) for i in reflector.ids])
    figure = draw_instructions(instrument, facet_instructions(alignment, TEN_DEG), None, "headline")
    assert any("has no bolts" in text.get_text() for text in figure.texts)

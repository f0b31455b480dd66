"""The reflector camera's pose from marked facets, against pinholes that are written out in the tests themselves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "imaging"))

from reflector_pictures import TrueCamera, instrument_of, true_outlines, true_pixels

from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.camera_pose import outlines_in_image, project_facets
from namod_ctl.optics.facet_marks import MarksError, pose_of_marks, turn_note
from namod_ctl.optics.instrument import Instrument

FOCAL_PX = {"fact": 860.0, "lst_like": 800.0, "thousand": 840.0}


@pytest.fixture(scope="module")
def instruments(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Instrument]:
    return {name: instrument_of(name, tmp_path_factory.mktemp("config")) for name in FOCAL_PX}


@pytest.fixture
def fact(instruments: dict[str, Instrument]) -> Instrument:
    return instruments["fact"]


def rim_facets(instrument: Instrument, n: int = 4) -> list[int]:
    """The facets that reach furthest to n sides: what a person would mark."""
    across = instrument.reflector.positions_m[:, :2]
    angles = np.deg2rad(80.0) + np.arange(n) * 2.0 * np.pi / n
    return [instrument.reflector.ids[int(np.argmax(across @ [np.cos(a), np.sin(a)]))] for a in angles]


def some_camera(instrument: Instrument, focal_px: float, rng: np.random.Generator, is_mirrored: bool = False):
    away = 0.015 * instrument.reflector.focal_length_m * rng.normal(size=3)
    turned = (*rng.normal(0.0, 0.02, 2), rng.normal(0.0, 0.3))
    return TrueCamera(tuple(away), turned, focal_px, is_mirrored)


def centres(instrument: Instrument, camera: TrueCamera) -> dict[int, np.ndarray]:
    places = true_pixels(instrument.reflector.positions_m, instrument, camera)
    return {i: place[None] for i, place in zip(instrument.reflector.ids, places, strict=True)}


def worst_vertex_px(instrument: Instrument, pose, truth: dict[int, np.ndarray]) -> float:
    found = project_facets(pose, instrument.reflector)
    return max(float(np.linalg.norm(found[i] - truth[i], axis=1).max()) for i in truth)


@pytest.mark.parametrize("is_mirrored", [False, True])
@pytest.mark.parametrize("name", FOCAL_PX)
def test_every_vertex_within_2_px_from_4_outlines_marked_to_a_pixel(instruments, name, is_mirrored):
    instrument = instruments[name]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        camera = some_camera(instrument, FOCAL_PX[name], rng, is_mirrored)
        truth = true_outlines(instrument, camera)
        marks = {}
        for facet_id in rim_facets(instrument):
            drawn = truth[facet_id] + rng.normal(0.0, 1.0, (6, 2))
            # A person begins at any corner and goes round either way.
            marks[facet_id] = np.roll(drawn, rng.integers(6), axis=0)[:: rng.choice([-1, 1])]
        found = pose_of_marks(marks, instrument.reflector, instrument.reflector_camera, is_mirrored)
        assert worst_vertex_px(instrument, found.pose, truth) < 2.0
        assert 0.5 < found.rms_px < 2.5  # a pixel per axis is 1.4 px


@pytest.mark.parametrize("name", FOCAL_PX)
def test_exact_marks_of_4_centres_give_the_camera_back(instruments, name):
    instrument = instruments[name]
    camera = some_camera(instrument, FOCAL_PX[name], np.random.default_rng(3))
    marks = {i: centres(instrument, camera)[i] for i in rim_facets(instrument)}
    found = pose_of_marks(marks, instrument.reflector, instrument.reflector_camera)
    # 4 points have 8 numbers for 7 unknowns; what is expected of cameras pulls a little.
    assert worst_vertex_px(instrument, found.pose, true_outlines(instrument, camera)) < 0.5
    assert not found.pose.is_mirrored
    assert found.pose.rotation_rad == pytest.approx(camera.turned_rad[2], abs=2e-3)


def test_the_expected_error_is_the_real_one(fact):
    """Of the worst facet centre, over many clicks with a pixel of error: root mean square against what is stated."""
    camera = TrueCamera((0.03, -0.05, 0.04), (0.01, 0.02, 0.2), 900.0)
    truth = centres(fact, camera)
    errors, stated = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        marks = {i: truth[i] + rng.normal(0.0, 1.0, (1, 2)) for i in rim_facets(fact, 5)}
        found = pose_of_marks(marks, fact.reflector, fact.reflector_camera, False)
        errors.append(found.pose.project(fact.reflector.positions_m) - np.concatenate(list(truth.values())))
        stated.append(found.uncertainty_px(fact.reflector))
    worst_px = np.sqrt(np.mean(np.sum(np.square(errors), axis=2), axis=0)).max()
    assert worst_px == pytest.approx(np.mean(stated), rel=0.35)


def test_a_lens_with_distortion_is_found_from_6_marks(fact):
    camera = TrueCamera(focal_px=900.0)
    axis = fact.reflector_camera.axis_pixel

    def bent(pixels):
        offset = (pixels - axis) / camera.focal_px
        return axis + camera.focal_px * offset * (1.0 - 0.4 * np.sum(offset**2, axis=-1, keepdims=True))

    truth = {i: bent(outline) for i, outline in true_outlines(fact, camera).items()}
    marks = {i: truth[i] for i in (13, 18, 11, 33, 16, 32)}
    found = pose_of_marks(marks, fact.reflector, fact.reflector_camera)
    assert found.pose.distortion == pytest.approx(-0.4, abs=0.03)
    assert worst_vertex_px(fact, found.pose, truth) < 0.5


@pytest.mark.parametrize(("n_marks", "pair"), [(4, (0, 1)), (4, (0, 2)), (4, (1, 3)), (6, (0, 2))])
def test_two_exchanged_ids_are_named(fact, n_marks, pair):
    rng = np.random.default_rng(1)
    truth = centres(fact, TrueCamera((0.02, 0.01, 0.0), (0.0, 0.01, 0.05), 900.0))
    ids = rim_facets(fact, n_marks)
    marks = {i: truth[i] + rng.normal(0.0, 0.7, (1, 2)) for i in ids}
    first, second = ids[pair[0]], ids[pair[1]]
    marks[first], marks[second] = marks[second], marks[first]
    with pytest.raises(MarksError) as caught:
        pose_of_marks(marks, fact.reflector, fact.reflector_camera, False)
    assert {first, second} <= set(caught.value.facet_ids)
    assert f"the ids of {first} and {second} are exchanged" in str(caught.value)


def test_a_mark_on_the_wrong_facet_is_named_with_that_facet(fact):
    truth = centres(fact, TrueCamera(focal_px=900.0))
    marks = {i: truth[i] for i in (13, 18, 11, 33, 10, 27)} | {16: truth[25]}
    with pytest.raises(MarksError, match=r"mark of 16 is .* where facet 25 is") as caught:
        pose_of_marks(marks, fact.reflector, fact.reflector_camera, False)
    assert caught.value.facet_ids == (16,)


def test_neighbours_exchanged_on_a_fine_dish_are_noticed(instruments):
    """Facets are 19 px wide there: the pose could bend to half of such a mistake."""
    instrument = instruments["thousand"]
    truth = centres(instrument, TrueCamera(focal_px=840.0))
    ids = rim_facets(instrument, 6)
    distance = np.linalg.norm(instrument.reflector.positions_m - _position(instrument, ids[2]), axis=1)
    neighbour = instrument.reflector.ids[int(np.argsort(distance)[1])]
    marks = {i: truth[i] for i in ids} | {ids[2]: truth[neighbour]}
    with pytest.raises(MarksError) as caught:
        pose_of_marks(marks, instrument.reflector, instrument.reflector_camera, False)
    assert ids[2] in caught.value.facet_ids


def _position(instrument: Instrument, facet_id: int) -> np.ndarray:
    return instrument.reflector.facets[instrument.reflector.ids.index(facet_id)].position_m


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_marks_decide_whether_the_image_is_mirrored(fact, is_mirrored):
    truth = centres(fact, TrueCamera(focal_px=900.0, is_mirrored=is_mirrored))
    marks = {i: truth[i] for i in rim_facets(fact, 5)}
    assert pose_of_marks(marks, fact.reflector, fact.reflector_camera).pose.is_mirrored == is_mirrored
    word = "mirrored" if is_mirrored else "not mirrored"
    with pytest.raises(MarksError, match=rf"the image is {word} \(then 0.\d px rms\)"):
        pose_of_marks(marks, fact.reflector, fact.reflector_camera, not is_mirrored)


def test_facets_nearly_in_a_row_still_tell_a_mirrored_image(instruments):
    """One of four is in the next row of a fine dish, 17 px aside: as little as passes for not being on one line."""
    instrument = instruments["thousand"]
    pitch_m = 0.66
    wanted = np.array([[2.0, 0.0], [5.0, 0.0], [7.5, np.sqrt(3.0) / 2.0], [11.0, 0.0]]) * pitch_m
    across = instrument.reflector.positions_m[:, :2]
    ids = [instrument.reflector.ids[int(np.argmin(np.linalg.norm(across - at, axis=1)))] for at in wanted]
    for is_mirrored in (False, True):
        truth = centres(instrument, TrueCamera(focal_px=840.0, is_mirrored=is_mirrored))
        rng = np.random.default_rng(2)
        marks = {i: truth[i] + rng.normal(0.0, 1.0, (1, 2)) for i in ids}
        found = pose_of_marks(marks, instrument.reflector, instrument.reflector_camera)
        assert found.pose.is_mirrored == is_mirrored


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda marks: {i: marks[i] for i in (13, 18, 11)}, "3 facets are marked; at least 4"),
        (lambda marks: marks | {999: marks[13]}, r"\[999\]"),
        (lambda marks: marks | {16: marks[13]}, "same place"),
        (lambda marks: marks | {13: np.array([[np.nan, 1.0]])}, "facet 13"),
        (lambda marks: marks | {13: np.zeros((2, 2))}, "facet 13: 2 points"),
        (lambda marks: marks | {13: np.array([[0.0, 0.0], [9.0, 9.0], [9.0, 0.0], [0.0, 9.0]])}, "crosses itself"),
    ],
)
def test_impossible_marks_are_refused(fact, change, text):
    truth = centres(fact, TrueCamera(focal_px=900.0))
    with pytest.raises(ConfigError, match=text):
        pose_of_marks(change({i: truth[i] for i in (13, 18, 11, 33)}), fact.reflector, fact.reflector_camera)


def test_marks_on_one_line_are_refused(fact):
    truth = centres(fact, TrueCamera(focal_px=900.0))
    with pytest.raises(MarksError, match="on one line"):
        pose_of_marks({i: truth[i] for i in (18, 22, 16, 25)}, fact.reflector, fact.reflector_camera)


def test_an_image_turned_against_the_config_is_told(fact):
    for turn_rad, is_told in ((0.05, False), (0.6, True)):
        truth = centres(fact, TrueCamera(turned_rad=(0.0, 0.0, turn_rad), focal_px=900.0))
        found = pose_of_marks({i: truth[i] for i in rim_facets(fact)}, fact.reflector, fact.reflector_camera)
        note = turn_note(found.pose, fact.reflector_camera, 0.17)
        assert (note is not None) == is_told
        assert note is None or "turned by 34.4 deg" in note


def test_outlines_end_at_the_edge_of_the_image(fact):
    truth = true_outlines(fact, TrueCamera(turned_rad=(0.25, 0.0, 0.0), focal_px=938.0))
    inside = outlines_in_image(truth, 1024, 768)
    assert len(inside) < len(truth)
    for outline in inside.values():
        assert np.all(outline >= -0.5)
        assert np.all(outline <= [1023.5, 767.5])

"""Poses fitted to the edges in twin pictures: how near to the truth, and when a fit is not to be trusted."""

from __future__ import annotations

import numpy as np
import pytest
from reflector_pictures import TrueCamera, instrument_of, true_outlines, true_pixels, twin_picture

from namod_ctl.core.errors import ConfigError
from namod_ctl.imaging.facet_edges import EdgePicture, propose_from_marks, propose_without_marks
from namod_ctl.optics.camera_pose import CameraPose, nominal_pose, project_facets
from namod_ctl.optics.facet_marks import pose_of_marks
from namod_ctl.optics.instrument import Instrument

FOCAL_PX = {"fact": 870.0, "lst_like": 800.0, "thousand": 840.0}


def worst_vertex_px(instrument: Instrument, pose: CameraPose, camera: TrueCamera) -> float:
    found = project_facets(pose, instrument.reflector)
    truth = true_outlines(instrument, camera)
    return max(float(np.linalg.norm(found[i] - truth[i], axis=1).max()) for i in truth)


def displaced(instrument: Instrument, focal_px: float) -> TrueCamera:
    away = 0.02 * instrument.reflector.focal_length_m
    return TrueCamera((away, -0.7 * away, 0.5 * away), (0.02, -0.015, 0.1), focal_px)


@pytest.mark.parametrize("name", FOCAL_PX)
def test_4_marked_centres_and_the_edges_put_every_vertex_within_2_px(name, tmp_path):
    """A hand that trembles by a pixel; the edges then leave a fraction of one."""
    instrument = instrument_of(name, tmp_path)
    camera = displaced(instrument, FOCAL_PX[name])
    places = true_pixels(instrument.reflector.positions_m, instrument, camera)
    rng = np.random.default_rng(4)
    marks = {}
    for angle in np.deg2rad([80.0, 170.0, 260.0, 350.0]):
        j = int(np.argmax(instrument.reflector.positions_m[:, :2] @ [np.cos(angle), np.sin(angle)]))
        marks[instrument.reflector.ids[j]] = places[j][None] + rng.normal(0.0, 1.0, (1, 2))
    model = instrument.reflector_camera
    solution = pose_of_marks(marks, instrument.reflector, model, False)
    picture = EdgePicture(twin_picture(instrument, camera, seed=3), instrument.reflector, model)
    proposal = propose_from_marks(picture, instrument.reflector, solution.pose)
    assert proposal.doubts == ()
    assert worst_vertex_px(instrument, proposal.fit.pose, camera) < 0.5


def test_without_marks_a_coarse_dish_is_found(tmp_path):
    instrument = instrument_of("fact", tmp_path)
    camera = TrueCamera((0.1, -0.07, 0.05), (0.02, -0.015, 0.02), 880.0)
    picture = EdgePicture(twin_picture(instrument, camera, seed=5), instrument.reflector, instrument.reflector_camera)
    proposal = propose_without_marks(picture, instrument.reflector, instrument.reflector_camera)
    assert proposal.doubts == ()
    assert worst_vertex_px(instrument, proposal.fit.pose, camera) < 1.0


def test_pictures_without_edges_are_not_trusted(tmp_path):
    instrument = instrument_of("fact", tmp_path)
    model = instrument.reflector_camera
    shape = (model.n_rows, model.n_columns)
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 255, shape).astype(np.uint8)
    for image in (np.zeros(shape, dtype=np.uint8), noise):
        picture = EdgePicture(image, instrument.reflector, model)
        proposal = propose_from_marks(picture, instrument.reflector, nominal_pose(instrument.reflector, model))
        assert any("edges of only" in doubt for doubt in proposal.doubts)


def test_a_pose_a_facet_off_meets_fewer_edges(tmp_path):
    """A lattice moved by a facet fits itself nearly: the lead of the right pose is what a proposal's trust rests on."""
    instrument = instrument_of("fact", tmp_path)
    camera = TrueCamera(focal_px=880.0)
    picture = EdgePicture(twin_picture(instrument, camera, seed=6), instrument.reflector, instrument.reflector_camera)
    right = picture.judge(_pose(instrument, camera, 0.0))
    moved = picture.refine(_pose(instrument, camera, 0.62))
    assert right.n_hits == right.n_samples
    assert moved.n_hits < 0.9 * right.n_hits


def _pose(instrument: Instrument, camera: TrueCamera, aside_m: float) -> CameraPose:
    """The pose of exact marks, all put `aside_m` aside on the dish."""
    places = true_pixels(instrument.reflector.positions_m + np.array([aside_m, 0.0, 0.0]), instrument, camera)
    marks = {i: place[None] for i, place in zip(instrument.reflector.ids, places, strict=True)}
    return pose_of_marks(marks, instrument.reflector, instrument.reflector_camera, False).pose


def test_a_picture_of_another_camera_is_refused(tmp_path):
    instrument = instrument_of("fact", tmp_path)
    with pytest.raises(ConfigError, match="640 x 480"):
        EdgePicture(np.zeros((480, 640), dtype=np.uint8), instrument.reflector, instrument.reflector_camera)

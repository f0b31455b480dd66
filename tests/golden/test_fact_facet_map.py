"""The facet map of the real FACT from marks in its published picture, against the tripod centres visible in it.

`CENTRES_PX` were measured in `reflector_with_published_instructions.png` (1215 x 911): where the three green arms
of a facet's tripod meet. The arms are drawn in one exact colour; straight lines through the middles of the three arms,
5 to 30 pixels from the meeting point, at 0, 120 and 240 deg, cross within 0.15 px of one point for every facet. Crops
enlarged ten times were looked at: facet 30's arms meet at x = 576, not 573 as in `published_facet_pixels.csv`, which
was read off by eye. The original program drew each tripod in the middle of a polygon that a person had clicked, so
these centres themselves scatter by about 1.3 px about any camera's view of the dish.
Axes: +x right, +y up, which of the two mirror images is true cannot be told from the data and changes nothing here.
"""

from __future__ import annotations

import csv
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.config.instrument import load_config
from namod_ctl.app.facet_editor.workbench import Workbench, scaled_camera
from namod_ctl.optics.facet_marks import MarkedPose, MarksError, pose_of_marks

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "fact_2014"
BLACK = np.zeros((911, 1215, 3), dtype=np.uint8)
PICTURE = "reflector_with_published_instructions.png"

# fmt: off
CENTRES_PX = {
    13: (571.8, 121.0), 31: (367.7, 239.5), 29: (503.2, 237.4), 35: (642.0, 238.4), 19: (777.3, 238.4),
    15: (917.0, 232.5), 18: (302.4, 359.4), 22: (437.7, 359.4), 16: (572.8, 357.0), 25: (710.4, 357.0),
    24: (848.5, 354.6), 11: (983.5, 353.4), 5: (371.4, 478.0), 12: (505.2, 476.9), 26: (780.7, 474.5),
    4: (916.1, 474.5), 34: (301.4, 597.9), 7: (439.1, 597.9), 30: (576.4, 597.9), 32: (714.0, 594.4),
    2: (849.2, 593.0), 17: (985.9, 590.9), 27: (370.2, 715.4), 3: (506.7, 714.0), 23: (644.4, 714.0),
    6: (784.4, 712.9), 10: (919.4, 711.9), 33: (575.5, 832.9), 21: (713.1, 830.4),
}
# fmt: on
RIMS = ((31, 15, 27, 10), (18, 11, 34, 17), (13, 21, 34, 17), (13, 33, 18, 11), (31, 15, 33, 21))
"""Four facets at the rim, on all sides."""
MIDDLES = ((16, 32), (25, 30), (12, 26))
"""Two facets beside the middle, opposite each other."""


def solve(ids: tuple[int, ...]) -> tuple[MarkedPose, np.ndarray]:
    """The pose from these marks, and how far every visible facet's centre is from it, pixel."""
    instrument = build_instrument(load_config("fact"))
    camera = scaled_camera(instrument.reflector_camera, 1215, 911)
    marks = {i: np.array([CENTRES_PX[i]]) for i in ids}
    solution = pose_of_marks(marks, instrument.reflector, camera, is_mirrored=False)
    seen = instrument.reflector.subset(tuple(CENTRES_PX))
    away = solution.pose.project(seen.positions_m) - np.array(list(CENTRES_PX.values()))
    return solution, np.linalg.norm(away, axis=1)


def test_from_6_marked_facets_all_29_centres_within_4_px() -> None:
    """Six marks with the advice of the editor's page: some at the rim, some near the middle."""
    worst_px = np.array([solve((*rim, *middle))[1].max() for rim, middle in product(RIMS, MIDDLES)])
    assert np.mean(worst_px < 4.0) >= 0.8
    assert worst_px.max() < 4.5  # the marks themselves are 1.3 px rms off


def test_from_all_29_marks_the_camera_stands_in_the_focal_point() -> None:
    solution, away_px = solve(tuple(CENTRES_PX))
    assert np.sqrt(np.mean(away_px**2)) < 1.5
    assert away_px.max() < 3.0
    # arXiv:1605.06274: the camera sits in the focal point, 4.889 m; 0.1 m is what such marks can tell.
    np.testing.assert_allclose(solution.pose.place_m, [0.0, 0.0, 4.889], atol=0.1)
    assert solution.pose.distortion < -0.2  # its lens is a wide one: barrel distortion
    assert abs(solution.pose.rotation_rad) < 0.01


def test_4_marks_on_this_lens_are_warned_of() -> None:
    """Without distortion facets are many pixels off, more than the stated uncertainty knows: the note says so."""
    instrument = build_instrument(load_config("fact"))
    bench = Workbench(instrument, scaled_camera(instrument.reflector_camera, 1215, 911), BLACK, "reflector.png", None)
    solution, away_px = solve((31, 15, 27, 10))
    assert away_px.max() > 8.0
    assert any("without distortion" in note for note in bench.mark_notes(solution))
    assert not bench.mark_notes(solve((31, 15, 27, 10, 16, 32))[0])


def test_two_exchanged_ids_of_the_real_picture_are_named() -> None:
    instrument = build_instrument(load_config("fact"))
    camera = scaled_camera(instrument.reflector_camera, 1215, 911)
    marks = {i: np.array([CENTRES_PX[i]]) for i in (31, 15, 27, 10, 16, 32)}
    marks[15], marks[27] = marks[27], marks[15]
    with pytest.raises(MarksError, match="the ids of 15 and 27 are exchanged"):
        pose_of_marks(marks, instrument.reflector, camera, is_mirrored=False)


@pytest.mark.skipif(not DATA.exists(), reason="the FACT picture of May 2014 is not here")
def test_the_measured_centres_are_where_the_green_arms_meet() -> None:
    image = cv2.imread(str(DATA / PICTURE))
    arm = np.all(image == (128, 255, 0), axis=2)
    for x, y in CENTRES_PX.values():
        for angle in np.deg2rad([0.0, 120.0, 240.0]):
            along = np.arange(6, 22)
            columns = np.rint(x + along * np.cos(angle)).astype(int)
            rows = np.rint(y - along * np.sin(angle)).astype(int)
            assert arm[rows, columns].mean() > 0.8, (x, y, angle)  # yellow numbers lie over some
    with (DATA / "published_facet_pixels.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            read_off = np.array([float(row["x_px"]), float(row["y_px"])])
            assert np.abs(read_off - CENTRES_PX[int(row["facet_id"])]).max() < 3.6

"""The bolt turns that were handed to people at FACT in May 2014, from the records they were made of.

Source: the instruction picture of the original NAMOD program (fact-project/NAMOD); turns read off it into
`published_bolt_turns.csv`. They rest on the single brightest record of each facet and aim at the axis.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad
from namod_ctl.optics.camera_model import CameraModel, RadiometricLaw
from namod_ctl.optics.coordinates import CameraOrientation
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Reflector
from namod_ctl.reconstruction.correction import correct

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "fact_2014"

pytestmark = pytest.mark.skipif(not DATA.exists(), reason="the FACT records of May 2014 are not here")


def brightest_direction_rad(facet_id: int) -> np.ndarray:
    path = DATA / "response_maps" / f"mirror_ID{facet_id}_response_map.csv"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    return deg_to_rad(table[np.argmax(table[:, 2]), :2])


def test_all_published_turns_to_the_degree() -> None:
    with (DATA / "published_bolt_turns.csv").open(newline="") as file:
        rows = [[int(value) for value in row.values()] for row in csv.DictReader(file)]
    published = {row[0]: row[1:] for row in rows}
    azimuth = np.radians([0.0, 120.0, 240.0])
    tripod = Mount(0.295 * np.column_stack([np.cos(azimuth), np.sin(azimuth)]), False, 0.01, 0.0, 0.001, "clockwise")
    camera = CameraModel("-", 2, 2, 1.0, np.zeros(2), True, CameraOrientation(), RadiometricLaw(1.0, -1.0, 0.0))
    mounts = dict.fromkeys(published, tripod)
    fact = Instrument("FACT", Reflector(4.889, ()), mounts, camera, camera, {}, np.radians(5.0), np.radians(0.025))
    theta = np.array([brightest_direction_rad(facet_id) for facet_id in published])
    corrections = correct(fact, list(published), theta, [FacetFlag.NONE] * len(published), np.zeros(2))
    turns = np.array([facet.bolt_turn_deg for facet in corrections])
    assert turns.size == 45
    np.testing.assert_array_equal(np.round(turns), list(published.values()))

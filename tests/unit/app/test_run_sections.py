"""What the page says of a run that is recorded: its records, and what its recorder says beside them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dashboard_samples import new_run, record, small_config

from namod_ctl.app.dashboard.facet_sections import instrument_of
from namod_ctl.app.dashboard.run_sections import RunGlance
from namod_ctl.core.flags import RejectReason
from namod_ctl.core.units import arcmin2_to_rad2, arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.pairs import DropCause
from namod_ctl.store.live_pictures import picture_of, put_live_picture

STATUS = LiveStatus(
    n_wanted=400,
    region_radius_rad=deg_to_rad(0.8),
    exposure_limits_s={"star": (1e-3, 3.0), "reflector": (1e-3, math.inf)},
    rate_per_min=7.0,
    dropped={DropCause.STAR_STARVED: 3},
    n_frames_missed=2,
    warning="no record counted for 31 s: wait for the cloud to pass",
    estimate=LiveEstimate(120, arcmin_to_rad(0.4), 17, (3, 4), arcmin2_to_rad2(15.0), arcmin2_to_rad2(0.5)),
    waits_for="the next pair of frames",
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "RUN"


def glance_at(path: Path) -> RunGlance:
    config = small_config()
    return RunGlance(path, config, instrument_of(config), 0)


def updated(glance: RunGlance) -> dict[str, Any]:
    assert glance.update()
    now = glance.now()
    json.dumps(now, allow_nan=False)
    return now


def test_the_recorders_words_arrive_with_the_records(path: Path) -> None:
    with new_run(path) as run, glance_at(path) as glance:
        n_facets = len(run.facet_ids)
        assert updated(glance)["live"] is None
        run.append([record(0, n_facets), record(1, n_facets, RejectReason.NO_STAR)], {NOTE_LIVE: STATUS.to_json()})
        now = updated(glance)
        live = now["live"]
        assert (now["n_accepted"], live["n_wanted"]) == (1, 400)
        assert live["retaken"] == [{"cause": "star frame too dark", "n": 3}]
        assert live["n_frames_missed"] == 2
        assert "cloud" in live["warning"]
        assert live["exposure_limits_s"] == {"star": [0.001, 3.0], "reflector": [0.001, None]}
        assert live["longest_now_s"] is None
        assert live["estimate"]["worst_arcmin"] == pytest.approx(0.4)
        assert live["estimate"]["area_arcmin2"] == pytest.approx(15.0)
        assert (live["estimate"]["worst_facet"], live["estimate"]["unseen"]) == (17, [3, 4])
        run.set_note(NOTE_LIVE, "{}", is_passing=True)
        assert updated(glance)["live"] is None


def test_the_coverage_is_that_of_the_recorders_region(path: Path) -> None:
    """All records lie within 0.35 deg: they fill most of the config's region, and a fifth of that of one of 0.8 deg."""
    with new_run(path) as run, glance_at(path) as glance:
        run.append([record(index, len(run.facet_ids)) for index in range(300)])
        config_region = updated(glance)["coverage"]
        assert config_region["share"] > 0.5
        run.set_note(NOTE_LIVE, STATUS.to_json(), is_passing=True)
        now = updated(glance)
        assert now["coverage"]["radius_deg"] == pytest.approx(0.8)
        assert np.sum(now["coverage"]["counts"]) == np.sum(config_region["counts"]) == now["n_accepted"] == 300
        assert now["coverage"]["share"] < 0.25
        run.append([record(300, len(run.facet_ids))])
        assert updated(glance)["n_accepted"] == 301


def test_the_mark_on_a_picture_is_where_the_star_was_in_it(path: Path) -> None:
    """The newest picture is often a record or two behind."""
    with new_run(path) as run, glance_at(path) as glance:
        run.append([record(index, len(run.facet_ids)) for index in range(5)])
        assert updated(glance)["frame_star_px"] is None
        picture = picture_of(np.zeros((10, 10), dtype=np.uint8))
        put_live_picture(path, 2, "star_camera", picture)
        run.append([record(5, len(run.facet_ids))])
        now = updated(glance)
        assert now["frames"] == {"star_camera": 2}
        camera = instrument_of(small_config()).star_camera
        assert now["frame_star_px"] == pytest.approx(camera.pixel_of_theta(record(2, 1).theta_rad), abs=0.1)
        assert now["star_px"] == pytest.approx(camera.pixel_of_theta(record(5, 1).theta_rad), abs=0.1)


@pytest.mark.parametrize(
    ("frame", "full_scale_adu"),
    [
        (np.full((1920, 2560), 64, dtype=np.uint8), 255.0),
        (np.full((768, 1024, 3), 64, dtype=np.uint8), 255.0),
        (np.full((100, 50), 1028, dtype=np.uint16), 4095.0),
    ],
)
def test_a_picture_is_small_and_brightened_whatever_the_camera(frame: np.ndarray, full_scale_adu: float) -> None:
    data = picture_of(frame, full_scale_adu)
    picture = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))
    assert picture.shape[1] == min(frame.shape[1], 960)
    assert picture.shape[0] / picture.shape[1] == pytest.approx(frame.shape[0] / frame.shape[1], rel=0.01)
    assert picture.mean() == pytest.approx(255.0 * math.sqrt(0.251), abs=2.0)  # a quarter of full scale
    assert len(data) < 30_000

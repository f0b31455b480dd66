"""A campaign with a PSF camera looks through it before its first correction and in the end, and says if both agree."""

from __future__ import annotations

from pathlib import Path

import campaign_rig
import pytest
from campaign_rig import small_config

from namod_ctl.app.config.psf_camera_schema import PsfCameraSection
from namod_ctl.app.report.document import Table
from namod_ctl.app.report.of_campaign import campaign_report
from namod_ctl.cycle.psf_check import AT_FIRST, EVENT
from namod_ctl.store.campaign_rows import TRANSITION

SCREEN = PsfCameraSection(
    model="screen",
    columns=640,
    rows=480,
    plate_scale_mdeg_per_px=2.1,
    full_scale_adu=4095.0,
    saturation_share=0.98,
    n_frames=4,
)


def test_campaign_is_verified(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = small_config().model_copy(update={"psf_camera": SCREEN})
    monkeypatch.setattr(campaign_rig, "small_config", lambda *_, **__: config)
    with campaign_rig.campaign_rig(tmp_path / "campaign") as rig:
        before_rad2 = rig.before_rad2
        assert rig.run() == "converged"
        after_rad2 = rig.area_rad2
        first, last = rig.events(EVENT)
        moves = [event for event in rig.events(TRANSITION) if event.data["to"] == "correcting"]
        assert first.id < moves[0].id <= moves[-1].id < last.id
    assert first.data["when"] == AT_FIRST
    assert last.data["when"] == "in the end (converged)"
    # the truth is of another moment than the images, and of a star on the axis: sag and coma are some per cent
    assert first.data["a_sigma_rad2"] == pytest.approx(before_rad2, rel=0.03)
    assert last.data["a_sigma_rad2"] == pytest.approx(after_rad2, rel=0.03)
    assert first.data["cycle"] == 1
    assert "they agree" in first.text
    assert "they agree" in last.text
    document, _ = campaign_report(tmp_path / "campaign")
    tables = [block for block in document.chapters[0].blocks if isinstance(block, Table)]
    (seen,) = [table for table in tables if table.head[:1] == ("PSF camera",)]
    assert [row[0] for row in seen.rows] == [AT_FIRST, "in the end (converged)"]
    assert {row[-1] for row in seen.rows} == {"they agree"}

"""The page of a run while it is recorded: what the recorder says beside its records, in a real browser."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
from dashboard_samples import new_run, record
from page_rig import OVERLAPS, Watcher, served
from playwright.sync_api import Page, expect

from namod_ctl.core.units import arcmin2_to_rad2, arcmin_to_rad, deg_to_rad
from namod_ctl.cycle.live_estimate import LiveEstimate
from namod_ctl.cycle.live_status import NOTE_LIVE, LiveStatus
from namod_ctl.cycle.pairs import DropCause

STATUS = LiveStatus(
    n_wanted=400,
    region_radius_rad=deg_to_rad(0.5),
    exposure_limits_s={"star": (1e-3, 3.0), "reflector": (1e-3, 3.0)},
    longest_now_s=0.6,
    dropped={DropCause.STAR_STARVED: 3},
    n_frames_missed=2,
    warning="no record counted for 31 s: camera lost (4 times); check the camera's cable and power",
    estimate=LiveEstimate(120, arcmin_to_rad(0.4), 17, (3, 4), arcmin2_to_rad2(15.0), arcmin2_to_rad2(0.5)),
    waits_for="a pair of frames that can be used",
)


@pytest.mark.parametrize("width", [390, 2560])
def test_the_crew_reads_what_is_wrong_and_what_to_do(page: Page, watcher: Watcher, tmp_path: Path, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 900})
    with new_run(tmp_path / "RUN") as run, served(tmp_path / "RUN") as address:
        run.append([record(index, len(run.facet_ids)) for index in range(30)], {NOTE_LIVE: STATUS.to_json()})
        page.goto(address)
        numbers, warning = page.locator("#numbers"), page.locator("#warning")
        expect(numbers).to_contain_text("30 of 400")
        expect(warning).to_be_visible()
        expect(warning).to_contain_text("check the camera's cable and power")
        expect(page.locator("#retaken li")).to_have_text(
            ["3 × star frame too dark", "2 × frame counted by a camera that never came"]
        )
        for words in ("15.0 ± 0.5 arcmin² (120 records)", "facet 17: ± 0.40 arcmin; not seen: 3, 4"):
            expect(numbers).to_contain_text(words)
        expect(numbers).to_contain_text("(1.0 ms to 3.00 s)")
        expect(numbers).to_contain_text("a pair of frames that can be used")
        expect(page.locator("#coverage")).to_contain_text("+0.50°")
        assert page.evaluate(OVERLAPS) == []
        run.set_note(NOTE_LIVE, replace(STATUS, warning="", waits_for="", ended="stopped by hand").to_json())
        expect(warning).to_be_hidden()
        expect(numbers).to_contain_text("stopped by hand")
        assert watcher.complaints == []


def test_a_recorder_that_is_dead_is_not_waited_for(page: Page, tmp_path: Path) -> None:
    """It was killed a minute ago: its last words are no warning any more."""
    with new_run(tmp_path / "RUN") as run:
        run.append([record(0, len(run.facet_ids))], {NOTE_LIVE: STATUS.to_json()})
    then_s = time.time() - 60.0
    os.utime(tmp_path / "RUN" / "run.sqlite", (then_s, then_s))
    with served(tmp_path / "RUN") as address:
        page.goto(address)
        expect(page.locator("#numbers")).to_contain_text("the recorder has said nothing for a while")
        expect(page.locator("#warning")).to_be_hidden()

"""The page in a real browser: what is seen, what is asked, and what happens on a press of a button."""

from __future__ import annotations

import math
import re
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from dashboard_samples import EVIL, new_run, record
from page_rig import NOT_RED, OVERLAPS, SIZES, TOKEN, Watcher, served, state_of, wait_until
from playwright.sync_api import Browser, Page, expect

from namod_ctl.core.flags import RejectReason
from namod_ctl.cycle.recording_control import RecordingControl

axe = pytest.importorskip("axe_core_python.sync_playwright")


def opened(page: Page, address: str) -> Page:
    page.goto(address)
    expect(page.locator("#numbers dd").first).to_be_attached()
    return page


def test_page_loads_fast_small_without_error_and_asks_nobody_else(page: Page, watcher: Watcher, address: str) -> None:
    sizes: list[int] = []
    page.on("requestfinished", lambda request: sizes.append(request.sizes()["responseBodySize"]))
    opened(page, address)
    expect(page.locator("#state")).to_have_text("awaiting approval")
    expect(page.locator("#facet-caption")).to_contain_text("records")
    timing = page.evaluate("() => performance.getEntriesByType('navigation')[0].loadEventEnd")
    assert watcher.complaints == []
    assert {urlsplit(url).netloc for url in watcher.asked} == {urlsplit(address).netloc}
    assert sum(sizes) < 500_000
    assert timing < 1000.0, f"{timing} ms"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", ["day", "night"])
def test_nothing_overlaps_or_scrolls_sideways(browser: Browser, address: str, size: str, mode: str) -> None:
    width, height = SIZES[size]
    scheme = "dark" if mode == "night" else "light"
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
    opened(page, address)
    expect(page.locator("#psf")).to_be_visible()
    for summary in page.locator("summary").all():
        if summary.is_visible():
            summary.click()
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    page.evaluate("() => scrollTo(0, 0)")
    assert page.evaluate(OVERLAPS) == []
    expect(page.locator("#stop")).to_be_in_viewport()
    page.evaluate("() => scrollTo(0, document.documentElement.scrollHeight)")
    expect(page.locator("#stop")).to_be_in_viewport()
    found = axe.Axe().run(page)
    serious = [each for each in found["violations"] if each["impact"] in ("serious", "critical")]
    assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []
    page.close()


def test_night_is_one_tap_remembered_and_never_white(browser: Browser, address: str) -> None:
    context = browser.new_context(color_scheme="light", viewport={"width": 390, "height": 844})
    page = opened(context.new_page(), address)
    back = "() => getComputedStyle(document.documentElement).backgroundColor"
    assert page.evaluate(back) == "rgb(243, 243, 239)"
    page.locator("#mode").click()
    expect(page.locator("#mode")).to_have_attribute("aria-pressed", "true")
    assert page.evaluate(back) == "rgb(0, 0, 0)"
    again = context.new_page()
    # the moment the body begins, before any module has run
    again.add_init_script(
        "addEventListener('DOMContentLoaded', () => { window.first = document.documentElement.dataset.mode; })"
    )
    opened(again, address)
    assert again.evaluate("() => window.first") == "night"
    assert again.evaluate(back) == "rgb(0, 0, 0)"
    assert again.evaluate(NOT_RED) == []  # red on black: nothing that blinds
    context.close()


def test_facet_details_by_pointer_and_by_keyboard(page: Page, address: str) -> None:
    opened(page, address)
    facets = page.locator("#mirror .facet")
    expect(facets).to_have_count(6)
    facets.nth(3).hover()
    expect(page.locator("#facet-choice")).to_have_value("4")
    expect(page.locator("#facet-map")).to_have_attribute("aria-label", re.compile(r"facet 4 .*\d+ records"))
    expect(page.locator("#facet-numbers")).to_contain_text("arcmin")
    page.locator("#facet-choice").focus()
    page.keyboard.press("Shift+Tab")
    expect(facets.nth(3)).to_be_focused()
    page.keyboard.press("Home")
    expect(facets.nth(0)).to_be_focused()
    expect(facets.nth(0)).to_have_attribute("aria-selected", "true")
    before = page.locator("#facet-choice").input_value()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#facet-choice")).not_to_have_value(before)
    assert page.evaluate("() => document.activeElement.getAttribute('aria-label')").startswith("facet ")


def test_live_values_change_soon_after_a_record_is_committed(page: Page, watcher: Watcher, tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run, served(tmp_path / "R") as address:
        n_facets = len(run.facet_ids)
        run.append([record(0, n_facets)])
        opened(page, address)
        expect(page.locator("#numbers")).to_contain_text("1 count, 0 rejected")
        page.evaluate(
            """() => {
              window.seen = {};
              new MutationObserver(() => {
                const n = document.querySelectorAll('#numbers dd')[1].textContent.match(/\\d+/)[0];
                window.seen[n] ??= Date.now();
              }).observe(document.querySelector('#numbers'), {childList: true});
            }"""
        )
        written_ms = {}
        for index in range(1, 21):
            run.append([record(index, n_facets)])
            written_ms[str(index + 1)] = 1000.0 * time.time()
            time.sleep(0.1)  # the pace of a recording
        run.append([record(21, n_facets, RejectReason.NO_STAR)])
        expect(page.locator("#numbers")).to_contain_text("21 count, 1 rejected")
        expect(page.locator("#rejected")).to_contain_text("1 × no star")
        seen_ms = page.evaluate("() => window.seen")
        late_ms = sorted(seen_ms.get(n, math.inf) - at_ms for n, at_ms in written_ms.items())
    assert late_ms[len(late_ms) // 2] < 100.0, late_ms  # the median: others use this computer, too
    assert watcher.complaints == []


def test_pictures_that_were_kept_are_shown_with_what_was_found_in_them(page: Page, tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        frame = np.zeros((120, 160), dtype=np.uint8)
        frame[60:70, 70:90] = 90
        for camera in ("star_camera", "reflector_camera"):
            run.add_frame(7, camera, frame)
        run.append([record(7, len(run.facet_ids))])
        with served(tmp_path / "R") as address:
            opened(page, address)
            for image in ("#star-image", "#mirror-image"):
                expect(page.locator(image)).to_be_visible()
                assert page.locator(image).evaluate("(image) => image.naturalWidth") == 160
            expect(page.locator("#star .star-ring")).to_have_count(2)
            expect(page.locator("#star-missing")).to_have_text("")


def test_html_in_a_name_is_shown_as_it_is(page: Page, watcher: Watcher, tmp_path: Path) -> None:
    with new_run(tmp_path / "R", EVIL) as run, served(tmp_path / "R") as address:
        run.append([record(0, len(run.facet_ids))])
        opened(page, address)
        expect(page.locator("#title")).to_have_text(f"{EVIL}: R")
        assert page.locator("#title *").count() == 0
    assert watcher.complaints == []


def test_plain_recording_is_ended_from_the_page_after_one_confirmation(page: Page, tmp_path: Path) -> None:
    is_asked = threading.Event()
    with new_run(tmp_path / "R") as run, served(tmp_path / "R") as address:
        run.append([record(0, len(run.facet_ids))])
        opened(page, f"{address}#token={TOKEN.replace(' ', '%20')}")
        expect(page.locator("#stop")).to_have_attribute("aria-disabled", "true")  # nobody records
        with RecordingControl(tmp_path / "R", is_asked.set) as control:
            expect(page.locator("#stop")).to_have_attribute("aria-disabled", "false")
            page.locator("#stop").click()
            expect(page.locator("#stop-dialog")).to_contain_text("All its records are kept")
            assert not is_asked.is_set()
            recorder = threading.Thread(target=looking, args=(control, is_asked))
            recorder.start()
            page.get_by_role("button", name="Stop now").click()
            expect(page.locator("#reply")).to_contain_text("stopping")
            recorder.join(10.0)
            assert is_asked.is_set()
        expect(page.locator("#state")).to_have_text("at rest")  # at once: it is known that nobody records any more


def looking(control: RecordingControl, is_asked: threading.Event) -> None:
    """A recorder between its records, until it is asked to stop."""
    while not is_asked.wait(0.01):
        control.look()


def test_commands_need_the_token_stop_needs_one_confirmation_and_the_end_can_be_viewed(
    page: Page, waiting_campaign: Path, address: str
) -> None:
    opened(page, address)
    approve = page.get_by_role("button", name="Approve the correction")
    approve.click()
    expect(page.locator("#reply")).to_contain_text("token is missing")
    assert state_of(waiting_campaign) == "awaiting_approval"
    page.get_by_label("Token for commands").fill("a wrong token, that is")
    page.get_by_role("button", name="Use it", exact=True).click()
    approve.click()
    expect(page.locator("#reply")).to_contain_text("token is missing or wrong")
    assert state_of(waiting_campaign) == "awaiting_approval"

    page.goto("about:blank")
    opened(page, f"{address}#token={TOKEN.replace(' ', '%20')}")
    assert "token" not in page.url
    approve.click()
    expect(page.locator("#journal")).to_contain_text("approved by a person")

    page.locator("#stop").click()
    page.get_by_role("button", name="Go back").click()
    assert state_of(waiting_campaign) != "held"
    page.locator("#stop").click()
    page.get_by_role("button", name="Stop now").click()
    wait_until(lambda: state_of(waiting_campaign) == "held", "it did not stop")
    expect(page.locator("#state")).to_have_text(re.compile("held"))
    expect(page.locator("#stop")).to_have_attribute("aria-disabled", "true")

    with served(waiting_campaign) as later:  # a page of a program that was not there shows it all
        opened(page, later)
        expect(page.locator("#journal")).to_contain_text("stopped by")
        expect(page.locator("#cycles-table tr").first).to_be_visible()
        expect(page.locator("#actuators-text")).to_contain_text("legs")
        expect(page.locator("#commands button")).to_have_count(0)

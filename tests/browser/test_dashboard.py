"""The page in a real browser: what is seen, what is asked, and what happens on a press of a button."""

from __future__ import annotations

import io
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
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from namod_ctl.core.flags import RejectReason
from namod_ctl.core.units import m_to_mm
from namod_ctl.cycle.recording_control import RecordingControl
from namod_ctl.store.campaign import CampaignStore

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


def test_bright_pictures_are_red_by_night(page: Page, tmp_path: Path) -> None:
    page.emulate_media(color_scheme="dark")
    with new_run(tmp_path / "R") as run:
        ramp = np.tile(np.linspace(0, 255, 160).astype(np.uint8), (120, 1))
        run.add_frame(0, "reflector_camera", ramp)
        run.append([record(0, len(run.facet_ids))])
        with served(tmp_path / "R") as address:
            opened(page, address)
            expect(page.locator("#mirror-image")).to_be_visible()
            page.locator("#mirror").evaluate("(map) => { map.style.visibility = 'hidden'; }")
            shown = Image.open(io.BytesIO(page.locator("#mirror-picture").screenshot())).convert("RGB")
    inside = np.asarray(shown).astype(float)[8:-8, 8:-8]  # the corners are round
    red, green, blue = np.moveaxis(inside, 2, 0)
    assert red.max() > 150.0  # it is to be seen
    assert (np.maximum(green, blue) <= 0.6 * red + 3.0).all()


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
        expect(page.locator("#stop")).to_have_attribute("aria-disabled", "true")  # nobody records, it seems
        page.locator("#stop").click(force=True)  # what a page believes may be old: it can be asked all the same
        page.get_by_role("button", name="Stop now").click()
        expect(page.locator("#reply")).to_contain_text("nobody is at work")
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


def planned_mm(page: Page) -> dict[tuple[int, int], float]:
    """Travels that the page's table of the legs announces, by facet and number of the leg."""
    rows = page.locator("#legs tr").evaluate_all("(rows) => rows.map((r) => [...r.cells].map((c) => c.textContent))")
    return {(int(row[0]), int(row[1])): float(row[4].removesuffix(" mm")) for row in rows if row[4] != "–"}


def travels_mm(campaign: Path) -> dict[tuple[int, int], float]:
    """Travels that are ordered."""
    with CampaignStore.open(campaign) as store:
        orders = [journaled.order for journaled in store.orders()]
    return {(o.leg.facet_id, o.leg.index + 1): float(m_to_mm(o.target_m - o.start_m)) for o in orders}


def test_who_is_asked_sees_what_would_move_how_far_and_what_is_to_be_won(
    page: Page, waiting_campaign: Path, address: str
) -> None:
    opened(page, address)
    planned = planned_mm(page)
    expect(page.locator("#preview-text")).to_contain_text(f"{len(planned)} legs of ")
    (facet, leg), farthest_mm = max(planned.items(), key=lambda item: abs(item[1]))
    expect(page.locator("#preview-text")).to_contain_text(f"leg {leg} of facet {facet} by {farthest_mm:+.3f} mm")
    with CampaignStore.open(waiting_campaign) as store:
        predicted_arcmin2 = math.degrees(math.degrees(store.cycles()[-1].a_sigma_predicted_rad2)) * 3600.0
    expect(page.locator("#preview-text")).to_contain_text(f"{predicted_arcmin2:.2f} arcmin² predicted")
    page.locator("#facet-choice").select_option(str(facet))
    expect(page.locator("#facet-numbers")).to_contain_text(f"would go by {farthest_mm:+.3f} mm")


def test_page_whose_program_ended_says_how_to_look_again_and_keeps_the_choice(page: Page, tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        run.append([record(0, len(run.facet_ids))])
        with served(tmp_path / "R") as first:
            opened(page, first)
            page.locator("#facet-choice").select_option(index=2)
            chosen = page.locator("#mirror .facet").nth(2)
            expect(chosen).to_have_attribute("aria-selected", "true")
        expect(page.locator("#banner")).to_contain_text("namod-ctl dashboard R")
        with served(tmp_path / "R", urlsplit(first).port or 0):
            expect(page.locator("#banner")).to_be_hidden()
            expect(chosen).to_have_attribute("aria-selected", "true")


def test_picture_stays_when_the_next_one_is_gone(page: Page, tmp_path: Path) -> None:
    with new_run(tmp_path / "R") as run:
        frame = np.full((120, 160), 90, dtype=np.uint8)
        run.add_frame(0, "star_camera", frame)
        run.append([record(0, len(run.facet_ids))])
        with served(tmp_path / "R") as address:
            opened(page, address)
            image = page.locator("#star-image")
            expect(image).to_be_visible()
            page.route("**/frame/**", lambda route: route.fulfill(status=204))
            with page.expect_response("**/frame/**") as asked:
                run.add_frame(1, "star_camera", frame)
                run.append([record(1, len(run.facet_ids))])
            assert asked.value.status == 204
            expect(page.locator("#numbers")).to_contain_text("2 count")
            assert image.evaluate("(image) => [image.naturalWidth, image.complete, image.src.at(-1)]") == [
                160,
                True,
                "0",
            ]


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
    page.get_by_role("button", name="Refuse: nothing moves, the campaign is held").click()
    expect(page.locator("#stop-dialog")).to_contain_text("namod-ctl release")
    page.get_by_role("button", name="Go back").click()
    assert state_of(waiting_campaign) == "awaiting_approval"
    promised_mm = planned_mm(page)
    approve.click()
    expect(page.locator("#journal")).to_contain_text("approved by a person")
    wait_until(lambda: len(travels_mm(waiting_campaign)) == len(promised_mm), "not what was promised is ordered")
    assert travels_mm(waiting_campaign) == pytest.approx(promised_mm, abs=0.00051)
    expect(page.locator("#preview")).to_be_hidden()

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

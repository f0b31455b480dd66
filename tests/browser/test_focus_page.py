"""The focus aid's page in a real browser: what the person at the lens sees, by day and by night."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from focus_samples import ARCMIN_PER_PX, chosen_camera, look_at, show, star_frame
from page_rig import NOT_RED, OVERLAPS, SIZES, Watcher
from playwright.sync_api import Browser, Page, expect

from namod_ctl.app.focus_page.beside import FocusPage, focus_page_beside
from namod_ctl.app.views.camera_views import Look
from namod_ctl.cycle.focus import FocusCourse
from namod_ctl.imaging.exposure import ExposureVerdict

axe = pytest.importorskip("axe_core_python.sync_playwright")

CHOSEN = chosen_camera()


class Lens:
    """Somebody turns it, and the page is told."""

    def __init__(self, page: FocusPage) -> None:
        self.address = page.address
        self._page, self._course, self._now_s = page, FocusCourse(), 0.0

    def turn(self, *sizes_px: float) -> None:
        for size_px in sizes_px:
            self.see(look_at(star_frame(size_px)))

    def see(self, look: Look) -> None:
        self._now_s += 0.7  # a slow camera
        show(self._page, self._now_s, self._course, look, CHOSEN)


@pytest.fixture
def lens() -> Iterator[Lens]:
    with focus_page_beside("star", "127.0.0.1", 0) as page:
        yield Lens(page)


def number_on(page: Page, which: str) -> float:
    found = re.search(r"[\d.]+", page.locator(which).inner_text())
    assert found is not None
    return float(found[0])


def test_person_at_the_lens_is_told_size_best_and_whither(page: Page, watcher: Watcher, lens: Lens) -> None:
    page.goto(lens.address)
    expect(page.locator("#camera")).to_have_text("star")
    lens.turn(24.0, 21.0, 18.0, 15.0, 12.0)
    expect(page.locator("#trend")).to_have_text("↓ better")
    expect(page.locator("#size")).to_have_text(re.compile(r"^(2\.9|3\.0)\d$"))
    assert number_on(page, "#size") == pytest.approx(12.0 * ARCMIN_PER_PX, rel=0.02)
    assert number_on(page, "#units") == pytest.approx(12.0, rel=0.02)
    expect(page.locator("#above")).to_have_text("(this is it)")
    lens.turn(13.0, 14.0, 15.0, 16.0, 18.0)
    expect(page.locator("#trend")).to_have_text("↑ worse")
    expect(page.locator("#size")).to_have_text(re.compile(r"^4\.[45]\d$"))
    assert number_on(page, "#best") == pytest.approx(12.0 * ARCMIN_PER_PX, rel=0.02)
    assert number_on(page, "#above") == pytest.approx(50.0, abs=3.0)
    points = page.locator("#curve .curve").get_attribute("points")
    assert points is not None
    assert len(points.split()) == 10
    heights = [float(point.split(",")[1]) for point in points.split()]
    assert np.argmax(heights) == 4  # the sharpest lies lowest, on the line of the best
    best = page.locator("#curve .best-line")
    assert float(best.get_attribute("y1") or "nan") == pytest.approx(heights[4], abs=0.2)
    expect(page.locator("#star-image")).to_be_visible()
    assert watcher.complaints == []
    assert {urlsplit(url).netloc for url in watcher.asked} == {urlsplit(lens.address).netloc}


def test_what_keeps_the_star_from_being_measured_is_said(page: Page, watcher: Watcher, lens: Lens) -> None:
    page.goto(lens.address)
    lens.turn(12.0)
    expect(page.locator("#size")).to_have_text(re.compile(r"^\d\.\d\d$"))
    lens.see(look_at(star_frame(12.0, peak_adu=3000.0), ExposureVerdict.SATURATED))
    expect(page.locator("#warning")).to_contain_text("Saturated")
    expect(page.locator("#size")).to_have_class(re.compile("old"))  # the last one, and not as if it were of now
    lens.see(look_at(star_frame(12.0, peak_adu=0.0)))
    expect(page.locator("#warning")).to_contain_text("No star")
    page.reload()  # who comes now is told what it was a moment ago, too
    expect(page.locator("#warning")).to_contain_text("No star")
    expect(page.locator("#size")).to_have_text(re.compile(r"^\d\.\d\d$"))
    lens.see(Look(None, None, None, "lost 1 s ago; attempt 1 of 6"))
    expect(page.locator("#warning")).to_contain_text("attempt 1 of 6")
    expect(page.locator("#numbers")).to_contain_text("no frame")
    expect(page.locator("#size")).to_have_text("–")  # too long ago
    lens.turn(12.0)
    expect(page.locator("#warning")).to_have_text("")
    assert watcher.complaints == []


@pytest.mark.parametrize("size", ["phone", "wide"])
def test_all_is_seen_at_once_and_nothing_overlaps(page: Page, watcher: Watcher, lens: Lens, size: str) -> None:
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    lens.turn(150.0, 60.0)  # the widest number: a figure more before the point
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        page.goto(lens.address)
        expect(page.locator("#size")).to_have_text(re.compile(r"^1\d\.\d$"))
        expect(page.locator("#star-image")).to_be_visible()
        assert page.evaluate("() => document.documentElement.scrollWidth") <= width
        assert page.evaluate(OVERLAPS) == []
        seen = page.locator(".star").bounding_box()
        assert seen is not None
        assert seen["y"] + seen["height"] <= height
        found = axe.Axe().run(page)
        serious = [each for each in found["violations"] if each["impact"] in ("serious", "critical")]
        assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []
    assert page.evaluate(NOT_RED) == []
    shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(int)
    blue, green, red = np.moveaxis(shot, 2, 0)
    assert red.max() > 200
    # what is painted, the picture of the star included: red above all
    assert np.all(np.maximum(blue, green) <= 0.75 * red + 3)
    assert watcher.complaints == []


def test_night_is_one_tap_and_remembered(browser: Browser, lens: Lens) -> None:
    context = browser.new_context(color_scheme="light")
    page = context.new_page()
    page.goto(lens.address)
    back = "() => getComputedStyle(document.documentElement).backgroundColor"
    assert page.evaluate(back) == "rgb(243, 243, 239)"
    page.locator("#mode").click()
    assert page.evaluate(back) == "rgb(0, 0, 0)"
    page.reload()
    expect(page.locator("#mode")).to_have_attribute("aria-pressed", "true")
    assert page.evaluate(back) == "rgb(0, 0, 0)"
    context.close()


def test_phone_follows_the_twins_camera_until_the_command_ends(page: Page) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    code = "import sys; from namod_ctl.app.cli import main; main()"
    arguments = ["camera", "focus", "star", "--twin", "--config", "mini_fact", "--page", "--port", "0"]
    with subprocess.Popen(
        [sys.executable, "-u", "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        page.goto(process.stdout.readline().split()[-1])
        expect(page.locator("#size")).to_have_text(re.compile(r"^\d+\.\d+$"))
        expect(page.locator("#units")).to_contain_text("arcmin")
        page.evaluate(
            """() => {
              window.seen = new Set();
              new MutationObserver(() => window.seen.add(document.querySelector('#units').textContent)).observe(
                document.querySelector('#units'), {childList: true});
            }"""
        )
        page.wait_for_function("() => window.seen.size >= 3")  # seeing: no two frames are alike
        expect(page.locator("#trend")).to_have_text("→ steady")  # nobody turns the twin's lens
        expect(page.locator("#banner")).to_be_hidden()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30.0)
    assert (process.returncode, errors) == (0, "")
    expect(page.locator("#banner")).to_contain_text("No connection")

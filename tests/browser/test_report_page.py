"""report.html in a browser: black on white by day, red on black by night, and not a request to anywhere."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from page_rig import Watcher
from playwright.sync_api import Browser, Page, expect

from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.report.document import Chapter, Document, Picture, Table, Text
from namod_ctl.app.report.html_page import to_html

WHITE, BLACK, RED = "rgb(255, 255, 255)", "rgb(0, 0, 0)", "rgb(255, 80, 64)"


@pytest.fixture
def report(tmp_path: Path) -> str:
    figure = Figure(figsize=(2, 2), facecolor="white")
    figure.text(0.1, 0.5, "a figure")
    blocks = (Text("words"), Text("a warning", is_warning=True), Picture(figure_to_png(figure), "a white picture"))
    document = Document("A report", "of nothing", (Chapter("One", (*blocks, Table(("a", "b"), (("1", "2"),)))),))
    path = tmp_path / "report.html"
    path.write_bytes(to_html(document))
    return path.as_uri()


def colours(page: Page) -> tuple[str, str]:
    found = page.evaluate("(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))")
    return found[0], found[1]


def brightest_part(page: Page) -> tuple[int, int, int]:
    """Largest red, green and blue that is anywhere on the screen."""
    picture = cv2.imdecode(np.frombuffer(page.screenshot(full_page=True), np.uint8), cv2.IMREAD_COLOR)
    blue, green, red = picture.reshape(-1, 3).max(axis=0).tolist()
    return red, green, blue


def test_night_is_one_tick_and_leaves_nothing_white(page: Page, watcher: Watcher, report: str) -> None:
    page.goto(report)
    assert colours(page)[0] == WHITE
    page.get_by_label("Night").check()
    assert colours(page) == (BLACK, RED)
    _, green, blue = brightest_part(page)
    assert max(green, blue) <= 0x90  # the palest of the colours: warnings, and the tick below the mouse
    page.get_by_label("Night").uncheck()
    assert colours(page)[0] == WHITE
    assert watcher.complaints == []
    assert watcher.asked == [report]


def test_a_dark_browser_begins_with_night(browser: Browser, report: str) -> None:
    page = browser.new_page(color_scheme="dark")
    page.goto(report)
    assert colours(page) == (BLACK, RED)
    expect(page.locator(".night")).to_be_hidden()
    page.close()


def test_on_paper_it_is_always_day(page: Page, report: str) -> None:
    page.goto(report)
    page.get_by_label("Night").check()
    page.emulate_media(media="print")
    assert colours(page)[0] in (WHITE, "rgba(0, 0, 0, 0)")
    assert colours(page)[1] == "rgb(17, 17, 17)"

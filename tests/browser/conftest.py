"""A browser, a campaign that waits for approval, and a run with pictures: each once for all tests."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from page_rig import BROWSER, Watcher, aligning, served, state_of, wait_until
from playwright.sync_api import Browser, Page, expect, sync_playwright

sys.path.append(str(Path(__file__).parents[1] / "unit" / "app"))


@pytest.fixture(scope="module")  # while it is there an event loop runs in this thread, and nobody can begin another
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(BROWSER))
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def waiting_campaign(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A campaign that has recorded, and asks a person."""
    folder = tmp_path_factory.mktemp("waiting")
    with aligning(folder, "--approve", "ask") as campaign:
        said = folder / "align.txt"
        ends = ("awaiting_approval", "held", "converged")
        wait_until(lambda: state_of(campaign) in ends or "namod-ctl:" in said.read_text(), "nobody was asked")
        assert state_of(campaign) == "awaiting_approval", said.read_text()
        yield campaign


@pytest.fixture(scope="session")
def address(waiting_campaign: Path) -> Iterator[str]:
    with served(waiting_campaign) as address:
        yield address


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    page = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="light")
    page.set_default_timeout(10_000)
    expect.set_options(timeout=10_000)
    yield page
    page.close()


@pytest.fixture
def watcher(page: Page) -> Watcher:
    return Watcher(page)

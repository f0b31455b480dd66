"""The work sheet in a real browser, with a campaign that waits for people at the bolts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from page_rig import (
    BY_HAND,
    NOT_RED,
    OVERLAPS,
    SIZES,
    TOKEN,
    Watcher,
    aligning,
    served,
    state_of,
    wait_until,
)
from playwright.sync_api import Browser, Page, expect

from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.dashboard.facet_sections import instrument_of
from namod_ctl.store.campaign import CampaignStore

axe = pytest.importorskip("axe_core_python.sync_playwright")
WITH_TOKEN = f"#token={TOKEN.replace(' ', '%20')}"


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A campaign whose sheets are written."""
    folder = tmp_path_factory.mktemp("by_hand")
    with aligning(folder, config=BY_HAND) as campaign:
        said = folder / "align.txt"
        wait_until(lambda: state_of(campaign) == "awaiting_operator" or "namod-ctl:" in said.read_text(), "no sheets")
        assert state_of(campaign) == "awaiting_operator", said.read_text()
        yield campaign


@pytest.fixture(scope="module")
def sheet_address(by_hand: Path) -> Iterator[str]:
    with served(by_hand) as address:
        yield address


def opened(page: Page, address: str) -> Page:
    page.goto(address)
    expect(page.locator("#sheet-list .chip")).to_have_count(6)
    return page


def marks(campaign: Path) -> dict[int, bool]:
    with CampaignStore.open(campaign) as store:
        return {turns.facet_id: turns.is_done for turns in store.turns()}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", ["day", "night"])
def test_sheet_fits_every_screen_and_everybody(browser: Browser, sheet_address: str, size: str, mode: str) -> None:
    width, height = SIZES[size]
    scheme = "dark" if mode == "night" else "light"
    page = opened(browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme), sheet_address)
    # what people work from is the first thing they see, the button under their thumb included
    expect(page.locator("#sheet-facet")).to_be_in_viewport()
    expect(page.locator("#sheet-done")).to_be_in_viewport()
    page.locator("#sheet-section summary").click()
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    page.evaluate("() => scrollTo(0, 0)")
    assert page.evaluate(OVERLAPS) == []
    found = axe.Axe().run(page)
    serious = [each for each in found["violations"] if each["impact"] in ("serious", "critical")]
    assert [(each["id"], each["nodes"][0]["html"]) for each in serious] == []
    if mode == "night":
        assert page.evaluate(NOT_RED) == []
    page.close()


def test_order_is_that_of_a_ladder_behind_the_mirror(page: Page, by_hand: Path, sheet_address: str) -> None:
    """From behind, left is +x; a ladder goes from left to right once, and up at each of its places."""
    opened(page, sheet_address)
    with CampaignStore.open(by_hand) as store:
        config = InstrumentConfig.from_json(store.config_json, "a test")
    at = {facet.id: facet.position_m for facet in instrument_of(config).reflector.facets}
    expect(page.locator("#sheet-side")).to_have_text("Seen from BEHIND the mirror.")
    groups = page.locator("#sheet-list .chips").all()
    ids = [[int(re.findall(r"\d+", text)[0]) for text in group.locator("button").all_inner_texts()] for group in groups]
    lefts = [min(-at[facet_id][0] for facet_id in group) for group in ids]
    assert lefts == sorted(lefts)
    for group in ids:
        heights = [at[facet_id][1] for facet_id in group]
        assert heights == sorted(heights)
    # drawn as seen from there: a facet with larger x stands further left on the screen
    boxes = page.locator("#sheet-map .mirror-name", has_text=re.compile(r"\d"))
    seen = {int(boxes.nth(i).text_content() or ""): boxes.nth(i).bounding_box() for i in range(boxes.count())}
    for one in at:
        for other in at:
            if at[one][0] > at[other][0] + 0.1:
                assert seen[one]["x"] < seen[other]["x"]  # type: ignore[index]
            if at[one][1] > at[other][1] + 0.1:
                assert seen[one]["y"] < seen[other]["y"]  # type: ignore[index]


def test_marks_need_the_token(page: Page, by_hand: Path, sheet_address: str) -> None:
    opened(page, sheet_address)
    page.locator("#sheet-done").click()
    expect(page.locator("#sheet-reply")).to_contain_text("token is missing")
    assert not any(marks(by_hand).values())


def test_facets_are_checked_off_and_taken_back_until_the_campaign_goes_on(
    page: Page, watcher: Watcher, by_hand: Path, sheet_address: str
) -> None:
    opened(page, sheet_address + WITH_TOKEN)
    first = int(page.locator("#sheet-facet").inner_text().removeprefix("Facet "))
    page.locator("#sheet-done").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#sheet-state")).to_have_text("✓ done")
    assert marks(by_hand)[first]
    expect(page.locator("#sheet-reply")).to_contain_text(f"1 facet marked as done: {first}; 5 to go")
    expect(page.locator("#sheet-left")).to_have_text("1 of 6 facets done")
    expect(page.locator("#sheet-list .chip").first).to_have_attribute("aria-label", f"facet {first}: done")
    expect(page.locator("#sheet-next")).to_be_focused()  # nothing is marked by a key that is pressed twice

    undo = page.get_by_role("button", name=f"Undo: facet {first} is not done")
    undo.click(force=True)  # a second tap on the same place
    expect(undo).to_have_attribute("aria-disabled", "false")
    assert marks(by_hand)[first]
    undo.click()
    expect(page.locator("#sheet-state")).to_have_text("to turn")
    assert not marks(by_hand)[first]
    expect(page.locator("#journal")).to_contain_text(f"not done after all: facet {first}")
    expect(page.locator("#sheet-left")).to_have_text("0 of 6 facets done")

    for n_left in range(5, 0, -1):
        page.locator("#sheet-done").click()
        expect(page.locator("#sheet-reply")).to_contain_text(f"{n_left} to go")
        page.locator("#sheet-next").click()
    expect(page.locator("#sheet-notes")).to_contain_text("last one")
    page.locator("#sheet-done").click()
    expect(page.locator("#state")).not_to_have_text("awaiting operator")
    assert all(marks(by_hand).values())

    # the sheet stays to be read, for whoever comes later as well
    expect(page.locator("#sheet-done")).to_be_hidden()
    expect(page.locator("#sheet-undo")).to_be_hidden()
    opened(page, sheet_address)
    expect(page.locator("#sheet-choice option")).to_have_text(["cycle 1"])
    expect(page.locator("#sheet-left")).to_have_text("6 of 6 facets done")
    expect(page.locator("#sheet-done")).to_be_hidden()
    expect(page.locator("#sheet-undo")).to_be_hidden()
    page.locator("#sheet-section summary").click()
    expect(page.locator("#sheet-table tr")).to_have_count(6)
    expect(page.locator("#sheet-table")).to_contain_text("clockwise")
    assert watcher.complaints == []

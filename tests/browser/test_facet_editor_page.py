"""The facet map editor as a person uses it, in headless Chromium over a twin picture of FACT's reflector."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

sys.path.append(str(Path(__file__).parents[1] / "unit" / "app"))

from facet_editor_rig import TOKEN, Editor, running_editor

from namod_ctl.store.facet_tables import read_polygon_table

COLUMNS, ROWS = 1024, 768
MARKED = (13, 18, 11, 33)


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    with running_editor(tmp_path_factory.mktemp("editor-page")) as running:
        yield running


def screen(page: Page, place_px: np.ndarray) -> tuple[float, float]:
    """Where a place of the picture is on the screen while all of it is shown."""
    box = page.locator("#board").bounding_box()
    assert box is not None
    scale = min(box["width"] / COLUMNS, box["height"] / ROWS)
    left = box["x"] + (box["width"] - scale * COLUMNS) / 2.0
    top = box["y"] + (box["height"] - scale * ROWS) / 2.0
    return left + (place_px[0] + 0.5) * scale, top + (place_px[1] + 0.5) * scale


def click(page: Page, place_px: np.ndarray) -> None:
    page.mouse.click(*screen(page, place_px))


def opened(page: Page, editor: Editor) -> None:
    page.goto(f"http://{editor.host}/#{TOKEN}")
    expect(page.locator("#count")).to_have_text("30 outlines of 30 facets.")


def marked(page: Page, editor: Editor, ids=MARKED) -> None:
    opened(page, editor)
    for facet_id in ids:
        page.fill("#number", str(facet_id))
        click(page, editor.centres_px[facet_id])
        expect(page.locator("#status")).to_contain_text(f"Facet {facet_id} marked")
    expect(page.locator("#fit")).to_contain_text("px rms")


def saved(page: Page, editor: Editor) -> dict[int, np.ndarray]:
    page.click("#save")
    expect(page.locator("#saved")).to_contain_text("Saved: 30 outlines")
    return read_polygon_table(editor.out)


def worst_px(found: dict[int, np.ndarray], editor: Editor) -> float:
    return max(
        float(np.linalg.norm(found[i][:, None] - true[None], axis=2).min(axis=1).max())
        for i, true in editor.outlines_px.items()
    )


def test_mark_4_facets_move_a_corner_undo_and_save(page, editor, watcher):
    marked(page, editor)
    expect(page.locator("#marks li")).to_have_count(4)
    assert worst_px(saved(page, editor), editor) < 2.0  # from clicks on whole pixels of the screen

    page.check("input[value=move]")
    corner = editor.outlines_px[0][0]
    page.mouse.move(*screen(page, corner))
    page.mouse.down()
    page.mouse.move(*screen(page, corner - (0.0, 12.0)), steps=4)
    page.mouse.up()
    expect(page.locator("#status")).to_contain_text("Corner of facet 0")
    moved = saved(page, editor)
    assert np.linalg.norm(moved[0] - (corner - (0.0, 12.0)), axis=1).min() < 3.0

    expect(page.locator("#marks li").first).to_contain_text("px off")  # the residuals stay in sight

    page.keyboard.press("Control+z")
    expect(page.locator("#status")).to_have_text("Undone.")
    assert worst_px(saved(page, editor), editor) < 2.0
    page.click("#redo")
    np.testing.assert_array_equal(saved(page, editor)[0], moved[0])

    assert watcher.complaints == []
    assert all(url.startswith(f"http://{editor.host}/") for url in watcher.asked)


def test_exchanged_ids_are_pointed_at(page, editor):
    opened(page, editor)
    for facet_id, place in ((13, 11), (18, 18), (11, 13), (33, 33), (10, 10)):
        page.fill("#number", str(facet_id))
        click(page, editor.centres_px[place])
    expect(page.locator("#fit")).to_contain_text("the ids of 13 and 11 are exchanged")
    expect(page.locator("#marks .bad")).to_have_count(2)


def test_a_proposal_is_shown_and_taken(page, editor):
    marked(page, editor)
    page.click("#propose")
    expect(page.locator("#proposal")).to_be_visible()
    page.click("#accept")
    expect(page.locator("#proposal")).to_be_hidden()
    assert worst_px(saved(page, editor), editor) < 0.5


def test_a_facet_is_drawn_numbered_and_deleted_by_hand(page, editor):
    marked(page, editor)
    page.check("input[value=move]")
    click(page, editor.centres_px[16])
    expect(page.locator("#status")).to_have_text("Facet 16.")
    page.click("#delete")
    expect(page.locator("#missing-text")).to_contain_text("out: 16")
    page.click("#save")
    expect(page.locator("#saved")).to_contain_text("facets 16 have no outline")

    page.check("input[value=draw]")
    page.fill("#number", "25")
    outline = editor.outlines_px[16]
    for corner in (*outline, outline[0]):
        click(page, corner)
    expect(page.locator("#faults")).to_contain_text("Facet 25: is drawn twice")
    page.check("input[value=move]")
    click(page, editor.centres_px[16])
    page.fill("#number", "16")
    page.click("#renumber")
    expect(page.locator("#faults li")).to_have_count(0)
    assert worst_px(saved(page, editor), editor) < 2.0


def test_keys_alone_mark_and_undo(page, editor):
    opened(page, editor)
    page.fill("#number", "13")
    page.locator("#board").focus()
    start = np.array([COLUMNS, ROWS]) / 2.0
    away = np.rint(editor.centres_px[13] - start).astype(int)
    for key, steps in (("ArrowRight", away[0]), ("ArrowLeft", -away[0]), ("ArrowDown", away[1]), ("ArrowUp", -away[1])):
        for _ in range(max(steps, 0) // 10):
            page.keyboard.press(f"Shift+{key}")
        for _ in range(max(steps, 0) % 10):
            page.keyboard.press(key)
    page.keyboard.press("Enter")
    expect(page.locator("#marks li")).to_have_text("facet 13")
    page.keyboard.press("Control+z")
    expect(page.locator("#marks li")).to_have_count(0)


def test_without_the_token_nothing_is_written(page, editor):
    editor.out.write_text("as it was")
    page.goto(f"http://{editor.host}/")
    expect(page.locator("#count")).to_have_text("30 outlines of 30 facets.")
    page.click("#save")
    expect(page.locator("#saved")).to_contain_text("token is missing or wrong")
    assert editor.out.read_text() == "as it was"


@pytest.mark.parametrize("mode", ["night", "day"])
def test_axe_finds_no_serious_fault(page, editor, mode):
    axe = pytest.importorskip("axe_core_python.sync_playwright")
    page.emulate_media(color_scheme="dark" if mode == "night" else "light")
    marked(page, editor)
    expect(page.locator("html")).to_have_attribute("data-mode", mode)
    page.click("summary")
    found = axe.Axe().run(page)
    serious = [fault for fault in found["violations"] if fault["impact"] in ("serious", "critical")]
    assert not serious, [(fault["id"], [node["target"] for node in fault["nodes"]]) for fault in serious]


def test_a_finger_marks_and_two_zoom(browser, editor):
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    page = context.new_page()
    opened(page, editor)
    for facet_id in MARKED:
        page.fill("#number", str(facet_id))
        page.touchscreen.tap(*screen(page, editor.centres_px[facet_id]))
    expect(page.locator("#fit")).to_contain_text("px rms")
    assert worst_px(saved(page, editor), editor) < 8.0  # a pixel of this screen is 2.8 of the picture

    page.evaluate("() => scrollTo(0, 0)")  # saving has scrolled down
    x, y = screen(page, np.array([COLUMNS, ROWS]) / 2.0)
    finger = context.new_cdp_session(page)
    for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 120), ("touchEnd", None)):
        points = [] if apart is None else [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    # Now three times as large: a tap beside the middle is a third as far away in the picture.
    page.fill("#number", "16")
    page.evaluate("() => scrollTo(0, 0)")
    x, y = screen(page, np.array([COLUMNS, ROWS]) / 2.0)
    page.touchscreen.tap(x + 60.0, y)
    expect(page.locator("#status")).to_contain_text("Facet 16 marked at")
    column = float(re.search(r"at ([\d.]+),", page.inner_text("#status"))[1])
    scale = page.locator("#board").bounding_box()["width"] / COLUMNS
    assert column == pytest.approx(COLUMNS / 2.0 + 60.0 / scale / 3.0, abs=6.0)
    context.close()


@pytest.mark.parametrize("size", [(390, 844), (2560, 1440)])
def test_it_fits_a_telephone_and_a_large_screen_and_remembers_the_night(page, editor, size):
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.emulate_media(color_scheme="dark")
    opened(page, editor)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= size[0]
    assert page.evaluate("() => getComputedStyle(document.documentElement).backgroundColor") == "rgb(0, 0, 0)"
    page.click("#mode")
    expect(page.locator("html")).to_have_attribute("data-mode", "day")
    page.reload()
    expect(page.locator("html")).to_have_attribute("data-mode", "day")

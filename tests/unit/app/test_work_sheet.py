"""The page's work sheet: whoever turns bolts as it says aligns the facet, and it says what the printed sheets say."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from typing import Any, Literal

import numpy as np
import pytest
from output_samples import alignment_of, facet_alignment, honeycomb, instrument_of, tripod, unknown_facet

from namod_ctl.app.dashboard.work_sheet import work_sheet
from namod_ctl.app.sheets.instructions import facet_instructions
from namod_ctl.app.sheets.ladder_sheets import _pages, plan_sheets
from namod_ctl.core.flags import FacetFlag
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment

Sense = Literal["clockwise", "counterclockwise"]
N_FACETS = 12
FORBIDDEN, CUT = 5, 7  # ids


def night(sense: Sense = "clockwise", side: Literal["front", "back"] = "back") -> tuple[Instrument, Alignment]:
    """A dozen facets off by some arcmin, as perfect records would show them; one that nobody must turn."""
    mount = replace(tripod(), turn_raises_leg=sense)
    telescope = replace(instrument_of(honeycomb(N_FACETS, 0.6, 4.9), {}, mount=mount), bolts_seen_from=side)
    rng = np.random.default_rng(11)
    facets = []
    for facet_id in telescope.reflector.ids:
        if facet_id == FORBIDDEN:
            facets.append(unknown_facet(facet_id))
            continue
        facet = facet_alignment(facet_id, rng.normal(0.0, 0.15, 2), mount)
        flags = FacetFlag.PSF_CUT_BY_SCAN_EDGE if facet_id == CUT else FacetFlag.NONE
        facets.append(replace(facet, bolt_turn_deg=mount.turn_deg_of_travel(facet.leg_travel_m), flags=flags))
    return telescope, alignment_of(facets)


def facets_of(sheet: dict[str, Any]) -> dict[int, dict[str, Any]]:
    return {facet["id"]: facet for each in sheet["sheets"] for facet in each["facets"]}


def degrees(words: str) -> float:
    """What a person reads in `1 turn + 52°`."""
    turns, rest = re.search(r"(\d+) turn", words), re.search(r"([\d.]+)°", words)
    return 360.0 * int(turns[1] if turns else 0) + float(rest[1] if rest else 0.0)


@pytest.mark.parametrize("sense", ["clockwise", "counterclockwise"])
def test_who_turns_as_the_sheet_says_aligns_the_facet(sense: Sense) -> None:
    """A screw whose turn in the config's sense raises the leg; the facet's normal ends where it should be."""
    telescope, alignment = night(sense)
    found = facets_of(work_sheet(telescope, alignment, []))
    for facet in alignment.facets:
        if facet.facet_id == FORBIDDEN:
            continue
        mount = telescope.mounts[facet.facet_id]
        assert mount.pitch_m_per_turn is not None
        raised_m = [
            (1.0 if bolt["sense"] == sense else -1.0) * degrees(bolt["turn"]) / 360.0 * mount.pitch_m_per_turn
            for bolt in found[facet.facet_id]["bolts"]
        ]
        tilt_rad = mount.tilt_of_travel(np.array(raised_m))
        # half a goniometer's step of 10 deg at legs 0.295 m from the centre
        tolerance_rad = 1e-3 * 5.0 / 360.0 / 0.295 * 1.2
        np.testing.assert_allclose(tilt_rad, facet.tilt_correction_rad, atol=tolerance_rad)
        assert np.hypot(*facet.tilt_correction_rad) > tolerance_rad or not raised_m


@pytest.mark.parametrize(("side", "to_right"), [("back", -1.0), ("front", 1.0)])
def test_bolts_lie_as_seen_from_the_side_of_the_config(side: Literal["front", "back"], to_right: float) -> None:
    """From behind, +x of the telescope is to the left (DESIGN, section 2); up stays up."""
    telescope, alignment = night(side=side)
    sheet = work_sheet(telescope, alignment, [])
    assert ("BEHIND" if side == "back" else "FRONT") in sheet["side"]
    for facet_id, facet in facets_of(sheet).items():
        middle = np.mean(facet["outline"], axis=0)
        position_m = next(each.position_m for each in telescope.reflector.facets if each.id == facet_id)
        np.testing.assert_allclose(middle, position_m[:2] * [to_right, 1.0], atol=2e-3)
        legs = np.array(facet["legs"]) - middle
        np.testing.assert_allclose(legs, telescope.mounts[facet_id].legs_m * [to_right, 1.0], atol=2e-3)


@pytest.mark.parametrize("sense", ["clockwise", "counterclockwise"])
def test_order_and_words_are_those_of_the_printed_sheets(sense: Sense) -> None:
    telescope, alignment = night(sense)
    sheet = work_sheet(telescope, alignment, [1, 2])
    instructions = facet_instructions(alignment, telescope.goniometer_resolution_rad)
    planned = plan_sheets(telescope.reflector, [facet.facet_id for facet in alignment.facets], "back")
    pages = list(_pages(telescope, instructions, "a test", date(2026, 11, 22)))
    assert len(pages) == len(planned) == len(sheet["sheets"])
    for page, each, plan in zip(pages, sheet["sheets"], planned, strict=True):
        assert {facet["id"] for facet in each["facets"]} == set(plan.facet_ids)
        printed = [" ".join(text.get_text().replace("counter-\n", "counter").split()) for text in page.axes[0].texts]
        assert each["name"] in printed
        assert sheet["side"] in printed
        assert any(sheet["stand"].rstrip(".") in text for text in printed)
        assert sheet["senses"] in printed
        at = 0
        for facet in each["facets"]:  # from the top of the page down, in the same order
            at = printed.index(str(facet["id"]), at) + 1
            for bolt in facet["bolts"]:
                at = printed.index(bolt["turn"], at) + 1
                if bolt["sense"]:
                    at = printed.index(bolt["sense"], at) + 1
            for note in facet["notes"]:
                assert any(note in text for text in printed)
    found = facets_of(sheet)
    assert found[CUT]["notes"]
    assert sheet["done"] == [1, 2]


def test_nobody_is_told_a_number_for_a_facet_that_must_not_be_turned() -> None:
    telescope, alignment = night()
    sheet = work_sheet(telescope, alignment, [])
    facet = facets_of(sheet)[FORBIDDEN]
    assert (facet["verdict"], facet["bolts"]) == ("do not turn", [])
    assert "dark" in facet["why"]
    last = next(each["facets"] for each in sheet["sheets"] if facet in each["facets"])
    assert last[-1] is facet  # as printed: in a box at the end of its sheet

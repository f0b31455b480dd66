"""What people are told to turn: the list and the sheets."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from output_samples import (
    FACT_DATA,
    alignment_of,
    facet_alignment,
    fact_response_table,
    honeycomb,
    instrument_of,
    random_alignment,
    tripod,
    unknown_facet,
)

from namod_ctl.app.sheets.instructions import Verdict, facet_instructions, instructions_to_csv, settable_turn_deg
from namod_ctl.app.sheets.ladder_sheets import (
    MOST_FACETS_PER_SHEET,
    _pages,
    plan_sheets,
    sheets_to_pdf,
    turn_in_words,
)
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import deg_to_rad, rad_to_deg

TEN_DEG = deg_to_rad(10.0)
WRITTEN = date(2026, 11, 22)


def rows_of(instructions, n_bolts=3):
    return list(csv.DictReader(io.StringIO(instructions_to_csv(instructions, n_bolts))))


@pytest.mark.skipif(not FACT_DATA.is_dir(), reason="the FACT records of 2014 are not beside the project")
def test_the_published_turns_come_out_of_the_brightest_records():
    table = fact_response_table()
    theta_deg = rad_to_deg(table.theta_rad[np.argmax(table.response, axis=0)])
    alignment = alignment_of([facet_alignment(i, at) for i, at in zip(table.facet_ids, theta_deg, strict=True)])
    rows = {row["facet_id"]: row for row in rows_of(facet_instructions(alignment, TEN_DEG))}
    published = list(csv.DictReader((FACT_DATA / "published_bolt_turns.csv").read_text().splitlines()))
    assert len(published) == 15
    for row in published:
        assert {key: rows[row["facet_id"]][key] for key in row} == row


def test_unreliable_facets_carry_no_number():
    facets = [
        facet_alignment(1, flags=FacetFlag.UNRELIABLE | FacetFlag.FEW_RECORDS),
        facet_alignment(2, flags=FacetFlag.BEYOND_TRAVEL_LIMIT),
        unknown_facet(3),
        facet_alignment(4, flags=FacetFlag.PSF_CUT_BY_SCAN_EDGE),
    ]
    instructions = facet_instructions(alignment_of(facets), TEN_DEG)
    assert [instruction.verdict for instruction in instructions] == [Verdict.DO_NOT_TURN] * 3 + [Verdict.TURN]
    rows = rows_of(instructions)
    for row in rows[:3]:
        assert row["bolt_1_deg"] == row["bolt_2_deg"] == row["bolt_3_deg"] == ""
    assert rows[0]["flags"] == "UNRELIABLE|FEW_RECORDS"
    assert rows[3]["bolt_1_deg"] != ""
    assert rows[3]["flags"] == "PSF_CUT_BY_SCAN_EDGE"
    assert all(instruction.reasons for instruction in instructions)


def test_turns_within_half_the_resolution_need_not_be_made():
    # one arm-length of 0.295 m, 1 mm pitch: 1 deg of bolt is (1 mm / 360) / 0.295 m of tilt
    deg_of_bolt_as_theta_deg = float(rad_to_deg(2 * 1e-3 / 360 / 0.295))
    just_below = facet_alignment(1, (4.9 * deg_of_bolt_as_theta_deg, 0.0))
    just_above = facet_alignment(2, (5.1 * deg_of_bolt_as_theta_deg, 0.0))
    rows = rows_of(facet_instructions(alignment_of([just_below, just_above]), TEN_DEG))
    assert [row["flags"] for row in rows] == ["NO_TURN_NEEDED", ""]
    assert rows[0]["bolt_1_deg"] == "5"  # stated all the same
    assert rows[0]["bolt_2_deg"] == "-2"


@pytest.mark.parametrize(
    ("turn_deg", "step_deg", "settable_deg"),
    [(2.4, 5.0, 0.0), (-2.4, 5.0, 0.0), (2.6, 5.0, 5.0), (-123.0, 5.0, -125.0), (0.34, 0.1, 0.3), (7.0, 90.0, 0.0)],
)
def test_people_read_what_the_goniometer_can_show(turn_deg, step_deg, settable_deg):
    found = settable_turn_deg(turn_deg, step_deg)
    assert found == settable_deg
    assert not str(found).startswith("-0.0")


def test_the_list_for_programs_is_not_rounded_to_the_goniometer():
    facet = facet_alignment(1, (0.1, 0.03))
    (row,) = rows_of(facet_instructions(alignment_of([facet]), TEN_DEG))
    listed = [int(row[f"bolt_{n}_deg"]) for n in (1, 2, 3)]
    assert listed == [round(turn) for turn in facet.bolt_turn_deg]
    assert any(turn % 10 for turn in listed)


def test_hexapods_have_six_columns_and_a_telescope_without_bolts_none():
    hexapod = tripod(legs=6)
    six = rows_of(facet_instructions(alignment_of([facet_alignment(1, mount=hexapod)]), TEN_DEG), n_bolts=6)
    assert list(six[0]) == ["facet_id", *(f"bolt_{n}_deg" for n in range(1, 7)), "flags"]
    driven = facet_instructions(alignment_of([facet_alignment(1, mount=tripod(pitch_m=None))]), TEN_DEG)
    assert driven[0].verdict is Verdict.NO_BOLTS
    assert list(rows_of(driven, n_bolts=0)[0]) == ["facet_id", "flags"]


@pytest.mark.parametrize("n_facets", [1, 29, 198])
def test_sheets_hold_every_facet_once_and_the_ladder_goes_one_way(n_facets):
    reflector = honeycomb(n_facets, 0.606, 4.889)
    sheets = plan_sheets(reflector, reflector.ids)
    assert sorted(facet_id for sheet in sheets for facet_id in sheet.facet_ids) == sorted(reflector.ids)
    position = {facet.id: facet.position_m for facet in reflector.facets}
    place_x = []
    for sheet in sheets:
        assert 1 <= len(sheet.facet_ids) <= MOST_FACETS_PER_SHEET
        x = [position[facet_id][0] for facet_id in sheet.facet_ids]
        heights = [position[facet_id][1] for facet_id in sheet.facet_ids]
        assert heights == sorted(heights)
        assert max(x) - min(x) < 0.606  # within reach without moving the ladder
        place_x.append((sheet.place, min(x)))
    assert [place for place, _ in place_x] == sorted(place for place, _ in place_x)
    reach_m = max(x for _, x in place_x) - min(x for _, x in place_x)
    assert place_x[-1][0] <= reach_m / (0.5 * 0.606) + 1


@pytest.mark.parametrize(
    ("turn_deg", "words"),
    [
        (0, "0°"),
        (285, "285°"),
        (360, "1 turn"),
        (412, "1 turn + 52°"),
        (725, "2 turns + 5°"),
        (722.5, "2 turns + 2.5°"),
    ],
)
def test_large_turns_are_counted_in_turns(turn_deg, words):
    assert turn_in_words(turn_deg) == words


def text_of(pdf, tmp_path):
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext (poppler-utils) is not installed")
    (tmp_path / "sheets.pdf").write_bytes(pdf)
    return subprocess.run(
        ["pdftotext", "sheets.pdf", "-"], cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout


def test_sheets_say_the_sense_of_every_turn(tmp_path):
    reflector = honeycomb(3, 0.606, 4.889)
    facets = [
        facet_alignment(1, (0.1, 0.0)),  # bolt 1 is at +x and must rise: the star is seen from its side
        facet_alignment(2, flags=FacetFlag.UNRELIABLE, remarks=("rests on record 17, a wrong star",)),
        facet_alignment(3, (0.0, 0.0)),
    ]
    alignment = alignment_of(facets)
    assert facets[0].bolt_turn_deg[0] > 0
    instrument = instrument_of(reflector, {})
    text = text_of(sheets_to_pdf(instrument, facet_instructions(alignment, TEN_DEG), "headline", WRITTEN), tmp_path)
    turns_deg = [10 * round(abs(turn) / 10) for turn in facets[0].bolt_turn_deg]  # the goniometer's marks
    assert [word for word in re.findall(r"(\d+)°", text) if word != "0"] == [str(turn) for turn in turns_deg]
    assert "2026-11-22" in text
    assert "Turned by" in text
    assert "DO NOT TURN" in text
    assert "record 17" in text
    assert "no turn needed" in text
    pages = list(_pages(instrument, facet_instructions(alignment, TEN_DEG), "headline", WRITTEN))
    words = [t.get_text().replace("-\n", "") for page in pages for t in page.axes[0].texts]
    senses = [word for word in words if word in ("clockwise", "counterclockwise")]
    assert senses == ["clockwise", "counterclockwise", "counterclockwise"]  # bolt 1 up, bolts 2 and 3 down


def test_a_telescope_without_bolts_gets_one_page_that_says_so(tmp_path):
    reflector = honeycomb(3, 0.606, 4.889)
    driven = tripod(pitch_m=None)
    alignment = alignment_of([facet_alignment(i, mount=driven) for i in reflector.ids])
    instrument = instrument_of(reflector, {}, mount=driven)
    text = text_of(sheets_to_pdf(instrument, facet_instructions(alignment, TEN_DEG), "headline", WRITTEN), tmp_path)
    assert "has no bolts" in text
    assert text.count("\f") == 1


def test_sheets_of_a_large_telescope():
    reflector = honeycomb(198, 1.51, 28.0)
    instructions = facet_instructions(random_alignment(reflector), TEN_DEG)
    assert sheets_to_pdf(instrument_of(reflector, {}), instructions, "headline", WRITTEN).startswith(b"%PDF")


def test_sheets_are_drawn_from_behind_unless_the_config_says_otherwise(tmp_path):
    reflector = honeycomb(29, 0.606, 4.889)
    places = {facet.id: facet.position_m[0] for facet in reflector.facets}
    behind = plan_sheets(reflector, reflector.ids, "back")
    leftmost = {place: [i for sheet in behind if sheet.place == place for i in sheet.facet_ids] for place in (1,)}[1]
    assert min(places[i] for i in leftmost) > max(places.values()) - 0.606  # +x is at the left hand
    instructions = facet_instructions(alignment_of([facet_alignment(i) for i in reflector.ids]), TEN_DEG)
    instrument = instrument_of(reflector, {})
    texts = {}
    for side in ("back", "front"):
        texts[side] = text_of(
            sheets_to_pdf(replace(instrument, bolts_seen_from=side), instructions, "h", WRITTEN), tmp_path
        )
    assert "BEHIND" in texts["back"]
    assert "BEHIND" not in texts["front"]
    # the numbers are the same: one sheet holds the same turns per facet, whoever looks
    assert sorted(re.findall(r"\d+°", texts["back"])) == sorted(re.findall(r"\d+°", texts["front"]))


@pytest.mark.parametrize("side", ["front", "back"])
def test_bolts_are_where_the_person_sees_them(side):
    """Bolt 1 of a tripod is at telescope +x: right as seen from the focal point, left from behind."""
    reflector = honeycomb(1, 0.606, 4.889)
    instrument = replace(instrument_of(reflector, {}), bolts_seen_from=side)
    instructions = facet_instructions(alignment_of([facet_alignment(1, (0.1, 0.0))]), TEN_DEG)
    (page,) = _pages(instrument, instructions, "headline", WRITTEN)
    x_of_numbers = {t.get_text(): t.get_position()[0] for t in page.axes[0].texts if t.get_fontsize() == 9}
    assert (x_of_numbers["1"] > x_of_numbers["2"]) == (side == "front")

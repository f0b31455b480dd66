"""instructions.pdf: A4 sheets for the people who turn the bolts, one sheet per place of the ladder.

Black on white and told apart by words and shapes, never by colour: sheets are read under red light. Everything is drawn
as the person who turns the bolts sees it: from behind the mirror left and right are exchanged against telescope x.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from namod_ctl.app.sheets.facet_map import outlines_m
from namod_ctl.app.sheets.instructions import FacetInstruction, Verdict
from namod_ctl.optics.coordinates import factors_to_view, sense_of_turn
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.optics.reflector import Reflector

Array = NDArray[np.float64]

PDF_FILE = "instructions.pdf"
MOST_FACETS_PER_SHEET = 8  # as many as fit on a sheet in letters that are legible at arm's length

_WIDTH_MM, _HEIGHT_MM = 210.0, 297.0  # A4
_INCH_MM = 25.4
_LEFT_MM, _RIGHT_MM = 14.0, 196.0
_TABLE_TOP_MM, _TABLE_BOTTOM_MM = 203.0, 14.0
_SMALLEST_MAP_LETTERS_PT = 4.5
_MAP_MM = (132.0, 212.0, 64.0, 64.0)  # left, bottom, width, height
_BOLTS_PER_LINE = 3
_ARROW_RADIUS_MM = 5.2
_REACH_IN_FACETS = 0.75  # a person on a ladder reaches facets whose centres are this much of a facet's width further


@dataclass(frozen=True, slots=True)
class Sheet:
    """The facets of one sheet in the order of work; `place` counts the places of the ladder from 1."""

    place: int
    facet_ids: tuple[int, ...]


def plan_sheets(
    reflector: Reflector, facet_ids: Sequence[int], seen_from: Literal["front", "back"] = "front"
) -> tuple[Sheet, ...]:
    """Sheets in the order of work: the ladder moves from left to right once, at each place people climb upwards once.

    Left and right are those of a person in front of the reflector, at its focal point, or behind it. At one place
    of the ladder lie the facets whose centres are within 0.75 of a facet's width; where these are more than
    fit on a sheet, they are split into sheets of equal length.
    """
    to_view = factors_to_view(seen_from)
    positions = {facet.id: to_view * facet.position_m[:2] for facet in reflector.facets}
    reach_m = _REACH_IN_FACETS * float(np.median([facet.width_m for facet in reflector.facets]))
    from_left = sorted(facet_ids, key=lambda facet_id: float(positions[facet_id][0]))
    places: list[list[int]] = []
    for facet_id in from_left:
        if not places or positions[facet_id][0] - positions[places[-1][0]][0] > reach_m:
            places.append([])
        places[-1].append(facet_id)
    sheets = []
    for number, place in enumerate(places, start=1):
        upwards = sorted(place, key=lambda facet_id: float(positions[facet_id][1]))
        n_sheets = -(-len(upwards) // MOST_FACETS_PER_SHEET)
        parts = np.array_split(np.array(upwards), n_sheets)
        sheets += [Sheet(number, tuple(int(facet_id) for facet_id in part)) for part in parts]
    return tuple(sheets)


def sheets_to_pdf(
    instrument: Instrument, instructions: Sequence[FacetInstruction], headline: str, written_on: date
) -> bytes:
    """The PDF with all sheets; one page that says so where no facet has bolts."""
    data = io.BytesIO()
    with PdfPages(data, metadata={"Title": headline, "Creator": "namod-ctl"}) as pdf:
        for page in _pages(instrument, instructions, headline, written_on):
            pdf.savefig(page)
    return data.getvalue()


def _pages(
    instrument: Instrument, instructions: Sequence[FacetInstruction], headline: str, written_on: date
) -> Iterator[Figure]:
    if all(instruction.verdict is Verdict.NO_BOLTS for instruction in instructions):
        page, axes = _blank_page()
        _write(axes, _LEFT_MM, 270.0, headline, 13, weight="bold")
        text = "This telescope has no bolts: its legs are driven. Their travels are in alignment.json (leg_travel_m)."
        _write(axes, _LEFT_MM, 255.0, textwrap.fill(text, 80), 11)
        yield page
        return
    by_id = {instruction.facet_id: instruction for instruction in instructions}
    to_view = factors_to_view(instrument.bolts_seen_from)
    outlines = {facet_id: to_view * outline for facet_id, outline in outlines_m(instrument.reflector).items()}
    sheets = plan_sheets(instrument.reflector, list(by_id), instrument.bolts_seen_from)
    for number, sheet in enumerate(sheets, start=1):
        page, axes = _blank_page()
        _draw_header(axes, instrument, headline, f"Sheet {number} of {len(sheets)} · ladder place {sheet.place}")
        _draw_signature(axes, written_on)
        _draw_key_map(page, outlines, sheet)
        _draw_table(axes, instrument, [by_id[facet_id] for facet_id in sheet.facet_ids])
        yield page


def _blank_page() -> tuple[Figure, Axes]:
    """A page and axes over all of it, in mm from its lower left corner."""
    page = Figure(figsize=(_WIDTH_MM / _INCH_MM, _HEIGHT_MM / _INCH_MM))
    axes = page.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, _WIDTH_MM)
    axes.set_ylim(0.0, _HEIGHT_MM)
    axes.set_axis_off()
    return page, axes


def _write(axes: Axes, x_mm: float, y_mm: float, text: str, size_pt: float, **style: str | float) -> None:
    axes.text(x_mm, y_mm, text, fontsize=size_pt, color="black", **({"va": "top", "ha": "left"} | style))  # type: ignore[arg-type]


def _draw_header(axes: Axes, instrument: Instrument, headline: str, sheet_name: str) -> None:
    _write(axes, _LEFT_MM, 285.0, sheet_name, 17, weight="bold")
    _write(axes, _LEFT_MM, 275.0, textwrap.fill(headline, 62), 10)
    is_behind = instrument.bolts_seen_from == "back"
    axes.add_patch(Rectangle((_LEFT_MM, 229.0), 114.0, 28.0, fc="none", ec="black", lw=2.0))
    where = "Seen from BEHIND the mirror" if is_behind else "Seen from the FRONT of the mirror"
    _write(axes, _LEFT_MM + 3.0, 254.5, where, 15, weight="bold")
    senses = sorted({mount.turn_raises_leg for mount in instrument.mounts.values() if mount.pitch_m_per_turn})
    raises = (
        f"{senses[0].capitalize()} raises the facet, to the sky." if len(senses) == 1 else "Senses differ: read each."
    )
    lines = ["Arrows: the way to turn, looking at the bolt.", raises]
    for line, text in enumerate(lines):
        _write(axes, _LEFT_MM + 3.0, 245.0 - 8.0 * line, text, 11, weight="bold")
    side = "stand behind the mirror and look at its back" if is_behind else "look at the mirror from its focal point"
    lines = [
        f"Left and right are yours when you {side}. Work from the top of the sheet down: the lowest facet comes first.",
        "Turn all bolts of a facet, then tick it. Map: black facets are on this sheet.",
    ]
    _write(axes, _LEFT_MM, 226.0, "\n".join(textwrap.fill(line, 68) for line in lines), 8.5, linespacing=1.2)


def _draw_signature(axes: Axes, written_on: date) -> None:
    """At the foot of the sheet: when it was written, and room for who turned and when."""
    y_mm = 8.0
    _write(axes, _LEFT_MM, y_mm, f"Written {written_on.isoformat()}", 9, va="center")
    for x_mm, name, end_mm in ((62.0, "Turned by", 128.0), (134.0, "Date, time", _RIGHT_MM)):
        _write(axes, x_mm, y_mm, name, 9, va="center")
        axes.plot([x_mm + 18.0, end_mm], [y_mm - 2.0, y_mm - 2.0], color="black", lw=0.8)


def _draw_key_map(page: Figure, outlines: Mapping[int, Array], sheet: Sheet) -> None:
    left, bottom, width, height = _MAP_MM
    key_map = page.add_axes((left / _WIDTH_MM, bottom / _HEIGHT_MM, width / _WIDTH_MM, height / _HEIGHT_MM))
    on_sheet = [outlines[facet_id] for facet_id in sheet.facet_ids]
    key_map.add_collection(
        PolyCollection(list(outlines.values()), facecolors="white", edgecolors="0.45", linewidths=0.5)
    )
    key_map.add_collection(PolyCollection(on_sheet, facecolors="black", edgecolors="white", linewidths=0.5))
    corners = np.concatenate(list(outlines.values()))
    margin = 0.01 * np.ptp(corners, axis=0)
    lowest, highest = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    pt_per_m = min((width, height) / (highest - lowest)) * 72.0 / _INCH_MM
    for facet_id, outline in outlines.items():
        size_pt = 0.3 * pt_per_m * float(np.ptp(outline[:, 0]))
        if size_pt < _SMALLEST_MAP_LETTERS_PT and facet_id not in sheet.facet_ids:
            continue
        x, y = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
        colour = "white" if facet_id in sheet.facet_ids else "0.3"
        key_map.text(
            x, y, str(facet_id), fontsize=max(size_pt, 2.0), color=colour, ha="center", va="center", weight="bold"
        )
    key_map.set_xlim(lowest[0], highest[0])
    key_map.set_ylim(lowest[1], highest[1])
    key_map.set_aspect("equal")
    key_map.set_axis_off()


def _draw_table(axes: Axes, instrument: Instrument, instructions: Sequence[FacetInstruction]) -> None:
    """One row per facet, the lowest facet of the reflector first; those not to be turned in a box at the end."""
    to_do = [instruction for instruction in instructions if instruction.verdict is not Verdict.DO_NOT_TURN]
    forbidden = [instruction for instruction in instructions if instruction.verdict is Verdict.DO_NOT_TURN]
    row_mm = (_TABLE_TOP_MM - _TABLE_BOTTOM_MM) / (MOST_FACETS_PER_SHEET + 0.5)
    top_mm = _TABLE_TOP_MM
    for instruction in to_do:
        mount = instrument.mounts[instruction.facet_id]
        _draw_row(axes, mount, factors_to_view(instrument.bolts_seen_from), instruction, top_mm, row_mm)
        top_mm -= row_mm
    if not forbidden:
        return
    box_mm = row_mm * (len(forbidden) + 0.35)
    top_mm -= 0.1 * row_mm
    frame = Rectangle((_LEFT_MM, top_mm - box_mm), _RIGHT_MM - _LEFT_MM, box_mm, fc="white", ec="black", lw=3, ls="--")
    axes.add_patch(frame)
    _write(axes, _LEFT_MM + 3.0, top_mm - 2.0, "DO NOT TURN any bolt of these facets", 13, weight="bold")
    for row, instruction in enumerate(forbidden):
        y_mm = top_mm - (row + 0.4) * row_mm
        _write(axes, _LEFT_MM + 12.0, y_mm - 0.1 * row_mm, str(instruction.facet_id), 22, weight="bold", ha="center")
        reasons = "; ".join(instruction.reasons) or "no reliable estimate"
        text = textwrap.shorten(f"Why: {reasons}.", 280, placeholder=" … (see alignment.json)")
        _write(axes, _LEFT_MM + 26.0, y_mm - 0.1 * row_mm, textwrap.fill(text, 92), 9)


def _draw_row(
    axes: Axes, mount: Mount, to_view: Array, instruction: FacetInstruction, top_mm: float, row_mm: float
) -> None:
    middle_mm = top_mm - 0.5 * row_mm
    axes.add_patch(Rectangle((_LEFT_MM, top_mm - row_mm), _RIGHT_MM - _LEFT_MM, row_mm, fc="none", ec="black", lw=0.8))
    _write(axes, _LEFT_MM + 12.0, middle_mm, str(instruction.facet_id), 24, weight="bold", ha="center", va="center")
    _draw_arms(axes, mount.legs_m * to_view, np.array([_LEFT_MM + 32.0, middle_mm]), 0.32 * row_mm)
    notes = [_NOTE_OF_FLAG[flag] for flag in instruction.flags if flag in _NOTE_OF_FLAG]
    if instruction.verdict is Verdict.NO_BOLTS:
        _write(axes, _LEFT_MM + 50.0, middle_mm, "no bolts: its legs are driven", 13, va="center")
    elif instruction.verdict is Verdict.NO_TURN_NEEDED:
        _write(axes, _LEFT_MM + 50.0, middle_mm, "ok: no turn needed", 15, va="center", weight="bold")
    else:
        column_mm = (_RIGHT_MM - 14.0 - _LEFT_MM - 48.0) / _BOLTS_PER_LINE
        n_lines = -(-len(instruction.settable_deg) // _BOLTS_PER_LINE)
        for bolt, turn_deg in enumerate(instruction.settable_deg):
            line, column = divmod(bolt, _BOLTS_PER_LINE)
            x_mm = _LEFT_MM + 48.0 + column * column_mm
            share = 1.0 if n_lines == 1 else 0.86  # of the row; below two lines a note still finds room
            y_mm = top_mm - (line + 0.5) * share * row_mm / n_lines
            _draw_turn(axes, x_mm, y_mm, bolt, turn_deg, 1.0 if n_lines == 1 else 1.25 / n_lines)
        axes.add_patch(Rectangle((_RIGHT_MM - 11.0, middle_mm - 3.5), 7.0, 7.0, fc="none", ec="black", lw=1.6))
    if notes:
        _write(axes, _LEFT_MM + 48.0, top_mm - row_mm + 0.8, "Note: " + "; ".join(notes), 7, va="bottom")


_NOTE_OF_FLAG = {
    "PSF_CUT_BY_SCAN_EDGE": "image cut by the edge of the recorded sky, record again after turning",
    "PSF_OUTSIDE_SCAN": "brightest outside the recorded sky, record again after turning",
    "FEW_RECORDS": "rests on few records",
    "LARGE_UNCERTAINTY": "rather uncertain",
}


def _draw_turn(axes: Axes, x_mm: float, y_mm: float, bolt: int, turn_deg: float, scale: float) -> None:
    """One bolt: its number, an arrow round it the way it is turned, and size and sense in words, whole turns apart."""
    radius_mm = _ARROW_RADIUS_MM * scale
    centre = np.array([x_mm + radius_mm, y_mm])
    _write(
        axes, float(centre[0]), y_mm - 0.1, str(bolt + 1), 15 * scale, weight="bold", ha="center", va="center_baseline"
    )
    x_mm += 2.0 * radius_mm + 2.8 * scale
    if turn_deg == 0:
        axes.add_patch(Circle((float(centre[0]), y_mm), 0.8 * radius_mm, fc="none", ec="0.6", lw=1.0))
        _write(axes, x_mm, y_mm, "leave", 13 * scale, va="center")
        return
    sense = sense_of_turn(turn_deg)
    _draw_round_arrow(axes, centre, radius_mm, is_clockwise=sense == "clockwise", scale=scale)
    words = turn_in_words(abs(turn_deg))
    size_pt = min(15.0, 112.0 / len(words)) * scale  # `12 turns + 345°` still fits beside the next bolt
    _write(axes, x_mm, y_mm + 4.4 * scale, words, size_pt, weight="bold", va="center")
    _write(axes, x_mm, y_mm + 0.9 * scale, sense.replace("counter", "counter-\n"), 9.5 * scale, linespacing=1.05)


def _draw_round_arrow(axes: Axes, centre: Array, radius_mm: float, *, is_clockwise: bool, scale: float) -> None:
    """Three quarters of a circle with a head; it begins and ends beside the top, where the gap is."""
    angles = np.pi / 2.0 + (-1.0 if is_clockwise else 1.0) * np.radians(np.linspace(45.0, 300.0, 60))
    arc = centre + radius_mm * np.column_stack([np.cos(angles), np.sin(angles)])
    axes.plot(*arc.T, color="black", lw=2.6 * scale, solid_capstyle="butt")
    along = arc[-1] - arc[-2]
    along /= np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    head = 1.9 * scale
    corners = [arc[-1] + 1.6 * head * along, arc[-1] + head * across, arc[-1] - head * across]
    axes.add_patch(Polygon(np.array(corners), closed=True, fc="black", ec="none"))


def turn_in_words(turn_deg: float) -> str:
    """A turn as people count it: `285°`, `1 turn + 52°`, `2 turns`."""
    whole, rest_deg = divmod(turn_deg, 360)
    turns = f"{whole:g} turn{'s' if whole > 1 else ''}" if whole else ""
    return " + ".join(part for part in (turns, f"{rest_deg:g}°" if rest_deg or not whole else "") if part)


def _draw_arms(axes: Axes, legs_m: Array, centre_mm: Array, size_mm: float) -> None:
    """Where the bolts are, as the person who turns them sees it; `legs_m` to the right and up."""
    reach_m = float(np.linalg.norm(legs_m, axis=1).max())
    for bolt, leg_m in enumerate(legs_m):
        end = centre_mm + size_mm * leg_m / reach_m
        axes.plot(*np.array([centre_mm, end]).T, color="black", lw=0.9)
        axes.add_patch(Circle((float(end[0]), float(end[1])), 2.3, fc="white", ec="black", lw=0.8, zorder=3))
        _write(axes, float(end[0]), float(end[1]) - 0.1, str(bolt + 1), 9, ha="center", va="center_baseline")

"""The work sheet of the page: what `instructions.pdf` says, in the same order and words, for the page to draw.

Everything lies as the person who turns the bolts sees it: x to that person's right, y up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.sheets.facet_map import outlines_m
from namod_ctl.app.sheets.instructions import FacetInstruction, Verdict, facet_instructions
from namod_ctl.app.sheets.ladder_sheets import plan_sheets, turn_in_words
from namod_ctl.optics.coordinates import factors_to_view, sense_of_turn
from namod_ctl.optics.instrument import Instrument
from namod_ctl.optics.mounts import Mount
from namod_ctl.reconstruction.alignment import Alignment

Array = NDArray[np.float64]

NOTES = {
    "PSF_CUT_BY_SCAN_EDGE": "image cut by the edge of the recorded sky, record again after turning",
    "PSF_OUTSIDE_SCAN": "brightest outside the recorded sky, record again after turning",
    "FEW_RECORDS": "rests on few records",
    "LARGE_UNCERTAINTY": "rather uncertain",
}


def work_sheet(instrument: Instrument, alignment: Alignment, done: Sequence[int]) -> dict[str, Any]:
    """The sheet of an alignment for JSON; `done` are the facets that are marked."""
    instructions = facet_instructions(alignment, instrument.goniometer_resolution_rad)
    by_id = {instruction.facet_id: instruction for instruction in instructions}
    seen_from = instrument.bolts_seen_from
    to_view = factors_to_view(seen_from)
    outlines = {facet_id: to_view * outline for facet_id, outline in outlines_m(instrument.reflector).items()}
    sheets = plan_sheets(instrument.reflector, list(by_id), seen_from)
    return {
        "side": f"Seen from {'BEHIND' if seen_from == 'back' else 'the FRONT of'} the mirror",
        "stand": "Left and right are yours when you "
        + ("stand behind the mirror and look at its back." if seen_from == "back" else _IN_FRONT),
        "senses": _senses(instrument),
        "done": list(done),
        "others": [
            {"id": facet_id, "outline": _rounded(outline)}
            for facet_id, outline in outlines.items()
            if facet_id not in by_id
        ],
        "sheets": [
            {
                "name": f"Sheet {number} of {len(sheets)} · ladder place {sheet.place}",
                "facets": [
                    _facet(by_id[facet_id], instrument.mounts[facet_id], to_view, outlines[facet_id])
                    for facet_id in sorted(sheet.facet_ids, key=lambda i: by_id[i].verdict is Verdict.DO_NOT_TURN)
                ],
            }
            for number, sheet in enumerate(sheets, start=1)
        ],
    }


_IN_FRONT = "look at the mirror from its focal point."


def _senses(instrument: Instrument) -> str:
    senses = sorted({mount.turn_raises_leg for mount in instrument.mounts.values() if mount.pitch_m_per_turn})
    if len(senses) != 1:
        return "Senses differ: read each."
    return f"{senses[0].capitalize()} raises the facet, to the sky."


def _facet(instruction: FacetInstruction, mount: Mount, to_view: Array, outline_m: Array) -> dict[str, Any]:
    is_turned = instruction.verdict is Verdict.TURN
    reasons = "; ".join(instruction.reasons) or "no reliable estimate"
    centre = 0.5 * (outline_m.min(axis=0) + outline_m.max(axis=0))
    return {
        "id": instruction.facet_id,
        "verdict": instruction.verdict.value,
        "outline": _rounded(outline_m),
        "legs": _rounded(centre + mount.legs_m * to_view),
        "bolts": [_bolt(turn_deg) for turn_deg in instruction.settable_deg] if is_turned else [],
        "notes": [NOTES[flag] for flag in instruction.flags if flag in NOTES],
        "why": f"Why: {reasons}." if instruction.verdict is Verdict.DO_NOT_TURN else "",
    }


def _bolt(turn_deg: float) -> dict[str, str]:
    """A turn in words."""
    if turn_deg == 0:
        return {"turn": "leave", "sense": ""}
    return {"turn": turn_in_words(abs(turn_deg)), "sense": sense_of_turn(turn_deg)}


def _rounded(points_m: Array) -> list[list[float]]:
    """Points to the millimetre."""
    return [[round(float(x), 3), round(float(y), 3)] for x, y in points_m]

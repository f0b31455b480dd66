"""What a person shall do at each facet, and instructions.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from namod_ctl.core.flags import FACET_FLAG_MEANING
from namod_ctl.core.units import rad_to_deg
from namod_ctl.reconstruction.alignment import Alignment, FacetAlignment

CSV_FILE = "instructions.csv"
_SETTABLE_DECIMALS = 6
NO_TURN_NEEDED = "NO_TURN_NEEDED"  # stands among the flags of instructions.csv


class Verdict(StrEnum):
    """What is to be done at a facet."""

    TURN = "turn"
    NO_TURN_NEEDED = "no turn needed"
    DO_NOT_TURN = "do not turn"
    NO_BOLTS = "no bolts"


@dataclass(frozen=True, slots=True)
class FacetInstruction:
    """What is to be done at one facet.

    Attributes
    ----------
    turns_deg
        Whole degrees per bolt, positive clockwise as seen by the person who turns. Empty where nobody should turn, and
        where there are no bolts. Where no turn is needed it holds the turns too small to be made. For programs.
    settable_deg
        The same turns as a person can set them: multiples of what the goniometer resolves. For people.
    flags
        Names for machines: those of the facet's flags, then NO_TURN_NEEDED where it holds.
    reasons
        What the flags mean and what the reconstruction remarked, one line each, for people.
    """

    facet_id: int
    verdict: Verdict
    turns_deg: tuple[int, ...]
    settable_deg: tuple[float, ...]
    flags: tuple[str, ...]
    reasons: tuple[str, ...]


def facet_instructions(alignment: Alignment, goniometer_resolution_rad: float) -> tuple[FacetInstruction, ...]:
    """What is to be done at every facet of the alignment, in its order.

    No turn is needed when every bolt is within half the goniometer's resolution: turning it could not improve it.
    """
    step_deg = rad_to_deg(goniometer_resolution_rad)
    return tuple(_instruct(facet, step_deg) for facet in alignment.facets)


def settable_turn_deg(turn_deg: float, step_deg: float) -> float:
    """The turn nearest to `turn_deg` that a goniometer with marks every `step_deg` can show."""
    # the sum with 0 makes -0 a 0; steps such as 0.1 are no exact numbers
    return round(round(turn_deg / step_deg) * step_deg, _SETTABLE_DECIMALS) + 0.0


def _instruct(facet: FacetAlignment, step_deg: float) -> FacetInstruction:
    verdict = _verdict(facet, 0.5 * step_deg)
    is_stated = verdict in (Verdict.TURN, Verdict.NO_TURN_NEEDED)
    flags = facet.flags.names + ((NO_TURN_NEEDED,) if verdict is Verdict.NO_TURN_NEEDED else ())
    meanings = tuple(meaning for flag, meaning in FACET_FLAG_MEANING.items() if flag in facet.flags)
    if verdict is Verdict.DO_NOT_TURN and not facet.flags.forbids_turning:
        meanings += ("no correction could be computed",)
    wanted_deg = [float(turn_deg) for turn_deg in facet.bolt_turn_deg] if is_stated else []
    turns_deg = tuple(map(round, wanted_deg))
    settable_deg = tuple(settable_turn_deg(turn_deg, step_deg) for turn_deg in wanted_deg)
    return FacetInstruction(facet.facet_id, verdict, turns_deg, settable_deg, flags, meanings + facet.remarks)


def _verdict(facet: FacetAlignment, smallest_turn_deg: float) -> Verdict:
    if facet.flags.forbids_turning or not np.all(np.isfinite(facet.tilt_correction_rad)):
        return Verdict.DO_NOT_TURN
    if len(facet.bolt_turn_deg) == 0:
        return Verdict.NO_BOLTS
    if not np.all(np.isfinite(facet.bolt_turn_deg)):
        return Verdict.DO_NOT_TURN
    is_small = bool(np.all(np.abs(facet.bolt_turn_deg) <= smallest_turn_deg))
    return Verdict.NO_TURN_NEEDED if is_small else Verdict.TURN


def instructions_to_csv(instructions: Sequence[FacetInstruction], n_bolts: int) -> str:
    """Text of instructions.csv: facet_id, bolt_1_deg .. bolt_n_deg, flags (separated by `|`).

    Where nobody should turn the numbers are empty. Small turns are given even where no turn is needed.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["facet_id", *(f"bolt_{bolt + 1}_deg" for bolt in range(n_bolts)), "flags"])
    for instruction in instructions:
        turns = [str(turn_deg) for turn_deg in instruction.turns_deg]
        turns += [""] * (n_bolts - len(turns))
        writer.writerow([instruction.facet_id, *turns, "|".join(instruction.flags)])
    return text.getvalue()

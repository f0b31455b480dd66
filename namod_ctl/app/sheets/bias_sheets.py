"""Bias alignment as files: sheets for the people who turn the bolts, and where each facet is to aim."""

from __future__ import annotations

import csv
import io
from collections import Counter
from datetime import date

import numpy as np
from numpy.typing import NDArray

from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.sheets.instructions import (
    CSV_FILE,
    FacetInstruction,
    Verdict,
    facet_instructions,
    instructions_to_csv,
)
from namod_ctl.app.sheets.ladder_sheets import PDF_FILE, sheets_to_pdf
from namod_ctl.app.sheets.overlay import PNG_FILE, draw_instructions
from namod_ctl.app.views.number_ranges import counted
from namod_ctl.calibration.gravity.bias_alignment import Compromise
from namod_ctl.calibration.gravity.gravity_table import GravityTable
from namod_ctl.core.flags import FacetFlag
from namod_ctl.core.units import rad_to_arcmin, rad_to_deg
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import Alignment, AreaOfPsf, FacetAlignment
from namod_ctl.reconstruction.correction import correct

Array = NDArray[np.float64]

AIMS_FILE = "bias_aims.csv"


def bias_files(
    table: GravityTable, best: Compromise, aligned_at_rad: float | None, instrument: Instrument, headline: str
) -> tuple[dict[str, bytes], str, bool]:
    """The files by name, what is to be turned in one line, and whether anything is.

    Parameters
    ----------
    aligned_at_rad
        Zenith distance at which the facets were aligned as they stand; None: they stand as the table's runs found them.
    """
    if aligned_at_rad is None:
        theta = table.beta_rad[:, 0] + best.offset_rad
    else:
        theta = best.offset_rad - table.motion_rad(np.array(aligned_at_rad))
    instructions = facet_instructions(_alignment(table, theta, instrument), instrument.goniometer_resolution_rad)
    n_bolts = max(len(instrument.mounts[facet_id].legs_m) for facet_id in table.facet_ids)
    turned = Counter(instruction.verdict for instruction in instructions)
    verdicts = ", ".join(f"{n} {verdict.value}" for verdict, n in turned.items())
    files = {
        CSV_FILE: instructions_to_csv(instructions, n_bolts).encode(),
        PNG_FILE: figure_to_png(draw_instructions(instrument, instructions, None, headline)),
        PDF_FILE: sheets_to_pdf(instrument, instructions, headline, date.today()),
        AIMS_FILE: _aims_csv(table, best, instructions).encode(),
    }
    is_driven = turned[Verdict.NO_BOLTS] > 0
    note = " Its legs are driven and can follow a table instead: namod-ctl lut apply." if is_driven else ""
    return files, f"{counted(len(instructions), 'facet')}: {verdicts}.{note}", turned[Verdict.TURN] > 0


def _alignment(table: GravityTable, theta_rad: Array, instrument: Instrument) -> Alignment:
    """What turning facets so that `theta_rad` (n_facets, 2) goes to 0 looks like; unknown facets are not turned."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(theta_rad).all(axis=1))
    flags = [FacetFlag.NONE if is_known else FacetFlag.NO_SIGNAL for is_known in known]
    corrections = correct(instrument, table.facet_ids, theta_rad, flags, np.zeros(2))
    unknown = AreaOfPsf(np.nan, np.nan)
    facets = tuple(
        FacetAlignment(
            facet_id=facet_id,
            theta_rad=theta,
            theta_cov_rad2=np.full((2, 2), np.nan),
            width_major_rad=np.nan,
            width_minor_rad=np.nan,
            flux=np.nan,
            background=np.nan,
            n_records_in_psf=0,
            flags=correction.flags,
            tilt_correction_rad=correction.tilt_correction_rad,
            leg_travel_m=correction.leg_travel_m,
            bolt_turn_deg=correction.bolt_turn_deg,
            remarks=correction.remarks,
        )
        for facet_id, theta, correction in zip(table.facet_ids, theta_rad, corrections, strict=True)
    )
    return Alignment(table.telescope, "bias alignment", 0, 0, np.zeros(2), unknown, unknown, unknown, facets)


def _aims_csv(table: GravityTable, best: Compromise, instructions: tuple[FacetInstruction, ...]) -> str:
    """Theta at which each facet is to stand, relative to the mean of all, at the ends and the middle of the range.

    A run recorded at one of these zenith distances shows whether the bolts were turned well.
    """
    middle = len(best.zenith_rad) // 2
    chosen = [0, middle, len(best.zenith_rad) - 1]
    aims = rad_to_arcmin(table.motion_rad(best.zenith_rad[chosen]) - best.offset_rad)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [f"theta_{axis}_arcmin_at_{rad_to_deg(best.zenith_rad[i]):.1f}_deg" for i in chosen for axis in "xy"]
    writer.writerow(["facet_id", *names, "verdict"])
    for j, instruction in enumerate(instructions):
        numbers = [f"{value:.4f}" for value in aims[:, j].ravel()]
        writer.writerow([table.facet_ids[j], *numbers, instruction.verdict.value])
    return text.getvalue()

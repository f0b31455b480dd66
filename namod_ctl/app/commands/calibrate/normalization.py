"""`namod-ctl calibrate normalization`: do responses depend on how bright the star was?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.normalization_plot import NORMALIZATION_PLOT_FILE, draw_normalization
from namod_ctl.core.errors import DataQualityError
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.normalization import (
    GOOD_PER_MAGNITUDE,
    Normalization,
    measure_at_rest,
    slope_in_words,
)
from namod_ctl.reconstruction.reconstruct import expected_size_rad, fit_run
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.results import write_results
from namod_ctl.store.run import RunStore

NORMALIZATION_FILE = "normalization.json"
_SCHEMA = "namod-normalization/1"
_REMEDY = (
    "Record a run in which the star gets bright and faint while the same facets are lit: through drifting clouds, on "
    "stars of different magnitude one after the other, or a lamp in steps; best with the mirror aligned and over a "
    "small region"
)


def normalization(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a series of records at a lamp.")],
) -> None:
    """Measure how the responses of facets depend on the star's brightness.

    They should not: clouds, zenith distance and another star must leave the point spread functions as they are. A slope
    says that the radiometric calibrations of the two cameras do not match. Writes normalization.png and
    normalization.json into the run's folder. Needs a run in which the star's brightness changed.

    Example: namod-ctl calibrate normalization runs/cloudy
    """
    check_run(run)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    with RunStore.open(run) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{run}: config"))
        with console.status("fitting the facets"):
            found, removed = _measure(store, instrument, run)
    if not found.is_known:
        raise DataQualityError(f"{run}: nothing can be said about the normalization: {found.doubt}. {_REMEDY}")
    verdict, words = verdict_of(found)
    files = {
        NORMALIZATION_PLOT_FILE: figure_to_png(draw_normalization(found, instrument.name)),
        NORMALIZATION_FILE: (
            json.dumps(_to_json(found, removed, instrument.name, verdict, words), indent=1) + "\n"
        ).encode(),
    }
    write_results(run, files)
    console.print(f"Responses: {slope_in_words(found)}")
    console.print(
        f"from {len(found.record_index)} records in which {found.n_facets} facets were lit, "
        f"the star varied by {found.range_mag:.1f} mag."
    )
    console.print(words)
    console.print(
        f"Written to {run}: {NORMALIZATION_PLOT_FILE}, {NORMALIZATION_FILE}. Next: {_next_step(verdict, run)}"
    )


def _measure(store: RunStore, instrument: Instrument, run: Path) -> tuple[Normalization, float]:
    """What was recorded, and the exponent that `namod-ctl reconstruct` would take out of it."""
    records = [record for record in store.records() if record.reject_reason is None]
    if not records:
        raise DataQualityError(f"{run}: no record of this run counts: nothing can be said. {_REMEDY}")
    theta_rad = np.array([record.theta_rad for record in records])
    if np.ptp(theta_rad, axis=0).max() < expected_size_rad(instrument):
        return measure_at_rest(tabulate_responses(records, store.facet_ids, is_at_rest=True)), 0.0
    fitted = fit_run(tabulate_responses(records, store.facet_ids), instrument)
    return fitted.normalization, fitted.removed_exponent


def verdict_of(found: Normalization) -> tuple[str, str]:
    """One word for programs (good, limited, imperfect, implausible) and what it means for a crew."""
    if found.is_implausible:
        return "implausible", (
            "No calibration is off by that much: the star camera followed another light than the mirror showed, or the "
            "light on the facets is not the star's. Nothing is taken out of such records."
        )
    uncertainty = found.per_magnitude_uncertainty
    if found.is_significant:
        kind = "fall" if found.per_magnitude < 0.0 else "rise"
        return "imperfect", (
            f"Responses {kind} as the star gets fainter: the radiometric calibrations of the two cameras do not match. "
            "The reconstruction of a run takes the slope out where the run itself shows it significantly; a new "
            "calibration of both cameras mends it for all runs."
        )
    if uncertainty > GOOD_PER_MAGNITUDE:
        return "limited", (
            "No slope is seen, but one below "
            f"{200.0 * uncertainty:.0f} % per magnitude could hide in the noise. {_REMEDY}, and record longer."
        )
    return "good", "No slope beyond chance and what cameras repeat: the normalization is good."


def _next_step(verdict: str, run: Path) -> str:
    if verdict == "imperfect":
        return "namod-ctl calibrate radiometric, for both cameras"
    if verdict == "implausible":
        return f"look at its frames and at the bad records in the report of namod-ctl reconstruct {run}"
    return f"namod-ctl reconstruct {run}"


def _to_json(found: Normalization, removed_exponent: float, telescope: str, verdict: str, words: str) -> dict[str, Any]:
    return {
        "schema": _SCHEMA,
        "telescope": telescope,
        "verdict": verdict,
        "words": words,
        "slope_percent_per_magnitude": 100.0 * found.per_magnitude,
        "slope_percent_per_magnitude_uncertainty": 100.0 * found.per_magnitude_uncertainty,
        "slope_percent_per_decade": 100.0 * found.per_decade,
        "slope_percent_per_decade_uncertainty": 100.0 * found.per_decade_uncertainty,
        "exponent": found.exponent,
        "exponent_uncertainty": found.exponent_uncertainty,
        "exponent_removed_by_reconstruct": removed_exponent,
        "range_mag": found.range_mag,
        "n_facets": found.n_facets,
        "records": {
            "index": found.record_index.tolist(),
            "magnitude": np.round(found.magnitude, 5).tolist(),
            "response_factor": np.round(np.exp(found.log_factor), 6).tolist(),
            "log_factor_uncertainty": np.round(found.log_factor_uncertainty, 6).tolist(),
        },
    }

"""`namod-ctl compare`: what changed between two runs of one telescope."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from namod_ctl.app.alignment_files import read_alignment
from namod_ctl.app.build.instrument import build_instrument
from namod_ctl.app.campaign_choice import check_run
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figure_style import figure_to_png
from namod_ctl.app.pictures.fingerprints import FINGERPRINTS_FILE, Fingerprint, draw_fingerprints
from namod_ctl.app.views.drift_table import DRIFT_FILE, drift_csv, drift_summary, drift_table
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.reflector import Reflector
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.drift import drift_between
from namod_ctl.reconstruction.responses import ResponseTable, tabulate_responses
from namod_ctl.store.results import write_results
from namod_ctl.store.run import RunStore

_SAME_POSITION_M = 0.01
"""Measured facet positions of one telescope agree better than that; those of two telescopes do not."""


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    name: str
    reflector: Reflector
    alignment: Alignment
    table: ResponseTable


def compare(
    run1: Annotated[Path, typer.Argument(metavar="RUN1", help="Folder of the earlier run, reconstructed.")],
    run2: Annotated[Path, typer.Argument(metavar="RUN2", help="Folder of the later run, reconstructed.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the files.")] = Path(),
) -> None:
    """Show which facets moved between two runs of one telescope, and by how much.

    Writes compare.csv and compare.png, the point spread functions of every facet side by side. The cameras may differ
    between the runs. What all facets did together (the star camera was touched) is shown and taken off. A cycle of a
    campaign is a run: CAMPAIGN/cycle_01.

    Example: namod-ctl compare NIGHT_2014 NIGHT_2015 --out REPORT
    """
    if run1.resolve() == run2.resolve():
        raise ConfigError(f"{run1}: is named twice; name two runs")
    if not out.is_dir():
        raise ConfigError(f"{out}: this folder does not exist; make it, or leave --out out to write into this one")
    names = _names(run1, run2)
    first, second = _read(run1, names[0]), _read(run2, names[1])
    _refuse_other_telescopes(first, second)
    drift = drift_between(first.alignment, second.alignment)
    prints = [Fingerprint(run.name, run.alignment, run.table) for run in (first, second)]
    files = {
        FINGERPRINTS_FILE: figure_to_png(draw_fingerprints(prints[0], prints[1], drift)),
        DRIFT_FILE: drift_csv(drift).encode(),
    }
    write_results(out, files)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(drift_table(drift, names))
    console.print(drift_summary(drift, (first.alignment, second.alignment), names))
    console.print(f"Written to {out}: {DRIFT_FILE}, {FINGERPRINTS_FILE}.")


def _names(run1: Path, run2: Path) -> tuple[str, str]:
    """Names by which people tell the two apart: the folders', with the folder above where these are alike."""
    here, there = run1.resolve(), run2.resolve()
    if here.name != there.name:
        return here.name, there.name
    return f"{here.parent.name}/{here.name}", f"{there.parent.name}/{there.name}"


def _read(path: Path, name: str) -> _Run:
    check_run(path)
    with RunStore.open(path) as store:
        instrument = build_instrument(InstrumentConfig.from_json(store.config_json, f"{path}: config"))
        table = tabulate_responses(store.records(), store.facet_ids)
    alignment = read_alignment(path)
    if alignment.telescope != instrument.name:
        raise ConfigError(
            f"{path}: alignment.json is of {alignment.telescope}, the run of {instrument.name}; "
            f"run `namod-ctl reconstruct {path}` anew"
        )
    bad = [record.index for record in alignment.bad_records]
    return _Run(name, instrument.reflector, alignment, table.select(~np.isin(table.record_index, bad)))


def _refuse_other_telescopes(first: _Run, second: _Run) -> None:
    problems = []
    if first.alignment.telescope != second.alignment.telescope:
        problems.append(
            f"{first.name} is of {first.alignment.telescope}, {second.name} of {second.alignment.telescope}"
        )
    here, there = first.reflector, second.reflector
    if not np.isclose(here.focal_length_m, there.focal_length_m, rtol=1e-3):
        problems.append(f"focal length is {here.focal_length_m:g} m in {first.name}, {there.focal_length_m:g} m there")
    places = {facet.id: facet.position_m for facet in there.facets}
    common = [facet for facet in here.facets if facet.id in places]
    elsewhere = [f.id for f in common if np.linalg.norm(f.position_m - places[f.id]) > _SAME_POSITION_M]
    if elsewhere:
        problems.append(f"facets {', '.join(map(str, elsewhere[:10]))} are at other places of the dish")
    if not common:
        problems.append("no facet id is in both")
    if problems:
        raise ConfigError(
            "; ".join(problems) + "; only runs of one telescope can be compared (its cameras may differ): name others"
        )

"""The report of a campaign: how A_sigma went from cycle to cycle, before and after, and every facet's way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from namod_ctl.app.alignment_files import alignment_from_json
from namod_ctl.app.build.twin import instrument_on_twin
from namod_ctl.app.config.instrument import InstrumentConfig
from namod_ctl.app.pictures.figure_style import DPI, ORANGE, SKY, VERMILLION, figure_to_png
from namod_ctl.app.pictures.figures import draw_psf_sum
from namod_ctl.app.pictures.psf_panels import measured_panels
from namod_ctl.app.report.journal import journal_rows
from namod_ctl.app.report.parts import area_text, when_text
from namod_ctl.app.views.number_ranges import counted
from namod_ctl.core.units import rad2_to_arcmin2, rad_to_arcmin
from namod_ctl.cycle.machine import STATES
from namod_ctl.cycle.psf_check import EVENT as PSF_CHECK
from namod_ctl.optics.instrument import Instrument
from namod_ctl.reconstruction.alignment import AreaOfPsf
from namod_ctl.reconstruction.reconstruct import reconstruct
from namod_ctl.reconstruction.responses import tabulate_responses
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_rows import Cycle, Event
from namod_ctl.store.results import write_results
from namod_ctl.store.run import RunStore

REPORT_FOLDER = "report"
BESIDE = 0.07
"""Of a cycle: so far from its estimate another one of the same moment is drawn."""
HISTORY_FILE, FACETS_FILE, SUMMARY_FILE = "a_sigma_history.png", "facets.csv", "summary.txt"
PSF_FILE = "psf_before_and_after.png"


def write_campaign_report(path: Path) -> None:
    """Write the report of the campaign at `path` into its folder `report`; nothing while no cycle has a result."""
    with CampaignStore.open(path) as store:
        cycles = [cycle for cycle in store.cycles() if cycle.alignment_json is not None]
        if not cycles:
            return
        config = InstrumentConfig.from_json(store.config_json, f"{path}: config")
        instrument = instrument_on_twin(config)
        files = {
            HISTORY_FILE: figure_to_png(draw_history(cycles, instrument.name, store.events())),
            FACETS_FILE: facet_text(cycles).encode(),
            SUMMARY_FILE: summary_text(store).encode(),
            PSF_FILE: _psf_picture(store, cycles[:1] + cycles[-1:] if len(cycles) > 1 else cycles, instrument),
        }
    folder = path / REPORT_FOLDER
    folder.mkdir(exist_ok=True)
    write_results(folder, files)


def draw_history(cycles: list[Cycle], telescope: str, events: Sequence[Event] = ()) -> Figure:
    """A_sigma of every cycle with its uncertainty, and what each cycle's correction was to make of it.

    `events` is the campaign's journal: what a PSF camera saw is drawn beside the estimates of the same moments.
    """
    figure = Figure(figsize=(7.0, 4.5), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    numbers = [cycle.number for cycle in cycles]
    now, doubt, predicted = (
        rad2_to_arcmin2(np.array([getattr(cycle, name) for cycle in cycles]))
        for name in ("a_sigma_now_rad2", "a_sigma_uncertainty_rad2", "a_sigma_predicted_rad2")
    )
    axes.errorbar(numbers, now, yerr=doubt, fmt="o-", color="black", capsize=4, label="measured")
    made = np.array(numbers[:-1], dtype=int)  # the last one's correction was not made, or not seen
    axes.plot(
        made + 1, predicted[:-1], "D", color=ORANGE, fillstyle="none", ms=10, label="predicted by the cycle before"
    )
    seen = [event.data for event in events if event.kind == PSF_CHECK and event.data.get("cycle") in numbers]
    if seen:
        areas, doubts = (
            [rad2_to_arcmin2(float(str(data[name]))) for data in seen] for name in ("a_sigma_rad2", "uncertainty_rad2")
        )
        at = [int(str(data["cycle"])) + BESIDE for data in seen]
        axes.errorbar(at, areas, yerr=doubts, fmt="s", color=VERMILLION, capsize=4, label="seen by the PSF camera")
    limit = rad2_to_arcmin2(cycles[-1].a_sigma_limit_rad2)
    if math.isfinite(limit):
        axes.axhline(limit, color=SKY, linestyle="--", label="ray-traced, mirrors without errors")
    for number, area in zip(numbers, now, strict=True):
        axes.annotate(f"{area:.1f}", (number, area), textcoords="offset points", xytext=(8, 6))
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0.8 * min(now.min(), limit if math.isfinite(limit) else now.min()), 1.3 * now.max())
    axes.set_xticks(numbers)
    axes.set_xlim(numbers[0] - 0.3, numbers[-1] + 0.5)
    axes.set_xlabel("cycle")
    axes.set_ylabel("A_sigma / arcmin$^2$")
    axes.set_title(f"{telescope}: area of the point spread function")
    axes.legend()
    return figure


def facet_text(cycles: list[Cycle]) -> str:
    """Every facet's orientation in every cycle: facet_id, then theta_x and theta_y in arcmin and flags per cycle."""
    alignments = [alignment_from_json(cycle.alignment_json or "", f"cycle {cycle.number}") for cycle in cycles]
    head = ["facet_id"]
    for cycle in cycles:
        head += [
            f"{name}_{cycle.number}" for name in ("theta_x_arcmin", "theta_y_arcmin", "uncertainty_arcmin", "flags")
        ]
    lines = [",".join(head)]
    for facets in zip(*(alignment.facets for alignment in alignments), strict=True):
        cells = [str(facets[0].facet_id)]
        for facet in facets:
            doubt_rad = math.sqrt(max(float(np.trace(facet.theta_cov_rad2)) / 2.0, 0.0))
            numbers = [*rad_to_arcmin(facet.theta_rad), rad_to_arcmin(doubt_rad)]
            cells += [f"{number:.3f}" if math.isfinite(number) else "" for number in numbers]
            cells.append("|".join(facet.flags.names))
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def summary_text(store: CampaignStore) -> str:
    """Cycles, then everything in the journal, in plain words."""
    state = store.last_state() or "idle"
    lines = [
        f"Campaign {store.path.name}: {store.source}",
        f"Begun {when_text(store.created_utc)}. Now {state.replace('_', ' ')}: {STATES.get(state, '')}.",
        "",
        "A_sigma, the area of the point spread function of the whole mirror, in square minutes of arc:",
    ]
    for cycle in store.cycles():
        area = AreaOfPsf(cycle.a_sigma_now_rad2, cycle.a_sigma_uncertainty_rad2)
        lines.append(f"  cycle {cycle.number}: {area_text(area)}, from {counted(cycle.n_records, 'record')}")
        if cycle.decision:
            lines.append(f"           then: {cycle.decision}")
    lines += ["", "What happened:"]
    for when, what, why in journal_rows(store.events()):
        lines += [f"  {when}  {what}", f"{'':27}why: {why}"] if why else [f"  {when}  {what}"]
    return "\n".join(lines) + "\n"


def _psf_picture(store: CampaignStore, cycles: Sequence[Cycle], instrument: Instrument) -> bytes:
    """The point spread function as it was measured in these cycles, on one scale."""
    results = []
    for cycle in cycles:
        with RunStore.open(store.run_path(cycle.number)) as run:
            results.append(reconstruct(tabulate_responses(run.records(), run.facet_ids), instrument))
    panels = measured_panels(results, [f"measured in cycle {cycle.number}" for cycle in cycles])
    return figure_to_png(draw_psf_sum(panels, instrument.name, results[-1].limit))

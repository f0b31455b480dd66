"""`namod-ctl align`: record, reconstruct and correct until the point spread function has converged."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.align_view import AlignView, cycle_table
from namod_ctl.app.alignment_files import alignment_files, alignment_from_json, alignment_to_json
from namod_ctl.app.build_actuators import build_motion_settings
from namod_ctl.app.build_recording import build_record_settings
from namod_ctl.app.build_twin import build_twin, load_twin_settings
from namod_ctl.app.build_twin_actuators import build_twin_actuators, twin_wiring
from namod_ctl.app.campaign_report import write_campaign_report
from namod_ctl.app.commands.instruct import write_instructions
from namod_ctl.app.instruction_sheets import PDF_FILE
from namod_ctl.app.config import InstrumentConfig, load_config
from namod_ctl.app.reconstruction_report import REPORT_FILE, report_text
from namod_ctl.app.twin_note import note_twin, noted_twin
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign, CampaignSettings, Outside
from namod_ctl.cycle.correct import Corrector
from namod_ctl.cycle.correct_by_hand import ManualCorrector
from namod_ctl.cycle.correct_by_motor import MotorCorrector
from namod_ctl.cycle.mover import Mover
from namod_ctl.cycle.record import Equipment
from namod_ctl.reconstruction.alignment import Alignment
from namod_ctl.reconstruction.reconstruct import Reconstruction
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.results import write_results
from namod_ctl.twin.operator import GONIOMETER_ERROR_RAD, TwinOperator
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin
from namod_ctl.twin.world import open_world

DEFAULT_CONFIG = "fact_actuated"
DEFAULT_OUT = Path("CAMPAIGN")
DEFAULT_SEED = 1
WORLD_FILE = "twin_world.jsonl"
EXIT_HELD = 3  # the campaign ended, and a person must look


class Approve(StrEnum):
    """Who approves of a correction."""

    AUTO = "auto"
    ASK = "ask"


@dataclass(frozen=True, slots=True)
class _Start:
    """What a campaign begins with."""

    store: CampaignStore
    config: InstrumentConfig
    settings: TwinSettings
    seed: int


def align(
    config: Annotated[
        str | None, typer.Option("--config", help=f"Instrument: a TOML file, or a built-in name.  [{DEFAULT_CONFIG}]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help=f"Folder of the new campaign; must not exist yet.  [{DEFAULT_OUT}]")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="CAMPAIGN", help="Take up a campaign that was interrupted.")
    ] = None,
    records: Annotated[int, typer.Option(min=50, help="Records per cycle.")] = 400,
    cycles: Annotated[int, typer.Option(min=1, help="Corrections at most.")] = 5,
    approve: Annotated[
        Approve, typer.Option(help="auto: corrections are carried out; ask: a person approves each one.")
    ] = Approve.AUTO,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the twin: another seed is another telescope.")] = None,
    twin_settings: Annotated[
        Path | None, typer.Option("--twin-settings", metavar="FILE", help="Faults and sky of the twin, a TOML file.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an older campaign at --out, at once.")] = False,
) -> None:
    """Align the telescope: record, reconstruct and correct until the point spread function has converged.

    Facets with motors are moved; without [actuators] in the config people get sheets with bolt turns. From another
    terminal: namod-ctl status, pause, resume, stop, approve, done. Ctrl-C stops all motion and holds the campaign.

    Example: namod-ctl align --out CAMPAIGN
    """
    console = Console(highlight=False)
    switch = StopSwitch()
    with ExitStack() as stack:
        start = (
            _resumed(stack, resume, config, seed, twin_settings, out)
            if resume is not None
            else _begun(stack, out or DEFAULT_OUT, config or DEFAULT_CONFIG, seed, twin_settings, force=force)
        )
        store, instrument_config = start.store, start.config
        twin = build_twin(instrument_config, start.settings, start.seed, twin_wiring(instrument_config))
        stack.callback(open_world(store.path / WORLD_FILE, twin).close)
        corrector = _corrector(stack, store, instrument_config, twin, start.seed, switch)
        settings = CampaignSettings(
            record=replace(build_record_settings(instrument_config), pace_s=twin.telescope.pass_s / records),
            n_records=records,
            max_cycles=cycles,
            is_asked=approve is Approve.ASK,
        )
        equipment = Equipment(twin.star_camera, twin.reflector_camera, twin.clock, twin.wall_clock)
        outside = Outside(lambda: equipment, alignment_to_json, alignment_from_json, _write_cycle)
        if store.last_state() == "held":
            raise ConfigError(f"{store.path}: is held; look why (namod-ctl status), then namod-ctl release")
        with AlignView(console) as view, _stopped_by_sigterm():
            campaign = Campaign(store, twin.instrument, corrector, outside, settings, SystemClock(), switch, view)
            try:
                state = campaign.run()
            finally:
                write_campaign_report(store, twin.instrument)
        console.print(cycle_table(store.cycles()))
        ratio = twin.reflector.a_sigma_now_rad2() / twin.reflector.a_sigma_aligned_rad2()
        console.print(f"The twin's truth: A_sigma is {ratio:.3f} times that of the same facets perfectly aligned.")
        console.print(f"{store.path}: {state}; report in {store.path / 'report'}", soft_wrap=True, markup=False)
    if state != "converged":
        raise typer.Exit(EXIT_HELD)


def _begun(
    stack: ExitStack, out: Path, config: str, seed: int | None, twin_settings: Path | None, *, force: bool
) -> _Start:
    instrument_config = load_config(config)
    settings = TwinSettings() if twin_settings is None else load_twin_settings(twin_settings)
    chosen = DEFAULT_SEED if seed is None else seed
    source = f"digital twin of {instrument_config.telescope.name}, seed {chosen}"
    store = stack.enter_context(CampaignStore.create(out, instrument_config.to_json(), source, SystemClock(), force))
    note_twin(store, settings, chosen)
    return _Start(store, instrument_config, settings, chosen)


def _resumed(
    stack: ExitStack, path: Path, config: str | None, seed: int | None, twin_settings: Path | None, out: Path | None
) -> _Start:
    if config is not None or seed is not None or twin_settings is not None or out is not None:
        raise ConfigError("--resume CAMPAIGN goes on with the campaign's own config and twin: leave the others out")
    store = stack.enter_context(CampaignStore.open(path, read_only=False))
    noted = noted_twin(store)
    if noted is None:
        raise ConfigError(f"{path}: was not begun on the twin, and there are no drivers for cameras yet")
    return _Start(store, InstrumentConfig.from_json(store.config_json, f"{path}: config"), *noted)


def _corrector(
    stack: ExitStack, store: CampaignStore, config: InstrumentConfig, twin: Twin, seed: int, switch: StopSwitch
) -> Corrector:
    if config.actuators is None:
        operator = TwinOperator(twin, seed)

        def write_sheets(run: Path, alignment: Alignment) -> str:
            write_instructions(run, alignment, twin.instrument, None, f"{store.path.name}/{run.name}")
            return f"sheets for the ladder: {run / PDF_FILE}; then namod-ctl done {store.path} --facet ... or --all"

        return ManualCorrector(store, twin.instrument, write_sheets, GONIOMETER_ERROR_RAD, operator.turn)
    buses = stack.enter_context(build_twin_actuators(config, twin.drives))
    motion = build_motion_settings(config)
    drives = {leg: drive for bus in buses for leg, drive in bus.drives.items()}
    return MotorCorrector(store, twin.instrument, Mover(buses, twin.clock, motion, switch), drives, motion)


def _write_cycle(run: Path, result: Reconstruction) -> None:
    write_results(run, {REPORT_FILE: report_text(result, {}).encode()} | alignment_files(result.alignment))


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """SIGTERM ends the program as Ctrl-C does: all motion stops first."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt("SIGTERM")

    before: Callable[[int, FrameType | None], object] | int | None = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

"""`namod-ctl align`: record, reconstruct and correct until the point spread function has converged."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console

from namod_ctl.app.align_view import AlignView, cycle_table
from namod_ctl.app.build_twin import load_twin_settings
from namod_ctl.app.build_twin_campaign import open_twin_campaign
from namod_ctl.app.campaign_report import write_campaign_report
from namod_ctl.app.config import InstrumentConfig, load_config
from namod_ctl.app.dashboard.beside import dashboard_beside
from namod_ctl.app.twin_note import note_twin, noted_twin
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign_parts import CampaignSettings
from namod_ctl.cycle.machine import FINAL
from namod_ctl.cycle.record import RecordSettings
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.import_namod import KeepFrames
from namod_ctl.twin.settings import TwinSettings

DEFAULT_CONFIG = "fact_actuated"
DEFAULT_OUT = Path("CAMPAIGN")
DEFAULT_SEED = 1
DEFAULT_RECORDS = 400
DEFAULT_CYCLES = 5
NOTE_WISHES = "align.wishes"
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
    records: Annotated[
        int | None, typer.Option(min=50, help=f"Records per cycle.  [{DEFAULT_RECORDS}, or as begun]")
    ] = None,
    cycles: Annotated[
        int | None, typer.Option(min=1, help=f"Corrections at most.  [{DEFAULT_CYCLES}, or as begun]")
    ] = None,
    approve: Annotated[
        Approve | None,
        typer.Option(help="auto: corrections are carried out; ask: a person approves each one.  [auto, or as begun]"),
    ] = None,
    keep_frames: Annotated[
        KeepFrames | None,
        typer.Option(
            help="Frames to keep in the runs of all cycles; the live page shows the newest ones in any case.  [none, "
            "or as begun]"
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the twin: another seed is another telescope.")] = None,
    twin_settings: Annotated[
        Path | None, typer.Option("--twin-settings", metavar="FILE", help="Faults and sky of the twin, a TOML file.")
    ] = None,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Serve the live page on this computer meanwhile, and print its address.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an older campaign at --out, at once.")] = False,
) -> None:
    """Align the telescope: record, reconstruct and correct until the point spread function has converged.

    Facets with motors are moved; without actuators in the config people get sheets with bolt turns. From another
    terminal: namod-ctl status, pause, resume, stop, approve, done. Ctrl-C stops all motion and holds the campaign.

    Example: namod-ctl align --out CAMPAIGN
    """
    console = Console(highlight=False)
    with ExitStack() as stack:
        if resume is not None:
            start = _resumed(stack, resume, config, seed, twin_settings, out)
        else:
            start = _begun(stack, out or DEFAULT_OUT, config or DEFAULT_CONFIG, seed, twin_settings, force=force)
        store = start.store
        if _has_ended(store, console):
            return
        wishes = _wishes(store, records, cycles, approve, keep_frames)
        switch = StopSwitch()
        view = stack.enter_context(AlignView(console))
        opened = stack.enter_context(
            open_twin_campaign(store, start.config, start.settings, start.seed, wishes, SystemClock(), switch, view)
        )
        twin = opened.twin
        if dashboard:
            console.print(
                f"live page: {stack.enter_context(dashboard_beside(store.path))}", soft_wrap=True, markup=False
            )
        # written last, when the campaign is free for others: it takes some seconds
        stack.callback(write_campaign_report, store.path)
        stack.enter_context(store)
        with _stopped_by_sigterm():
            state = opened.campaign.run()
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
    if noted is None and store.last_state() is None:
        raise ConfigError(
            f"{path}: was killed in its first moment and is empty: begin it again, with --out and --force"
        )
    if noted is None:
        raise ConfigError(f"{path}: was not begun on the twin, and there are no drivers for cameras yet")
    return _Start(store, InstrumentConfig.from_json(store.config_json, f"{path}: config"), *noted)


def _has_ended(store: CampaignStore, console: Console) -> bool:
    """Says so when a campaign has converged before.

    Raises ConfigError when it is held or has failed: a person must look.
    """
    last = store.last_transition()
    if last is None or (state := store.last_state()) not in FINAL:
        return False
    why = f"{state}: {last.data.get('reason')}"
    if state == "converged":
        text = f"{store.path}: has {why}; there is nothing to do. Begin another campaign to align it anew."
        console.print(text, soft_wrap=True, markup=False)
        return True
    remedy = f"look why, then 'namod-ctl release {store.path}'" if state == "held" else "begin another campaign"
    raise ConfigError(f"{store.path}: is {why}; {remedy}")


def _wishes(
    store: CampaignStore,
    records: int | None,
    cycles: int | None,
    approve: Approve | None,
    keep_frames: KeepFrames | None,
) -> CampaignSettings:
    """What the crew wishes; noted in the campaign, which goes on with it after a restart."""
    given = {"records": records, "cycles": cycles, "approve": approve, "keep_frames": keep_frames}
    wishes: dict[str, Any] = {
        "records": DEFAULT_RECORDS,
        "cycles": DEFAULT_CYCLES,
        "approve": Approve.AUTO,
        "keep_frames": KeepFrames.NONE,
    }
    wishes |= json.loads(store.note(NOTE_WISHES) or "{}")
    wishes |= {name: wish for name, wish in given.items() if wish is not None}
    store.set_note(NOTE_WISHES, json.dumps(wishes))
    record = RecordSettings(keep_frames=wishes["keep_frames"] == KeepFrames.ALL)
    return CampaignSettings(record, wishes["records"], wishes["cycles"], wishes["approve"] == Approve.ASK)


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

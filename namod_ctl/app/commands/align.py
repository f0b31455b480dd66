"""`namod-ctl align`: record, reconstruct and correct until the point spread function has converged."""

from __future__ import annotations

import json
import signal
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console

from namod_ctl.app.build.cameras import has_cameras
from namod_ctl.app.build.sky_campaign import check_hardware, open_sky_campaign
from namod_ctl.app.build.sky_session import Tell
from namod_ctl.app.build.twin import load_twin_settings
from namod_ctl.app.build.twin_campaign import open_twin_campaign
from namod_ctl.app.build.twin_note import note_twin, noted_twin
from namod_ctl.app.campaign_report import write_campaign_report
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.dashboard.beside import dashboard_beside
from namod_ctl.app.end_signals import ended_in_order
from namod_ctl.app.views.align_view import AlignView, cycle_table
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.motion import StopSwitch
from namod_ctl.cycle.campaign import Campaign
from namod_ctl.cycle.campaign_parts import CampaignSettings
from namod_ctl.cycle.machine import FINAL
from namod_ctl.cycle.record import RecordSettings
from namod_ctl.cycle.table_move import NOTE_JOURNAL
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.folders import check_output
from namod_ctl.store.import_namod import KeepFrames
from namod_ctl.twin.settings import TwinSettings
from namod_ctl.twin.twin import Twin

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
    """What a campaign begins with; `twin` is the twin's settings and seed, None for the telescope itself."""

    store: CampaignStore
    config: InstrumentConfig
    twin: tuple[TwinSettings, int] | None


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
        int | None,
        typer.Option(
            min=50,
            help="Records per cycle at least; up to three times as many until the region is covered without a hole.  "
            f"[{DEFAULT_RECORDS}, or as begun]",
        ),
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
    twin: Annotated[
        bool, typer.Option("--twin", help="Rehearse on the digital twin of a config that names cameras.")
    ] = False,
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

    A config that names no cameras is aligned on its digital twin. Facets with motors are moved; without actuators in
    the config people get sheets with bolt turns. From another terminal: namod-ctl status, pause, resume, stop, approve,
    done. Ctrl-C stops all motion and holds the campaign.

    Example: namod-ctl align --out CAMPAIGN
    """
    console = Console(highlight=False)

    def tell(text: str) -> None:
        console.print(text, soft_wrap=True, markup=False)

    with ExitStack() as stack:
        if resume is not None:
            if twin or any(option is not None for option in (config, seed, twin_settings, out)):
                raise ConfigError("--resume CAMPAIGN goes on with the campaign's own config and twin: leave others out")
            start = _resumed(stack, resume)
        else:
            is_twin = twin or seed is not None or twin_settings is not None
            chosen = out or DEFAULT_OUT, config or DEFAULT_CONFIG
            start = _begun(stack, *chosen, seed, twin_settings, tell, is_twin=is_twin, force=force)
        store = start.store
        if _has_ended(store, console):
            return
        tell(_what_is_aligned(start))
        wishes = _wishes(store, records, cycles, approve, keep_frames)
        switch = StopSwitch()
        view = stack.enter_context(AlignView(console))
        campaign, its_twin = _opened(stack, start, wishes, switch, view)
        if dashboard:
            console.print(
                f"live page: {stack.enter_context(dashboard_beside(store.path))}", soft_wrap=True, markup=False
            )
        # written last, when the campaign is free for others: it takes some seconds
        stack.callback(write_campaign_report, store.path)
        stack.enter_context(store)
        with ended_in_order(_interrupt):
            state = campaign.run()
        console.print(cycle_table(store.cycles()))
        if its_twin is not None:
            its_twin.update(its_twin.clock.monotonic_s())  # facets follow what the drives did last
            reflector = its_twin.reflector
            ratio = reflector.a_sigma_now_rad2() / reflector.a_sigma_aligned_rad2()
            console.print(f"The twin's truth: A_sigma is {ratio:.3f} times that of the same facets perfectly aligned.")
        console.print(f"{store.path}: {state}; report in {store.path / 'report'}", soft_wrap=True, markup=False)
    if state != "converged":
        raise typer.Exit(EXIT_HELD)


def _begun(
    stack: ExitStack,
    out: Path,
    config_name: str,
    seed: int | None,
    twin_settings: Path | None,
    tell: Tell,
    *,
    is_twin: bool,
    force: bool,
) -> _Start:
    config = load_config(config_name)
    twin = None
    if is_twin or not has_cameras(config):
        settings = TwinSettings() if twin_settings is None else load_twin_settings(twin_settings)
        twin = settings, DEFAULT_SEED if seed is None else seed
        source = f"digital twin of {config.telescope.name}, seed {twin[1]}"
    else:
        check_output(out, force=force)
        source = f"{config.telescope.name}; {', '.join(check_hardware(config, tell))}"
    store = stack.enter_context(CampaignStore.create(out, config.to_json(), source, SystemClock(), force))
    if twin is not None:
        note_twin(store, *twin)
    return _Start(store, config, twin)


def _what_is_aligned(start: _Start) -> str:
    """So that nobody takes a rehearsal for the telescope, or the telescope for a rehearsal."""
    if start.twin is not None:
        return f"Aligning the {start.store.source}: a rehearsal, nothing real is recorded or moved."
    who = "people turn its bolts" if start.config.actuators is None else "its drives will move"
    return f"Aligning the telescope itself, {who}: {start.store.source}"


def _resumed(stack: ExitStack, path: Path) -> _Start:
    store = stack.enter_context(CampaignStore.open(path, read_only=False))
    twin = noted_twin(store)
    if store.note(NOTE_JOURNAL) is not None:
        raise ConfigError(
            f"{path}: is the journal of a look-up table, no campaign: 'namod-ctl lut apply' goes on with it"
        )
    if twin is None and store.last_state() is None:
        # whether it was to be the twin or the telescope itself nobody can tell
        raise ConfigError(
            f"{path}: was killed in its first moment and is empty: begin it again, with --out and --force"
        )
    config = InstrumentConfig.from_json(store.config_json, f"{path}: config")
    if twin is None and not has_cameras(config):
        raise ConfigError(f"{path}: was not begun on the twin, and its config names no cameras")
    return _Start(store, config, twin)


def _opened(
    stack: ExitStack, start: _Start, wishes: CampaignSettings, switch: StopSwitch, view: AlignView
) -> tuple[Campaign, Twin | None]:
    """The campaign, and the twin that it aligns, if it does."""
    store, config, clock = start.store, start.config, SystemClock()
    if start.twin is None:
        return stack.enter_context(open_sky_campaign(store, config, wishes, clock, switch, view)), None
    settings, seed = start.twin
    opened = stack.enter_context(open_twin_campaign(store, config, settings, seed, wishes, clock, switch, view))
    return opened.campaign, opened.twin


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


def _interrupt(number: int, frame: FrameType | None) -> None:
    """As Ctrl-C: all motion stops first."""
    raise KeyboardInterrupt(signal.Signals(number).name)

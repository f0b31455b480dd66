"""`namod-ctl record`: image pairs become a run, live."""

from __future__ import annotations

import math
import os
import re
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console

from namod_ctl.app.build.bench_sky import twin_equipment
from namod_ctl.app.build.recording import build_record_settings
from namod_ctl.app.build.replay import new_run_of, replay_equipment
from namod_ctl.app.build.sky_session import open_sky_session
from namod_ctl.app.build.twin import build_twin, instrument_on_twin, load_twin_settings
from namod_ctl.app.build.twin_note import different_sections, note_twin, noted_twin
from namod_ctl.app.config.instrument import InstrumentConfig, load_config
from namod_ctl.app.dashboard.beside import dashboard_beside
from namod_ctl.app.views.number_ranges import counted
from namod_ctl.app.views.recording_view import TerminalView
from namod_ctl.core.errors import ConfigError
from namod_ctl.core.flags import REJECT_REASON_MEANING
from namod_ctl.core.records import Record
from namod_ctl.core.units import arcmin_to_rad, arcsec_to_rad, deg_to_rad
from namod_ctl.cycle.live_estimate import LiveEstimator
from namod_ctl.cycle.progress import Progress
from namod_ctl.cycle.record import SESSION_GAP_S, Equipment, Recorder, StopRule
from namod_ctl.cycle.recording_control import RecordingControl
from namod_ctl.cycle.replay import replayable_records
from namod_ctl.optics.instrument import Instrument
from namod_ctl.store.folders import is_run
from namod_ctl.store.import_namod import KeepFrames
from namod_ctl.store.run import RunStore
from namod_ctl.store.run_lock import recording_lock
from namod_ctl.twin.settings import TwinSettings

DEFAULT_N_RECORDS = 1300  # of FACT's night (arXiv:1605.06274, section 4)
EXIT_INTERRUPTED = 130  # what shells report for a program that was ended by Ctrl-C
DEFAULT_SEED = 1

MAX_MINUTES = 24.0 * 60.0  # no night is longer
MAX_EVERY_S = 3600.0
MAX_REGION_RADIUS_DEG = 5.0
_ANGLE = re.compile(r"([0-9]*\.?[0-9]+)\s*(arcsec|arcmin|deg)")


@dataclass(frozen=True, slots=True)
class _Session:
    """What is recorded with, and into what."""

    equipment: Equipment
    instrument: Instrument
    config: InstrumentConfig
    store: RunStore
    path: Path
    pass_s: float
    replayed: Iterator[Record] | None = None


def record(
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the new run; must not exist yet.")] = None,
    config: Annotated[
        str | None, typer.Option("--config", help="Instrument: a TOML file, or a built-in name.  [default: fact]")
    ] = None,
    append: Annotated[Path | None, typer.Option("--append", metavar="RUN", help="Go on with this run.")] = None,
    replay: Annotated[
        Path | None, typer.Option("--replay", metavar="RUN", help="Record the frames kept in this run anew, to --out.")
    ] = None,
    records: Annotated[
        int | None,
        typer.Option(min=1, help="Stop when so many records of the run count.  [default: 1300 if nothing else stops]"),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.0, help="Stop after this time.")] = None,
    until_uncertainty: Annotated[
        str | None, typer.Option(help="Stop when every facet is known to this, such as 0.3arcmin.")
    ] = None,
    keep_frames: Annotated[KeepFrames, typer.Option(help="Frames to keep in the run.")] = KeepFrames.NONE,
    every: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Start a pair this long after the one before.  [default: at once; on the twin with --records, so "
            "that they fill one pass over the region]",
        ),
    ] = None,
    region_radius_deg: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=MAX_REGION_RADIUS_DEG,
            help="Of the directions that are to be covered.  [default: of the config; 0.35]",
        ),
    ] = None,
    twin: Annotated[
        bool, typer.Option("--twin", help="Record the digital twin, in its own time, as fast as the computer can.")
    ] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the twin: another seed is another telescope.")] = None,
    twin_settings: Annotated[
        Path | None,
        typer.Option(
            "--twin-settings",
            metavar="FILE",
            help="Sky, telescope, cameras and faults of the twin: a TOML file such as config/twin/rough_night.toml.",
        ),
    ] = None,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Serve the live page on this computer meanwhile, and print its address.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an older run at --out, at once.")] = False,
) -> None:
    """Record image pairs of a star and of the reflector into a run.

    Ctrl-C stops after the record in work, as 'namod-ctl stop RUN' from another terminal does; a second one stops at
    once, and the run keeps all records before it.

    Example: namod-ctl record --twin --twin-settings config/twin/rough_night.toml --out RUN --records 300
    """
    _refuse_beyond("--minutes", minutes, MAX_MINUTES)
    _refuse_beyond("--every", every, MAX_EVERY_S)
    _refuse_beyond("--region-radius-deg", region_radius_deg, MAX_REGION_RADIUS_DEG)
    stop = _stop_rule(records, minutes, until_uncertainty, is_replay=replay is not None)
    if force and out is not None and out.is_dir():
        with recording_lock(out):  # refuses a run into which somebody records: its records would be lost
            pass
    console = Console(stderr=True, highlight=False)
    sky = None

    def tell(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    with ExitStack() as stack:
        if replay is not None:
            if twin or any(option is not None for option in (append, config, seed, every, twin_settings)):
                raise ConfigError("--replay takes everything from its run: give it --out and nothing else of the night")
            session = _replay(stack, replay, out, console, force=force)
            title = f"replay of {replay}"
        else:
            _refuse_unclear_goal(out, append, force=force)
            is_twin_wanted = twin or seed is not None or twin_settings is not None
            sky = None if is_twin_wanted else open_sky_session(stack, out, append, config, force=force, tell=tell)
            if sky is not None:
                session = _Session(sky.equipment, sky.instrument, sky.config, sky.store, sky.store.path, pass_s=0.0)
                title = session.instrument.name
            else:
                session = _record_twin(stack, out, append, config, seed, twin_settings, force=force)
                title = f"twin of {session.instrument.name}"
                if not is_twin_wanted and session.config.star_camera.device is None:
                    console.print(
                        "The config names no cameras: this records the digital twin, not a sky (--twin says so); "
                        "cameras are named in [star_camera.device] and [reflector_camera.device].",
                        markup=False,
                    )
        pace_s = every or 0.0
        if every is None and stop.n_records is not None:
            pace_s = session.pass_s / stop.n_records
        settings = replace(
            build_record_settings(session.config),
            keep_frames=keep_frames is KeepFrames.ALL,
            pace_s=pace_s,
        )
        if region_radius_deg is not None:
            settings = replace(settings, region_radius_rad=deg_to_rad(region_radius_deg))
        estimator = None
        if replay is None:
            is_waited_for = sky is None  # a twin can wait, a sky cannot
            estimator = LiveEstimator(session.store.path, session.instrument, is_waited_for=is_waited_for)
            stack.callback(estimator.close)
        recorder = Recorder(session.equipment, session.instrument, session.store, settings, estimator, session.replayed)
        if dashboard:
            address = stack.enter_context(dashboard_beside(session.store.path))
            console.print(f"live page: {address}", soft_wrap=True, markup=False)
        control = stack.enter_context(RecordingControl(session.store.path, recorder.ask_to_stop))
        with TerminalView(console, title) as view, _stopped_by_ctrl_c(recorder, console):

            def on_progress(progress: Progress) -> None:
                control.look()
                view.show(progress)

            reason = recorder.record(stop, on_progress)
            progress = recorder.progress()
            view.show(progress, now=True)
        session.store.check_in_place()
        _print_summary(session.path, reason, progress, recorder.events)


def _stop_rule(records: int | None, minutes: float | None, until: str | None, *, is_replay: bool) -> StopRule:
    if records is None and minutes is None and until is None and not is_replay:
        records = DEFAULT_N_RECORDS
    return StopRule(
        n_records=records,
        duration_s=None if minutes is None else 60.0 * minutes,
        uncertainty_rad=None if until is None else _angle_rad(until),
    )


def _refuse_beyond(option: str, value: float | None, limit: float) -> None:
    if value is not None and not value <= limit:  # NaN as well
        raise ConfigError(f"{option} {value:g}: must be at most {limit:g}")


def _angle_rad(text: str) -> float:
    match = _ANGLE.fullmatch(text.strip())
    if match is None or float(match[1]) <= 0.0:
        raise ConfigError(f"--until-uncertainty {text}: give a positive angle in arcsec, arcmin or deg: 0.3arcmin")
    to_rad = {"arcsec": arcsec_to_rad, "arcmin": arcmin_to_rad, "deg": deg_to_rad}[match[2]]
    return to_rad(float(match[1]))


def _refuse_unclear_goal(out: Path | None, append: Path | None, *, force: bool) -> None:
    if (out is None) == (append is None):
        raise ConfigError("say where the records go: --out for a new run, or --append RUN to go on with one")
    if out is not None and not force and is_run(out):
        raise ConfigError(
            f"{out}: holds a run already; go on with it by namod-ctl record --append {out}, choose another --out, or "
            "replace it with --force"
        )
    if append is not None and force:
        raise ConfigError(f"--append {append}: goes on with that run, --force would replace one; leave one of them out")


def _record_twin(
    stack: ExitStack,
    out: Path | None,
    append: Path | None,
    config: str | None,
    seed: int | None,
    settings_file: Path | None,
    *,
    force: bool,
) -> _Session:
    asked = None if settings_file is None else load_twin_settings(settings_file)
    if append is not None:
        store = stack.enter_context(RunStore.open(append, read_only=False))
        stack.enter_context(recording_lock(store.path))
        noted = noted_twin(store)
        if noted is None:
            raise ConfigError(f"{append}: was not recorded with the twin, so the twin cannot go on with it; use --out")
        settings, noted_seed = noted
        if seed is not None and seed != noted_seed:
            raise ConfigError(f"{append}: was recorded with --seed {noted_seed}, another seed is another telescope")
        if asked is not None and (different := different_sections(asked, settings)):
            raise ConfigError(
                f"{append}: was recorded with another twin than {settings_file} describes (it differs in "
                f"{', '.join(different)}); leave --twin-settings out to go on with its own"
            )
        used = InstrumentConfig.from_json(store.config_json, f"{append}: config")
        if config is not None and load_config(config) != used:
            raise ConfigError(f"{append}: was recorded with another config; leave --config out to go on with its own")
        twin = build_twin(used, settings, noted_seed)
        times_s = [r.star_mid_exposure_s for r in store.records() if math.isfinite(r.star_mid_exposure_s)]
        twin.update(max(times_s, default=0.0) + SESSION_GAP_S)
    else:
        assert out is not None
        used = load_config(config or "fact")
        chosen = DEFAULT_SEED if seed is None else seed
        settings = TwinSettings() if asked is None else asked
        try:
            twin = build_twin(used, settings, chosen)
        except ConfigError as error:  # a star that does not exist, or that has not risen
            raise ConfigError(str(error) if settings_file is None else f"{settings_file}: {error}") from None
        source = f"digital twin of {used.telescope.name}, seed {chosen}"
        if settings_file is not None:
            source += f", settings {settings_file.name}"
        facet_ids = [facet.id for facet in used.facets]
        store = stack.enter_context(RunStore.create(out, facet_ids, used.to_json(), source, twin.wall_clock, force))
        stack.enter_context(recording_lock(store.path))
        note_twin(store, settings, chosen)
    equipment = stack.enter_context(twin_equipment(used, twin))()
    return _Session(equipment, instrument_on_twin(used), used, store, store.path, twin.telescope.pass_s)


def _replay(stack: ExitStack, replay: Path, out: Path | None, console: Console, *, force: bool) -> _Session:
    if out is None:
        raise ConfigError("--replay RUN needs --out for the new run: the old one stays as it is")
    old = stack.enter_context(RunStore.open(replay))
    found = replayable_records(old)
    n_without = len(old.labels()) - len(found)
    if n_without:
        text = f"{replay}: {n_without} of its records without frames left out"
        console.print(text, markup=False, soft_wrap=True)
    config = InstrumentConfig.from_json(old.config_json, f"{replay}: config")
    run = new_run_of(old, out, old.config_json, f"replay of {old.path}", force=force)
    store = stack.enter_context(run)
    equipment = replay_equipment(old, found)
    return _Session(equipment, instrument_on_twin(config), config, store, out.resolve(), 0.0, iter(found))


@contextmanager
def _stopped_by_ctrl_c(recorder: Recorder, console: Console) -> Iterator[None]:
    """The first Ctrl-C asks the recorder to stop, the second ends the program there and then."""

    def stop_now(number: int, frame: FrameType | None) -> None:
        # threads that wait for a camera would hold up an orderly end; what is committed is safe on the disk
        console.show_cursor(True)
        os._exit(EXIT_INTERRUPTED)

    def ask_to_stop(number: int, frame: FrameType | None) -> None:
        recorder.ask_to_stop()
        signal.signal(signal.SIGINT, stop_now)

    before = signal.signal(signal.SIGINT, ask_to_stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _print_summary(path: Path, reason: str, progress: Progress, events: list[str]) -> None:
    console = Console(soft_wrap=True, highlight=False)
    n_rejected = sum(progress.rejected.values())
    console.print(f"{path}: {reason}; {progress.n_accepted} records count, {n_rejected} rejected", markup=False)
    for rejection, n in progress.rejected.items():
        console.print(f"  {n} {rejection.name}: {REJECT_REASON_MEANING[rejection]}", markup=False)
    for cause, n in progress.source.dropped.items():
        console.print(f"  {counted(n, 'pair')} retaken: {cause.value}", markup=False)
    if progress.source.n_frames_missed:
        console.print(f"  {progress.source.n_frames_missed} frames were counted by a camera but never came")
    for event in events:
        console.print(f"  {event}", markup=False)

"""`namod-ctl stop`, `pause`, `resume`, `approve`, `refuse`, `release`, `done`: word to a campaign, or a recording."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from namod_ctl.app.campaign_choice import CAMPAIGN_HELP, choose_campaign
from namod_ctl.app.views.number_ranges import numbers_of_words
from namod_ctl.core.clock import SystemClock
from namod_ctl.core.errors import ConfigError
from namod_ctl.cycle.control import ALL, Answer, Request, RequestKind, SentRequest, send
from namod_ctl.cycle.machine import FINAL, CampaignMachine
from namod_ctl.cycle.recording_control import pid_at_work
from namod_ctl.cycle.turn_marks import mark, unmark
from namod_ctl.store.campaign import CampaignStore
from namod_ctl.store.campaign_lock import running_pid
from namod_ctl.store.folders import is_run

PATIENCE_S = 10.0  # the other process looks every 50 ms; then it may have drives to halt
LOOK_S = 0.02
EXIT_REFUSED = 2

_Campaign = Annotated[Path | None, typer.Argument(metavar="CAMPAIGN", help=CAMPAIGN_HELP, show_default=False)]


def stop(
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="CAMPAIGN|RUN", help=f"Folder of a run that is recorded, or: {CAMPAIGN_HELP}", show_default=False
        ),
    ] = None,
) -> None:
    """Halt every drive at once and hold the campaign until somebody releases it; or end a recording in order.

    A recording ends as with its first Ctrl-C: after the record in work, and all its records are kept.

    Example: namod-ctl stop CAMPAIGN
    """
    if path is not None and is_run(path):
        if pid_at_work(path) is None:
            _refuse(f"nobody records into {path}, so there is nothing to stop")
        _ask(path, Request(kind=RequestKind.STOP))
        return
    _ask_running(path, RequestKind.STOP)


def pause(campaign: _Campaign = None) -> None:
    """Let the recording of a campaign wait until `namod-ctl resume`.

    Example: namod-ctl pause CAMPAIGN
    """
    _ask_running(campaign, RequestKind.PAUSE)


def resume(campaign: _Campaign = None) -> None:
    """Go on with a recording that was paused.

    A campaign whose program has ended goes on with 'namod-ctl align --resume CAMPAIGN'.

    Example: namod-ctl resume CAMPAIGN
    """
    _ask_running(campaign, RequestKind.RESUME)


def approve(campaign: _Campaign = None) -> None:
    """Let the correction that is previewed be carried out.

    Example: namod-ctl approve CAMPAIGN
    """
    _ask_running(campaign, RequestKind.APPROVE)


def refuse(campaign: _Campaign = None) -> None:
    """Do not let the correction that is previewed be carried out: nothing moves.

    Example: namod-ctl refuse CAMPAIGN
    """
    _ask_running(campaign, RequestKind.REFUSE)


def release(campaign: _Campaign = None) -> None:
    """Release a campaign that is held, after a person has looked at the telescope and found it safe to move.

    Example: namod-ctl release CAMPAIGN
    """
    path = choose_campaign(campaign)
    if running_pid(path) is not None:
        _ask(path, Request(kind=RequestKind.RELEASE))
        return
    with CampaignStore.open(path, read_only=False) as store:
        state = store.last_state()
        if state != "held":
            _refuse(
                f"there is nothing to release: {path} is not held, its state is {(state or 'idle').replace('_', ' ')}"
            )

        def journal(source: str, trigger: str, destination: str, reason: str) -> None:
            store.add_transition(source, destination, trigger, reason)

        machine = CampaignMachine(state, journal)
        machine.fire("release", "released by a person, with 'namod-ctl release'")
    typer.echo(f"Released; go on with 'namod-ctl align --resume {path}'.")


def done(
    campaign: _Campaign = None,
    facet: Annotated[
        str | None, typer.Option("--facet", metavar="IDS", help="Facets whose bolts were turned, such as 13,31,2-7.")
    ] = None,
    is_all: Annotated[bool, typer.Option("--all", help="All turns that were asked for are done.")] = False,
    undo: Annotated[
        bool, typer.Option("--undo", help="They are not done after all; until the campaign goes on this can be said.")
    ] = False,
) -> None:
    """Say which of the turns that were asked for are done, or take it back.

    Example: namod-ctl done CAMPAIGN --facet 13,31,2-7
    """
    if (facet is not None) == is_all:
        raise ConfigError("say either which facets are done (--facet 13,31) or that all are (--all)")
    facet_ids: tuple[int, ...] | Literal["all"] = ALL if facet is None else _facet_ids(facet)
    path = choose_campaign(campaign)
    if running_pid(path) is not None:
        kind = RequestKind.NOT_DONE if undo else RequestKind.DONE
        _ask(path, Request(kind=kind, facet_ids=facet_ids))
        return
    with CampaignStore.open(path, read_only=False) as store:
        typer.echo((unmark if undo else mark)(store, facet_ids))
        is_complete = all(turns.is_done for turns in store.turns())
        has_ended = store.last_state() in FINAL
    if is_complete and not has_ended:
        typer.echo(f"Go on with 'namod-ctl align --resume {path}'.")


def _ask_running(campaign: Path | None, kind: RequestKind) -> None:
    """Ask the process that works on the campaign; exit code 2 when nobody does."""
    path = choose_campaign(campaign)
    if running_pid(path) is None:
        _refuse(
            f"nobody is running {path}, so there is nothing to {kind}; 'namod-ctl status {path}' says how it stands. A "
            "program that is only just starting is not told: ask again in a moment"
        )
    _ask(path, Request(kind=kind))


def _ask(path: Path, request: Request) -> None:
    """Send the request, wait for what comes of it, and say it; exit code 2 when nothing does."""
    sent = send(path, request, SystemClock())
    try:
        answer = _wait_for_answer(path, sent)
    except BaseException:
        if request.kind is not RequestKind.STOP:  # Ctrl-C: nothing is to happen later; but a stop is never taken back
            sent.withdraw()
        raise
    if answer is None:
        typer.echo(f"Taken: {request.kind.replace('_', ' ')}.")
    elif answer.is_accepted:
        typer.echo(answer.text)
    else:
        _refuse(answer.text)


def _wait_for_answer(path: Path, sent: SentRequest) -> Answer | None:
    """The answer; None when the request was taken and nobody answered."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        pid = pid_at_work(path)  # before the looks: one who answers and ends at once has answered
        if (answer := sent.answer()) is not None:
            return answer
        is_late = time.monotonic() > deadline_s
        if pid is None or is_late:
            break
        time.sleep(LOOK_S)  # for another process there is nothing to wait on but its file
    if sent.is_taken():
        return None
    kind = sent.request.kind
    who = f"process {pid}" if pid else f"the program at work on {path}"
    if pid is not None and kind is RequestKind.STOP:
        kill = f" with 'kill {pid}'" if pid else ""
        _refuse(
            f"{who} has not looked for {PATIENCE_S:g} s; the request to stop stays until it does. Use the telescope's "
            f"own emergency stop if something moves, and end the process{kill}"
        )
    if sent.withdraw():
        _refuse(
            f"the process that worked on {path} has ended before it took this; nothing was done"
            if pid is None
            else f"{who} has not looked for {PATIENCE_S:g} s; the request was withdrawn, try again"
        )
    return None


def _facet_ids(text: str) -> tuple[int, ...]:
    try:
        return numbers_of_words(text)
    except ConfigError as problem:
        raise ConfigError(f"--facet {text}: {problem}") from None


def _refuse(why: str) -> NoReturn:
    typer.echo(f"namod-ctl: {why}", err=True)
    raise typer.Exit(EXIT_REFUSED)

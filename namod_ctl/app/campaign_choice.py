"""Which campaign a command is about when none is named; and what was meant where a run was to be named."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

import typer

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME, is_campaign, require_campaign
from namod_ctl.store.folders import is_run, require_run

CAMPAIGN_HELP = "Folder of the campaign.  [default: the one in or at the current folder that changed last]"


def choose_campaign(named: Path | None) -> Path:
    """The campaign that was named, else the current folder, else the one in it that changed last, saying which.

    Raises
    ------
    ConfigError
        The one that was named is none, or there is none in the current folder.
    """
    if named is not None:
        require_campaign(named)
        return named
    here = Path.cwd()
    found = [here] if is_campaign(here) else [entry for entry in here.iterdir() if is_campaign(entry)]
    found = [entry for entry in found if not entry.name.startswith(".")]  # one that is being made or deleted
    if not found:
        raise ConfigError(f"{here}: there is no campaign in this folder; name one, or begin one with 'namod-ctl align'")
    newest = max(found, key=_changed_ns)
    typer.echo(f"Campaign {newest.name}.", err=True)
    return newest


def check_run(path: Path) -> None:
    """Raise ConfigError when there is no run at `path`: naming the runs of a campaign, or a folder of similar name."""
    if is_run(path):
        return
    if is_campaign(path):
        runs = sorted(entry for entry in path.iterdir() if is_run(entry))
        named = f"its runs are {', '.join(map(str, runs))}; name one of them" if runs else "it has no run yet"
        raise ConfigError(f"{path}: this is a campaign; {named}")
    if not path.exists() and path.parent.is_dir():
        beside = [entry.name for entry in path.parent.iterdir() if is_run(entry)]
        if similar := get_close_matches(path.name, beside, n=1, cutoff=0.7):
            raise ConfigError(f"{path}: there is no run here; did you mean {path.with_name(similar[0])}?")
    require_run(path)


def _changed_ns(campaign: Path) -> int:
    database = campaign / CAMPAIGN_DATABASE_NAME
    changed_ns = database.stat().st_mtime_ns
    log = database.with_name(database.name + "-wal")  # what is written goes there first; readers leave it empty
    if log.exists() and log.stat().st_size:
        changed_ns = max(changed_ns, log.stat().st_mtime_ns)
    return changed_ns

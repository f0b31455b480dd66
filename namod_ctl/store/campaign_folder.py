"""Where a new campaign may go, and how it gets there without endangering what lies there."""

from __future__ import annotations

from pathlib import Path

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.campaign_database import CAMPAIGN_DATABASE_NAME, connect_new_campaign, is_campaign
from namod_ctl.store.campaign_lock import CampaignLock
from namod_ctl.store.database import store_errors, transaction
from namod_ctl.store.folders import discard, free_sibling, put_in_place
from namod_ctl.store.frames import sync_folder

CONTROL_FOLDER = "control"  # where requests from another terminal lie


def check_campaign_output(path: Path, *, force: bool) -> None:
    """Raise ConfigError when no new campaign may be put at `path`; `folders.check_output` has the same rules."""
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: the folder {path.parent} for the output does not exist; make it first")
    if not path.exists():
        return
    if not path.is_dir():
        raise ConfigError(f"{path}: is a file, not a campaign, and is left alone; choose another --out")
    is_replaceable = is_campaign(path) or not any(path.iterdir())
    if not force:
        hint = "choose another, go on with it (--resume), or replace it with --force"
        raise ConfigError(f"{path}: the output folder exists; {hint if is_replaceable else 'choose another'}")
    if not is_replaceable:
        raise ConfigError(
            f"{path}: holds files but no campaign ({CAMPAIGN_DATABASE_NAME} is missing); it is not replaced even "
            "with --force; choose another --out"
        )


def put_campaign_in_place(built: Path, path: Path) -> None:
    """Move the folder `built` to `path`; the campaign that it replaces is locked, moved aside and deleted after."""
    if not path.exists():
        put_in_place(built, path, force=False)
        return
    lock = CampaignLock.take(path)
    try:
        old = free_sibling(path)
        with store_errors(path):
            path.rename(old)
        try:
            put_in_place(built, path, force=False)
        except BaseException:
            old.rename(path)
            raise
        discard(old)
    finally:
        lock.release()


def write_empty_campaign(folder: Path, meta: dict[str, str]) -> None:
    """Make a campaign without any cycle at `folder`, where there is nothing yet. Raises StoreError."""
    database = folder / CAMPAIGN_DATABASE_NAME
    with store_errors(database):
        (folder / CONTROL_FOLDER).mkdir(parents=True)
        connection = connect_new_campaign(database)
        try:
            with transaction(connection):
                connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
        finally:
            connection.close()
        sync_folder(folder)

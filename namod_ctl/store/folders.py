"""Where a new run may go, and how it gets there without endangering what lies there.

A run that takes long to make is built in a folder beside its place (`RUN.partial`) and takes its place when it
is complete; an old run that it replaces is there until that moment. After a crash the disk holds the old run,
the unfinished one, or both; never half of one under the name of the other.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable
from pathlib import Path

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.database import DATABASE_NAME, store_errors
from namod_ctl.store.frames import sync_folder

_MOST_NAMED = 6


def partial_folder(path: Path) -> Path:
    """Where the run that will be `path` is built."""
    return path.with_name(path.name + ".partial")


def is_run(path: Path) -> bool:
    """True for a folder that holds a run."""
    return (path / DATABASE_NAME).is_file()


def named_near(path: Path, is_sought: Callable[[Path], bool]) -> str:
    """What a person may have meant by `path`: folders in it or else beside it that are sought, as a sentence's end."""
    for folder in (path, path.parent):
        try:
            found = sorted(entry for entry in folder.iterdir() if entry.name[0] != "." and is_sought(entry))
        except OSError:
            continue  # there is no such folder, or we may not look into it
        if found:
            more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
            return f"; there {'is' if len(found) == 1 else 'are'} {', '.join(map(str, found[:_MOST_NAMED]))}{more}"
    return ""


def require_run(path: Path) -> None:
    """Raise ConfigError when there is no run at `path`."""
    if is_run(path):
        return
    hint = "make one with 'namod-ctl record --out' or 'namod-ctl import'"
    if is_run(partial_folder(path)):
        hint = f"an unfinished import lies in {partial_folder(path)}: finish it with --resume"
    near = named_near(path, is_run)
    raise ConfigError(f"{path}: there is no run here ({DATABASE_NAME} is missing){near}; {hint}")


def check_output(path: Path, *, force: bool) -> None:
    """Raise ConfigError when no new run may be put at `path`.

    Without `force` the path must be free; with it, a run or an empty folder may be replaced, nothing else.
    """
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: the folder {path.parent} for the output does not exist; make it first")
    if not path.exists():
        return
    if not path.is_dir():
        raise ConfigError(f"{path}: is a file, not a run, and is left alone; choose another --out")
    is_replaceable = is_run(path) or not any(path.iterdir())
    if not force:
        hint = "choose another, or replace it with --force" if is_replaceable else "choose another"
        raise ConfigError(f"{path}: the output folder exists; {hint}")
    if not is_replaceable:
        raise ConfigError(
            f"{path}: holds files but no run ({DATABASE_NAME} is missing); it is not replaced even with --force; "
            "choose another --out"
        )


def free_sibling(path: Path) -> Path:
    """A hidden path beside `path`, so on the same disk, at which there is nothing yet."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def put_in_place(built: Path, path: Path, *, force: bool) -> None:
    """Move the folder `built` to `path`; what `force` allows to replace is deleted after that.

    Raises ConfigError as `check_output`, StoreError when the file system refuses (then `path` is as before).
    """
    check_output(path, force=force)
    with store_errors(path):
        if not path.exists():
            built.rename(path)
            sync_folder(path.parent)
            return
        old = free_sibling(path)
        path.rename(old)
        try:
            built.rename(path)
        except BaseException:
            old.rename(path)
            raise
        sync_folder(path.parent)
    shutil.rmtree(old, ignore_errors=True)


def discard(folder: Path) -> None:
    """Delete a folder of ours with all it holds; a folder that is not there is fine."""
    shutil.rmtree(folder, ignore_errors=True)

"""Who records into a run: a lock that the operating system lets go of when its holder dies, however it dies."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from namod_ctl.core.errors import ConfigError
from namod_ctl.store.database import store_errors


@contextmanager
def recording_lock(run: Path) -> Iterator[None]:
    """Nobody else records into the run in that folder meanwhile; reading and reconstructing it is free.

    The lock lies on the folder itself: it leaves no file, and does not meet the locks of SQLite. Where the file system
    knows no such locks (some on a network), none is taken.

    Raises
    ------
    ConfigError
        Another process records into it.
    StoreError
        The folder cannot be opened.
    """
    with store_errors(run):
        descriptor = os.open(run, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{run}: another program records into this run at the moment; wait until it has ended, or record to "
                "another --out"
            ) from None
        except OSError:
            pass
        yield
    finally:
        os.close(descriptor)

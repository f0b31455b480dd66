"""Which troubles of the disk a recording waits out."""

from __future__ import annotations

import errno
import sqlite3

from namod_ctl.core.errors import StoreError

_DISK_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ENOENT, errno.ESTALE)
_DISK_CODES = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN)


def is_mended_by_waiting(error: StoreError) -> bool:
    """True for a disk that is full, gone or busy; False for a run that is damaged or was replaced."""
    cause = error.__cause__
    if isinstance(cause, sqlite3.Error):
        return getattr(cause, "sqlite_errorcode", -1) & 0xFF in _DISK_CODES
    return isinstance(cause, OSError) and cause.errno in _DISK_ERRNOS

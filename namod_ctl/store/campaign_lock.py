"""Who is at work on a campaign: a lock that the operating system lets go of when its holder dies, however it dies."""

from __future__ import annotations

import fcntl
import os
from dataclasses import dataclass
from pathlib import Path

from namod_ctl.core.errors import StoreError
from namod_ctl.store.database import store_errors

LOCK_NAME = "campaign.lock"
UNKNOWN_PID = 0  # somebody holds the lock and has not yet written who
_MAX_TRIES = 10_000  # a reader who looks holds the lock for some microseconds


@dataclass(frozen=True, slots=True)
class CampaignLock:
    """The lock on a campaign, held until `release` or the end of the process."""

    descriptor: int

    @classmethod
    def take(cls, campaign: Path) -> CampaignLock:
        """The lock on the campaign in that folder. Raises StoreError when a process has it."""
        path = campaign / LOCK_NAME
        with store_errors(path):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                if not _lock(descriptor):
                    pid = _read_pid(descriptor)
                    raise StoreError(
                        f"{campaign}: {f'process {pid}' if pid else 'another process'} is at work on this campaign; "
                        f"meanwhile 'namod-ctl status {campaign}' shows what it does, and "
                        f"'namod-ctl stop {campaign}' stops it"
                    )
                if not os.path.samestat(os.fstat(descriptor), path.stat()):
                    raise StoreError(f"{campaign}: the campaign was replaced by another at this moment; try again")
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
            except BaseException:
                os.close(descriptor)
                raise
        return cls(descriptor)

    def release(self) -> None:
        """Let others work on the campaign."""
        os.close(self.descriptor)


def running_pid(campaign: Path) -> int | None:
    """Id of the process that is at work on the campaign, `UNKNOWN_PID` in its first moment; None when nobody is.

    The lock tells, never the file: a process that was killed has left its file, but no lock. Raises StoreError.
    """
    path = campaign / LOCK_NAME
    with store_errors(path):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        try:
            return None if _try(descriptor, fcntl.LOCK_SH) else _read_pid(descriptor)
        finally:
            os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Take the lock for writing; False when a writer has it. Readers who look at it are waited for."""
    for _ in range(_MAX_TRIES):
        if _try(descriptor, fcntl.LOCK_EX):
            return True
        if not _try(descriptor, fcntl.LOCK_SH):  # readers would not be in the way of this one
            return False
    return False


def _try(descriptor: int, operation: int) -> bool:
    try:
        fcntl.flock(descriptor, operation | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read_pid(descriptor: int) -> int:
    text = os.pread(descriptor, 20, 0).strip()
    return int(text) if text.isdigit() else UNKNOWN_PID

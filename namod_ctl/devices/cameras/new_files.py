"""Which files of a folder have come, or changed, since a moment; also where it holds thousands of old ones.

What was there before is told from what is new by the file system's own clock: by the time of a file that is written at
the moment. So it does not matter how far the clocks of two computers are apart.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path

SETTLED_S = 0.03
"""A file that has not changed for so long is taken for written; whether it is whole, its content says."""

LOOK_AT_ALL_EVERY_S = 0.2
"""A file that is overwritten in its place does not change its folder, and is seen when all are looked at."""
MAX_LOOKING_SHARE = 0.5
"""Of the time, at most, goes into looking at all: some 10 ms per thousand files."""

Stamp = tuple[int, int, int]
"""Inode, size and time of change of the content."""


class NewFiles:
    """Files that `is_wanted` says are of interest, by name. Raises OSError in all methods when the folder is gone."""

    def __init__(self, folder: Path, is_wanted: Callable[[str], bool]) -> None:
        self._folder, self._is_wanted = folder, is_wanted
        self._old: dict[str, Stamp] = {}
        self._old |= {name: stamp for name, (stamp, _) in self._look_at_all().items()}
        self._unfinished: dict[str, int] = {}
        self._since_ns = 0
        self._folder_changed_ns = 0
        self._look_at_all_from_s = -math.inf
        self._watched: dict[str, tuple[Stamp, float]] = {}

    def begin(self, mark: Path) -> None:
        """From now on files are new that come after `mark`, which was written just now, into the same folder."""
        # what is there but was never looked at may be being written: it was begun before, and stays the same file
        unknown = [name for name in os.listdir(self._folder) if name not in self._old and self._is_wanted(name)]
        seen = {name: _seen(self._folder / name) for name in unknown}
        self._unfinished = {name: what[0][0] for name, what in seen.items() if what is not None}
        self._since_ns = mark.stat().st_ctime_ns
        self._watched.clear()
        self._look_at_all_from_s = -math.inf

    def settled(self, now_s: float) -> list[tuple[str, float]]:
        """Names of the new files that do not change any more, and since when, on the clock of `now_s`; oldest first."""
        found = []
        for name, (stamp, changed_ns) in self._look(now_s).items():
            if self._old.get(name) == stamp:
                continue
            is_unfinished = self._unfinished.get(name) == stamp[0]
            if changed_ns <= self._since_ns and not is_unfinished:
                self._old[name] = stamp
                continue
            if name not in self._watched or self._watched[name][0] != stamp:
                self._watched[name] = (stamp, now_s)
            since_s = self._watched[name][1]
            if now_s - since_s < SETTLED_S:
                continue
            if is_unfinished:
                self.dismiss(name)
            else:
                found.append((changed_ns, name, since_s))
        return [(name, since_s) for _, name, since_s in sorted(found)]

    def dismiss(self, name: str) -> None:
        """That file is dealt with, until it changes."""
        self._unfinished.pop(name, None)
        self._old[name], _ = self._watched.pop(name)

    def _look(self, now_s: float) -> dict[str, tuple[Stamp, int]]:
        changed_ns = self._folder.stat().st_mtime_ns
        if changed_ns == self._folder_changed_ns and now_s < self._look_at_all_from_s:
            return {name: seen for name in self._watched if (seen := _seen(self._folder / name)) is not None}
        began_s = time.monotonic()
        everything = self._look_at_all()
        pause_s = max(LOOK_AT_ALL_EVERY_S, (time.monotonic() - began_s) / MAX_LOOKING_SHARE)
        self._folder_changed_ns, self._look_at_all_from_s = changed_ns, now_s + pause_s
        return everything

    def _look_at_all(self) -> dict[str, tuple[Stamp, int]]:
        with os.scandir(self._folder) as entries:
            wanted = [entry for entry in entries if entry.name in self._old or self._is_wanted(entry.name)]
            seen = {entry.name: _seen(entry) for entry in wanted}
        return {name: what for name, what in seen.items() if what is not None}


def _seen(entry: os.DirEntry[str] | Path) -> tuple[Stamp, int] | None:
    """Stamp, and time of the last change of any kind; None for a file that is gone meanwhile."""
    try:
        status = entry.stat()
    except FileNotFoundError:
        return None
    return (status.st_ino, status.st_size, status.st_mtime_ns), status.st_ctime_ns

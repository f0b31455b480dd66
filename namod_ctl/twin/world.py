"""A twin's world that outlives the program: a file of everything that came in from outside, and the twin made from it.

A real telescope stays as it is when the program is killed, and its drives finish their moves. The twin lives inside of
the program, but it is a function of its seed and of what came in: telegrams that drives obeyed, faults that were
injected, bolts that were turned. These are lines of JSON in the order in which they happened, each with the moment `t`
on the twin's clock, and lines with the time alone in between. The first line says which twin it is.

- `{"t": 3.5, "bus": "east", "telegram": "0104000000000064..."}`: bytes that may have changed a drive, without
  what faults of the line did to them; questions are not written.
- `{"t": 3.5, "fault": "stuck_leg", "from_s": 3.5, "for_s": null, "params": {...}}`
- `{"t": 3.5, "facet": 13, "travel_m": [...]}`, `{"t": 3.5, "tilt_rad": [[...], ...]}`: turned by hand.
- `{"t": 3.5, "frames": [12, 12]}`, `{"t": 3.5}`: time has passed; frames of the star and the reflector camera.

A line is written before the drives answer, in one piece, to the system (which survives a kill of the program, not a
loss of power). A last line without its end was never obeyed; it is cut off.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.twin.settings import FaultSpec
from namod_ctl.twin.twin import Twin

VERSION = 1
DEAD_S = 60.0
"""So long nobody runs the program after it was killed: drives that were under way have arrived."""


class World:
    """The file of one twin, open for what comes next; safe to use from all threads.

    Attributes
    ----------
    path
        Of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        self._size = os.fstat(self._file).st_size

    def note(self, time_s: float, what: Mapping[str, Any]) -> None:
        """Write a line. Raises StoreError when it cannot be written; then the file is as before."""
        self._write({"t": time_s, **what})

    def begin(self, identity: Mapping[str, Any]) -> None:
        """Write the first line. Raises StoreError."""
        self._write(identity)

    def close(self) -> None:
        """Let go of the file; what comes in after that fails."""
        with self._lock:
            os.close(self._file)

    def _write(self, what: Mapping[str, Any]) -> None:
        line = json.dumps(what).encode() + b"\n"
        with self._lock:
            try:
                is_whole = os.write(self._file, line) == len(line)
                reason = "the disk is full"
            except OSError as error:
                is_whole, reason = False, error.strerror or str(error)
            if not is_whole:
                os.ftruncate(self._file, self._size)
                raise StoreError(f"{self.path}: the twin's world cannot be written: {reason}; make room and resume")
            self._size += len(line)


def open_world(path: Path, twin: Twin, dead_s: float = DEAD_S) -> World:
    """The twin's world in a file, new or resumed; from now on all that comes in to the twin is written there.

    `twin` must be new. It is brought to the state in which the file leaves it, `dead_s` later. Its motors stand where
    they would stand to the last bit if nobody had looked at them in between; questions, which are not written, split
    the sums that carry a motor along its ramp, so that it differs by rounding (1e-9 steps).

    What a real telescope would keep is kept: reflector, drives with settings, home and faults, their log, the clock.
    Not kept: a running exposure, and half a telegram on a line. Faults of lines are drawn anew from their beginning.

    Raises
    ------
    ConfigError
        The file belongs to another twin: seed, settings or wiring differ.
    StoreError
        The file is damaged, or cannot be written.
    """
    identity = {"world": VERSION, "seed": twin.drives.seed, "twin": _fingerprint(twin)}
    try:
        lines = _whole_lines(path)
        world = World(path)
    except OSError as error:
        raise StoreError(f"{path}: the twin's world cannot be opened: {error.strerror}") from error
    if lines:
        _replay(path, lines, identity, twin)
        twin.update(twin.clock.monotonic_s() + dead_s)
    else:
        world.begin(identity)
    twin.keep_journal(world.note)
    world.note(twin.clock.monotonic_s(), {})
    return world


def _fingerprint(twin: Twin) -> str:
    """Of what a twin is made of, besides the instrument."""
    made_of = repr((twin.settings, tuple(twin.drives.wiring.values())))
    return hashlib.sha256(made_of.encode()).hexdigest()


def _whole_lines(path: Path) -> list[bytes]:
    """All lines of a file that may not exist; a torn last one is cut off the file."""
    if not path.exists():
        return []
    data = path.read_bytes()
    size = data.rfind(b"\n") + 1
    if size < len(data):
        os.truncate(path, size)
    return data[:size].splitlines()


def _replay(path: Path, lines: list[bytes], identity: Mapping[str, Any], twin: Twin) -> None:
    for number, line in enumerate(lines, start=1):
        try:
            event = json.loads(line.decode())
            if number > 1:
                _repeat(event, twin)
            elif event["world"] != VERSION:
                raise ValueError(f"version {event['world']}; this program reads {VERSION}")
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError) as problem:
            raise StoreError(
                f"{path}: line {number} of the twin's world is damaged ({type(problem).__name__}: {problem}); restore "
                "the file from a copy, or begin a new campaign"
            ) from problem
        if number == 1 and event != identity:
            raise ConfigError(
                f"{path}: this is the world of another twin (seed {event.get('seed')}); resume with the seed, the "
                "settings and the wiring that it was begun with, or begin a new campaign"
            )


def _repeat(event: dict[str, Any], twin: Twin) -> None:
    """Let happen again what happened."""
    twin.clock.advance_to_s(event["t"])
    match event:
        case {"telegram": telegram}:
            twin.drives.receive(event["bus"], bytes.fromhex(telegram))
        case {"fault": name}:
            twin.drives.inject(FaultSpec(name, event["from_s"], event["for_s"], event["params"]))
        case {"tilt_rad": tilts}:
            twin.apply_correction(np.array(tilts, dtype=np.float64))
        case {"travel_m": travels}:
            twin.move_legs(event["facet"], np.array(travels))
        case _:
            if "frames" in event:
                twin.star_camera.n_frames, twin.reflector_camera.n_frames = event["frames"]
            twin.drives.update(event["t"])  # sag and facets need not follow before the end

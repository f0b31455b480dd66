"""The cameras that all drivers see, whatever a maker's library does: hang, crash, or write to the terminal.

Every driver is asked in a process of its own, all at the same time, and no longer than `PATIENCE_S`.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from namod_ctl.core.errors import NamodError
from namod_ctl.devices.cameras.found import FoundCamera

DRIVERS = {
    driver: f"namod_ctl.devices.cameras.{driver}_camera"
    for driver in ("pylon", "genicam", "ueye", "alpaca", "indi", "opencv")
}
"""By the name that the config uses, the module with its `list_cameras`; a folder may be anywhere, and is not listed."""

PATIENCE_S = 20.0
"""A search in the network takes seconds, the first import of a maker's library as long on a slow computer."""


@dataclass(frozen=True, slots=True)
class DriverListing:
    """What one driver sees, or `remark`: why it cannot look, and what to do about it."""

    driver: str
    cameras: tuple[FoundCamera, ...]
    remark: str = ""


def list_all_cameras(drivers: Mapping[str, str] = DRIVERS, patience_s: float = PATIENCE_S) -> list[DriverListing]:
    """What every driver sees, in the order of `drivers`; takes `patience_s` at most."""
    context = multiprocessing.get_context("spawn")  # a fork would inherit what libraries and threads hold
    asked: dict[str, tuple[SpawnProcess, Connection]] = {}
    for driver, module in drivers.items():
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_look, args=(module, theirs), daemon=True)
        process.start()
        theirs.close()  # so that an end of file is seen when the process ends
        asked[driver] = (process, ours)
    deadline_s = time.monotonic() + patience_s
    pending = {connection for _, connection in asked.values()}
    while pending and (left_s := deadline_s - time.monotonic()) > 0.0:
        pending -= set(wait(list(pending), left_s))
    listings = [
        _listing(driver, process, connection, is_hung=connection in pending, patience_s=patience_s)
        for driver, (process, connection) in asked.items()
    ]
    for process, connection in asked.values():
        process.kill()  # those that hang, and makers' threads that hold up the end of others
        process.join()
        connection.close()
    return listings


def _listing(
    driver: str, process: SpawnProcess, connection: Connection, *, is_hung: bool, patience_s: float
) -> DriverListing:
    if is_hung:
        return DriverListing(driver, (), f"did not answer within {patience_s:g} s; end other programs that use cameras")
    try:
        answer = connection.recv()
    except EOFError:
        process.join(1.0)
        return DriverListing(driver, (), f"its library crashed (exit code {process.exitcode}); install it anew")
    return DriverListing(driver, (), answer) if isinstance(answer, str) else DriverListing(driver, tuple(answer))


def _look(module: str, connection: Connection) -> None:
    """In a process of its own: send the cameras, or the text of what is wrong."""
    with open(os.devnull, "w") as nowhere:  # makers' libraries write what they like, and --json must stay JSON
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    answer: list[FoundCamera] | str
    try:
        answer = list(importlib.import_module(module).list_cameras())
    except NamodError as error:
        answer = str(error)
    except Exception as error:  # noqa: BLE001 - whatever a maker's library raises must not hide the other drivers
        answer = f"failed: {type(error).__name__}: {error}"
    connection.send(answer)
    connection.close()

"""The properties of an INDI server's devices, kept up to date by a thread of its own.

indipyclient speaks the protocol in asyncio. Its loop runs in one thread from `__init__` to `close`; other threads read
what has arrived, wait for what is to arrive, and queue what is to be sent.

Source: INDI protocol version 1.7 (properties, states Idle, Ok, Busy, Alert).
"""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from namod_ctl.core.errors import ConfigError

CONNECT_TIMEOUT_S: Final = 5.0
_WATCH_S: Final = 0.05
_JOIN_S: Final = 0.3  # a camera closes within 0.5 s
_N_MESSAGES: Final = 3

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class IndiProperty:
    """One property (vector) of a device as last heard of.

    Attributes
    ----------
    state
        "Idle", "Ok", "Busy" or "Alert".
    values
        Of its members; numbers as text, switches as "On" and "Off"; empty for BLOBs.
    limits
        Lowest and highest value of number members.
    n_updates
        Counts what the device said of it.
    """

    state: str
    values: Mapping[str, str]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    n_updates: int = 0


class IndiClient:
    """A connection to an INDI server.

    Parameters
    ----------
    listen
        Called in the client's thread with every event of indipyclient, after the properties are up to date; must not
        block.

    Raises
    ------
    OSError
        Nobody answers there.
    ConfigError
        indipyclient is not installed.
    """

    def __init__(self, host: str, port: int, listen: Callable[[Any], None]) -> None:
        self._listen = listen
        self._changed = threading.Condition()
        self._properties: dict[tuple[str, str], IndiProperty] = {}
        self._messages: list[str] = []
        self._lost = ""
        self._is_made = False
        self._wire = _make_wire(host, port, self._hear)
        with socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S):
            pass  # indipyclient would go on trying for ever
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name=f"indi {host}:{port}", daemon=True)
        self._thread.start()
        if not self.wait(lambda: self._is_made, CONNECT_TIMEOUT_S):
            self.close()
            raise TimeoutError("no connection")

    @property
    def lost(self) -> str:
        """Why the connection ended; empty while it is there."""
        return self._lost

    @property
    def messages(self) -> str:
        """What the server's devices said last, for a person."""
        with self._changed:
            return "; ".join(self._messages)

    def devices(self) -> list[str]:
        """Names of the devices that have defined properties so far."""
        with self._changed:
            return sorted({device for device, _ in self._properties})

    def find(self, device: str, name: str) -> IndiProperty | None:
        """The property; None while it is not defined."""
        with self._changed:
            return self._properties.get((device, name))

    def wait(self, condition: Callable[[], Result], timeout_s: float) -> Result:
        """What `condition` gives, as soon as it is true or else when the time or the connection is over."""
        with self._changed:
            self._changed.wait_for(lambda: condition() or self._lost, timeout_s)
            return condition()

    def wake(self) -> None:
        """Let those who wait look again."""
        with self._changed:
            self._changed.notify_all()

    def send(self, device: str, name: str, members: Mapping[str, str | float]) -> None:
        """Ask the device for these values, after what was sent before."""
        self._schedule(self._wire.send_newVector(device, name, members=dict(members)))

    def enable_blobs(self, device: str, name: str) -> None:
        """Have the server send what this property holds, besides all else."""
        self._schedule(self._wire.send_enableBLOB("Also", device, name))

    def close(self) -> None:
        """End the connection and the thread; harmless when that was done."""
        with suppress(RuntimeError):  # the loop is closed already
            self._loop.call_soon_threadsafe(self._end.set)
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def _schedule(self, task: Any) -> None:
        try:
            asyncio.run_coroutine_threadsafe(task, self._loop)
        except RuntimeError:  # the loop is closed: the connection is lost, which whoever waits will be told
            task.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._talk())
        finally:
            self._lose("the connection was closed")
            self._loop.close()

    async def _talk(self) -> None:
        """Run the client until `close`, or until the server ends the connection."""
        talking = asyncio.create_task(self._wire.asyncrun())
        while not self._end.is_set() and not talking.done():
            # indipyclient 0.9.4 takes the end of the stream for silence, and finds out after 40 s
            if self._is_made and (self._wire._reader is None or self._wire._reader.at_eof()):
                self._lose("the server ended the connection")
                break
            with suppress(TimeoutError):
                await asyncio.wait_for(self._end.wait(), _WATCH_S)
        talking.cancel()
        with suppress(asyncio.CancelledError):
            await talking

    def _lose(self, why: str) -> None:
        with self._changed:
            self._lost = self._lost or why
            self._changed.notify_all()

    def _hear(self, event: Any) -> None:
        """Keep what an event of indipyclient says."""
        key = (event.devicename, event.vectorname)
        with self._changed:
            if event.eventtype == "ConnectionMade":
                self._is_made = True
            elif event.eventtype == "Message" and event.devicename is not None:
                self._messages = [*self._messages, str(event.message)][-_N_MESSAGES:]
            elif event.eventtype == "Delete":
                gone = [known for known in self._properties if known[0] == key[0] and key[1] in (None, known[1])]
                for known in gone:
                    del self._properties[known]
            elif event.vector is not None and event.eventtype in ("Define", "DefineBLOB", "Set", "SetBLOB"):
                before = self._properties.get(key)
                self._properties[key] = IndiProperty(
                    event.vector.state,
                    {} if "BLOB" in event.eventtype else {name: str(event.vector[name]) for name in event.vector},
                    _limits_of(event.vector),
                    0 if before is None else before.n_updates + 1,
                )
        self._listen(event)
        self.wake()


def _limits_of(vector: Any) -> dict[str, tuple[float, float]]:
    if vector.vectortype != "NumberVector":
        return {}
    return {name: (float(member.min), float(member.max)) for name, member in vector.members().items()}


def _make_wire(host: str, port: int, hear: Callable[[Any], None]) -> Any:
    """indipyclient's client, handing its events on."""
    try:
        from indipyclient import IPyClient
    except ImportError as error:
        raise ConfigError(
            "cameras on an INDI server need indipyclient: install it with pip install 'namod-ctl[indi]'"
        ) from error
    logging.getLogger("indipyclient").addHandler(logging.NullHandler())  # errors are told, here and only once

    class Wire(IPyClient):  # type: ignore[misc]
        async def rxevent(self, event: Any) -> None:
            hear(event)

    wire = Wire(host, port)
    wire.enable_reports = False
    return wire

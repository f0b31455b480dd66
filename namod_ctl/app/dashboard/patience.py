"""Connections that say nothing: kept for a moment, a few at a time, so that they cannot take the place of pages.

A server that waits for ever for the rest of a request can be silenced by anybody who opens many connections and sends
a byte now and then. Here a connection that has not sent a whole request head in time is closed, and when too many are
silent at once the one that has been so longest goes first: a browser's request comes whole within milliseconds.
"""

from __future__ import annotations

import asyncio
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE_S: Final = 5.0
MAX_SILENT: Final = 128

_silent: dict[PatientProtocol, asyncio.TimerHandle] = {}
"""Connections that have not finished saying what they want, the one that is silent longest first."""


class PatientProtocol(H11Protocol):
    """uvicorn's HTTP protocol, with the end of its patience."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._begin_waiting()

    def data_received(self, data: bytes) -> None:
        """Wait on while what has come is no whole head of a request."""
        super().data_received(data)
        if self._is_served():
            self._end_waiting()
        elif self not in _silent:
            self._begin_waiting()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nobody to wait for any more."""
        self._end_waiting()
        super().connection_lost(exc)

    def _is_served(self) -> bool:
        cycle: Any = self.cycle
        return cycle is not None and not cycle.response_complete

    def _begin_waiting(self) -> None:
        if len(_silent) >= MAX_SILENT:
            next(iter(_silent))._give_up()
        _silent[self] = self.loop.call_later(PATIENCE_S, self._give_up)

    def _end_waiting(self) -> None:
        timer = _silent.pop(self, None)
        if timer is not None:
            timer.cancel()

    def _give_up(self) -> None:
        self._end_waiting()
        if not self.transport.is_closing():
            self.transport.abort()

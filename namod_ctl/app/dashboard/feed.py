"""The feed: looks at the disk while anybody listens, and tells every listener what has changed.

One thread reads, whatever the number of listeners; each section is turned into text once. A listener that is slow gets
the newest state of each section and never a backlog, so that memory does not grow.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeVar

from namod_ctl.app.dashboard.state import Sections, Watched

LOOK_EVERY_S: Final = 0.025
"""A look at what has not changed costs 0.1 ms; a change is seen after half of this on average."""

REST_PER_LISTENER_S: Final = 0.001
"""After every telling, for each listener: that much it costs about, and the recording needs the computer more."""

KEEP_ALIVE_S: Final = 15.0
"""Something is sent at least so often: a listener that has gone is noticed by then."""

MAX_LISTENERS: Final = 200

_T = TypeVar("_T")


class _Listener:
    """Which sections one page has not been told yet."""

    def __init__(self) -> None:
        self.stale: set[str] = set()
        self.is_told = asyncio.Event()

    def tell(self, names: set[str]) -> None:
        self.stale |= names
        self.is_told.set()


class Feed:
    """What `path` holds, for any number of listeners; `start` before and `close` after use."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._thread = ThreadPoolExecutor(1, "dashboard-reader")  # databases are read in one thread only
        self._watched: Watched | None = None
        self._sections: Sections = {}
        self._listeners: set[_Listener] = set()
        self._looking: asyncio.Task[None] | None = None
        self._is_over = False

    async def start(self) -> None:
        """Open the run or campaign. Raises ConfigError and StoreError."""
        self._watched = await self._in_thread(lambda: Watched(self._path))

    async def close(self) -> None:
        """Let go of everything; every listener is told to end."""
        if self._looking is not None:
            self._looking.cancel()
        watched = self._watched
        if watched is not None:
            await self._in_thread(watched.close)
        self._thread.shutdown(wait=False)

    def dismiss(self) -> None:
        """Have every listener end: the page's program is about to."""
        self._is_over = True
        self._wake_all()

    @property
    def watched(self) -> Watched:
        """What is looked at; its methods are for `ask` only."""
        assert self._watched is not None
        return self._watched

    @property
    def is_full(self) -> bool:
        """No room for another listener."""
        return len(self._listeners) >= MAX_LISTENERS

    async def ask(self, question: Callable[[Watched], _T]) -> _T:
        """The answer of the reading thread."""
        watched = self.watched
        return await self._in_thread(lambda: question(watched))

    async def events(self) -> AsyncIterator[str]:
        """Text of server-sent events: everything first, then what changes, for as long as the caller listens."""
        listener = _Listener()
        self._listeners.add(listener)
        try:
            yield f"retry: 1000\nevent: clock\ndata: {time.time():.2f}\n\n"  # a phone's own may be wrong
            await self._begin_looking()
            listener.tell(set(self._sections))
            while self._looking is not None and not self._looking.done() and not self._is_over:
                try:
                    await asyncio.wait_for(listener.is_told.wait(), KEEP_ALIVE_S)
                except TimeoutError:
                    yield ": still here\n\n"
                    continue
                listener.is_told.clear()
                names, listener.stale = listener.stale, set()
                yield "".join(f"event: {name}\ndata: {self._sections[name]}\n\n" for name in sorted(names))
        finally:
            self._listeners.discard(listener)

    async def _begin_looking(self) -> None:
        """Have the disk looked at, if it is not already."""
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._look_while_listened_to())
            self._looking.add_done_callback(lambda _: self._wake_all())
        await self._look()

    async def _look_while_listened_to(self) -> None:
        rest_s = LOOK_EVERY_S
        while self._listeners:
            await asyncio.sleep(rest_s)
            is_news = await self._look()
            rest_s = max(LOOK_EVERY_S, is_news * REST_PER_LISTENER_S * len(self._listeners))

    async def _look(self) -> bool:
        """Tell all listeners what has changed; False when nothing has."""
        changed = await self.ask(lambda watched: watched.look())
        self._sections |= changed
        if changed:
            for listener in self._listeners:
                listener.tell(set(changed))
        return bool(changed)

    def _wake_all(self) -> None:
        """So that every listener sees that nobody looks any more, and its page comes again."""
        for listener in self._listeners:
            listener.is_told.set()

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

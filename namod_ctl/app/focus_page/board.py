"""The last two minutes of the focus course, and the pages that are told of them.

A page that comes gets all of it, then what is new; one that is slow gets more at once. Nothing grows without end.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncIterator
from itertools import islice
from typing import Final

from namod_ctl.app.dashboard.feed import KEEP_ALIVE_S, MAX_LISTENERS
from namod_ctl.app.focus_page.news import FocusNews
from namod_ctl.app.focus_page.trend import trend

SHOWN_S: Final = 120.0
MAX_READINGS: Final = 2000


class Board:
    """News of one camera. For one event loop.

    Attributes
    ----------
    picture, n_pictures
        The last cut-out as JPEG, and how many there were: its number.
    """

    def __init__(self, camera_name: str) -> None:
        self._camera_name = camera_name
        self._course: deque[tuple[float, float | None]] = deque(maxlen=MAX_READINGS)
        self._n_news = 0
        self._last: FocusNews | None = None
        self._listeners: set[asyncio.Event] = set()
        self._is_over = False
        self.picture, self.n_pictures = b"", 0

    @property
    def is_full(self) -> bool:
        """No room for another page."""
        return len(self._listeners) >= MAX_LISTENERS

    def add(self, news: FocusNews, picture: bytes) -> None:
        """Tell every page; `picture` is empty where there is none."""
        self._course.append((news.at_s, news.size_px))
        while self._course[0][0] < news.at_s - SHOWN_S:
            self._course.popleft()
        self._n_news += 1
        self._last = news
        if picture:
            self.picture, self.n_pictures = picture, self.n_pictures + 1
        self._wake_all()

    def end(self) -> None:
        """Nothing comes any more: every page is let go."""
        self._is_over = True
        self._wake_all()

    async def events(self) -> AsyncIterator[str]:
        """Text of server-sent events: the course so far, then what is added, for as long as the caller listens."""
        is_told = asyncio.Event()
        self._listeners.add(is_told)
        try:
            yield f"retry: 1000\n{_event('about', {'camera': self._camera_name, 'shown_s': SHOWN_S})}"
            n_told = 0
            while not self._is_over:
                if self._last is not None and n_told < self._n_news:
                    text = _event("news", self._since(n_told, self._last))
                    n_told = self._n_news
                    yield text
                    continue
                try:
                    await asyncio.wait_for(is_told.wait(), KEEP_ALIVE_S)
                except TimeoutError:
                    yield ": still here\n\n"
                is_told.clear()
        finally:
            self._listeners.discard(is_told)

    def _since(self, n_told: int, last: FocusNews) -> dict[str, object]:
        n_new = min(self._n_news - n_told, len(self._course))
        stars = [(at_s, size_px) for at_s, size_px in self._course if size_px is not None]
        whither = trend([at_s for at_s, _ in stars], [size_px for _, size_px in stars])
        return {
            "course": list(islice(self._course, len(self._course) - n_new, None)),
            "at_s": last.at_s,
            "size_px": last.size_px,
            "best_px": last.best_px,
            "arcmin_per_px": last.arcmin_per_px,
            "peak_share": last.peak_share,
            "exposure_s": last.exposure_s,
            "warning": last.warning,
            "trend": whither if last.size_px is not None else None,
            "picture": {"number": self.n_pictures, "width_px": last.picture_px} if last.picture_px else None,
        }

    def _wake_all(self) -> None:
        for listener in self._listeners:
            listener.set()


def _event(name: str, content: dict[str, object]) -> str:
    return f"event: {name}\ndata: {json.dumps(content)}\n\n"

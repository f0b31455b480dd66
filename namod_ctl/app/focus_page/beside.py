"""The page in a process of its own, beside the loop that holds the camera and never waits for it."""

from __future__ import annotations

import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context

import typer

from namod_ctl.app.build.camera_choice import ChosenCamera
from namod_ctl.app.dashboard.guard import is_loopback
from namod_ctl.app.dashboard.server import listen
from namod_ctl.app.focus_page.cutout import FIRST_PX, cutout, cutout_side_px
from namod_ctl.app.focus_page.frame_news import news_of
from namod_ctl.app.focus_page.news import packed
from namod_ctl.app.focus_page.server import serve
from namod_ctl.app.views.camera_views import Look
from namod_ctl.cycle.focus import FocusReading

ENDS_WITHIN_S = 3.0


class FocusPage:
    """Where the loop leaves what it sees.

    Attributes
    ----------
    address
        Where people look at it.
    is_loopback
        It is shown to this computer only.
    """

    def __init__(self, address: str, link: socket.socket, *, is_loopback: bool) -> None:
        self.address, self.is_loopback = address, is_loopback
        self._link = link
        self._side_px = FIRST_PX
        self._is_there = True

    def show(
        self,
        at_s: float,
        look: Look,
        reading: FocusReading | None,
        best_px: float,
        chosen: ChosenCamera,
        *,
        is_exposure_given: bool,
    ) -> None:
        """Leave a frame and what was read of it, with a picture of the star; at once, whatever becomes of it.

        `at_s` is when it came, on a clock that never goes back. A page that is too slow for it misses it, and gets the
        next.
        """
        if not self._is_there:
            return
        news = news_of(at_s, look, reading, best_px, chosen, is_exposure_given=is_exposure_given)
        picture = b""
        if look.exposure is not None and reading is not None:
            self._side_px = cutout_side_px(reading.diameter_px, self._side_px)
            picture, width_px = cutout(look.exposure.image, self._side_px, chosen.model.full_scale_adu)
            news = replace(news, picture_px=width_px)
        try:
            self._link.send(packed(news, picture))
        except BlockingIOError:
            pass
        except ConnectionError:
            self._is_there = False
            typer.echo("The page has ended; the focus aid goes on here. Start it again to have the page.", err=True)


@contextmanager
def focus_page_beside(camera_name: str, host: str, port: int) -> Iterator[FocusPage]:
    """The page, served until the block ends. Raises ConfigError when it cannot be served there."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)  # whole messages, and an end that is seen
    ours.setblocking(False)
    with ours:
        with theirs, listen(host, port) as listening:
            shown = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            address = f"http://{shown}:{listening.getsockname()[1]}/"
            arguments = (camera_name, theirs, listening, is_loopback(host))
            process = get_context("spawn").Process(target=serve, args=arguments, daemon=True)
            # Ctrl-C reaches all processes of a terminal; the new one inherits that it is ignored, only we are stopped
            before = signal.signal(signal.SIGINT, signal.SIG_IGN)
            try:
                process.start()
            finally:
                signal.signal(signal.SIGINT, before)
        try:
            yield FocusPage(address, ours, is_loopback=is_loopback(host))
        finally:
            try:
                ours.close()  # tells it to end
                process.join(ENDS_WITHIN_S)
            finally:
                process.kill()
                process.join()

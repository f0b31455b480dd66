"""The page in a process of its own, beside a recording that goes on when the page is slow, flooded or killed."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from pathlib import Path

from namod_ctl.app.dashboard.guard import TOKEN_VARIABLE, Rules, checked_token
from namod_ctl.app.dashboard.server import build_server, listen

NICENESS = 19
"""The recording comes first, as it does before the live estimate."""


@contextmanager
def dashboard_beside(path: Path, port: int = 0, token: str | None = None) -> Iterator[str]:
    """Address of the page, token included, which is served to this computer until the block ends.

    `path` is a run or campaign that exists already; without a token that of the environment is taken, or a new one.
    Raises ConfigError when the port is in use, or the environment's token can be guessed.
    """
    if token is None and (given := os.environ.get(TOKEN_VARIABLE)):
        token = checked_token(given, TOKEN_VARIABLE)
    rules = Rules(token or secrets.token_urlsafe(16), is_loopback=True)
    with listen("127.0.0.1", port) as listening:
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/#token={rules.token}"
        process = get_context("spawn").Process(target=_serve, args=(path, rules, listening), daemon=True)
        # Ctrl-C reaches all processes of a terminal; the new one inherits that it is ignored, only we are interrupted
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            process.start()
        finally:
            signal.signal(signal.SIGINT, before)
    try:
        yield address
    finally:
        process.kill()
        process.join()


def _serve(path: Path, rules: Rules, listening: socket.socket) -> None:
    with suppress(OSError):
        os.nice(NICENESS)
    server = build_server(path, rules)

    def end_with_parent() -> None:
        if (parent := parent_process()) is not None:
            parent.join()  # one that was killed had no time to end this process
            server.should_exit = True

    threading.Thread(target=end_with_parent, daemon=True).start()
    # not in the main thread: there the server would listen to Ctrl-C again
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    thread.join()

"""`namod-ctl dashboard`: the page for the crew."""

from __future__ import annotations

import os
import secrets
import socket
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from namod_ctl.app.dashboard.addresses import own_addresses
from namod_ctl.app.dashboard.beside import NICENESS
from namod_ctl.app.dashboard.guard import TOKEN_VARIABLE, Rules, checked_token, is_loopback
from namod_ctl.app.dashboard.server import build_server, listen
from namod_ctl.app.dashboard.state import Watched

DEFAULT_PORT = 8765


def dashboard(
    path: Annotated[Path, typer.Argument(metavar="RUN|CAMPAIGN", help="Folder of what is to be shown.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes one that is free.")] = DEFAULT_PORT,
    host: Annotated[
        str, typer.Option(help="Address to serve on; any but this computer's own shows the page to the network.")
    ] = "127.0.0.1",
    token: Annotated[
        str | None,
        typer.Option(
            envvar=TOKEN_VARIABLE, help="What a page must know to send commands.  [default: a new one, printed]"
        ),
    ] = None,
) -> None:
    """Serve a page that shows how the night goes, live, and afterwards what came of it.

    Whoever has the printed address can look and send commands: pause, resume, approve, stop. The page holds no device
    and can be ended at any time with Ctrl-C.

    Example: namod-ctl dashboard CAMPAIGN
    """
    rules = Rules(
        checked_token(token, "--token") if token is not None else secrets.token_urlsafe(16), is_loopback(host)
    )
    with Watched(path):  # what is wrong with it is said here
        pass
    with suppress(OSError):
        os.nice(NICENESS)
    with listen(host, port) as listening:
        port = listening.getsockname()[1]
        # a phone seldom knows this computer's name
        shown = [*own_addresses(), socket.gethostname()] if host in ("0.0.0.0", "::") else [host]
        addresses = [f"http://{f'[{one}]' if ':' in one else one}:{port}/" for one in shown]
        if not rules.is_loopback:
            typer.echo(
                f"WARNING: --host {host} shows this page to everybody in the network, unencrypted; with the token they "
                "can also stop and move the telescope. For a phone on the dish use a network of your own.",
                err=True,
            )
        for address in addresses:
            typer.echo(f"Look:     {address}")
        for address in addresses:
            typer.echo(f"Command:  {address}#token={rules.token}")
        with suppress(KeyboardInterrupt):
            build_server(path, rules).run(sockets=[listening])

"""The page's server: files, events and the last picture. Nothing can be sent to it."""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib.resources import files
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from namod_ctl.app.dashboard.beside import NICENESS
from namod_ctl.app.dashboard.guard import Guard, Rules
from namod_ctl.app.dashboard.patience import PatientProtocol
from namod_ctl.app.dashboard.server import page_files
from namod_ctl.app.focus_page.board import Board
from namod_ctl.app.focus_page.news import unpacked

PAGE: Final = "focus.html"
OF_THE_LIVE_PAGE: Final = ("theme.js", "page.css", "figures.css", "dom.js", "picture.js", "icon.svg")
MAX_MESSAGE_BYTES: Final = 200_000
"""Linux takes 212 992 in one message."""

_OWN: Final = {
    PAGE: "text/html; charset=utf-8",
    "focus.css": "text/css; charset=utf-8",
    "focus.js": "text/javascript; charset=utf-8",
    "curve.js": "text/javascript; charset=utf-8",
}


def build_app(board: Board, link: socket.socket, rules: Rules, on_end: Callable[[], None]) -> Starlette:
    """The page as an ASGI application, which follows the messages of `link` until its other end is closed."""
    folder = files("namod_ctl.app.focus_page")
    of_live_page = page_files()
    served = {name: of_live_page[name] for name in OF_THE_LIVE_PAGE}
    served |= {name: ((folder / name).read_bytes(), media_type) for name, media_type in _OWN.items()}

    async def follow() -> None:
        loop = asyncio.get_running_loop()
        with suppress(ConnectionError):
            while message := await loop.sock_recv(link, MAX_MESSAGE_BYTES):
                board.add(*unpacked(message))
        board.end()
        on_end()

    @asynccontextmanager
    async def followed(app: Starlette) -> AsyncIterator[None]:
        link.setblocking(False)
        following = asyncio.create_task(follow())
        yield
        following.cancel()

    async def page(request: Request) -> Response:
        content, media_type = served.get(request.path_params.get("name", PAGE), (None, ""))
        return _nothing_here() if content is None else Response(content, media_type=media_type)

    async def events(request: Request) -> Response:
        if board.is_full:
            return PlainTextResponse("too many pages look at this already", 503, {"retry-after": "10"})
        return StreamingResponse(board.events(), media_type="text/event-stream")

    async def picture(request: Request) -> Response:
        # the newest whatever was asked for: a page that asks while a newer one comes did nothing wrong
        return Response(board.picture, media_type="image/jpeg") if board.picture else _nothing_here()

    return Starlette(
        routes=[
            Route("/", page),
            Route("/events", events),
            Route("/frame/0/star/{number:int}", picture),  # where the live page's picture.js asks for it
            Route("/{name}", page),
        ],
        middleware=[Middleware(Guard, rules=rules)],
        lifespan=followed,
    )


def _nothing_here() -> Response:
    return PlainTextResponse("there is nothing here", 404)


def build_server(camera_name: str, link: socket.socket, *, is_loopback: bool) -> uvicorn.Server:
    """The server of the page; `run(sockets=[...])` serves until the other end of `link` is closed."""

    def end() -> None:
        server.should_exit = True

    # nobody is told the token: there is nothing to command
    rules = Rules(secrets.token_urlsafe(16), is_loopback=is_loopback)
    config = uvicorn.Config(
        build_app(Board(camera_name), link, rules, end),
        loop="asyncio",
        http=PatientProtocol,
        ws="none",
        lifespan="on",
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16384,
    )
    server = uvicorn.Server(config)
    return server


def serve(camera_name: str, link: socket.socket, listening: socket.socket, is_loopback: bool) -> None:
    """Serve the page in this process, after everything else that the computer has to do."""
    with suppress(OSError):
        os.nice(NICENESS)
    server = build_server(camera_name, link, is_loopback=is_loopback)
    # not in the main thread: there the server would listen to Ctrl-C again
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    thread.join()

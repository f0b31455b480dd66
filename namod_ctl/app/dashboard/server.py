"""The page's server: a handful of addresses, each harmless or guarded."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from importlib.resources import files
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from namod_ctl.app.dashboard.feed import Feed
from namod_ctl.app.dashboard.guard import MAX_BODY_BYTES, Guard, Rules
from namod_ctl.app.dashboard.orders import Reply, carry_out, read_order
from namod_ctl.app.dashboard.patience import PatientProtocol
from namod_ctl.app.dashboard.pictures import Pictures
from namod_ctl.core.errors import ConfigError, StoreError
from namod_ctl.store.frames import REFLECTOR_CAMERA, STAR_CAMERA
from namod_ctl.store.live_pictures import live_pictures

PAGE: Final = "page.html"
BODY_WITHIN_S: Final = 5.0

_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def page_files() -> dict[str, tuple[bytes, str]]:
    """Content and type of every file of the page, by name: read once, so that no name ever reaches the disk."""
    folder = files("namod_ctl.app.dashboard") / "page"
    return {
        file.name: (file.read_bytes(), _TYPES[Path(file.name).suffix])
        for file in folder.iterdir()
        if Path(file.name).suffix in _TYPES
    }


def build_app(feed: Feed, rules: Rules) -> Starlette:
    """The page of what the feed follows, as an ASGI application that starts and closes the feed."""
    pictures, painter = Pictures(), ThreadPoolExecutor(1, "dashboard-pictures")
    served = page_files()

    @asynccontextmanager
    async def opened(app: Starlette) -> AsyncIterator[None]:
        await feed.start()
        yield
        await feed.close()
        painter.shutdown(wait=False)

    async def page(request: Request) -> Response:
        content, media_type = served.get(request.path_params.get("name", PAGE), (None, ""))
        return _nothing_here() if content is None else Response(content, media_type=media_type)

    async def events(request: Request) -> Response:
        if feed.is_full:
            return PlainTextResponse("too many pages look at this already", 503, {"retry-after": "10"})
        return StreamingResponse(feed.events(), media_type="text/event-stream")

    async def facet(request: Request) -> Response:
        facet_id = int(request.path_params["facet_id"])
        found = await feed.ask(lambda watched: watched.facet(facet_id))
        return _nothing_here() if found is None else JSONResponse(found)

    async def sheet(request: Request) -> Response:
        key = int(request.path_params["key"])
        found = None if key > _LARGEST else await feed.ask(lambda watched: watched.sheet(key))
        return _nothing_here() if found is None else JSONResponse(found)

    async def frame(request: Request) -> Response:
        camera = request.path_params["camera"]
        key, index = int(request.path_params["key"]), int(request.path_params["index"])
        if camera not in (STAR_CAMERA, REFLECTOR_CAMERA) or max(key, index) > _LARGEST:
            return _nothing_here()
        run = await feed.ask(lambda watched: watched.run_path(key))
        if run is None:
            return _nothing_here()
        loop = asyncio.get_running_loop()
        data = await loop.run_in_executor(painter, pictures.picture, run, camera, index)
        if data is not None:
            return Response(data, media_type="image/jpeg", headers=_FOREVER)
        # the recorder shows its newest pictures only: a page that was told of the one before did nothing wrong
        return Response(status_code=204) if live_pictures(run) else _nothing_here()

    async def command(request: Request) -> Response:
        reply = await _command(request, feed)
        return JSONResponse({"text": reply.text}, reply.status)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/events", events),
            Route("/facet/{facet_id:int}", facet),
            Route("/sheet/{key:int}", sheet),
            Route("/frame/{key:int}/{camera}/{index:int}", frame),
            Route("/command", command, methods=["POST"]),
            Route("/{name}", page),
        ],
        middleware=[Middleware(Guard, rules=rules)],
        lifespan=opened,
    )


_LARGEST: Final = 2**62  # what SQLite can be asked for
_FOREVER: Final = {"cache-control": "private, max-age=3600, immutable"}  # a frame never changes


async def _command(request: Request, feed: Feed) -> Reply:
    try:
        async with asyncio.timeout(BODY_WITHIN_S):
            body = await _body(request)
    except (TimeoutError, ClientDisconnect):
        return Reply(408, "the command did not come in time")
    if body is None:
        return Reply(413, f"a command has at most {MAX_BODY_BYTES} bytes")
    order = read_order(body)
    if isinstance(order, Reply):
        return order
    if not feed.watched.is_campaign and order.kind != "stop":
        return Reply(409, "a plain recording can only be stopped")
    try:  # to stop needs nothing of what the disk says
        step = 0 if order.kind == "stop" else await feed.ask(lambda watched: watched.step())
    except StoreError as error:
        return Reply(503, str(error))
    return await carry_out(feed.watched.path, order, step)


async def _body(request: Request) -> bytes | None:
    """What was sent, None when it is too much: what follows is never read."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            return None
    return body


def _nothing_here() -> Response:
    return PlainTextResponse("there is nothing here", 404)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens. Raises ConfigError when the address is not ours, or in use."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=2048)
    except socket.gaierror as error:
        raise ConfigError(f"--host {host}: is no address of this computer ({error.strerror}); try 127.0.0.1") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ConfigError(
                f"--port {port}: is in use, perhaps by another dashboard; choose another, or 0 for a free one"
            ) from None
        raise ConfigError(f"--host {host} --port {port}: cannot be listened to ({error.strerror})") from None


class PageServer(uvicorn.Server):
    """uvicorn's server, which does not wait for pages that would listen for ever."""

    def __init__(self, config: uvicorn.Config, feed: Feed) -> None:
        super().__init__(config)
        self._feed = feed

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End in order."""
        self._feed.dismiss()
        await super().shutdown(sockets)


def build_server(path: Path, rules: Rules) -> PageServer:
    """The server of the page of a run or campaign; `run(sockets=[...])` serves until it is interrupted."""
    feed = Feed(path)
    config = uvicorn.Config(
        build_app(feed, rules),
        http=PatientProtocol,
        ws="none",
        lifespan="on",
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=3,
        h11_max_incomplete_event_size=16384,
    )
    return PageServer(config, feed)

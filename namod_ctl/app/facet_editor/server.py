"""The facet map editor: a page for one person on this computer.

Bound to 127.0.0.1. Whatever a web site of another origin might try, it can neither read nor write: the guard that the
live page has lets only this page itself send, with the token that is printed at start.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from datetime import date
from importlib.resources import files

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from namod_ctl.app.dashboard.guard import Guard, Rules
from namod_ctl.app.facet_editor.messages import (
    Drawing,
    Marks,
    check_to_json,
    facets_to_json,
    map_to_json,
    points_by_id,
    read_message,
)
from namod_ctl.app.facet_editor.workbench import Workbench, png_of
from namod_ctl.core.errors import ConfigError
from namod_ctl.optics.facet_marks import MarksError

MAX_BODY_BYTES = 4_000_000
"""A map of 1000 round facets with 48 corners each is 1 MB."""
PAGE_FILES = {
    "editor.html": "text/html; charset=utf-8",
    "editor.css": "text/css; charset=utf-8",
    "editor.js": "text/javascript; charset=utf-8",
    "board.js": "text/javascript; charset=utf-8",
    "model.js": "text/javascript; charset=utf-8",
    "server.js": "text/javascript; charset=utf-8",
    "icon.svg": "image/svg+xml",
}
THEME = "theme.js"
"""Of the live page: night or day are remembered for all pages together."""


def build_app(bench: Workbench, token: str) -> Starlette:
    """The editor as an ASGI application that takes what it is sent from its own page only, with `token`."""
    folder = files("namod_ctl.app.facet_editor")
    types = {**PAGE_FILES, THEME: PAGE_FILES["editor.js"]}
    served = {name: (folder / name).read_bytes() for name in PAGE_FILES}
    served[THEME] = (files("namod_ctl.app.dashboard") / "page" / THEME).read_bytes()
    picture = png_of(bench.image)
    made = {"hand": "drawn by hand"}  # how the outlines came about, by what the page says it shows

    async def page(request: Request) -> Response:
        name = request.path_params.get("name", "editor.html")
        if name not in served:
            return PlainTextResponse("there is nothing here", 404)
        return Response(served[name], media_type=types[name])

    async def image(_: Request) -> Response:
        return Response(picture, media_type="image/png")

    async def first(_: Request) -> Response:
        return JSONResponse(map_to_json(bench))

    def solve(body: bytes) -> dict[str, object]:
        marks = points_by_id(read_message(Marks, body).facets)
        solution = bench.solve(marks)
        uncertainty_px = solution.uncertainty_px(bench.instrument.reflector)
        made["marks"] = f"camera pose from {len(marks)} marked facets, {solution.rms_px:.2f} px rms"
        return {
            "facets": facets_to_json(bench.outlines_px(solution.pose)),
            "residuals": [{"id": i, "px": round(r, 2)} for i, r in solution.residual_px.items()],
            "rms_px": round(solution.rms_px, 2),
            "uncertainty_px": round(uncertainty_px, 2),
            "notes": bench.mark_notes(solution) + bench.notes(solution.pose),
        }

    def propose(body: bytes) -> dict[str, object]:
        proposal = bench.propose(points_by_id(read_message(Marks, body).facets))
        fit = proposal.fit
        made["edges"] = (
            f"camera pose fitted to the edges of {fit.seen_share:.0%} of the facets, {fit.rms_px:.2f} px rms"
        )
        return {
            "facets": facets_to_json(bench.outlines_px(fit.pose)),
            "seen_share": round(fit.seen_share, 3),
            "doubts": list(proposal.doubts),
            "notes": bench.notes(fit.pose),
        }

    def check(body: bytes) -> dict[str, object]:
        return check_to_json(bench, read_message(Drawing, body))

    def save(body: bytes) -> dict[str, object]:
        drawing: Drawing = read_message(Drawing, body)
        how = f"{made.get(drawing.basis, 'drawn by hand')}, looked over in the editor, {date.today().isoformat()}"
        written = bench.save(points_by_id(drawing.facets), drawing.is_missing_confirmed, how)
        return {"written": str(written), "n_facets": len(drawing.facets), "next": bench.next_step()}

    return Starlette(
        routes=[
            Route("/", page),
            Route("/picture.png", image),
            Route("/map", first),
            *(Route(f"/{work.__name__}", _answering(work), methods=["POST"]) for work in (solve, propose, check, save)),
            Route("/{name}", page),
        ],
        middleware=[Middleware(Guard, rules=Rules(token, is_loopback=True, max_body_bytes=MAX_BODY_BYTES))],
    )


def _answering(work: Callable[[bytes], dict[str, object]]) -> Callable[[Request], object]:
    """The request handler that lets `work` answer; what a person can mend comes back as text, status 422."""

    async def answer(request: Request) -> Response:
        try:
            return JSONResponse(await run_in_threadpool(work, await _body(request)))
        except MarksError as error:
            return JSONResponse({"error": str(error), "ids": list(error.facet_ids)}, 422)
        except ConfigError as error:
            return JSONResponse({"error": str(error), "ids": []}, 422)

    return answer


async def _body(request: Request) -> bytes:
    """What was sent. Raises ConfigError when it is more than its length promised, and too much."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY_BYTES:
            raise ConfigError(f"at most {MAX_BODY_BYTES} bytes can be sent")
    return bytes(body)


def serve(bench: Workbench, port: int, announce: Callable[[str], None]) -> None:
    """Serve the editor on 127.0.0.1 until it is interrupted. Raises ConfigError for a port in use."""
    try:
        listener = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise ConfigError(f"--port {port}: cannot be listened to ({error.strerror}); choose another, or 0") from None
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    token = secrets.token_urlsafe(24)
    server = uvicorn.Server(
        uvicorn.Config(
            build_app(bench, token),
            ws="none",
            lifespan="off",
            log_level="error",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
        )
    )
    announce(f"Open this address in a browser on this computer: http://{host}/#{token}")
    announce(f"The map goes to {bench.out}. End with Ctrl-C.")
    with listener, suppress(KeyboardInterrupt):  # the server hands Ctrl-C on when it has ended
        server.run(sockets=[listener])

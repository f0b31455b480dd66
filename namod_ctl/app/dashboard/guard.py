"""Who may ask what of the page: hosts, origins, the token, and how much may be sent.

A page on this computer can be reached by every web page that its user visits. A name that an attacker's server gives
out for 127.0.0.1 (DNS rebinding) is refused by the Host header; a form or script on another site (cross-site request)
by the Origin header and by the token, which other sites do not know and cannot send without permission.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from namod_ctl.core.errors import ConfigError

TOKEN_HEADER: Final = "x-namod-token"
TOKEN_VARIABLE: Final = "NAMOD_CTL_TOKEN"
"""Of the environment: the token of every page that is begun without another one."""
MAX_BODY_BYTES: Final = 4096
MIN_TOKEN_LENGTH: Final = 12
MAX_PATH_LENGTH: Final = 200

_SECURITY_HEADERS: Final = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
}


@dataclass(frozen=True, slots=True)
class Rules:
    """What the page was started with.

    Attributes
    ----------
    token
        What a request that changes something must know.
    is_loopback
        The page is served to this computer only.
    max_body_bytes
        So much may be sent at once.
    """

    token: str
    is_loopback: bool
    max_body_bytes: int = MAX_BODY_BYTES


def checked_token(token: str, where: str) -> str:
    """The token. Raises ConfigError, which names `where` it was given, for one that can be guessed or not be typed."""
    if len(token) < MIN_TOKEN_LENGTH or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(
            f"{where}: must be at least {MIN_TOKEN_LENGTH} plain characters without blanks; leave it out for a new one"
        )
    return token


def is_loopback(host: str) -> bool:
    """Does this address, or name, stand for this computer alone?"""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def is_own_host(host_header: str, rules: Rules) -> bool:
    """Is this what a browser sends that was pointed at this page by its own address?

    An address in numbers can be no attacker's name; of names only this computer's own pass.
    """
    name = host_header.strip().lower()
    if name.startswith("["):
        name = name[1 : name.find("]")] if "]" in name else ""
    elif name.count(":") == 1:
        name = name.split(":")[0]
    if is_loopback(name):
        return True
    if rules.is_loopback:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        return name in {own, f"{own}.local", socket.getfqdn().lower()}
    return True


def refusal(method: str, headers: Headers, rules: Rules) -> tuple[int, str] | None:
    """HTTP status and reason why the request is refused before anything of it is looked at; None when it is not."""
    hosts = headers.getlist("host")
    if len(hosts) != 1 or not is_own_host(hosts[0], rules):
        return 421, "this page does not go by that name; use the address that was printed when it was started"
    if method in ("GET", "HEAD"):
        return None
    origins = headers.getlist("origin")
    if origins != [f"http://{hosts[0]}"]:
        return 403, "only this page itself may send commands"
    if not hmac.compare_digest(headers.get(TOKEN_HEADER, "").encode(), rules.token.encode()):
        return 401, "the token is missing or wrong; it was printed when the page was started"
    if headers.get("content-type", "").split(";")[0].strip().lower() != "application/json":
        return 415, "commands are sent as application/json"
    length = headers.get("content-length", "0")
    if not length.isdigit() or int(length) > rules.max_body_bytes:
        return 413, f"at most {rules.max_body_bytes} bytes can be sent"
    return None


class Guard:
    """Refuses what `refusal` refuses, and puts the headers that browsers obey on every answer."""

    def __init__(self, app: ASGIApp, rules: Rules) -> None:
        self._app, self._rules = app, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _SECURITY_HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
            await send(message)

        refused = refusal(scope["method"], Headers(scope=scope), self._rules)
        if len(scope["path"]) > MAX_PATH_LENGTH:  # Python reads no number of thousands of digits
            refused = 414, "there is no address of this length here"
        if refused is None:
            await self._app(scope, receive, send_guarded)
            return
        status, why = refused
        answer = PlainTextResponse(why, status, {"connection": "close"})
        await answer(scope, receive, send_guarded)

"""Guard of requests: only the page that this server has sent, in a browser on this machine, has access.

A server on loopback is not safe from other pages in the same browser: they can send forms to it, and by a
host name of their own that resolves to 127.0.0.1 they can read its answers. So each request must name this
host, must come from this page, and its path must begin with a random token that is new at each start. Other
requests are answered 403, and those that are too long 413, before their content is read.

The browser is started with its own path, which works once and leads to the token: the arguments of a
process can be read by others for as long as it runs.
"""

import hmac
from collections.abc import Callable, Iterable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

JSON_LIMIT, FILE_LIMIT = 2 * 2**20, 8 * 2**20
"""Largest request of the page: JSON, and a file dropped on it [bytes]."""

_JSON, _FILE = "application/json", "application/octet-stream"

_HEADERS = (
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' blob: data:; style-src 'self'; object-src 'none'; "
        b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
)


class Guard:
    """Guard of an application: passes requests on, without the token at the start of their paths.

    Args:
        app: Application to guard.
        token: Token of the page.
        hosts: Hosts that a browser may name, each with its port.
        once: Token that works once and leads to the page; empty for none.
        complain: Function that takes a line if that token is used again.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        hosts: Iterable[str],
        *,
        once: str = "",
        complain: Callable[[str], object] | None = None,
    ) -> None:
        self._app, self._token = app, token
        self._once, self._complain, self._n_led = once, complain or str, 0
        self._hosts = frozenset(hosts)
        self._origins = frozenset(f"http://{host}" for host in self._hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        headers = [(name.lower(), value) for name, value in given]
        status, reason = self._refusal(scope, headers)
        if status == 403 and self._is_first_visit(scope, headers):
            await _lead(send, f"/{self._token}/")
            return
        if status:
            await _refuse(scope, receive, send, status, reason)
            return
        inner = dict(scope)
        inner["path"] = scope["path"][len(self._token) + 1 :]
        inner["raw_path"] = inner["path"].encode("ascii")
        limit = _limit(dict(headers))
        await _Bounded(self._app, limit)(inner, receive, send)

    def _is_first_visit(self, scope: Scope, headers: list[tuple[str, str]]) -> bool:
        """Return whether a request uses the path that works once, for the first time; complain of others."""
        path = f"/{self._once}/".encode("ascii")
        given: bytes = scope.get("raw_path") or b""
        if not self._once or not hmac.compare_digest(given, path):
            return False
        with_token = {**scope, "raw_path": f"/{self._token}/".encode("ascii")}
        if scope["type"] != "http" or scope["method"] != "GET" or self._refusal(with_token, headers)[0]:
            return False
        self._n_led += 1
        if self._n_led == 2:
            self._complain(
                "the address that the browser was given, which works once, was used again: if no page has "
                "opened, another program may have the page; end the designer with Ctrl-C"
            )
        return self._n_led == 1

    def _refusal(self, scope: Scope, headers: list[tuple[str, str]]) -> tuple[int, str]:
        """Return status and reason; 0 for an accepted request."""
        named = [name for name, _ in headers]
        if any(named.count(name) > 1 for name in ("host", "origin", "content-length", "content-type")):
            return 403, "a header stands there twice"
        given = dict(headers)
        length = given.get("content-length", "0")
        if not length.isascii() or not length.isdigit() or len(length) > 12:
            return 413, "a length that is none"
        if given.get("host") not in self._hosts:
            return 403, "another host"
        talks = scope["type"] == "websocket"
        posts = not talks and scope["method"] == "POST"
        origin = given.get("origin")
        if (origin is None and (talks or posts)) or (origin is not None and origin not in self._origins):
            return 403, "another origin"
        site = given.get("sec-fetch-site", "same-origin")
        if site != "same-origin" and (posts or talks or site != "none"):
            return 403, "another site"
        if not talks and scope["method"] not in ("GET", "HEAD", "POST"):
            return 403, "another method"
        path: bytes = scope.get("raw_path") or scope["path"].encode("utf-8", "surrogateescape")
        key, _, rest = path.removeprefix(b"/").partition(b"/")
        if not hmac.compare_digest(key, self._token.encode("ascii")) or not path.startswith(
            b"/" + key + b"/"
        ):
            return 403, "no token, or not this one"
        if any(odd in b"/" + rest for odd in (b"..", b"%", b"\\", b"//", b"\0")) or not rest.isascii():
            return 403, "an odd path"
        if posts and given.get("content-type") not in (_JSON, _FILE):
            return 403, "neither JSON nor a file"
        if int(length) > (_limit(given) if posts else 0):
            return 413, "too long"
        return 0, ""


class _Bounded:
    """Limit of a request's length: refuses a request that exceeds it."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        # The whole body is read before the application runs, so that the answer can still be 413.
        body = bytearray()
        more = True
        while more:
            message = await receive()
            if message["type"] != "http.request":
                return
            body += message.get("body", b"")
            more = message.get("more_body", False)
            if len(body) > self._limit:
                await _refuse(scope, receive, send, 413, "too long")
                return
        given = False

        async def whole() -> Message:
            nonlocal given
            if given:
                return await receive()
            given = True
            return {"type": "http.request", "body": bytes(body), "more_body": False}

        async def safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
            await send(message)

        await self._app(scope, whole, safely)


def _limit(headers: dict[str, str]) -> int:
    return FILE_LIMIT if headers.get("content-type") == _FILE else JSON_LIMIT


async def _lead(send: Send, path: str) -> None:
    """Answer with another path of this server."""
    headers = [(b"location", path.encode("ascii")), (b"content-length", b"0"), *_HEADERS]
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, reason: str) -> None:
    if scope["type"] == "websocket":
        # Closing before accepting makes the server answer 403.
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    body = f"{status}: {reason}\n".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close"), *_HEADERS]
    headers.append((b"content-length", str(len(body)).encode()))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})

"""Guard of requests: only the page that this server has sent, in a browser on this machine, has access.

A server on loopback is not safe from other pages in the same browser. They can send forms to it
(cross-site request forgery), and read its answers under a host name that resolves to 127.0.0.1 (DNS
rebinding). So each request must name this host, must come from this page, and its path must start with a
random token that is new at each start. Other requests are answered 403, and oversized ones 413, before their
content is read.

The browser is started with a separate path, which works once and redirects to the token: other users can read
the arguments of a running process.
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
    """Guard of an application, which gets accepted requests without the token in their paths.

    Args:
        app: Application to guard.
        token: Token of the page.
        hosts: Accepted hosts, each with its port.
        one_time_token: Token that works once and redirects to the page; empty for none.
        report: Function that takes a line if that token is used again.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        hosts: Iterable[str],
        *,
        one_time_token: str = "",
        report: Callable[[str], object] | None = None,
    ) -> None:
        self._app = app
        self._token = token
        self._one_time_token = one_time_token
        self._report = report or str
        self._n_visits = 0
        self._hosts = frozenset(hosts)
        self._origins = frozenset(f"http://{host}" for host in self._hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it to the application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = [
            (name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]
        ]
        status, reason = self._refusal(scope, headers)
        if status == 403 and self._is_first_visit(scope, headers):
            await _redirect(send, f"/{self._token}/")
            return
        if status:
            await _refuse(scope, receive, send, status, reason)
            return
        path = scope["path"][len(self._token) + 1 :]
        inner_scope = {**scope, "path": path, "raw_path": path.encode("ascii")}
        await _SizeLimit(self._app, _limit(dict(headers)))(inner_scope, receive, send)

    def _is_first_visit(self, scope: Scope, headers: list[tuple[str, str]]) -> bool:
        """Return whether a request uses the one-time path for the first time; report the second time."""
        path = f"/{self._one_time_token}/".encode("ascii")
        requested_path: bytes = scope.get("raw_path") or b""
        if not self._one_time_token or not hmac.compare_digest(requested_path, path):
            return False
        with_token = {**scope, "raw_path": f"/{self._token}/".encode("ascii")}
        if scope["type"] != "http" or scope["method"] != "GET" or self._refusal(with_token, headers)[0]:
            return False
        self._n_visits += 1
        if self._n_visits == 2:
            self._report(
                "the address that the browser was given, which works once, was used again: if no page has "
                "opened, another program may have the page; end the designer with Ctrl-C"
            )
        return self._n_visits == 1

    def _refusal(self, scope: Scope, headers: list[tuple[str, str]]) -> tuple[int, str]:
        """Return status and reason; 0 for an accepted request."""
        names = [name for name, _ in headers]
        if any(names.count(name) > 1 for name in ("host", "origin", "content-length", "content-type")):
            return 403, "a header stands there twice"
        header = dict(headers)
        length = header.get("content-length", "0")
        if not length.isascii() or not length.isdigit() or len(length) > 12:
            return 413, "a length that is none"
        if header.get("host") not in self._hosts:
            return 403, "another host"
        is_websocket = scope["type"] == "websocket"
        is_post = not is_websocket and scope["method"] == "POST"
        origin = header.get("origin")
        if origin not in self._origins and (origin is not None or is_websocket or is_post):
            return 403, "another origin"
        fetch_site = header.get("sec-fetch-site", "same-origin")
        if fetch_site != "same-origin" and (is_post or is_websocket or fetch_site != "none"):
            return 403, "another site"
        if not is_websocket and scope["method"] not in ("GET", "HEAD", "POST"):
            return 403, "another method"
        path: bytes = scope.get("raw_path") or scope["path"].encode("utf-8", "surrogateescape")
        token, _, rest = path.removeprefix(b"/").partition(b"/")
        is_token = hmac.compare_digest(token, self._token.encode("ascii"))
        if not is_token or not path.startswith(b"/" + token + b"/"):
            return 403, "no token, or not this one"
        if any(part in b"/" + rest for part in (b"..", b"%", b"\\", b"//", b"\0")) or not rest.isascii():
            return 403, "an odd path"
        if is_post and header.get("content-type") not in (_JSON, _FILE):
            return 403, "neither JSON nor a file"
        if int(length) > (_limit(header) if is_post else 0):
            return 413, "too long"
        return 0, ""


class _SizeLimit:
    """Limit of a request's length; refuses longer requests."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        # The whole body is read before the application runs, so that the answer can still be 413.
        body = bytearray()
        has_more = True
        while has_more:
            message = await receive()
            if message["type"] != "http.request":
                return
            body += message.get("body", b"")
            has_more = message.get("more_body", False)
            if len(body) > self._limit:
                await _refuse(scope, receive, send, 413, "too long")
                return
        pending: list[Message] = [{"type": "http.request", "body": bytes(body), "more_body": False}]

        async def receive_body() -> Message:
            return pending.pop() if pending else await receive()

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
            await send(message)

        await self._app(scope, receive_body, send_with_headers)


def _limit(headers: dict[str, str]) -> int:
    return FILE_LIMIT if headers.get("content-type") == _FILE else JSON_LIMIT


async def _redirect(send: Send, path: str) -> None:
    """Redirect to another path of this server."""
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

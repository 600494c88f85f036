"""Actions of the page: what takes a request and returns an answer, each a POST with JSON and JSON back.

A user's error is answered 400 with its line, a file that has changed meanwhile 409, a path outside the
folder 403. The page itself, which asks by a header, gets these as 200: browsers report any other status in
their console, as a fault of the page.
"""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NamedTuple

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, Response

from khep_twin.errors import KhepTwinError
from khep_twin.web.documents import ConflictError, OutsideError
from khep_twin.web.requests import Asked, Request, request_of

QUIET = "Khepera-Quiet"
"""Header of requests whose refusals are answered 200."""

Endpoint = Callable[[HttpRequest], Awaitable[Response]]

Shown = Callable[[str], str]
"""Function that returns an error's text as users are shown it."""


class Action(NamedTuple):
    """Action of the page.

    Attributes:
        kind: Class of its request.
        do: Function of a request that returns a response, an object for JSON, or None for an empty one.
    """

    kind: type[Request]
    do: Callable[[Any], object]


Actions = Mapping[str, Action]
"""Actions by name."""


def on(kind: type[Asked], do: Callable[[Asked], object]) -> Action:
    """Return the action that a function does on requests of a class."""
    return Action(kind, do)


def endpoint(name: str, action: Action, shown: Shown) -> Endpoint:
    """Return the endpoint of an action."""
    return with_body(lambda body, _: action.do(request_of(body, action.kind, name)), shown)


def with_body(act: Callable[[bytes, HttpRequest], object], shown: Shown) -> Endpoint:
    """Return the endpoint of a function of a request's body, which runs in a thread of its own."""

    async def answer(request: HttpRequest) -> Response:
        body = await request.body()
        response = await run_in_threadpool(answered, lambda: act(body, request), shown)
        if QUIET in request.headers:
            response.status_code = 200
        return response

    return answer


async def failed(request: HttpRequest, error: Exception) -> Response:
    """Answer a request after an internal error, which is printed on standard error."""
    return refused(f"the designer failed: {type(error).__name__}: {error}", 500)


def answered(act: Callable[[], object], shown: Shown) -> Response:
    """Return the response of an action, or of its error as it is shown."""
    try:
        answer = act()
        return answer if isinstance(answer, Response) else JSONResponse({} if answer is None else answer)
    except OutsideError as error:
        return refused(shown(error.plain), 403)
    except ConflictError as error:
        return refused(shown(error.plain), 409, conflict=True)
    except OSError as error:  # such as a name that is too long
        return refused(error.strerror or str(error))
    except KhepTwinError as error:
        return refused(shown(error.plain))


def refused(text: str, status: int = 400, **more: bool) -> Response:
    """Return an answer with the problems, a line each."""
    lines = (line if line.isprintable() else ascii(line)[1:-1] for line in text.split("\n"))
    return JSONResponse({"error": "\n".join(lines), **more}, status)

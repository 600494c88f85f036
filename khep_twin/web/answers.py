"""Actions of the page: functions that take a request and return a reply, by POST with JSON both ways.

The status is 400 for a user's error, 409 for a file that has changed meanwhile, and 403 for a path outside
the folder. The page requests 200 instead by a header, as browsers report other statuses in their console as
faults of the page.
"""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NamedTuple

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, Response

from khep_twin.errors import KhepTwinError, user_error_text
from khep_twin.web.documents import ConflictError, OutsideError
from khep_twin.web.requests import Request, RequestType, request_of

QUIET_HEADER = "Khepera-Quiet"
"""Header of requests whose refusals are answered 200."""

Endpoint = Callable[[HttpRequest], Awaitable[Response]]

FormatText = Callable[[str], str]
"""Function that returns an error's text as the page shows it."""


class Action(NamedTuple):
    """Action of the page.

    Attributes:
        kind: Class of its request.
        do: Function that takes the request and returns a response, an object for JSON, or None for {}.
    """

    kind: type[Request]
    do: Callable[[Any], object]


Actions = Mapping[str, Action]  # by name


def action(kind: type[RequestType], do: Callable[[RequestType], object]) -> Action:
    """Return the action that calls a function with requests of a class."""
    return Action(kind, do)


def endpoint(name: str, action: Action, format_text: FormatText) -> Endpoint:
    """Return the endpoint of an action."""
    return body_endpoint(lambda body, _: action.do(request_of(body, action.kind, name)), format_text)


def body_endpoint(act: Callable[[bytes, HttpRequest], object], format_text: FormatText) -> Endpoint:
    """Return the endpoint of a function of a request's body, which runs in a worker thread."""

    async def answer(request: HttpRequest) -> Response:
        body = await request.body()
        response = await run_in_threadpool(respond, lambda: act(body, request), format_text)
        if QUIET_HEADER in request.headers:
            response.status_code = 200
        return response

    return answer


async def internal_error(request: HttpRequest, error: Exception) -> Response:
    """Answer a request after an internal error, which is printed on standard error."""
    return refusal(f"the designer failed: {type(error).__name__}: {error}", 500)


def respond(act: Callable[[], object], format_text: FormatText) -> Response:
    """Return the response of an action, or a refusal with its error."""
    try:
        answer = act()
        return answer if isinstance(answer, Response) else JSONResponse({} if answer is None else answer)
    except OutsideError as error:
        return refusal(format_text(error.plain), 403)
    except ConflictError as error:
        return refusal(format_text(error.plain), 409, conflict=True)
    except OSError as error:  # for example a name that is too long
        return refusal(user_error_text(error) or error.strerror or str(error))
    except KhepTwinError as error:
        return refusal(format_text(error.plain))


def refusal(text: str, status: int = 400, **fields: bool) -> Response:
    """Return a response with the problems of `text`, a line each, and further JSON `fields`."""
    lines = (line if line.isprintable() else ascii(line)[1:-1] for line in text.split("\n"))
    return JSONResponse({"error": "\n".join(lines), **fields}, status)

"""Requests of the page: one class per action, with the keys of the request as attributes.

Each request is checked here before it is executed: its keys, their types, ranges of numbers, lengths of text.
"""

import json
import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal, TypeVar, cast

from pydantic import AfterValidator, Field

from khep_twin.errors import KhepTwinError, Problem
from khep_twin.files import toml_files
from khep_twin.files.toml_files import TomlTable
from khep_twin.randomness import SEED_LIMIT

_DEPTH_LIMIT = 32
"""Largest depth of nested objects and lists; a playpen has five."""

PROGRAM_LIMIT = 60_000
"""Longest program that the page edits [characters]."""

_COORDINATE_LIMIT = 100_000
"""Bound of positions [mm] and angles [degrees]."""

Sendable = TypeVar("Sendable", str, dict[str, object])


def sendable(value: Sendable) -> Sendable:
    """Return a value if JSON can represent it.

    Raises:
        ValueError: It contains non-finite numbers or invalid Unicode.
    """
    json.dumps(value, ensure_ascii=False, allow_nan=False).encode("utf-8")
    return value


FileName = Annotated[str, Field(min_length=1, max_length=1024, description="the name of a file")]
Text = Annotated[str, Field(max_length=10_000, description="text of up to 10000 characters")]
ShortText = Annotated[str, Field(max_length=1024, description="text of up to 1024 characters")]
PageId = Annotated[
    str, Field(pattern="^[A-Za-z0-9-]{0,40}$", description="up to 40 letters, digits and hyphens")
]
Draft = Annotated[
    dict[str, object],
    Field(description="a playpen as an object, of finite numbers and Unicode text"),
    AfterValidator(sendable),
]
Index = Annotated[int, Field(ge=0, le=10_000)]
Coordinate = Annotated[float, Field(ge=-_COORDINATE_LIMIT, le=_COORDINATE_LIMIT)]
Speed = Annotated[float, Field(ge=0, le=1000, description="a number from 0.001 to 1000, or 0 for the most")]


class RequestError(KhepTwinError):
    """An invalid request; one line with the first problem."""

    def __init__(self, message: object = "", option: str = "", *, problems: Sequence[Problem] = ()) -> None:
        super().__init__(str(message).partition("\n")[0], option, problems=problems[:1])


class Request(TomlTable):
    """A request; `tab` is the identifier of the requesting page."""

    tab: PageId = ""


class FileRequest(Request):
    """A request about a file."""

    file: FileName


class ProgramRequest(FileRequest):
    """A program to open, for robots of a model."""

    model: ShortText


class PlaypenRequest(Request):
    """A request about a file, or about a playpen without a file."""

    file: FileName | None = None


class HelloRequest(PlaypenRequest):
    """The first request of a page; `file` is that of a reloaded page."""


class LibraryRequest(Request):
    """A playpen or challenge of the library."""

    name: FileName


class DraftRequest(Request):
    """A request about a draft."""

    draft: Draft


class Base(TomlTable):
    """Source of the text to edit."""

    file: FileName | None = None
    library: FileName | None = None


class SceneRequest(Request):
    """A scene to show: of a draft, or of the running twin."""

    draft: Draft | None = None


class SaveDraftRequest(Request):
    """A draft to save, or to delete if it is None; of the requesting page or of another."""

    file: FileName | None = None
    draft: Draft | None = None
    version: ShortText | None = None
    base: Base | None = None
    page: PageId | None = None


class SaveRequest(DraftRequest):
    """A file to write."""

    file: FileName
    version: ShortText | None = None
    base: Base = Base()
    overwrite: bool = False
    rename: bool = False


class SaveProgramRequest(Request):
    """A program to write."""

    file: FileName
    text: Annotated[
        str,
        Field(max_length=PROGRAM_LIMIT, description="Unicode text of up to 60000 characters"),
        AfterValidator(sendable),
    ]
    version: ShortText | None = None
    overwrite: bool = False


class PaceRequest(Request):
    """Speed of time; 0 is as fast as possible."""

    speed: Speed = 1.0
    paused: bool = False


class StartRequest(DraftRequest, PaceRequest):
    """A twin to start; `version` is that of the file on which the draft is based."""

    file: FileName | None = None
    version: ShortText | None = None
    seed: Annotated[int, Field(ge=0, lt=SEED_LIMIT, description="an integer from 0 to 2**63-1")] = 0
    noise: bool = True
    log: ShortText | None = None


class ConnectRequest(Request):
    """A robot at a port."""

    port: Annotated[str, Field(min_length=1, max_length=1024, description="the name of a port")]


class RoomRequest(Request):
    """A position to check for room for a robot."""

    robot: Index
    x_mm: Coordinate
    y_mm: Coordinate


class PutRequest(RoomRequest):
    """A pose for a robot."""

    heading_deg: Coordinate


class SwitchRequest(Request):
    """A lamp to switch on or off."""

    lamp: Index
    on: bool


class RunRequest(Request):
    """A series of runs of a controller, or of one for each robot; an empty name lets the robot stand."""

    controllers: Annotated[
        tuple[ShortText, ...],
        Field(min_length=1, max_length=1000, description="names of controllers or of their files"),
    ] = ("braitenberg",)
    runs: Annotated[int, Field(ge=1, le=100_000)] = 1
    cycles: Annotated[int | None, Field(ge=1, le=10**9, description="an integer from 1 to 1000000000")] = None
    seconds: Annotated[float | None, Field(gt=0, le=100_000)] = None
    pause: Annotated[float, Field(ge=0, le=100_000)] = 0.0
    folder: ShortText | None = None


class ScoreRequest(Request):
    """A program to score in a challenge; None for the reference solution."""

    challenge: FileName
    program: FileName | None = None


class ScoreTableRequest(Request):
    """A folder of programs to score in a challenge; "." is the designer's folder."""

    challenge: FileName
    folder: FileName = "."


class SenseRequest(Request):
    """A sensor test."""

    what: Literal["proximity", "light"] = "proximity"
    motion: Literal["linear", "rotational"] = "linear"
    amount: Annotated[float, Field(ge=-360, le=360)]
    speed: Annotated[int, Field(ge=1, le=127)] = 10
    acceleration: Annotated[int, Field(ge=1, le=255)] = 64
    back: Annotated[bool, Field(alias="return")] = False
    text: Text = ""


class FigureRequest(Request):
    """The picture of a sensor test."""

    sensor: ShortText | None = None
    y_min: Annotated[int, Field(ge=0, le=2**16 - 1)] = 0
    grid: bool = False


RequestType = TypeVar("RequestType", bound=Request)


def request_of(data: bytes, kind: type[RequestType], action: str) -> RequestType:
    """Return a request from JSON.

    Raises:
        RequestError: The request is invalid.
    """
    return toml_files.check(kind, toml_files.freeze(object_of(data)), action, RequestError)


def object_of(data: bytes) -> dict[str, object]:
    """Return an object from JSON as Python reads it: numbers may be infinite or NaN.

    Raises:
        RequestError: The data are not a JSON object, or its nesting exceeds 32 levels.
    """
    try:
        value = json.loads(data, parse_int=_parse_int)
        if _depth(value) > _DEPTH_LIMIT:
            raise RecursionError
    except RecursionError:
        raise RequestError(
            f"nested too deeply; expected a JSON object of at most {_DEPTH_LIMIT} levels"
        ) from None
    except ValueError as error:
        raise RequestError(f"no JSON: {error}; expected a JSON object") from None
    if not isinstance(value, dict):
        raise RequestError(f"{toml_files.format_value(value)}: expected a JSON object")
    return cast(dict[str, object], value)


def _parse_int(digits: str) -> float:
    # Python refuses to read thousands of digits; the checks report which key has them.
    return int(digits) if len(digits) < 1000 else math.inf


def _depth(value: object) -> int:
    """Return the depth of nested objects and lists."""
    depth, level = 0, [value]
    while level := [items for item in level if (items := _items(item)) is not None]:
        depth, level = depth + 1, [item for items in level for item in items]
    return depth


def _items(value: object) -> Iterable[object] | None:
    if isinstance(value, dict):
        return cast(dict[str, object], value).values()
    return cast(list[object], value) if isinstance(value, list) else None

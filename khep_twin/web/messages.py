"""Messages from the designer to its open pages: the kinds, each with its keys.

The page has one function for each kind, in a table `hears` of `main.js`, `run.js` or `challenges.js`; a test
holds both to the same kinds. A message with a `tab` answers one page, which alone takes it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NotRequired, TypedDict, get_args, get_type_hints

# The twin or the robot ------------------------------------------------------------------------------------


class RobotShape(TypedDict):
    """Radius of a robot [mm], and the position [mm] and heading [deg] of each sensor around.

    `names` are those of its infrared sensors, `n_ground` of which look at the floor; `wheels_mm` has their
    distance, radius and width; `sonar` is as `sensors` for the ultrasonic ones; `bars` are the kinds of bars.
    """

    radius_mm: float
    sensors: Sequence[Sequence[float]]
    names: Sequence[str]
    n_ground: int
    wheels_mm: Sequence[float]
    sonar: Sequence[Sequence[float]]
    bars: Mapping[str, object]


class PresentRobot(RobotShape):
    """Robot of a session; a robot at a port lacks what only a playpen knows."""

    name: str
    port: str
    baud: NotRequired[int]
    sensor_height_mm: NotRequired[float]
    leds_mm: NotRequired[Sequence[Sequence[float]]]
    turrets: NotRequired[Sequence[str]]


class TwinBegins(TypedDict):
    """A twin has begun, in a playpen of this name; `log` is the name of its log."""

    kind: Literal["twin"]
    playpen: str
    robots: Sequence[PresentRobot]
    log: str | None


class RobotBegins(TypedDict):
    """A robot at a port is connected."""

    kind: Literal["robot"]
    robots: Sequence[PresentRobot]


class RobotReadings(TypedDict):
    """Readings of a robot; what follows `vision` is known of a twin only.

    `vision` is missing where the image was not read, and None without a camera; `more` has further channels
    of a Khepera IV.
    """

    proximity: Sequence[int]
    ambient: Sequence[int]
    speed: Sequence[int]
    leds: Sequence[int]
    vision: NotRequired[Sequence[int] | None]
    x_mm: NotRequired[float]
    y_mm: NotRequired[float]
    heading_deg: NotRequired[float]
    turrets: NotRequired[object]
    more: NotRequired[Mapping[str, Sequence[int]]]
    host: NotRequired[bool]
    host_commands: NotRequired[int]


class Picture(TypedDict):
    """Present state; what follows `robots` is known of a twin only.

    `part` is the completed part of the job; `objects` has x, y [mm] and angle [deg] of each movable object by
    its table and index; `bodies` has the poses of the 3-D view's moving bodies.
    """

    kind: Literal["picture"]
    time: float
    busy: bool
    part: float
    robots: Sequence[RobotReadings]
    paused: NotRequired[bool]
    speed: NotRequired[float]
    lamps: NotRequired[Sequence[Mapping[str, object]]]
    bodies: NotRequired[Sequence[Sequence[float]]]
    objects: NotRequired[Mapping[str, Mapping[int, Sequence[float]]]]


class Ended(TypedDict):
    """The session has ended."""

    kind: Literal["ended"]


class RoomFound(TypedDict):
    """Reason why a held robot has no room at its position; empty if it has."""

    kind: Literal["room"]
    robot: int
    reason: str
    tab: str


class Refused(TypedDict):
    """A move by hand was refused."""

    kind: Literal["refused"]
    text: str
    tab: str


class Notice(TypedDict):
    """A line for the user: an error of the session, or a note."""

    kind: Literal["error", "note"]
    text: str


# Jobs -----------------------------------------------------------------------------------------------------


class RunDone(TypedDict):
    """A run of a series is over."""

    kind: Literal["run"]
    robot: int
    number: int
    stopped: bool
    cycles: int
    seconds: float
    metrics: Mapping[str, float]


class Sensed(TypedDict):
    """A sensor test is over."""

    kind: Literal["sensed"]
    warning: str


class Printed(TypedDict):
    """A program of a job, or one that is scored, has printed this."""

    kind: Literal["printed", "score-printed"]
    text: str


class JobDone(TypedDict):
    """The job is over."""

    kind: Literal["done"]


# Challenges -----------------------------------------------------------------------------------------------


class Scoring(TypedDict):
    """A program, or all of a folder, is being scored."""

    kind: Literal["scoring"]
    challenge: str
    program: NotRequired[str]
    folder: NotRequired[str]


class Scored(TypedDict):
    """Result of a program: a score and what it is compared with, or the reason why there is none."""

    kind: Literal["scored"]
    program: str
    score: str | None
    reason: NotRequired[str]
    runs: NotRequired[Sequence[str]]
    passes: NotRequired[bool | None]
    threshold: NotRequired[str]
    reference: NotRequired[str | None]


class ScoreRows(TypedDict):
    """Table of a folder's programs so far, and the part of them that is scored."""

    kind: Literal["score-rows"]
    part: float
    rows: Sequence[Mapping[str, object]]


class ScoreEnded(TypedDict):
    """The scoring has ended; the text says why if it is no success."""

    kind: Literal["score-ended"]
    text: str


# Other pages ----------------------------------------------------------------------------------------------


class FileSaved(TypedDict):
    """The page `by` has saved a file."""

    kind: Literal["saved"]
    file: str
    version: str
    by: str


class FromPage(TypedDict):
    """Another page's own message, as JSON: its file and its identifier."""

    kind: Literal["page"]
    said: str


Message = (
    TwinBegins
    | RobotBegins
    | Picture
    | Ended
    | RoomFound
    | Refused
    | Notice
    | RunDone
    | Sensed
    | Printed
    | JobDone
    | Scoring
    | Scored
    | ScoreRows
    | ScoreEnded
    | FileSaved
    | FromPage
)

KINDS: frozenset[str] = frozenset(
    kind for message in get_args(Message) for kind in get_args(get_type_hints(message)["kind"])
)
"""All kinds of messages."""

REPORTS = ("error", "note", "refused", "score-ended")
"""Those whose "text" is the designer's, and may name files."""

Publish = Callable[[Message], None]
"""Function that takes a message for the page."""

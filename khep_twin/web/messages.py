"""Messages from the designer to its open pages: the kinds, each with its keys.

The page has one function for each kind, in `messageHandlers` of `run.js`, `challenges.js` or `drafts.js`; a
test compares both lists of kinds. A message with a `tab` is for this page only; others ignore it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NotRequired, TypedDict

EXTRA_CHANNELS = ("ultrasonic", "position", "accelerometer", "gyroscope", "battery")
"""Further channels that the page shows, of the models that have them."""


class RobotShape(TypedDict):
    """Radius of a robot [mm], and position [mm] and heading [deg] of each proximity sensor.

    `programs` are the built-in controllers that can drive its model, and `speed_unit` is that of the wheels'
    speeds; `names` are those of the infrared sensors, of which `n_ground` point at the floor; `wheels_mm` has
    the distance, radius and width of the wheels; `sonar` has position x, y, z and heading of each ultrasonic
    sensor, `sonar_codes` their readings without a distance, and `sonar_unit_mm` the unit of others; `bars`
    has the kinds of bars.
    """

    model: str
    title: str
    programs: Sequence[str]
    speed_unit: str
    radius_mm: float
    sensors: Sequence[Sequence[float]]
    names: Sequence[str]
    n_ground: int
    wheels_mm: Sequence[float]
    sonar: Sequence[Sequence[float]]
    sonar_unit_mm: float
    sonar_codes: Sequence[int]
    bars: Mapping[str, object]


class PresentRobot(RobotShape):
    """Robot of a session; a robot at a port lacks the keys that need a playpen."""

    name: str
    port: str
    sensor_height_mm: NotRequired[float]
    leds_mm: NotRequired[Sequence[Sequence[float]]]
    turrets: NotRequired[Sequence[str]]


class TwinStarted(TypedDict):
    """A twin has started in a playpen; `log` is the name of its log."""

    kind: Literal["twin"]
    playpen: str
    robots: Sequence[PresentRobot]
    log: str | None


class RobotConnected(TypedDict):
    """A robot at a port is connected."""

    kind: Literal["robot"]
    robots: Sequence[PresentRobot]


class RobotReadings(TypedDict):
    """Readings of a robot; a robot at a port lacks the keys after `vision`.

    `vision` is missing if the image was not read, and None without a camera; `more` has further channels
    of its model.
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
    """Present state; a robot at a port lacks the keys after `robots`.

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


class Paths(TypedDict):
    """Paths of the robots so far, for a page that opens during a session: points x, y [mm]."""

    kind: Literal["paths"]
    paths: Sequence[Sequence[Sequence[float]]]


class Ended(TypedDict):
    """The session has ended, or its job."""

    kind: Literal["ended", "done"]


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
    """Text for the user: error, note, output of a program, or why a scoring has ended, empty if complete."""

    kind: Literal["error", "note", "printed", "score-printed", "score-ended"]
    text: str


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


class Scoring(TypedDict):
    """The scoring of a program, or of all programs of a folder, has started."""

    kind: Literal["scoring"]
    challenge: str
    program: NotRequired[str]
    folder: NotRequired[str]


class Scored(TypedDict):
    """Result of a program: a score with its references, or the reason for its absence."""

    kind: Literal["scored"]
    program: str
    score: str | None
    reason: NotRequired[str]
    runs: NotRequired[Sequence[str]]
    passes: NotRequired[bool | None]
    threshold: NotRequired[str]
    reference: NotRequired[str | None]


class ScoreRows(TypedDict):
    """Table of a folder's scored programs, and their share of all."""

    kind: Literal["score-rows"]
    part: float
    rows: Sequence[Mapping[str, object]]


class FileSaved(TypedDict):
    """The page `by` has saved a file."""

    kind: Literal["saved"]
    file: str
    version: str
    by: str


class FromPage(TypedDict):
    """Another page's message, as JSON: its file and its identifier."""

    kind: Literal["page"]
    said: str


SessionMessage = TwinStarted | RobotConnected | Picture | Paths | Ended | RoomFound | Refused | Notice
ChallengeMessage = Scoring | Scored | ScoreRows
Message = SessionMessage | RunDone | Sensed | ChallengeMessage | FileSaved | FromPage

REPORTS = ("error", "note", "refused", "score-ended")
"""Kinds whose "text" is the designer's and may contain file names."""

Publish = Callable[[Message], None]
"""Function that takes a message for the page."""

"""Channels of a shadow's log: where it takes its robot to be, what deviates, and its alarms.

    /shadow/pose        geometry_msgs/PoseWithCovarianceStamped  estimate, in the plane
    /shadow/reckoned    geometry_msgs/PoseStamped                pose by commands alone
    /shadow/particles   std_msgs/Float64MultiArray               x, y [m], heading [rad] of some particles
    /shadow/expected    std_msgs/Float64MultiArray               proximity as the twins expect it
    /shadow/measured    std_msgs/Float64MultiArray               proximity as replied last
    /shadow/residuals   std_msgs/Float64MultiArray               deviations of the replies (`RESIDUALS`)
    /shadow/learned     std_msgs/Float64MultiArray               wheels and gains, as parts, now and then
    /shadow/state       rcl_interfaces/Log                       state of the estimate, where it changes
    /shadow/suspected   rcl_interfaces/Log                       suspected faults, where these change
    /shadow/alarms      rcl_interfaces/Log                       alarms: WARN at the begin, INFO at the end

/tf has the robot at the estimate, so that every viewer draws it there. `shadow_track` reads all of it.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.log.channels import Level, TextLine
from khep_twin.log.decoding import DecodeError, shown
from khep_twin.log.entries import Label
from khep_twin.units import SENSOR_LABELS

TOPICS = "/shadow/"
"""Beginning of all topics of a shadow."""

LINE_TOPICS = STATE, SUSPECTED, ALARMS = tuple(f"{TOPICS}{name}" for name in ("state", "suspected", "alarms"))
"""Those that have lines."""


RESIDUALS = [
    *(f"proximity {sensor} [counts]" for sensor in SENSOR_LABELS),
    *(f"light {sensor} [counts]" for sensor in SENSOR_LABELS),
    "wheel left [pulses]",
    "wheel right [pulses]",
    "timing [s]",
]
"""Numbers of a message of residuals, in this order; NaN where nothing was asked."""

PROXIMITY, LIGHT, WHEELS, TIMING = slice(0, 8), slice(8, 16), slice(16, 18), 18
"""Places of these."""

PARTICLES = 100
"""Particles in a message, evenly chosen."""

_PLAIN = r"[0-9]{1,18}(?:\.[0-9]{1,9})?"
_ALARM_LINE = re.compile(rf"([^:]+): (?:since ({_PLAIN}) s, ({_PLAIN}) % sure|ended.*)")
_SUSPICION = re.compile(rf"([^:;]+): ([a-z]+), since ({_PLAIN}) s, ({_PLAIN}) %")
_NOTHING = "none"


@dataclass(frozen=True, slots=True)
class Alarm:
    """Alarm of a shadow: a fault by name, since when, and how sure.

    Attributes:
        fault: Name of the fault, e.g. "stuck sensor 3".
        channel: Channel in which it shows: "proximity", "light", "wheels" or "line".
        since_ns: Time since when the fault explains the replies better than a sound robot does [ns].
        raised_ns: Time of the alarm [ns].
        sureness: Probability of the fault, among all that were considered.
        ended_ns: Time of its end [ns]; None while it lasts.
    """

    fault: str
    channel: str
    since_ns: int
    raised_ns: int
    sureness: float
    ended_ns: int | None = None


class PoseState(StrEnum):
    """State of a pose: known, with a region that holds it; known to less; or searched for."""

    FOLLOWED = "followed"
    UNSURE = "unsure"
    LOST = "lost"


STATE_COLOURS = {
    PoseState.FOLLOWED: (94, 53, 177),
    PoseState.UNSURE: (240, 140, 0),
    PoseState.LOST: (200, 30, 60),
}
"""Colours in which the region of an estimate is drawn: red, green, blue."""

REGION = 2.4477
"""Standard deviations in half of a region in the plane that holds 95 %."""


OR = " or "
"""Word between the names of faults that look alike."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """Fault that explains the replies better than a sound robot does, without being certain.

    Attributes:
        faults: Names that it may have, the most probable first.
        channel: Channel in which it shows.
        since_ns: Time since when it explains the replies [ns].
        probability: Probability that there is one of these faults.
    """

    faults: tuple[str, ...]
    channel: str
    since_ns: int
    probability: float

    @property
    def name(self) -> str:
        """Names in words, in an order that does not change with their probabilities."""
        return OR.join(sorted(self.faults))


class StateTimes:
    """Times that a pose was in each state.

    Attributes:
        state: Present state; None before the first.
        lost: Number of times that it was lost.
    """

    def __init__(self) -> None:
        self._passed_ns = dict.fromkeys(PoseState, 0)
        self._time_ns = 0
        self.state: PoseState | None = None
        self.lost = 0

    def add(self, time_ns: int, state: PoseState) -> None:
        """Note the state at a time, not before that of earlier ones [ns]."""
        if self.state is not None:
            self._passed_ns[self.state] += time_ns - self._time_ns
        self.lost += state is PoseState.LOST and self.state is not PoseState.LOST
        self._time_ns, self.state = time_ns, state

    def __str__(self) -> str:
        whole_ns = sum(self._passed_ns.values())
        shares = {each: passed_ns / whole_ns for each, passed_ns in self._passed_ns.items() if whole_ns}
        times = ", ".join(f"{each} {share:.1%}".replace("%", " %") for each, share in shares.items())
        return f"{times} of the time" if times else "of no time"


def is_shadow(label: Label) -> bool:
    """Return whether a log is a shadow's."""
    return "shadow" in label.metadata


def begin_line(time_ns: int, alarm: Alarm) -> TextLine:
    """Return the line of a log where an alarm begins."""
    text = f"{alarm.fault}: since {alarm.since_ns / NS_PER_S:.3f} s, {100 * alarm.sureness:.1f} % sure"
    return TextLine(time_ns, Level.WARN, alarm.channel, text)


def end_line(time_ns: int, alarm: Alarm) -> TextLine:
    """Return the line of a log where an alarm ends."""
    text = f"{alarm.fault}: ended, since {alarm.since_ns / NS_PER_S:.3f} s"
    return TextLine(time_ns, Level.INFO, alarm.channel, text)


def alarms_of(lines: Iterable[TextLine]) -> list[Alarm]:
    """Return the alarms that lines in order of time tell; lines of other forms are left out."""
    alarms: list[Alarm] = []
    for line in lines:
        found = _ALARM_LINE.fullmatch(line.text)
        if found is None:
            continue
        fault, since, sure = found.groups()
        if since is not None:
            since_ns, sureness = to_ns(float(since)), float(sure) / 100
            alarms.append(Alarm(fault, line.name, since_ns, line.time_ns, sureness))
            continue
        for index, alarm in enumerate(alarms):
            if alarm.fault == fault and alarm.ended_ns is None:
                alarms[index] = replace(alarm, ended_ns=line.time_ns)
    return alarms


def state_line(time_ns: int, state: PoseState) -> TextLine:
    """Return the line of a log where a state begins."""
    level = Level.WARN if state is PoseState.LOST else Level.INFO
    return TextLine(time_ns, level, "state", state)


def state_of(text: str) -> PoseState:
    """Return the state that a line tells; a `DecodeError` is raised where it tells none."""
    try:
        return PoseState(text)
    except ValueError:
        raise DecodeError(f"state {shown(text)}", f"one of {', '.join(PoseState)}") from None


def suspected_line(time_ns: int, suspected: Iterable[Suspicion]) -> TextLine:
    """Return the line of a log where the suspected faults change: one after another, or none."""
    found = [
        f"{', '.join(each.faults)}: {each.channel}, since {each.since_ns / NS_PER_S:.3f} s, "
        f"{100 * each.probability:.1f} %"
        for each in suspected
    ]
    return TextLine(time_ns, Level.INFO, "suspected", "; ".join(found) or _NOTHING)


def suspected_of(text: str) -> tuple[Suspicion, ...]:
    """Return the suspected faults that a line tells; a `DecodeError` is raised where it tells none."""
    found: list[Suspicion] = []
    for part in [] if text == _NOTHING else text.split("; "):
        told = _SUSPICION.fullmatch(part)
        if told is None or float(told[4]) > 100:
            raise DecodeError(f"suspected {shown(part)}", "FAULT: CHANNEL, since SECONDS s, PERCENT %")
        faults = tuple(told[1].split(", "))
        found.append(Suspicion(faults, told[2], to_ns(float(told[3])), float(told[4]) / 100))
    return tuple(found)

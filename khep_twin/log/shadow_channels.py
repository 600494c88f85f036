"""Channels of a shadow's log: estimated pose, residuals of the replies, and alarms.

    /shadow/pose        geometry_msgs/PoseWithCovarianceStamped  estimate in 2-D
    /shadow/reckoned    geometry_msgs/PoseStamped                dead reckoning by commands alone
    /shadow/particles   std_msgs/Float64MultiArray               x, y [m], heading [rad] of some particles
    /shadow/expected    std_msgs/Float64MultiArray               expected proximity of the twins
    /shadow/measured    std_msgs/Float64MultiArray               last replied proximity
    /shadow/residuals   std_msgs/Float64MultiArray               deviations of the replies (`residual_names`)
    /shadow/learned     std_msgs/Float64MultiArray               ratios of wheels and gains, at intervals
    /shadow/state       rcl_interfaces/Log                       state of the estimate, at changes
    /shadow/suspected   rcl_interfaces/Log                       suspected faults, at changes
    /shadow/alarms      rcl_interfaces/Log                       alarms: WARN at the start, INFO at the end

/tf places the robot at the estimate, so that all viewers draw it there. `shadow_track` reads these channels.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.log.channels import Level, TextLine
from khep_twin.log.decoding import DecodeError, printable
from khep_twin.log.entries import Label

TOPIC_PREFIX = "/shadow/"
"""Prefix of all topics of a shadow."""

LINE_TOPICS = STATE, SUSPECTED, ALARMS = tuple(f"/shadow/{name}" for name in ("state", "suspected", "alarms"))
"""Topics with lines."""


RESIDUALS = "proximity", "light", "wheels", "timing"
"""Kinds of residuals, in the order of a message."""


def residual_names(sensors: Sequence[str]) -> list[str]:
    """Return the names of the residuals of a robot with these sensors; they are NaN without a reply."""
    counts = [f"{kind} {sensor} [counts]" for kind in ("proximity", "light") for sensor in sensors]
    return [*counts, "wheel left [pulses]", "wheel right [pulses]", "timing [s]"]


PARTICLES = 100
"""Number of particles in a message, a regular subsample."""

_DECIMAL = r"[0-9]{1,18}(?:\.[0-9]{1,9})?"
_ALARM_LINE = re.compile(rf"([^:]+): (?:since ({_DECIMAL}) s, ({_DECIMAL}) % sure|ended.*)")
_SUSPICION = re.compile(rf"([^:;]+): ([a-z]+), since ({_DECIMAL}) s, ({_DECIMAL}) %")
_NO_FAULTS = "none"


@dataclass(frozen=True, slots=True)
class Alarm:
    """Alarm of a shadow: a fault with its start and probability.

    Attributes:
        fault: Name of the fault, e.g. "stuck sensor 3".
        channel: Affected channel: "proximity", "light", "wheels" or "line".
        since_ns: Time from which the fault explains the replies better than a healthy robot [ns].
        raised_ns: Time of the alarm [ns].
        sureness: Probability of the fault among all hypotheses.
        ended_ns: Time of its end [ns]; None while it is active.
    """

    fault: str
    channel: str
    since_ns: int
    raised_ns: int
    sureness: float
    ended_ns: int | None = None


class PoseState(StrEnum):
    """State of a pose estimate: tracked within its region, uncertain, or lost and searched globally."""

    FOLLOWED = "followed"
    UNSURE = "unsure"
    LOST = "lost"


STATE_COLOURS = {
    PoseState.FOLLOWED: (94, 53, 177),
    PoseState.UNSURE: (240, 140, 0),
    PoseState.LOST: (200, 30, 60),
}
"""RGB colour of the region of an estimate by state."""

REGION_SIGMAS = 2.4477
"""Half-axes of the 95 % region of a 2-D normal distribution, in standard deviations."""

FAULT_SEPARATOR = " or "
"""Separator of the names of indistinguishable faults."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """Fault that explains the replies better than a healthy robot, without certainty.

    Attributes:
        faults: Names of the possible faults, the most probable first.
        channel: Affected channel.
        since_ns: Time from which the fault explains the replies [ns].
        probability: Total probability of these faults.
    """

    faults: tuple[str, ...]
    channel: str
    since_ns: int
    probability: float

    @property
    def name(self) -> str:
        """Names of the faults, in an order that is independent of their probabilities."""
        return FAULT_SEPARATOR.join(sorted(self.faults))


class StateTimes:
    """Durations of a pose's states.

    Attributes:
        state: Present state; None before the first.
        n_losses: Number of transitions to `LOST`.
    """

    def __init__(self) -> None:
        self._durations_ns = dict.fromkeys(PoseState, 0)
        self._time_ns = 0
        self.state: PoseState | None = None
        self.n_losses = 0

    def add(self, time_ns: int, state: PoseState) -> None:
        """Add the state at a non-decreasing time [ns]."""
        if self.state is not None:
            self._durations_ns[self.state] += time_ns - self._time_ns
        self.n_losses += state is PoseState.LOST and self.state is not PoseState.LOST
        self._time_ns = time_ns
        self.state = state

    def __str__(self) -> str:
        total_ns = sum(self._durations_ns.values())
        shares = {state: time_ns / total_ns for state, time_ns in self._durations_ns.items() if total_ns}
        times = ", ".join(f"{state} {share:.1%}".replace("%", " %") for state, share in shares.items())
        return f"{times} of the time" if times else "of no time"


def is_shadow(label: Label) -> bool:
    """Return whether a log is that of a shadow."""
    return "shadow" in label.metadata


def alarm_start_line(time_ns: int, alarm: Alarm) -> TextLine:
    """Return the line for the start of an alarm."""
    text = f"{alarm.fault}: since {alarm.since_ns / NS_PER_S:.3f} s, {100 * alarm.sureness:.1f} % sure"
    return TextLine(time_ns, Level.WARN, alarm.channel, text)


def alarm_end_line(time_ns: int, alarm: Alarm) -> TextLine:
    """Return the line for the end of an alarm."""
    text = f"{alarm.fault}: ended, since {alarm.since_ns / NS_PER_S:.3f} s"
    return TextLine(time_ns, Level.INFO, alarm.channel, text)


def parse_alarms(lines: Iterable[TextLine]) -> list[Alarm]:
    """Parse alarms from lines in order of time; other lines are ignored."""
    alarms: list[Alarm] = []
    for line in lines:
        match = _ALARM_LINE.fullmatch(line.text)
        if match is None:
            continue
        fault, start_s, percentage = match.groups()
        if start_s is not None:
            since_ns, sureness = to_ns(float(start_s)), float(percentage) / 100
            alarms.append(Alarm(fault, line.name, since_ns, line.time_ns, sureness))
            continue
        for index, alarm in enumerate(alarms):
            if alarm.fault == fault and alarm.ended_ns is None:
                alarms[index] = replace(alarm, ended_ns=line.time_ns)
    return alarms


def state_line(time_ns: int, state: PoseState) -> TextLine:
    """Return the line for the start of a state."""
    level = Level.WARN if state is PoseState.LOST else Level.INFO
    return TextLine(time_ns, level, "state", state)


def parse_state(text: str) -> PoseState:
    """Parse a state; raise a `DecodeError` for an unknown one."""
    try:
        return PoseState(text)
    except ValueError:
        raise DecodeError(f"state {printable(text)}", f"one of {', '.join(PoseState)}") from None


def suspicion_line(time_ns: int, suspicions: Iterable[Suspicion]) -> TextLine:
    """Return the line with the present suspected faults, or none."""
    parts = [
        f"{', '.join(suspicion.faults)}: {suspicion.channel}, since {suspicion.since_ns / NS_PER_S:.3f} s, "
        f"{100 * suspicion.probability:.1f} %"
        for suspicion in suspicions
    ]
    return TextLine(time_ns, Level.INFO, "suspected", "; ".join(parts) or _NO_FAULTS)


def parse_suspicions(text: str) -> tuple[Suspicion, ...]:
    """Parse suspected faults; raise a `DecodeError` for an invalid text."""
    suspicions: list[Suspicion] = []
    for part in [] if text == _NO_FAULTS else text.split("; "):
        match = _SUSPICION.fullmatch(part)
        if match is None or float(match[4]) > 100:
            raise DecodeError(f"suspected {printable(part)}", "FAULT: CHANNEL, since SECONDS s, PERCENT %")
        faults = tuple(match[1].split(", "))
        suspicions.append(Suspicion(faults, match[2], to_ns(float(match[3])), float(match[4]) / 100))
    return tuple(suspicions)

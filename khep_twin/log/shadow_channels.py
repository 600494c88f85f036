"""Channels of a shadow's log: where it takes its robot to be, what deviates, and its alarms.

    /shadow/pose        geometry_msgs/PoseWithCovarianceStamped  estimate, in the plane
    /shadow/reckoned    geometry_msgs/PoseStamped                pose by commands alone
    /shadow/particles   std_msgs/Float64MultiArray               x, y [m], heading [rad] of some particles
    /shadow/expected    std_msgs/Float64MultiArray               proximity as the twins expect it
    /shadow/measured    std_msgs/Float64MultiArray               proximity as replied last
    /shadow/residuals   std_msgs/Float64MultiArray               deviations of the replies (`RESIDUALS`)
    /shadow/learned     std_msgs/Float64MultiArray               wheels and gains, as parts, now and then
    /shadow/alarms      rcl_interfaces/Log                       alarms: WARN at the begin, INFO at the end

/tf has the robot at the estimate, so that every viewer draws it there.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.errors import LogError
from khep_twin.log.channels import PLANAR, Level, TextLine
from khep_twin.log.decoding import DecodeError, Decoder, read_arrays_of, read_each, read_line
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_raw
from khep_twin.units import SENSOR_LABELS

Floats = NDArray[np.float64]

TOPICS = "/shadow/"
"""Beginning of all topics of a shadow."""


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

_T = TypeVar("_T")

_DOUBLES = {"pose": 43, "reckoned": 7}
"""Numbers of a message of a pose: position, quaternion, covariance."""


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


class State(StrEnum):
    """State of a pose: known, with a region that holds it; known to less; or searched for."""

    FOLLOWED = "followed"
    UNSURE = "unsure"
    LOST = "lost"


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


@dataclass(frozen=True, slots=True)
class ShadowTrack:
    """A shadow's log as arrays.

    Attributes:
        label: Metadata and attachments of the log.
        times_ns: Times of the updates (n,) [ns].
        pose: Estimated x, y [m] and heading [rad] (n, 3).
        covariance: Covariances of these (n, 3, 3).
        reckoned: x, y [m] and heading [rad] by commands alone (n, 3).
        expected: Expected proximity (n, 8) [counts].
        measured: Measured proximity (n, 8) [counts]; NaN before the first.
        residuals: Deviations of the replies (n, 19), as `RESIDUALS` names them.
        particles_ns: Times of the particles (m,) [ns].
        particles: x, y [m] and heading [rad] of particles (m, 100, 3).
        alarms: Alarms in order of their beginnings.
    """

    label: Label
    times_ns: NDArray[np.int64]
    pose: Floats
    covariance: Floats
    reckoned: Floats
    expected: Floats
    measured: Floats
    residuals: Floats
    particles_ns: NDArray[np.int64]
    particles: Floats
    alarms: list[Alarm]


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


def read_shadow(path: Path) -> ShadowTrack:
    """Read a shadow's log.

    Raises:
        LogError: There is no such log, it is not whole, or it is none of a shadow.
    """
    label, found, _ = read_raw(path, lambda topic: topic.startswith(TOPICS))
    if not is_shadow(label):
        raise LogError(f"{path}: no log of a shadow; expected one of khep-twin shadow -o")

    def channel(name: str, read: Callable[[list[bytes]], _T]) -> tuple[NDArray[np.int64], _T]:
        messages = found.get(TOPICS + name, [])
        times_ns = np.array([time_ns for time_ns, _ in messages], np.int64)
        try:
            return times_ns, read([data for _, data in messages])
        except DecodeError as error:
            raise error.at(path, TOPICS + name, int(times_ns[error.row])) from None

    times_ns, poses = channel("pose", partial(_poses, width=_DOUBLES["pose"]))

    def of_all(name: str, read: Callable[[list[bytes]], Floats]) -> Floats:
        own_ns, values = channel(name, read)
        if not np.array_equal(own_ns, times_ns):
            found = f"{len(own_ns)} messages"
            raise DecodeError(found, f"{len(times_ns)}, at the times of {TOPICS}pose").at(path, TOPICS + name)
        return values

    covariances = poses[:, 7:].reshape(-1, 6, 6)[:, PLANAR][:, :, PLANAR]
    particles_ns, particles = channel("particles", partial(_floats, width=3 * PARTICLES))
    return ShadowTrack(
        label,
        times_ns,
        planar(poses),
        covariances,
        planar(of_all("reckoned", partial(_poses, width=_DOUBLES["reckoned"]))),
        of_all("expected", partial(_floats, width=len(SENSOR_LABELS))),
        of_all("measured", partial(_floats, width=len(SENSOR_LABELS))),
        of_all("residuals", partial(_floats, width=len(RESIDUALS))),
        particles_ns,
        particles.reshape(-1, PARTICLES, 3),
        alarms_of(channel("alarms", partial(read_each, read_line))[1]),
    )


def planar(poses: Floats) -> Floats:
    """Return x, y [m] and heading [rad] (n, 3) of positions and quaternions x, y, z, w (n, 7 or more)."""
    return np.column_stack([poses[:, :2], 2 * np.arctan2(poses[:, 5], poses[:, 6])])


def _poses(messages: Sequence[bytes], width: int) -> Floats:
    """Return position, quaternion and what follows, of messages of poses (n, width)."""

    def read(message: bytes) -> tuple[float, ...]:
        decoder = Decoder(message)
        decoder.time()
        decoder.text()
        values = decoder.get("d", width)
        decoder.end()
        return values

    return np.array(read_each(read, messages), np.float64).reshape(-1, width)


def _floats(messages: Sequence[bytes], width: int) -> Floats:
    if not messages:
        return np.zeros((0, width))
    return np.asarray(read_arrays_of(messages, "d", width, " of a shadow"), np.float64)

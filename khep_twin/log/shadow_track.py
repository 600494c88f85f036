"""A shadow's log as arrays, with its alarms, states and suspected faults."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError
from khep_twin.log.attached import playpen_of
from khep_twin.log.channels import PLANAR_ROWS
from khep_twin.log.decoding import DecodeError, Decoder, read_all, read_line, stack_arrays
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_raw
from khep_twin.log.shadow_channels import (
    PARTICLES,
    RESIDUALS,
    TOPIC_PREFIX,
    Alarm,
    PoseState,
    StateTimes,
    Suspicion,
    is_shadow,
    parse_alarms,
    parse_state,
    parse_suspicions,
    residual_names,
)

Floats = NDArray[np.float64]

_T = TypeVar("_T")

_POSE_WIDTHS = {"pose": 43, "reckoned": 7}
"""Numbers of a message of a pose: position, quaternion, covariance."""


@dataclass(frozen=True, slots=True)
class ShadowTrack:
    """A shadow's log as arrays.

    Attributes:
        label: Metadata and attachments of the log.
        sensors: Names of the infrared sensors around the robot.
        times_ns: Times of the updates (n,) [ns].
        pose: Estimated x, y [m] and heading [rad] (n, 3).
        covariance: Covariances of `pose` (n, 3, 3).
        reckoned: x, y [m] and heading [rad] by dead reckoning of the commands (n, 3).
        expected: Expected proximity (n, n_sensors) [counts].
        measured: Measured proximity (n, n_sensors) [counts]; NaN before the first.
        residuals: Deviations of the replies, by their kinds (`RESIDUALS`).
        particles_ns: Times of the particles (m,) [ns].
        particles: x, y [m] and heading [rad] of particles (m, 100, 3).
        alarms: Alarms in order of their starts.
        states: Times of changes of the state [ns], with the new state; empty in older logs.
        suspected: Times of changes of the suspected faults [ns], with the new ones.
    """

    label: Label
    sensors: tuple[str, ...]
    times_ns: NDArray[np.int64]
    pose: Floats
    covariance: Floats
    reckoned: Floats
    expected: Floats
    measured: Floats
    residuals: Mapping[str, Floats]
    particles_ns: NDArray[np.int64]
    particles: Floats
    alarms: list[Alarm]
    states: list[tuple[int, PoseState]]
    suspected: list[tuple[int, tuple[Suspicion, ...]]]

    @property
    def state_times(self) -> StateTimes:
        """Times in each state, up to the last update."""
        times = StateTimes()
        for time_ns, state in self.states:
            times.add(time_ns, state)
        if times.state is not None and len(self.times_ns):
            times.add(int(self.times_ns[-1]), times.state)
        return times


def read_shadow(path: Path) -> ShadowTrack:
    """Read a shadow's log.

    Raises:
        LogError: The log is missing, incomplete, or not that of a shadow.
    """
    label, messages_by_topic, _ = read_raw(path, lambda topic: topic.startswith(TOPIC_PREFIX))
    if not is_shadow(label):
        raise LogError(f"{path}: no log of a shadow; expected one of khep-twin shadow -o")

    def read_channel(name: str, read: Callable[[list[bytes]], _T]) -> tuple[NDArray[np.int64], _T]:
        messages = messages_by_topic.get(TOPIC_PREFIX + name, [])
        times_ns = np.array([time_ns for time_ns, _ in messages], np.int64)
        try:
            return times_ns, read([data for _, data in messages])
        except DecodeError as error:
            raise error.to_log_error(path, TOPIC_PREFIX + name, int(times_ns[error.row])) from None

    def read_lines(name: str, read: Callable[[str], _T]) -> list[tuple[int, _T]]:
        read_texts = partial(read_all, lambda message: read(read_line(message).text))
        times_ns, values = read_channel(name, read_texts)
        return list(zip(times_ns.tolist(), values, strict=True))

    times_ns, poses = read_channel("pose", partial(_read_poses, width=_POSE_WIDTHS["pose"]))

    def read_synchronous(name: str, read: Callable[[list[bytes]], Floats]) -> Floats:
        channel_times_ns, values = read_channel(name, read)
        if not np.array_equal(channel_times_ns, times_ns):
            expected = f"{len(times_ns)}, at the times of {TOPIC_PREFIX}pose"
            error = DecodeError(f"{len(channel_times_ns)} messages", expected)
            raise error.to_log_error(path, TOPIC_PREFIX + name)
        return values

    covariances = poses[:, 7:].reshape(-1, 6, 6)[:, PLANAR_ROWS][:, :, PLANAR_ROWS]
    particles_ns, particles = read_channel("particles", partial(_read_floats, width=3 * PARTICLES))
    reckoned = read_synchronous("reckoned", partial(_read_poses, width=_POSE_WIDTHS["reckoned"]))
    sensors = playpen_of(label.attachments, path).robots[0].body.ring_sensors
    return ShadowTrack(
        label,
        sensors,
        times_ns,
        planar_poses(poses),
        covariances,
        planar_poses(reckoned),
        read_synchronous("expected", partial(_read_floats, width=len(sensors))),
        read_synchronous("measured", partial(_read_floats, width=len(sensors))),
        split_residuals(
            read_synchronous("residuals", partial(_read_floats, width=len(residual_names(sensors))))
        ),
        particles_ns,
        particles.reshape(-1, PARTICLES, 3),
        parse_alarms(read_channel("alarms", partial(read_all, read_line))[1]),
        read_lines("state", parse_state),
        read_lines("suspected", parse_suspicions),
    )


def split_residuals(residuals: Floats) -> dict[str, Floats]:
    """Return the residuals of each kind, of those of all sensors, wheels and timing (n, 2 n_sensors + 3)."""
    n_sensors = residuals.shape[1] // 2 - 1
    ends = n_sensors, 2 * n_sensors, 2 * n_sensors + 2
    return dict(zip(RESIDUALS, np.split(residuals, ends, axis=1), strict=True))


def planar_poses(poses: Floats) -> Floats:
    """Return x, y [m] and heading [rad] (n, 3) of positions and quaternions x, y, z, w (n, 7 or more)."""
    return np.column_stack([poses[:, :2], 2 * np.arctan2(poses[:, 5], poses[:, 6])])


def _read_poses(messages: Sequence[bytes], width: int) -> Floats:
    """Return position, quaternion and covariance, if any, of messages of poses (n, width)."""

    def read(message: bytes) -> tuple[float, ...]:
        decoder = Decoder(message)
        decoder.time()
        decoder.text()
        values = decoder.numbers("d", width)
        decoder.check_end()
        return values

    return np.array(read_all(read, messages), np.float64).reshape(-1, width)


def _read_floats(messages: Sequence[bytes], width: int) -> Floats:
    if not messages:
        return np.zeros((0, width))
    return np.asarray(stack_arrays(messages, "d", width, " of a shadow"), np.float64)

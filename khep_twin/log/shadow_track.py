"""A shadow's log as arrays, with its alarms, states and suspected faults."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError
from khep_twin.log.channels import PLANAR
from khep_twin.log.decoding import DecodeError, Decoder, read_arrays_of, read_each, read_line
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_raw
from khep_twin.log.shadow_channels import (
    PARTICLES,
    RESIDUALS,
    TOPICS,
    Alarm,
    PoseState,
    StateTimes,
    Suspicion,
    alarms_of,
    is_shadow,
    state_of,
    suspected_of,
)
from khep_twin.units import SENSOR_LABELS

Floats = NDArray[np.float64]

_T = TypeVar("_T")

_DOUBLES = {"pose": 43, "reckoned": 7}
"""Numbers of a message of a pose: position, quaternion, covariance."""


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
        states: Times at which the state changed [ns], with the state from then on; none in older logs.
        suspected: Times at which the suspected faults changed [ns], with those from then on.
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

    def lines(name: str, read: Callable[[str], _T]) -> list[tuple[int, _T]]:
        times_ns, found = channel(name, partial(read_each, lambda message: read(read_line(message).text)))
        return list(zip(times_ns.tolist(), found, strict=True))

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
        lines("state", state_of),
        lines("suspected", suspected_of),
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

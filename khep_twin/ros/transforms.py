"""Frames of a log as one tree with the odometry (REP 105).

    map > khepera0/odom > khepera0/base_link > khepera0/left_wheel

A log has the true pose of a robot, map > khepera0/base_link, but each frame has one parent. So map > odom is
the truth times the inverse of the odometry: map > base_link remains the truth.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import BASE_FRAME, MAP, TransformFrame
from khep_twin.log.decoding import DecodeError
from khep_twin.log.transforms import Floats, Frames, compose, invert, read_frames, relative
from khep_twin.ros.standard import ODOM_FRAME, round_steps

_OLD_MAP, _OLD_BASE = "world", "/base"
"""Frame of the scene and end of a robot's frame in logs of version 1.0."""

Times = NDArray[np.int64]


class Reckoned(NamedTuple):
    """Poses of a robot by its odometry: times (n,) [ns], and position and quaternion x, y, z, w (n, 7)."""

    times_ns: Times
    poses: Floats


def odometry_trees(
    times_ns: Times, messages: Sequence[bytes], odometry: Mapping[str, Reckoned]
) -> Iterator[tuple[Times, NDArray[np.void]]]:
    """Yield times and messages of /tf with the robots' odometry, in groups of the same frames.

    Args:
        times_ns: Times of the log's messages of /tf (n,) [ns].
        messages: These messages.
        odometry: Odometry of robots by name; others keep their pose in the map.

    Raises:
        DecodeError: A message is invalid.
    """
    rest_ns, rest = times_ns, list(messages)
    while rest:
        frames = read_frames(rest[0])
        has_frames, poses = TransformFrame(frames).parse(rest)
        if not has_frames[0]:
            raise DecodeError("other bytes between the values of a message", "zeros")
        group_ns = rest_ns[has_frames]
        rest_ns, rest = rest_ns[~has_frames], [rest[row] for row in np.flatnonzero(~has_frames)]
        frames, poses = _mounted(*_renamed(frames, poses))
        for robot, reckoned in odometry.items():
            frames, poses = _with_odometry(frames, poses, robot, _at(reckoned, group_ns))
        yield group_ns, TransformFrame(frames).messages(group_ns, round_steps(poses))


def _renamed(frames: Frames, poses: Floats) -> tuple[Frames, Floats]:
    """Return frames with the present names."""
    names = {_OLD_MAP: MAP} | {
        child: BASE_FRAME.format(child.removesuffix(_OLD_BASE))
        for _, child in frames
        if child.endswith(_OLD_BASE)
    }
    return [(names.get(parent, parent), names.get(child, child)) for parent, child in frames], poses


def _mounted(frames: Frames, poses: Floats) -> tuple[Frames, Floats]:
    """Return frames in which no part of a robot has its pose in the map, as in logs of version 1.0."""
    names = [child for _, child in frames]
    frames, poses = list(frames), poses.copy()
    for index, (parent, child) in enumerate(frames):
        base = BASE_FRAME.format(child.partition("/")[0])
        if parent == MAP and child != base and base in names:
            base_pose = poses[:, names.index(base)]
            frames[index] = base, child
            poses[:, index] = relative(poses[:, index], base_pose)
    return frames, poses


def _with_odometry(frames: Frames, poses: Floats, robot: str, reckoned: Floats) -> tuple[Frames, Floats]:
    """Return frames with a robot's odometry (n, 7) between the map and the robot."""
    base, odom = BASE_FRAME.format(robot), ODOM_FRAME.format(robot)
    if (MAP, base) not in frames:
        return frames, poses
    index = frames.index((MAP, base))
    poses = np.concatenate([poses, reckoned[:, None]], axis=1)
    poses[:, index] = compose(poses[:, index], invert(reckoned))
    return [*frames[:index], (MAP, odom), *frames[index + 1 :], (odom, base)], poses


def _at(reckoned: Reckoned, times_ns: Times) -> Floats:
    """Return the last poses up to times (n, 7)."""
    rows = np.searchsorted(reckoned.times_ns, times_ns, "right") - 1
    return reckoned.poses[np.maximum(rows, 0)]

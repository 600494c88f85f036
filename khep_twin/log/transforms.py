"""Poses in other frames, and the poses of all bodies in the messages of /tf, decoded together.

A pose is x, y, z [m] and a quaternion x, y, z, w, along the last axis of an array (..., 7).
"""

from collections.abc import Collection, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import TRANSFORMS, TransformFrame
from khep_twin.log.decoding import DecodeError, body_of, decode, read_all

Floats = NDArray[np.float64]
Frames = list[tuple[str, str]]

_IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


def from_planar(poses: Floats) -> Floats:
    """Return poses of x, y [m] and heading [rad] (n, 3) as poses (n, 7)."""
    half, result = poses[:, 2] / 2, np.zeros((len(poses), 7))
    result[:, :2], result[:, 5], result[:, 6] = poses[:, :2], np.sin(half), np.cos(half)
    return result


def compose(outer: Floats, inner: Floats) -> Floats:
    """Return the poses that are `inner` in the frame of `outer`."""
    position = outer[..., :3] + _rotate(outer[..., 3:], inner[..., :3])
    return np.concatenate([position, _multiply(outer[..., 3:], inner[..., 3:])], axis=-1)


def relative(poses: Floats, parents: Floats) -> Floats:
    """Return poses in the frames of their parents."""
    inverse = parents[..., 3:] * [-1, -1, -1, 1]
    position = _rotate(inverse, poses[..., :3] - parents[..., :3])
    return np.concatenate([position, _multiply(inverse, poses[..., 3:])], axis=-1)


def invert(poses: Floats) -> Floats:
    """Return the inverse poses."""
    return relative(np.broadcast_to(_IDENTITY, poses.shape), poses)


def read_frames(message: bytes) -> Frames:
    """Return the frames of a message of /tf: pairs of a parent and the frame itself."""
    transforms = decode(TRANSFORMS, message)["transforms"]
    return [(item["header"]["frame_id"], item["child_frame_id"]) for item in transforms]


def world_poses(messages: Sequence[bytes], bodies: Collection[str]) -> dict[str, Floats]:
    """Return the poses of bodies in the root frame (n, 7), of those that have one.

    Raises:
        DecodeError: A message is invalid, or has other frames than the first.
    """
    frames = read_frames(messages[0])
    has_frames, values = TransformFrame(frames).parse(messages)
    if not has_frames.all():
        rows = read_all(partial(_read_poses, frames=frames), messages)
        values = np.array(rows, np.float64).reshape(len(rows), -1, 7)
    parents = {frame: parent for parent, frame in frames}
    local = {frame: values[:, index] for index, (_, frame) in enumerate(frames)}
    return {body_of(frame): _to_root(frame, parents, local) for frame in parents if body_of(frame) in bodies}


def _read_poses(message: bytes, frames: Frames) -> list[list[float]]:
    if (other := read_frames(message)) != frames:
        raise DecodeError(f"{len(other)} frames", "those of the channel's first message")
    transforms = [item["transform"] for item in decode(TRANSFORMS, message)["transforms"]]
    return [[*item["translation"].values(), *item["rotation"].values()] for item in transforms]


def _to_root(frame: str, parents: Mapping[str, str], local: Mapping[str, Floats]) -> Floats:
    """Return the poses of a frame in the root frame, by the poses of all in their parents' frames."""
    pose, parent = local[frame], parents[frame]
    for _ in parents:
        if parent not in local:
            return pose
        pose, parent = compose(local[parent], pose), parents[parent]
    raise DecodeError(f"frame {frame[:60]!r} in a circle of frames", "one below a root")


def _multiply(left: Floats, right: Floats) -> Floats:
    """Return products of quaternions x, y, z, w (..., 4)."""
    left_xyz, left_w, right_xyz, right_w = left[..., :3], left[..., 3:], right[..., :3], right[..., 3:]
    w = left_w * right_w - np.sum(left_xyz * right_xyz, axis=-1, keepdims=True)
    xyz = left_w * right_xyz + right_w * left_xyz + np.cross(left_xyz, right_xyz)
    return np.concatenate([xyz, w], axis=-1)


def _rotate(rotation: Floats, vectors: Floats) -> Floats:
    """Return vectors (..., 3) rotated by quaternions x, y, z, w (..., 4)."""
    xyz, w = rotation[..., :3], rotation[..., 3:]
    return vectors + 2 * np.cross(xyz, w * vectors + np.cross(xyz, vectors))

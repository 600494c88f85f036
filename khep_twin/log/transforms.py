"""Poses of all bodies in the messages of /tf, decoded together."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.decoding import DecodeError, Decoder

_POSE_BYTES = 7 * 8
_STAMP_BYTES = 8


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout of a TFMessage: parent by frame, and the offsets of stamps and poses in the message [bytes]."""

    parents: dict[str, str]
    stamps: list[int]
    poses: list[int]


def world_poses(messages: Sequence[bytes]) -> dict[str, NDArray[np.float64]]:
    """Return the poses of the frames in the root frame: x, y, z [m], quaternion x, y, z, w (n, 7).

    Raises:
        DecodeError: A message is invalid, or has other frames than the first.
    """
    if not messages:
        return {}
    layout, size = _layout(messages[0]), len(messages[0])
    if all(len(message) == size for message in messages):
        raw = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), size)
        is_fixed = np.ones(size, bool)
        for offsets, length in ((layout.stamps, _STAMP_BYTES), (layout.poses, _POSE_BYTES)):
            is_fixed[np.add.outer(offsets, np.arange(length)).ravel().astype(int)] = False
        if (raw[:, is_fixed] == raw[0, is_fixed]).all():
            columns = np.add.outer(layout.poses, np.arange(_POSE_BYTES)).ravel().astype(int)
            values = np.ascontiguousarray(raw[:, columns]).view("<f8").reshape(len(messages), -1, 7)
            return _compose(layout.parents, values)
    rows: list[list[tuple[float, ...]]] = []
    for row, message in enumerate(messages):
        other = _layout(message)
        if other.parents != layout.parents:
            expected = "those of the channel's first message"
            raise DecodeError(f"{len(other.parents)} frames", expected).in_row(row)
        rows.append([struct.unpack_from("<7d", message, offset) for offset in other.poses])
    return _compose(layout.parents, np.array(rows, np.float64).reshape(len(messages), -1, 7))


def _layout(message: bytes) -> _Layout:
    decoder = Decoder(message)
    layout, offset = _Layout({}, [], []), 8  # after the CDR header and the number of transforms
    for _ in range(decoder.uint32()):
        stamp = offset
        decoder.time()
        offset += _STAMP_BYTES
        names: list[str] = []
        for _ in range(2):
            offset += -offset % 4
            names.append(decoder.text())
            offset += 4 + struct.unpack_from("<I", message, offset)[0]
        # Numbers are aligned in the content after the header of 4 bytes.
        offset += -(offset - 4) % 8
        decoder.numbers("d", 7)
        if names[1] not in layout.parents:
            layout.stamps.append(stamp + -stamp % 4)
            layout.poses.append(offset)
            layout.parents[names[1]] = names[0]
        offset += _POSE_BYTES
    decoder.check_end()
    return layout


def _compose(parents: dict[str, str], values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the poses in the root frame of poses in their parents' frames (n, frames, 7)."""
    local = dict(zip(parents, np.moveaxis(values, 1, 0), strict=True))
    poses: dict[str, NDArray[np.float64]] = {}
    for frame in parents:
        pose, parent = local[frame], parents[frame]
        for _ in range(len(parents)):
            if parent not in local:
                break
            pose, parent = multiply(local[parent], pose), parents[parent]
        else:
            raise DecodeError(f"frame {frame[:60]!r} in a circle of frames", "one below a root")
        poses[frame] = pose
    return poses


def multiply(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses in the frame in which `outer` is, of poses in the frame `outer` (n, 7)."""
    axis, w = outer[:, 3:6], outer[:, 6:]
    turn = 2 * np.cross(axis, inner[:, :3])
    position = outer[:, :3] + inner[:, :3] + w * turn + np.cross(axis, turn)
    inner_axis, inner_w = inner[:, 3:6], inner[:, 6:]
    vector = w * inner_axis + inner_w * axis + np.cross(axis, inner_axis)
    scalar = w * inner_w - (axis * inner_axis).sum(axis=1, keepdims=True)
    return np.hstack([position, vector, scalar])


def invert(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse poses (n, 7)."""
    turned = poses * (1, 1, 1, -1, -1, -1, 1)
    turned[:, :3] = 0
    shift = poses.copy()
    shift[:, 3:] = 0, 0, 0, 1
    shift[:, :3] *= -1
    return multiply(turned, shift)

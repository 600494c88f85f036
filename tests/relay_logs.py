"""Logs of a real robot's line, as a relay writes them."""

from collections.abc import Iterable
from pathlib import Path

from khep_twin.log.line_recorder import LineRecorder
from khep_twin.robots.model import RobotModel


def relayed(
    path: Path,
    chunks: Iterable[tuple[int, bool, bytes]] = (),
    model: RobotModel | None = None,
    **facts: object,
) -> Path:
    """Write a log of bytes to the robot, or from it, at times [ms]; return its path."""
    now_ns = 0
    recorder = LineRecorder(path, {"relay": "/dev/robot", **facts}, lambda: now_ns, model)
    for time_ms, to_robot, data in chunks:
        now_ns = time_ms * 1_000_000
        recorder.on_bytes(to_robot, data)
    recorder.close()
    return path


def in_turn(*lines: bytes) -> list[tuple[int, bool, bytes]]:
    """Return what host and robot say in turn, 0.1 s apart, as `relayed` takes it."""
    return [(100 * number, number % 2 == 1, data) for number, data in enumerate(lines, 1)]

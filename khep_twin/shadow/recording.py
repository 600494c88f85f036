"""The bytes of a recorded robot's line, read from a log for a shadow."""

import re
from pathlib import Path
from typing import NamedTuple

from khep_twin.errors import LogError
from khep_twin.log.decoding import decode_messages, read_line
from khep_twin.log.reader import read_raw, require_feature_in
from khep_twin.log.transcript import unescape
from khep_twin.robots.model import Feature


class LineChunk(NamedTuple):
    """Bytes that crossed the line at a time [ns], sent by the host or by the robot."""

    time_ns: int
    to_robot: bool
    data: bytes


class RecordedRobot(NamedTuple):
    """Line of a recorded robot: its baud rate at the start, None if unknown, and its bytes in order."""

    name: str
    baud: int | None
    chunks: list[LineChunk]


def read_recording(path: Path, robot: int = 0) -> RecordedRobot:
    """Read the line of a robot of a log.

    Args:
        path: Path of the log of a relay or of a twin.
        robot: Number of the robot, from 0; ignored for a log with one robot, such as a relay's.

    Raises:
        LogError: There is no log, it is incomplete, or it has no line of that robot.
    """
    label, messages, _ = read_raw(path, lambda topic: topic.endswith("/serial"))
    require_feature_in(label, path, Feature.SHADOW)
    names = label.robots
    index = robot if len(names) > 1 else 0
    if not 0 <= index < len(names):
        raise LogError(f"{path}: robot {robot}; expected one of 0 to {len(names) - 1}, as the log has them")
    name = names[index]
    lines = [line for _, line in decode_messages(path, f"/{name}/serial", messages, read_line)]
    if not lines:
        raise LogError(f"{path}: nothing crossed the line of {name}; expected a host's commands")
    chunks = [LineChunk(line.time_ns, line.name == "host", unescape(line.text) + b"\n") for line in lines]
    baud = label.metadata.get("baud", "")
    start_baud = int(baud) if re.fullmatch("[1-9][0-9]{2,6}", baud) else None
    return RecordedRobot(name, start_baud, sorted(chunks, key=lambda chunk: chunk.time_ns))

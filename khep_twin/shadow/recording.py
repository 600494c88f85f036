"""A shadow of a recorded robot: the bytes of its line from a log."""

import re
from pathlib import Path
from typing import NamedTuple

from khep_twin.errors import LogError
from khep_twin.log.decoding import decoded, read_line
from khep_twin.log.reader import read_raw, require_kheperas_in
from khep_twin.log.transcript import bytes_of


class Heard(NamedTuple):
    """Bytes that crossed the line at a time [ns], a host's to the robot or the robot's."""

    time_ns: int
    to_robot: bool
    data: bytes


class RecordedRobot(NamedTuple):
    """Line of a recorded robot: its speed at the start [baud], None if unknown, and bytes in order."""

    name: str
    baud: int | None
    heard: list[Heard]


def recorded(path: Path, robot: int = 0) -> RecordedRobot:
    """Read the line of a robot of a log.

    Args:
        path: Path of the log, of a relay or of a twin.
        robot: Number of the robot, from 0; a relay's log has one, which is any.

    Raises:
        LogError: There is no log, it is not whole, or it has no such line.
    """
    label, found, _ = read_raw(path, lambda topic: topic.endswith("/serial"))
    require_kheperas_in(label, path, "the shadow")
    names = label.robots
    index = robot if len(names) > 1 else 0
    if not 0 <= index < len(names):
        raise LogError(f"{path}: robot {robot}; expected one of 0 to {len(names) - 1}, as the log has them")
    name = names[index]
    lines = [line for _, line in decoded(path, f"/{name}/serial", found, read_line)]
    if not lines:
        raise LogError(f"{path}: nothing crossed the line of {name}; expected a host's commands")
    heard = [Heard(line.time_ns, line.name == "host", bytes_of(line.text) + b"\n") for line in lines]
    baud = label.metadata.get("baud", "")
    known = int(baud) if re.fullmatch("[1-9][0-9]{2,6}", baud) else None
    return RecordedRobot(name, known, sorted(heard, key=lambda each: each.time_ns))

"""The bytes of a recorded robot's line, read from a log for a shadow.

A robot without a host, as in a log of `exec`, has no line. The samples of its registers then are replies to
the requests that read them, and its motors' duties are those of a host.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from khep_twin.errors import LogError
from khep_twin.log.decoding import decode_messages, read_line
from khep_twin.log.reader import RobotTrack, read_log, read_raw
from khep_twin.log.robot_models import models_of
from khep_twin.log.transcript import unescape
from khep_twin.robots.model import Dialect, Read, RobotModel


class LineChunk(NamedTuple):
    """Bytes that crossed the line at a time [ns], sent by the host or by the robot."""

    time_ns: int
    to_robot: bool
    data: bytes


_SAMPLES_PER_READ = 5
"""Samples of the registers per reply to each request; all of them set the duties."""

_SAMPLED_BAUD = 10**9
"""Baud rate at which samples are replies without a delay."""


class RecordedRobot(NamedTuple):
    """Line of a recorded robot: its baud rate at the start, None if unknown, and its bytes in order."""

    name: str
    baud: int | None
    chunks: list[LineChunk]


def read_recording(path: Path, robot: int = 0, model: RobotModel | None = None) -> RecordedRobot:
    """Read the line of a robot of a log.

    Args:
        path: Path of the log of a relay or of a twin.
        robot: Number of the robot, from 0; ignored for a log with one robot, such as a relay's.
        model: Expected model; a relay's log does not have one.

    Raises:
        LogError: There is no log, it is incomplete, it has no line of that robot, or one
            of another model.
    """
    label, messages, _ = read_raw(path, lambda topic: topic.endswith("/serial"))
    names = label.robots
    index = robot if len(names) > 1 else 0
    if not 0 <= index < len(names):
        raise LogError(f"{path}: robot {robot}; expected one of 0 to {len(names) - 1}, as the log has them")
    name = names[index]
    if model and "playpen.toml" in label.attachments:
        logged_model = models_of(label.attachments, [name])[name]
        if logged_model.family != model.family:
            raise LogError(f"{path}: {name} is a {logged_model.title}; expected a {model.title}")
    lines = [line for _, line in decode_messages(path, f"/{name}/serial", messages, read_line)]
    if not lines and (chunks := list(_sampled_chunks(read_log(path).robots[name]))):
        return RecordedRobot(name, _SAMPLED_BAUD, chunks)
    if not lines:
        raise LogError(f"{path}: nothing crossed the line of {name}; expected a host's commands")
    chunks = [LineChunk(line.time_ns, line.name == "host", unescape(line.text) + b"\n") for line in lines]
    baud = label.metadata.get("baud", "")
    start_baud = int(baud) if re.fullmatch("[1-9][0-9]{2,6}", baud) else None
    return RecordedRobot(name, start_baud, sorted(chunks, key=lambda chunk: chunk.time_ns))


def reads_of(dialect: Dialect) -> list[Read]:
    """Return the requests that a shadow needs, of the readings that a robot has."""
    reads = map(dialect.reads.get, ("proximity", "ultrasonic", "position"))
    return [read for read in reads if read is not None]


def _sampled_chunks(robot: RobotTrack) -> Iterator[LineChunk]:
    """Yield samples of registers as the bytes of requests and replies; none without duties to set."""
    dialect, (order, duties) = robot.model.dialect, robot.model.dialect.open_loop
    reads = reads_of(dialect)
    for index, (time_ns, row) in enumerate(zip(robot.times_ns.tolist(), robot.registers, strict=True)):
        replies: dict[str, str] = {}
        for read in reads if order and index % _SAMPLES_PER_READ == 0 else ():
            values = dict(zip(read.values, row[list(read.registers)].tolist(), strict=True))
            numbers = [values.get(number, 0) for number in range(read.n_values)]
            replies[read.request] = "".join(f",{number}" for number in numbers)
        if order:
            replies[order.format(*row[list(duties)])] = ""
        for request, values in replies.items():
            yield LineChunk(time_ns, True, request.encode() + b"\n")
            yield LineChunk(time_ns, False, (request[0].lower() + values).encode() + b"\r\n")

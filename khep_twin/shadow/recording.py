"""The bytes of a recorded robot's line, read from a log for a shadow.

A robot without a host, as in a log of `exec`, has no line. The samples of its registers then are replies to
the requests that read them, and its speed setpoints, or other speeds that it drives, are those of a host.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError
from khep_twin.log.decoding import decode_messages, read_line
from khep_twin.log.reader import RobotTrack, read_log, read_raw, require_feature_in
from khep_twin.log.transcript import unescape
from khep_twin.robots.model import Feature


class LineChunk(NamedTuple):
    """Bytes that crossed the line at a time [ns], sent by the host or by the robot."""

    time_ns: int
    to_robot: bool
    data: bytes


_SAMPLES_PER_READ = 5
"""Samples of the registers per reply to each request; all of them command the speeds."""

_SAMPLED_BAUD = 10**9
"""Baud rate at which samples are replies without a delay."""

_MAX_MEASURED = 0.05
"""Part of the samples up to which speeds may be measured, as of a robot that coasts (assumed)."""

_SAMPLED = "proximity", "ultrasonic", "position"
"""Channels that are read."""


class RecordedRobot(NamedTuple):
    """Line of a recorded robot.

    Attributes:
        name: Name of the robot.
        baud: Baud rate at the start; None if it is unknown.
        chunks: Bytes in order.
        has_commands: Whether its speeds are commanded; False if they are measured.
    """

    name: str
    baud: int | None
    chunks: list[LineChunk]
    has_commands: bool = True


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
    if not lines and (track := read_log(path).robots[name]).registers.size:
        has_setpoints = np.ones(len(track.times_ns), np.bool_)
        for register, value in track.model.speed_modes.items():
            has_setpoints &= track.registers[:, register] == value
        is_measured = ~has_setpoints & track.speed[:, :2].any(axis=1)
        chunks = list(_sampled_chunks(track, has_setpoints))
        return RecordedRobot(name, _SAMPLED_BAUD, chunks, bool(is_measured.mean() < _MAX_MEASURED))
    if not lines:
        raise LogError(f"{path}: nothing crossed the line of {name}; expected a host's commands")
    chunks = [LineChunk(line.time_ns, line.name == "host", unescape(line.text) + b"\n") for line in lines]
    baud = label.metadata.get("baud", "")
    start_baud = int(baud) if re.fullmatch("[1-9][0-9]{2,6}", baud) else None
    return RecordedRobot(name, start_baud, sorted(chunks, key=lambda chunk: chunk.time_ns))


def _sampled_chunks(robot: RobotTrack, has_setpoints: NDArray[np.bool_]) -> Iterator[LineChunk]:
    """Yield samples of a twin's registers as the bytes of requests and replies.

    Those `has_setpoints` of have speed setpoints in force (n,).
    """
    model, dialect, last_drive = robot.model, robot.model.dialect, ""
    setpoints = model.episode_interface.setpoints
    for index, (time_ns, row) in enumerate(zip(robot.times_ns.tolist(), robot.registers, strict=True)):
        replies: dict[str, str] = {}
        for read in (dialect.reads[channel] for channel in _SAMPLED if channel in dialect.reads):
            if index % _SAMPLES_PER_READ == 0:
                values = dict(zip(read.values, row[list(read.registers)].tolist(), strict=True))
                texts = [str(values.get(number, 0)) for number in range(read.n_values)]
                replies[read.request] = ",".join([read.request.lower(), *texts])
        speeds = row[list(setpoints if has_setpoints[index] else dialect.reads["speed"].registers)].tolist()
        if (drive := dialect.drive(*speeds)) != last_drive:
            last_drive, replies[drive] = drive, drive[0].lower()
        for request, reply in replies.items():
            yield LineChunk(time_ns, True, request.encode() + b"\n")
            yield LineChunk(time_ns, False, reply.encode() + b"\r\n")

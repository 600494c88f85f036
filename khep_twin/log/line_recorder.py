"""Recorder of a real robot's serial line: its transcript, and the data in the robot's replies.

The log has the format of a twin's log, as far as a line can provide it: transcript, events, and the sensor
values, wheel speeds and line images of replies to N, O, E and T,2,N, at the time of their last byte. It lacks
the robot's true pose, which is known only for a twin.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from khep_twin import __version__
from khep_twin.board.protocol import Command, LineReader
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.firmware import parse
from khep_twin.log.channels import FLOATS, IMAGE, INTEGERS, STRING, ArrayFrame, ImageFrame
from khep_twin.log.host_events import events_message
from khep_twin.log.log_file import FileRecorder, LogFile
from khep_twin.log.sample_layout import channel_names_message
from khep_twin.log.transcript import Transcript
from khep_twin.robots.framing import LINES
from khep_twin.robots.khepera.robot import SAMPLED
from khep_twin.robots.model import robot_name
from khep_twin.units import K213_NUMBER, K213_PIXELS

ROBOT = robot_name(0)
"""Name of the robot in the log."""

_REPLIES = {
    b"n,": ("proximity", 8),
    b"o,": ("ambient", 8),
    b"e,": ("speed", 2),
    f"t,{K213_NUMBER},n,".encode(): ("vision", K213_PIXELS),
}
"""Topic and number of integers of the replies with sampled values, by prefix of the reply."""

_INTEGER = re.compile(rb"-?[0-9]{1,10}")

_REPLY_LIMIT = 1024
"""Longest reply that is parsed [bytes]; a line image has up to 264."""


class LineRecorder(FileRecorder):
    """Recorder of one robot's line in a log.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        settings: Configuration of the line, saved in the log as configuration.json.
        clock: Function that returns the time since the start [ns].
        on_failure: Function that takes the message of a write error, after which the relay continues without
            a log; None raises a `LogError`.

    Raises:
        LogError: The file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        settings: Mapping[str, object],
        clock: Callable[[], int],
        *,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self._file = LogFile(path, clock)
        self._clock = clock
        self._transcript = Transcript(self._file, {ROBOT: LINES})
        self._line_readers = {True: LineReader(), False: LineReader(_REPLY_LIMIT)}
        self._host_events: list[tuple[int, HostEvent]] = []
        self._setpoints: tuple[int, ...] = (0, 0)
        self._frames = {name: ArrayFrame(len(registers), "f8", label) for name, label, registers in SAMPLED}
        self._image_frame = ImageFrame(K213_PIXELS, f"{ROBOT}/k213")
        attachment = json.dumps(dict(settings), indent=2, sort_keys=True) + "\n"
        facts = {"robots": ROBOT, "khep_twin": __version__, **settings}
        self._file.describe({"configuration.json": attachment}, facts)
        self._file.add("/channel_names", STRING, 0, channel_names_message(SAMPLED))
        self._file.flush()
        self._file.on_failure = on_failure
        self._file.on_exit = self.close

    def on_bytes(self, to_robot: bool, data: bytes) -> None:
        """Record bytes that are being transmitted."""
        if not self._file.open:
            return
        time_ns = self._clock()
        self._transcript.on_bytes(time_ns, 0, to_robot, data)
        if to_robot:
            self._host_events.append((time_ns, HostEvent(HostEventKind.SEND, time_ns, None, data)))
        for line in self._line_readers[to_robot].feed(data):
            if not to_robot:
                self._record_values(time_ns, line)
            elif isinstance(command := parse(line), Command) and command.letter == "D":
                self._setpoints = command.arguments

    def on_event(self, text: str) -> None:
        """Record an event; flush the file."""
        if self._file.open:
            self._file.add_event(self._clock(), ROBOT, text)
            self.flush()

    def flush(self) -> None:
        """Write the recorded data to the file system."""
        if self._file.open:
            self._write()
            self._file.flush()

    def close(self) -> None:
        """Complete the file and rename it to its path."""
        if self._file.open:
            self._transcript.finish(self._clock())
            self._write()
            self._file.finish()

    def _write(self) -> None:
        self._transcript.write()
        events, self._host_events = self._host_events, []
        if events:
            self._file.add(f"/{ROBOT}/host_events", INTEGERS, events[0][0], events_message(events))

    def _record_values(self, time_ns: int, line: bytes) -> None:
        """Record the values of a reply of `_REPLIES`; ignore other lines."""
        prefix = next((candidate for candidate in _REPLIES if line.startswith(candidate)), None)
        if prefix is None:
            return
        topic, count = _REPLIES[prefix]
        fields = line.removeprefix(prefix).split(b",")
        if len(fields) != count or not all(map(_INTEGER.fullmatch, fields)):
            return  # noise on the line, which the transcript contains
        values = [int(field) for field in fields]
        if topic == "vision":
            if all(0 <= value <= 255 for value in values):
                image = self._image_frame.messages(np.array([time_ns]), np.array([values]))[0].tobytes()
                self._file.add(f"/{ROBOT}/vision", IMAGE, time_ns, image)
            return
        if topic == "speed":
            values += self._setpoints
        message = self._frames[topic].messages(np.array([values]))[0].tobytes()
        self._file.add(f"/{ROBOT}/{topic}", FLOATS, time_ns, message)

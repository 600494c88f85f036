"""Recorder of a real robot's serial line: its transcript, and the data in the robot's replies.

The log has the format of a twin's log, as far as a line can provide it: transcript, events, line images, and
the channels that `Dialect.reads` of the robot's model reads, at the time of a reply's last byte: proximity,
light and speeds (with the setpoints of the last request of speeds), of some models others. A value that no
reply has, the target of a move, is 0. The log lacks the robot's true pose, which is known only for a twin.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from khep_twin import __version__
from khep_twin.board.protocol import LineReader
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.log.channels import FLOATS, IMAGE, INTEGERS, STRING, ArrayFrame, ImageFrame
from khep_twin.log.host_events import events_message
from khep_twin.log.log_file import FileRecorder, LogFile
from khep_twin.log.sample_layout import channel_names_message
from khep_twin.log.transcript import Transcript
from khep_twin.robots.model import RobotModel, robot_name
from khep_twin.robots.registry import default_model
from khep_twin.robots.robot import Robot
from khep_twin.units import K213_NUMBER, K213_PIXELS

ROBOT = robot_name(0)
"""Name of the robot in the log."""

_IMAGE_PREFIX = f"t,{K213_NUMBER},"
"""Prefix of the reply `n` of a K213, a line image."""

_REPLY_LIMIT = 1024
"""Longest reply that is parsed [bytes]; a line image has up to 264."""


class LineRecorder(FileRecorder):
    """Recorder of one robot's line in a log.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        settings: Configuration of the line, saved in the log as configuration.json.
        clock: Function that returns the time since the start [ns].
        model: Model of the robot, which the log then names; None for a Khepera.
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
        model: RobotModel | None = None,
        *,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self._file = LogFile(path, clock)
        self._clock = clock
        settings = settings if model is None else {**settings, "model": model.name}
        self._model = model or default_model()
        dialect, sampled = self._model.dialect, self._model.load_class("robot", Robot).sampled
        self._speed_command = dialect.framing.command(dialect.drive(0, 0))
        self._transcript = Transcript(self._file, {ROBOT: dialect.framing})
        self._line_readers = {True: LineReader(), False: LineReader(_REPLY_LIMIT)}
        self._host_events: list[tuple[int, HostEvent]] = []
        interface = self._model.interface
        self._setpoints = dict.fromkeys(interface.setpoints if interface else (), 0)
        self._channels = [channel for channel in sampled if channel.name in dialect.reads]
        self._frames = {name: ArrayFrame(len(registers), "f8", label) for name, label, registers in sampled}
        self._image_frame = ImageFrame(K213_PIXELS, f"{ROBOT}/k213")
        attachment = json.dumps(dict(settings), indent=2, sort_keys=True) + "\n"
        facts = {"robots": ROBOT, "khep_twin": __version__, **settings}
        self._file.describe({"configuration.json": attachment}, facts)
        self._file.add("/channel_names", STRING, 0, channel_names_message(sampled))
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
            try:
                self._take_line(time_ns, to_robot, self._model.dialect.framing.decode(line))
            except ValueError:
                pass  # noise on the line, which the transcript contains

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

    def _take_line(self, time_ns: int, to_robot: bool, text: str) -> None:
        """Take the setpoints of a request, or record the values of a reply; ValueError for other numbers."""
        dialect, framing = self._model.dialect, self._model.dialect.framing
        if to_robot:
            if framing.command(text) == self._speed_command:
                numbers = framing.values(text.replace(" ", ""))
                self._setpoints = dict(zip(self._setpoints, numbers, strict=True))
            return
        if text.startswith(f"{_IMAGE_PREFIX}n,"):
            self._record_image(time_ns, framing.values(text.removeprefix(_IMAGE_PREFIX)))
        for name, _, registers in self._channels:
            read = dialect.reads[name]
            if framing.answers(read.request, text) and len(numbers := framing.values(text)) == read.n_values:
                replied = zip(read.registers, [numbers[index] for index in read.values], strict=True)
                values = self._setpoints | dict(replied)
                row = np.array([[values.get(register, 0) for register in registers]])
                message = self._frames[name].messages(row)[0].tobytes()
                self._file.add(f"/{ROBOT}/{name}", FLOATS, time_ns, message)

    def _record_image(self, time_ns: int, greys: Sequence[int]) -> None:
        """Record a line image of the K213."""
        if len(greys) == K213_PIXELS and all(0 <= grey <= 255 for grey in greys):
            image = self._image_frame.messages(np.array([time_ns]), np.array([greys]))[0].tobytes()
            self._file.add(f"/{ROBOT}/vision", IMAGE, time_ns, image)

"""Recording a run: a tap that writes what it sees into an MCAP file.

The file grows as NAME.mcap.part and gets its name when it is whole. Attachments and metadata come first, so
that even a torn file says what it was. All times are simulated, and nothing of the clock on the wall, the
machine or the file's own name goes in: the same run gives the same bytes.
"""

import json
import os
import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from khep_twin import __version__, calibration
from khep_twin import playpen as playpens
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files import unusable
from khep_twin.kernel import AMBIENT, DUTIES, N_REGISTERS, PROXIMITY, SETPOINTS, SPEEDS, Board
from khep_twin.log import channels
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.channels import ArrayFrame, Level, Line, TransformFrame
from khep_twin.log.description import body_name, urdf
from khep_twin.log.part_file import PartFile, set_aside, undisturbed
from khep_twin.robot import Robot
from khep_twin.world import SAMPLE_NS, World

FLUSH_NS = 5 * NS_PER_S
"""Simulated time after which everything is handed to the file system [ns]."""

_BATCH = FLUSH_NS // SAMPLE_NS

_LINE_ENDS = re.compile(rb"[\r\n]")
_LINE_LIMIT = 1024


class Recorder:
    """Writes one run into one file; a `Tap` of its world.

    Args:
        path: of the finished log, by custom NAME.mcap.
        world: what is recorded.
        settings: how the run was set up, kept in the log as configuration.json.

    Attributes:
        path: of the finished log.
        part: of the file while it grows.
        kept: where an unfinished log of an earlier run was moved to, None if there was none.

    Raises:
        LogError: the file cannot be made.
    """

    def __init__(self, path: Path, world: World, settings: Mapping[str, object]) -> None:
        if reason := unusable(path) or _no_log(path):
            raise LogError(f"{path}: cannot write a log here: {reason}")
        self.path = path
        # A link is followed, so that it stays a link.
        self._target = path.resolve() if path.is_symlink() else path
        self.part = self._target.with_name(self._target.name + ".part")
        self._world = world
        self._wire: list[tuple[int, int, bool, bytes]] = []
        self._rests: dict[tuple[int, bool], bytes] = {}
        self._open = True
        try:
            self.kept = set_aside(self.part)
            self._file = PartFile(self.part)
        except OSError as error:
            raise LogError(f"{path}: cannot write a log here: {error.strerror}") from error
        # What moves is shown at every sample, what stands is part of the description.
        model = world.model
        self._moving: list[int] = np.flatnonzero(model.body_weldid != 0).tolist()
        self._transforms = TransformFrame([body_name(model, body) for body in self._moving])
        self._streams = [_RobotStream(robot) for robot in world.robots]
        self._rows = 0
        self._times_ns = np.zeros(_BATCH, np.int64)
        self._positions = np.zeros((_BATCH, len(self._moving), 3))
        self._quaternions = np.zeros((_BATCH, len(self._moving), 4))
        with self._guarded():
            self._begin(settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def sample(self, world: World) -> None:
        """Notes where everything is and what the boards hold; it is written in batches."""
        if not self._open:
            return
        row = self._rows
        self._times_ns[row] = world.time_ns
        self._positions[row] = world.data.xpos[self._moving]
        self._quaternions[row] = world.data.xquat[self._moving]
        for stream in self._streams:
            stream.note(row)
        self._rows = row + 1
        if self._rows == _BATCH:
            self.flush()

    def wire(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Notes bytes of the transcript."""
        if self._open:
            self._wire.append((time_ns, robot, to_robot, data))

    def event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Writes a note, and everything so far to the file."""
        if not self._open:
            return
        name = "world" if robot is None else self._world.robots[robot].name
        with self._guarded():
            message = channels.line_message(Line(time_ns, Level.INFO, name, text))
            self._add("/events", "rcl_interfaces/msg/Log", time_ns, message)
        self.flush()

    def flush(self) -> None:
        """Hands everything so far to the file system."""
        if self._open:
            with self._guarded():
                self._write_samples()
                self._write_lines()
                self._writer.flush()

    def close(self) -> None:
        """Completes the file and gives it its name.

        Raises:
            LogError: that is not possible; what was written before stays as NAME.mcap.part.
        """
        if not self._open:
            return
        with self._guarded():
            self._write_samples()
            self._write_lines()
            self._write_rests()
            self._writer.finish()
            os.replace(self.part, self._target)
            self._open = False
            self._file.close()

    def _write_samples(self) -> None:
        rows, self._rows = self._rows, 0
        times_ns = self._times_ns[:rows]
        poses = self._transforms.messages(times_ns, self._positions[:rows], self._quaternions[:rows])
        self._writer.add_rows(self._channel("/tf", "tf2_msgs/msg/TFMessage"), times_ns, poses)
        for stream in self._streams:
            for topic, schema, messages in stream.messages(rows):
                self._writer.add_rows(self._channel(topic, schema), times_ns, messages)

    def _write_lines(self) -> None:
        """Writes the lines that the noted bytes complete."""
        lines: dict[int, list[tuple[int, bytes]]] = {}
        for time_ns, robot, to_robot, data in self._wire:
            *whole, rest = _LINE_ENDS.split(self._rests.get((robot, to_robot), b"") + data)
            if len(rest) > _LINE_LIMIT:  # noise, or a host that knows no line ends
                whole, rest = [*whole, rest], b""
            self._rests[robot, to_robot] = rest
            lines.setdefault(robot, []).extend(
                (time_ns, _line_message(time_ns, to_robot, line)) for line in whole if line
            )
        self._wire.clear()
        for robot, messages in lines.items():
            self._write_transcript(robot, messages)

    def _write_rests(self) -> None:
        """Writes lines that were begun and never ended."""
        time_ns = self._world.time_ns
        for (robot, to_robot), rest in self._rests.items():
            if rest:
                self._write_transcript(robot, [(time_ns, _line_message(time_ns, to_robot, rest))])

    def _write_transcript(self, robot: int, messages: list[tuple[int, bytes]]) -> None:
        topic = f"/{self._world.robots[robot].name}/serial"
        times_ns, lines = [time_ns for time_ns, _ in messages], [line for _, line in messages]
        self._writer.add_lines(self._channel(topic, "rcl_interfaces/msg/Log"), times_ns, lines)

    def _begin(self, settings: Mapping[str, object]) -> None:
        world = self._world
        self._writer = BatchWriter(self._file, "ros2", f"khep_twin {__version__}")
        robots = world.playpen.robots
        attachments = {
            "playpen.toml": playpens.dump(world.playpen),
            "scene.xml": world.spec.to_xml(),
            "configuration.json": json.dumps(dict(settings), indent=2, sort_keys=True) + "\n",
            **{
                f"calibration/{robot.name}.toml": calibration.read(entry.calibration)[1]
                for robot, entry in zip(world.robots, robots, strict=True)
            },
        }
        for name, text in attachments.items():
            self._writer.attach(name, text)
        facts = {
            "playpen": world.playpen.name,
            "robots": ",".join(robot.name for robot in world.robots),
            "khep_twin": __version__,
            "mujoco": mujoco.__version__,
            "numpy": version("numpy"),
        }
        self._writer.describe("run", {**facts, **{key: str(value) for key, value in settings.items()}})
        message = channels.text_message(urdf(world.model))
        self._add("/robot_description", "std_msgs/msg/String", 0, message)
        self._writer.flush()

    def _add(self, topic: str, schema: str, time_ns: int, message: bytes) -> None:
        self._writer.add(self._channel(topic, schema), time_ns, message)

    def _channel(self, topic: str, schema: str) -> int:
        return self._writer.channel(topic, schema, channels.SCHEMAS[schema])

    @contextmanager
    def _guarded(self) -> Generator[None, None, None]:
        """Turns the first trouble with the file into an error, after which the file is left alone."""
        try:
            with undisturbed():
                yield
        except OSError as error:
            self._open = False
            self._wire.clear()
            self._file.close()
            seconds = self._world.time_ns / NS_PER_S
            raise LogError(
                f"{self.path}: the log cannot be written any more at {seconds:.2f} s: {error.strerror}; "
                f"what came before is kept in {self.part}"
            ) from error


def _no_log(path: Path) -> str:
    """Why a file that is there must not be replaced by a log; empty if it may."""
    try:
        if not path.exists() or path.stat().st_size == 0:
            return ""
        with path.open("rb") as file:
            return (
                ""
                if file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
                else "this file is no log; right is another name"
            )
    except OSError as error:
        return error.strerror or str(error)


def _line_message(time_ns: int, to_robot: bool, line: bytes) -> bytes:
    # Readable and whole: control characters and noise on the line become \n, \x00, \xff.
    text = line.decode("latin-1").encode("unicode_escape").decode("ascii")
    return channels.line_message(Line(time_ns, Level.INFO, "host" if to_robot else "robot", text))


class _RobotStream:
    """One robot's sampled channels: all of them are parts of the registers of its board and its turrets."""

    def __init__(self, robot: Robot) -> None:
        turrets = robot.firmware.turrets
        self._sources = [robot.registers, *(turret.registers for turret in turrets.values())]
        starts = np.cumsum([0, *(len(source) for source in self._sources)])
        self._noted = np.zeros((_BATCH, starts[-1]), np.int64)
        floats, integers = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Int64MultiArray"
        speeds = "left, right, setpoint left, setpoint right [pulses/10 ms]"
        self._channels = [
            (f"/{robot.name}/{topic}", schema, ArrayFrame(len(columns), kind, label), columns)
            for topic, schema, kind, label, columns in (
                ("proximity", floats, "f8", "counts", PROXIMITY),
                ("ambient", floats, "f8", "counts", AMBIENT),
                ("speed", floats, "f8", speeds, [*SPEEDS, *SETPOINTS]),
                ("duty", floats, "f8", "left, right [-255 to 255]", DUTIES),
                ("leds", floats, "f8", "lateral, frontal", [int(Board.LED_0), int(Board.LED_1)]),
                ("registers", integers, "i8", "registers", list(range(N_REGISTERS))),
                *(
                    (kind.name, integers, "i8", "registers", list(range(start, end)))
                    for kind, start, end in zip(turrets, starts[1:], starts[2:], strict=False)
                ),
            )
        ]

    def note(self, row: int) -> None:
        """Keeps the board's state as a row of the batch."""
        self._noted[row] = np.concatenate(self._sources) if len(self._sources) > 1 else self._sources[0]

    def messages(self, rows: int) -> list[tuple[str, str, NDArray[np.void]]]:
        """Topic, message type and messages of each channel, for the first rows of the batch."""
        return [
            (topic, schema, frame.messages(self._noted[:rows, columns]))
            for topic, schema, frame, columns in self._channels
        ]

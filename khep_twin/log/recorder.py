"""Recording a run: a tap that writes what it sees into an MCAP file.

The file grows as NAME.mcap.part and gets its name when it is whole. Attachments and metadata come first, so
that even a torn file says what it was. All times are simulated, and nothing of the clock on the wall, the
machine or the file's own name goes in: the same run gives the same bytes.
"""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import IO, Self, cast

import mujoco
import numpy as np
from mcap.writer import Writer

from khep_twin import __version__, calibration
from khep_twin import playpen as playpens
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.kernel import N_REGISTERS
from khep_twin.log import channels
from khep_twin.log.channels import ArrayFrame, Level, Line, TransformFrame
from khep_twin.log.description import body_name, urdf
from khep_twin.world import Robot, World

FLUSH_NS = 5 * NS_PER_S
"""Simulated time after which everything is handed to the file system [ns]."""

_CHUNK_SIZE = 2**20


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
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self._world = world
        self._channels: dict[str, int] = {}
        self._lines: dict[tuple[int, bool], bytearray] = {}
        self._flushed_ns = 0
        self._open = True
        if path.is_dir():
            raise LogError(f"{path}: this is a directory; right is the name of a file, such as run.mcap")
        try:
            self.kept = _set_aside(self.part)
            self._file = _PartFile(self.part)
        except OSError as error:
            raise LogError(f"{path}: cannot write a log here: {error.strerror}") from error
        self._writer = Writer(cast(IO[bytes], self._file), chunk_size=_CHUNK_SIZE)
        # What moves is shown at every sample, what stands only in the description.
        model = world.model
        self._moving: list[int] = np.flatnonzero(model.body_weldid != 0).tolist()
        self._transforms = TransformFrame([body_name(model, body) for body in self._moving])
        self._streams = [_RobotStream(robot) for robot in world.robots]
        with self._guarded():
            self._begin(settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def sample(self, world: World) -> None:
        """Writes where everything is and what the robots sense."""
        if not self._open:
            return
        time_ns = world.time_ns
        with self._guarded():
            data = world.data
            poses = self._transforms.message(
                time_ns, data.xpos[self._moving].tolist(), data.xquat[self._moving].tolist()
            )
            self._add("/tf", "tf2_msgs/msg/TFMessage", time_ns, poses)
            for stream in self._streams:
                for topic, schema, message in stream.messages():
                    self._add(topic, schema, time_ns, message)
            if time_ns - self._flushed_ns >= FLUSH_NS:
                self._flushed_ns = time_ns
                self._writer.flush()

    def wire(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Writes the lines that these bytes complete."""
        if not self._open:
            return
        line = self._lines.setdefault((robot, to_robot), bytearray())
        with self._guarded():
            for byte in data:
                if byte not in b"\r\n":
                    line.append(byte)
                elif line:
                    self._add_line(time_ns, robot, to_robot)

    def event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Writes a note, and everything so far to the file."""
        if not self._open:
            return
        name = "world" if robot is None else self._world.robots[robot].name
        with self._guarded():
            message = channels.line_message(Line(time_ns, Level.INFO, name, text))
            self._add("/events", "rcl_interfaces/msg/Log", time_ns, message)
            self._writer.flush()

    def flush(self) -> None:
        """Hands everything so far to the file system."""
        if self._open:
            with self._guarded():
                self._writer.flush()

    def close(self) -> None:
        """Completes the file and gives it its name.

        Raises:
            LogError: that is not possible; what was written before stays as NAME.mcap.part.
        """
        if not self._open:
            return
        with self._guarded():
            for (robot, to_robot), line in self._lines.items():
                if line:
                    self._add_line(self._world.time_ns, robot, to_robot)
            self._writer.finish()
            self._file.close()
            os.replace(self.part, self.path)
        self._open = False

    def _begin(self, settings: Mapping[str, object]) -> None:
        world = self._world
        self._writer.start(profile="ros2", library=f"khep_twin {__version__}")
        robots = world.playpen.robots
        attachments = {
            "playpen.toml": playpens.dump(world.playpen),
            "scene.xml": world.spec.to_xml(),
            "configuration.json": json.dumps(dict(settings), indent=2, sort_keys=True) + "\n",
            **{
                f"calibration/{Path(name).stem}.toml": calibration.read(name)[1]
                for name in dict.fromkeys(robot.calibration for robot in robots)
            },
        }
        for name, text in attachments.items():
            self._writer.add_attachment(0, 0, name, "text/plain", text.encode("utf-8"))
        facts = {
            "playpen": world.playpen.name,
            "robots": ",".join(robot.name for robot in world.robots),
            "khep_twin": __version__,
            "mujoco": mujoco.__version__,
            "numpy": version("numpy"),
        }
        self._writer.add_metadata("run", {**facts, **{key: str(value) for key, value in settings.items()}})
        message = channels.text_message(urdf(world.model))
        self._add("/robot_description", "std_msgs/msg/String", 0, message)
        self._writer.flush()

    def _add_line(self, time_ns: int, robot: int, to_robot: bool) -> None:
        line = self._lines[robot, to_robot]
        text = line.decode("ascii", "backslashreplace")
        line.clear()
        message = channels.line_message(Line(time_ns, Level.INFO, "host" if to_robot else "robot", text))
        topic = f"/{self._world.robots[robot].name}/serial"
        self._add(topic, "rcl_interfaces/msg/Log", time_ns, message)

    def _add(self, topic: str, schema: str, time_ns: int, message: bytes) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            known = self._writer.register_schema(schema, "ros2msg", channels.SCHEMAS[schema].encode("ascii"))
            channel = self._channels[topic] = self._writer.register_channel(topic, "cdr", known)
        self._writer.add_message(channel, time_ns, message, time_ns)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turns the first trouble with the file into an error, after which the file is left alone."""
        try:
            yield
        except OSError as error:
            self._open = False
            self._file.close()
            seconds = self._world.time_ns / NS_PER_S
            raise LogError(
                f"{self.path}: the log cannot be written any more at {seconds:.2f} s: {error.strerror}; "
                f"what came before is kept in {self.part}"
            ) from error


class _PartFile:
    """A file without a buffer of its own, in which each write is there as a whole or not at all."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        self._size = 0

    def write(self, data: bytes) -> int:
        """Appends `data`; what a full disk tore off is taken back before the error goes on."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """How much has been written [bytes]."""
        return self._size

    def flush(self) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Ends the file."""
        os.close(self._descriptor)


class _RobotStream:
    """One robot's sampled channels."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._eight = ArrayFrame(8, "d", "counts")
        self._speed = ArrayFrame(4, "d", "left, right, setpoint left, setpoint right [pulses/10 ms]")
        self._duty = ArrayFrame(2, "d", "left, right [-255 to 255]")
        self._registers = ArrayFrame(N_REGISTERS, "q", "registers")

    def messages(self) -> list[tuple[str, str, bytes]]:
        """Topic, message type and message of each channel, as of now."""
        robot, name = self._robot, self._robot.name
        floats, integers = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Int64MultiArray"
        speeds = [*robot.wheel_speeds.tolist(), *robot.wheel_setpoints.tolist()]
        return [
            (f"/{name}/proximity", floats, self._eight.message(robot.proximity.tolist())),
            (f"/{name}/ambient", floats, self._eight.message(robot.ambient.tolist())),
            (f"/{name}/speed", floats, self._speed.message(speeds)),
            (f"/{name}/duty", floats, self._duty.message(robot.duties.tolist())),
            (f"/{name}/registers", integers, self._registers.message(robot.registers.tolist())),
        ]


def _set_aside(part: Path) -> Path | None:
    """Moves an unfinished log out of the way, so that nothing that could be rescued is lost."""
    if not part.exists():
        return None
    number = 1
    while (kept := part.with_name(f"{part.name}.{number}")).exists():
        number += 1
    os.rename(part, kept)
    return kept

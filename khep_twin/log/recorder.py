"""Recording of a run: an observer that writes an MCAP file, or feeds a live view.

Attachments and metadata come first, so that even a torn file describes its run. All times are simulated, and
the file holds no wall clock time, machine name or file name: the same run gives the same bytes.
"""

import json
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import __version__
from khep_twin import playpen as playpens
from khep_twin.board.kernel import AMBIENT, DUTIES, PROXIMITY, SETPOINTS, SPEEDS, Board
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.log import channels, foxglove_scene
from khep_twin.log.channels import BYTES, FLOATS, IMAGE, INTEGERS, ArrayFrame, ImageFrame, TransformFrame
from khep_twin.log.description import body_name, urdf
from khep_twin.log.entries import Entry
from khep_twin.log.host_events import events_message
from khep_twin.log.log_file import LogFile
from khep_twin.log.output import Output
from khep_twin.log.snapshots import SNAPSHOT_NS, TOPIC, RecorderState, snapshot_message
from khep_twin.log.state_hashes import Answered, boards, hashes, states_message
from khep_twin.log.transcript import Transcript
from khep_twin.robot import Robot
from khep_twin.sensing import calibration
from khep_twin.sensing.lamps import Lamps
from khep_twin.units import SENSOR_LABELS
from khep_twin.world import SAMPLE_NS, World

FLUSH_NS = 5 * NS_PER_S
"""Simulated time between two flushes to the file system [ns]."""

_BATCH = FLUSH_NS // SAMPLE_NS

_FINENESS = 2.0**30
"""Steps of positions in a log per metre, and of rotations per 1: about a nanometre each.

Finer digits are noise of contacts, which does not compress: a seventh of the file. The hashes of the state
include them."""

_NONE: Mapping[str, str] = {}

_SENSORS = ", ".join(SENSOR_LABELS)

_WHEELS = "left, right, setpoint left, setpoint right"

SAMPLED: list[tuple[str, str, str, str, list[int]]] = [
    ("proximity", FLOATS, "f8", f"{_SENSORS} [counts]", list(PROXIMITY)),
    ("ambient", FLOATS, "f8", f"{_SENSORS} [counts]", list(AMBIENT)),
    ("speed", FLOATS, "f8", f"{_WHEELS} [pulses/10 ms]", [*SPEEDS, *SETPOINTS]),
    ("duty", FLOATS, "f8", "left, right [-255 to 255]", list(DUTIES)),
    ("leds", FLOATS, "f8", "lateral, frontal [1 is lit]", [int(Board.LED_0), int(Board.LED_1)]),
]
"""Channels of every robot: topic, message type, format of numbers, label, and registers."""


class Beginning(NamedTuple):
    """Beginning of a run that another log has.

    Attributes:
        entries: Messages of the beginning, in pieces as that log has them; none of a run that begins anew.
        state: State of its recorder after them; None likewise.
    """

    entries: Iterable[Sequence[Entry]] = ()
    state: RecorderState | None = None


class WorldRecorder:
    """Recorder of one run in an output; an `Observer` of its world.

    Args:
        output: Destination of the messages.
        world: World to record.
        settings: Configuration of the run, kept in a log as configuration.json.
        facts: More metadata of the run.
        attachments: More texts to keep, by name.
        beginning: Beginning of the run, after which the world is; its own label is in facts and attachments.
    """

    def __init__(
        self,
        output: Output,
        world: World,
        settings: Mapping[str, object],
        *,
        facts: Mapping[str, str] = _NONE,
        attachments: Mapping[str, str] = _NONE,
        beginning: Beginning | None = None,
    ) -> None:
        self._log = output
        self._transcript = Transcript(self._log, [robot.name for robot in world.robots])
        self._answers = Answered(len(world.robots))
        self._host_events: list[list[tuple[int, HostEvent]]] = [[] for _ in world.robots]
        self._samples: list[_Sample] = []
        # Without a line the state of the controllers would be missing.
        self._takes_snapshots = "line" not in facts
        self._observe(world)
        self._known_lamps: Lamps = world.lamps
        self._lamps_topic, self._lamps_sets = "/lamps", 1
        self._lamps = None if world.lamps.steady else _lamps_frame(world)
        if beginning is None:
            attachments, facts = self._description(settings, facts, attachments)
        self._log.describe(attachments, {**facts, **settings} if beginning is None else facts)
        if beginning is None or beginning.state is None:
            self._describe_scene(0)
            self._log.add("/channel_names", "std_msgs/msg/String", 0, channel_names())
            self._log.flush()
        else:
            for entries in beginning.entries:
                self._log.add_entries(entries)
                self._log.flush()
            self._resume(beginning.state)
        self._log.complete = self._complete

    def _observe(self, world: World) -> None:
        """Find what is recorded of a world."""
        self._world = world
        # Moving bodies are shown at every sample, fixed ones are part of the description.
        model, data = world.model, world.data
        moving: NDArray[np.intp] = np.flatnonzero(model.body_weldid != 0)
        self._transforms = TransformFrame([body_name(model, body) for body in moving])
        # A sample is the memory of all of these, eight bytes a number; what follows from it is computed batch
        # by batch. Positions and rotations of the bodies, which come last, follow from the state.
        sources: list[NDArray[np.float64] | NDArray[np.int64]] = [data.qpos, data.qvel]
        self._channels: list[_Channel] = []
        for robot in world.robots:
            self._channels += _channels_of(robot, sum(source.size for source in sources))
            sources += boards(robot)
        self._state_size = sum(source.size for source in sources)
        sources += data.xpos, data.xquat
        self._sample_size = sum(source.size for source in sources)
        self._memories = [source.data for source in sources]
        places, turns = self._state_size + 3 * moving, self._state_size + data.xpos.size + 4 * moving
        self._poses = np.hstack([np.add.outer(places, [0, 1, 2]), np.add.outer(turns, [1, 2, 3, 0])])

    def move_to(self, world: World) -> None:
        """Go on recording in another world of the same robots, which has taken over this one's state."""
        self.flush()
        before, self._known_lamps = self._world, world.lamps
        self._observe(world)
        if self._lamps is None and not world.lamps.steady:
            self._lamps = _lamps_frame(world)
        if world.scene != before.scene:
            self._describe_scene(world.time_ns)
        self.flush()

    def sample(self, world: World) -> None:
        """Record the state of all bodies and boards; it is written in batches."""
        if not self._log.open:
            return
        if world.lamps is not self._known_lamps:
            # Rows of a channel have one length, so lamps set up later have their own channel.
            self.flush()
            self._lamps_sets += 1
            self._lamps_topic = f"/lamps_{self._lamps_sets}"
            self._known_lamps, self._lamps = world.lamps, _lamps_frame(world)
        elif self._lamps is None and not world.lamps.steady:  # one was switched by hand
            self.flush()
            self._lamps = _lamps_frame(world)
        # In one step: the thread that completes the log of a controller that never returns comes at any time.
        state, answered = b"".join(self._memories), tuple(self._answers.numbers)
        self._samples.append(_Sample(world.time_ns, state, answered, tuple(world.lamps.powers)))
        if self._takes_snapshots and world.time_ns and world.time_ns % SNAPSHOT_NS == 0:
            self._flush(snapshot=True)
        elif len(self._samples) == _BATCH:
            self.flush()

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Record bytes for the transcript."""
        if self._log.open:
            self._transcript.on_bytes(time_ns, robot, to_robot, data)
            if not to_robot:
                self._answers.on_bytes(time_ns, robot, data)

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Record a host event."""
        if self._log.open:
            self._host_events[robot].append((time_ns, event))
            # The others log an event, which ends the piece. Of one robot all events are in order anyway.
            if event.kind is HostEventKind.SCAN and len(self._host_events) > 1:
                self.flush()

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Record an event; flush the file."""
        if self._log.open:
            name = "world" if robot is None else self._world.robots[robot].name
            self._log.add_event(time_ns, name, text)
            self.flush()

    def flush(self) -> None:
        """Hand everything so far to the file system."""
        self._flush(snapshot=False)

    def close(self) -> None:
        """Complete the file, with a last snapshot, and rename it to its path.

        Raises:
            LogError: That is not possible; the data written before stays as NAME.mcap.part.
        """
        # An error may have ended the run amid a step.
        self._complete(snapshot=self._takes_snapshots and self._world.is_between_steps)

    def _flush(self, snapshot: bool) -> None:
        if self._log.open:
            with self._log.guarded():
                self._write(snapshot)
                self._log.flush()

    def _complete(self, snapshot: bool = False) -> None:
        """Complete the file; without a snapshot at any moment, also amid a step in another thread."""
        if self._log.open:
            with self._log.guarded():
                self._write(snapshot)
                self._transcript.write_rests(self._world.time_ns)
                self._log.finish()

    def _resume(self, state: RecorderState) -> None:
        """Go on from another recorder's state.

        Raises:
            ValueError: It is of other robots.
        """
        count = len(self._answers.numbers)
        if len(state.answered) != count or any(robot >= count for robot, _, _ in state.rests):
            raise ValueError(f"a recorder's state of {len(state.answered)} robots; expected {count}")
        self._answers.numbers[:] = state.answered
        self._transcript.resume(state.rests)
        self._lamps_sets = state.lamps_sets
        self._lamps_topic = "/lamps" if self._lamps_sets == 1 else f"/lamps_{self._lamps_sets}"
        self._lamps = _lamps_frame(self._world) if state.lamps_change else None

    def _write(self, snapshot: bool = False) -> None:
        """Write the samples and lines recorded so far, and a snapshot of the present if it is wanted."""
        taken, self._samples = self._samples, []
        times_ns = np.array([sample.time_ns for sample in taken], np.int64)
        states = b"".join(sample.state for sample in taken)
        samples = np.frombuffer(states, np.int64).reshape(-1, self._sample_size)
        poses = np.rint(samples.view(np.float64)[:, self._poses] * _FINENESS) / _FINENESS
        transforms = self._transforms.messages(times_ns, poses)
        self._log.add_rows("/tf", "tf2_msgs/msg/TFMessage", times_ns, transforms)
        if self._lamps is not None:
            shape = len(taken), len(self._known_lamps.names)
            powers = np.array([sample.powers for sample in taken]).reshape(shape)
            self._log.add_rows(self._lamps_topic, FLOATS, times_ns, self._lamps.messages(powers))
        for channel in self._channels:
            found, frame = samples[:, channel.columns], channel.frame
            is_image = isinstance(frame, ImageFrame)
            messages = frame.messages(times_ns, found) if is_image else frame.messages(found)
            self._log.add_rows(channel.topic, channel.schema, times_ns, messages)
        self._transcript.write()
        for index, robot in enumerate(self._world.robots):
            events, self._host_events[index] = self._host_events[index], []
            if events:
                self._log.add(f"/{robot.name}/host_events", INTEGERS, events[0][0], events_message(events))
        # Last, so that the part of it in a torn file can be repeated with what came before.
        if taken:
            answered = np.array([sample.answered for sample in taken], np.int64)
            numbers = hashes(answered, samples[:, : self._state_size])
            self._log.add("/state", INTEGERS, taken[0].time_ns, states_message(numbers))
        if snapshot:
            lamps = self._lamps_sets, self._lamps is not None
            state = RecorderState(tuple(self._answers.numbers), self._transcript.rests, *lamps)
            message = snapshot_message(self._world, state)
            self._log.add(TOPIC, BYTES, self._world.time_ns, message)

    def _description(
        self, settings: Mapping[str, object], more_facts: Mapping[str, str], more: Mapping[str, str]
    ) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Return the attachments and facts of a run."""
        world = self._world
        robots = world.playpen.robots
        attachments = {
            "playpen.toml": playpens.dump(world.playpen),
            "scene.xml": world.spec.to_xml(),
            "configuration.json": json.dumps(dict(settings), indent=2, sort_keys=True) + "\n",
            **{
                f"calibration/{robot.name}.toml": calibration.read(entry.calibration)[1]
                for robot, entry in zip(world.robots, robots, strict=True)
            },
            **more,
        }
        facts = {
            "playpen": world.playpen.name,
            "robots": ",".join(robot.name for robot in world.robots),
            **versions(),
            **more_facts,
        }
        return attachments, facts

    def _describe_scene(self, time_ns: int) -> None:
        """Write the shapes of the scene."""
        model = self._world.model
        message = channels.text_message(urdf(model))
        self._log.add("/robot_description", "std_msgs/msg/String", time_ns, message)
        scene = foxglove_scene.scene_update(model)
        self._log.add("/scene", foxglove_scene.SCHEMA, time_ns, scene, foxglove_scene.descriptors())


class Recorder(WorldRecorder):
    """Recorder of one run in one file.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        world: World to record.
        settings: Configuration of the run, kept in the log as configuration.json.
        facts: More metadata of the run.
        attachments: More texts to keep, by name.
        beginning: Beginning of the run, after which the world is; its own label is in facts and attachments.
        on_failure: Function that takes the message if the log can no longer be written, after which the run
            continues without it; None ends the run by a `LogError`.

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.
        kept: New path of an unfinished log of an earlier run, None if there was none.

    Raises:
        LogError: The file cannot be made.
    """

    def __init__(
        self,
        path: Path,
        world: World,
        settings: Mapping[str, object],
        *,
        facts: Mapping[str, str] = _NONE,
        attachments: Mapping[str, str] = _NONE,
        beginning: Beginning | None = None,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self._world = world
        self._file = LogFile(path, lambda: self._world.time_ns)
        self.path, self.part, self.kept = path, self._file.part, self._file.kept
        super().__init__(
            self._file, world, settings, facts=facts, attachments=attachments, beginning=beginning
        )
        # An error at the very start of a log is always raised.
        self._file.on_failure = on_failure

    @property
    def failure(self) -> LogError | None:
        """Error after which the log is no longer written, None if there was none."""
        return self._file.failure

    def discard(self) -> None:
        """Remove the file, of a run that has not begun."""
        self._file.discard()


def _lamps_frame(world: World) -> ArrayFrame:
    return ArrayFrame(len(world.lamps.names), "f8", "power [W]")


def channel_names() -> bytes:
    """Return a message that names the numbers of each channel, for viewers that only index them."""
    topics: dict[str, list[str]] = {}
    for topic, _, _, label, _ in SAMPLED:
        topics.setdefault(label, []).append(topic)
    lines = ["Numbers of each robot's channels:"]
    for label, found in topics.items():
        names, _, unit = label.removesuffix("]").partition(" [")
        lines += ["", f"{', '.join(found)} [{unit}]"]
        lines += [f"  [{index}]  {name}" for index, name in enumerate(names.split(", "))]
    return channels.text_message("\n".join(lines))


def versions() -> dict[str, str]:
    """Return all that the last bits of a run may depend on: packages and kind of machine."""
    return {
        "khep_twin": __version__,
        "mujoco": mujoco.__version__,
        "numpy": version("numpy"),
        "machine": f"{platform.system()} {platform.machine()}",
    }


class _Sample(NamedTuple):
    """Sample of the world.

    Attributes:
        time_ns: Time [ns].
        state: Memory of all bodies and boards.
        answered: Hash of the answers of each robot.
        powers: Power of each lamp [W].
    """

    time_ns: int
    state: bytes
    answered: tuple[int, ...]
    powers: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Channel:
    """Channel of registers, of the board or of a turret.

    Attributes:
        topic: Topic.
        schema: Message type.
        frame: Its messages.
        columns: Places of the registers in a sample.
    """

    topic: str
    schema: str
    frame: ArrayFrame | ImageFrame
    columns: list[int] | slice


def _channels_of(robot: Robot, start: int) -> Iterator[_Channel]:
    """Yield the channels of a robot, whose registers begin at `start` in a sample."""
    for name, schema, kind, label, registers in SAMPLED:
        frame = ArrayFrame(len(registers), kind, label)
        yield _Channel(f"/{robot.name}/{name}", schema, frame, [start + register for register in registers])
    kinds = [None, *robot.firmware.turrets]
    for kind, board in zip(kinds, boards(robot), strict=True):
        end, name = start + len(board), "registers" if kind is None else kind.name
        label = ", ".join(kind.names) if kind and kind.names else "registers"
        frame = ArrayFrame(len(board), "i8", label)
        yield _Channel(f"/{robot.name}/{name}", INTEGERS, frame, slice(start, end))
        if kind and kind.image:
            pixels = range(start, end)[kind.image]
            frame = ImageFrame(len(pixels), f"{robot.name}/{kind.name}")
            yield _Channel(f"/{robot.name}/vision", IMAGE, frame, slice(pixels.start, pixels.stop))
        start = end

"""Recording of a run: an observer that writes an MCAP file, or feeds a live view while the run goes on.

Attachments and metadata come first, so that even a torn file describes its run. All times are simulated, and
the file holds no wall clock time, machine name or file name: the same run gives the same bytes.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S, Pacer
from khep_twin.files.paths import StrPath
from khep_twin.log.channels import BYTES, FLOATS, INTEGERS
from khep_twin.log.host_events import events_message
from khep_twin.log.log_file import FileRecorder, LogFile
from khep_twin.log.output import Output, Writer
from khep_twin.log.run_description import RunDescription
from khep_twin.log.sample_layout import LampsChannel, SampleLayout, channel_names
from khep_twin.log.snapshots import (
    SNAPSHOT_NS,
    TOPIC,
    Answered,
    RecorderState,
    hashes,
    snapshot_message,
    states_message,
)
from khep_twin.log.transcript import Transcript
from khep_twin.world import SAMPLE_NS, World

FLUSH_NS = 5 * NS_PER_S
"""Simulated time between two flushes to the file system [ns]."""

_BATCH = FLUSH_NS // SAMPLE_NS


class WorldRecorder:
    """Recorder of one run in an output; an `Observer` of its world."""

    def __init__(self, output: Output, world: World, run: RunDescription) -> None:
        self._log, self._world = output, world
        self._transcript = Transcript(self._log, [robot.name for robot in world.robots])
        self._answers = Answered(len(world.robots))
        self._host_events: list[list[tuple[int, HostEvent]]] = [[] for _ in world.robots]
        self._samples: list[_Sample] = []
        # Without a line the state of the controllers would be missing.
        self._takes_snapshots = "line" not in run.facts
        self._layout = SampleLayout(world)
        self._lamps = LampsChannel(world.lamps)
        self._log.describe(run.all_attachments(world), run.all_facts(world))
        if run.beginning is None or run.beginning.state is None:
            self._log.add_scene(0, world.model)
            channels = (each for robot in world.robots for each in robot.sampled)
            self._log.add("/channel_names", "std_msgs/msg/String", 0, channel_names(channels))
            self._log.flush()
        else:
            for entries in run.beginning.entries:
                self._log.add_entries(entries)
                self._log.flush()
            self._resume(run.beginning.state)
        self._log.complete = self._complete

    def move_to(self, world: World) -> None:
        """Go on recording in another world of the same robots, which has taken over this one's state."""
        self.flush()
        before, self._world = self._world, world
        self._layout = SampleLayout(world)
        self._lamps.move_to(world.lamps)
        if world.scene != before.scene:
            self._log.add_scene(world.time_ns, world.model)
        self.flush()

    def sample(self, world: World) -> None:
        """Record the state of all bodies and boards; it is written in batches."""
        if not self._log.open:
            return
        if not self._lamps.is_of(world.lamps):
            self.flush()
            self._lamps.follow(world.lamps)
        # In one step: the thread that completes the log of a controller that never returns comes at any time.
        state, answered = self._layout.take(), tuple(self._answers.numbers)
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
        """Go on from another recorder's state."""
        count = len(self._answers.numbers)
        if len(state.answered) != count or any(robot >= count for robot, _, _ in state.rests):
            raise ValueError(f"a recorder's state of {len(state.answered)} robots; expected {count}")
        self._answers.numbers[:] = state.answered
        self._transcript.resume(state.rests)
        self._lamps.resume(state)

    def _write(self, snapshot: bool = False) -> None:
        """Write the samples and lines recorded so far, and a snapshot of the present if it is wanted."""
        taken, self._samples = self._samples, []
        times_ns = np.array([sample.time_ns for sample in taken], np.int64)
        table = self._layout.table([sample.state for sample in taken])
        transforms = self._layout.transforms(times_ns, table)
        self._log.add_rows("/tf", "tf2_msgs/msg/TFMessage", times_ns, transforms)
        powers = self._lamps.messages([sample.powers for sample in taken])
        if powers is not None:
            self._log.add_rows(self._lamps.topic, FLOATS, times_ns, powers)
        for channel in self._layout.channels:
            messages = channel.messages(times_ns, table)
            self._log.add_rows(channel.topic, channel.schema, times_ns, messages)
        self._transcript.write()
        for index, robot in enumerate(self._world.robots):
            events, self._host_events[index] = self._host_events[index], []
            if events:
                self._log.add(f"/{robot.name}/host_events", INTEGERS, events[0][0], events_message(events))
        # Last, so that the part of it in a torn file can be repeated with what came before.
        if taken:
            answered = np.array([sample.answered for sample in taken], np.int64)
            numbers = hashes(answered, self._layout.states(table))
            self._log.add("/state", INTEGERS, taken[0].time_ns, states_message(numbers))
        if snapshot:
            lamps = self._lamps.n_sets, self._lamps.change
            state = RecorderState(tuple(self._answers.numbers), self._transcript.rests, *lamps)
            message = snapshot_message(self._world, state)
            self._log.add(TOPIC, BYTES, self._world.time_ns, message)


class Recorder(WorldRecorder, FileRecorder):
    """Recorder of one run in one file.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        world: World to record.
        run: Description of the run.
        on_failure: Function that takes the message if the log can no longer be written, after which the run
            continues without it; None ends the run by a `LogError`.

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.

    Raises:
        LogError: The file cannot be made.
    """

    def __init__(
        self,
        path: StrPath,
        world: World,
        run: RunDescription,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self._world = world
        self.path = Path(path)
        self._file = LogFile(self.path, lambda: self._world.time_ns)
        self.part = self._file.part
        super().__init__(self._file, world, run)
        # An error at the very start of a log is always raised.
        self._file.on_failure = on_failure


class _Sample(NamedTuple):
    """Memory of all bodies and boards, hash of each robot's answers, and power of each lamp [W]."""

    time_ns: int
    state: bytes
    answered: tuple[int, ...]
    powers: tuple[float, ...]


class LiveRecorder(WorldRecorder):
    """Recorder of a run in a live view, which has what was sampled after an interval of wall time [ns].

    It has it with the next sample at the latest; in real time, a world that is ahead is slowed down.
    """

    def __init__(
        self,
        view: Writer,
        world: World,
        settings: Mapping[str, object],
        *,
        interval_ns: int,
        real_time: bool = False,
    ) -> None:
        self._interval_ns = interval_ns
        self._pacer = Pacer(1.0, world.time_ns) if real_time else None
        self._sent_ns = 0
        super().__init__(Output(view), world, RunDescription(settings))

    def sample(self, world: World) -> None:
        """Take a sample; pass on all so far if it is time to, and wait for the wall clock in real time."""
        super().sample(world)
        if time.monotonic_ns() - self._sent_ns >= self._interval_ns:
            self.flush()
        if self._pacer is not None and (early := self._pacer.wait(world.time_ns)) > 0:
            time.sleep(early)
        elif self._pacer is not None:
            self._pacer.slip(world.time_ns)

    def flush(self) -> None:
        """Pass on everything so far."""
        super().flush()
        self._sent_ns = time.monotonic_ns()

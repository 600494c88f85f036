"""Recording of a run: an observer that writes an MCAP file, or feeds a live view during the run.

Attachments and metadata come first, so that even a truncated file describes its run. All times are simulated,
and the file contains no wall clock time, machine name or file name: the same run gives the same bytes.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S, Pacer
from khep_twin.files.paths import StrPath
from khep_twin.log.channels import BYTES, FLOATS, INTEGERS, STRING, TRANSFORMS
from khep_twin.log.host_events import events_message
from khep_twin.log.log_file import FileRecorder, LogFile
from khep_twin.log.output import Output, Writer
from khep_twin.log.run_description import RunDescription
from khep_twin.log.sample_layout import LampsChannel, SampleLayout, channel_names_message
from khep_twin.log.snapshots import (
    SNAPSHOT_NS,
    SNAPSHOT_TOPIC,
    RecorderState,
    ReplyHashes,
    hash_samples,
    snapshot_message,
    states_message,
)
from khep_twin.log.transcript import Transcript
from khep_twin.observers import SAMPLE_NS
from khep_twin.world import World

FLUSH_NS = 5 * NS_PER_S
"""Simulated time between two flushes to the file system [ns]."""

_BATCH_SAMPLES = FLUSH_NS // SAMPLE_NS


class WorldRecorder:
    """Recorder of one run in an output; an `Observer` of its world."""

    def __init__(self, output: Output, world: World, run: RunDescription) -> None:
        self._log = output
        self._world = world
        self._transcript = Transcript(
            self._log, {robot.name: robot.dialect.framing for robot in world.robots}
        )
        self._reply_hashes = ReplyHashes(len(world.robots))
        self._host_events: list[list[tuple[int, HostEvent]]] = [[] for _ in world.robots]
        self._samples: list[_Sample] = []
        # Without a serial line, the state of the controllers would be missing.
        self._takes_snapshots = "line" not in run.facts
        self._layout = SampleLayout(world)
        self._lamps = LampsChannel(world.lamps)
        self._log.describe(run.all_attachments(world), run.all_facts(world))
        if run.prefix is None or run.prefix.state is None:
            self._log.add_scene(0, world.model)
            channels = (channel for robot in world.robots for channel in robot.sampled)
            self._log.add("/channel_names", STRING, 0, channel_names_message(channels))
            self._log.flush()
        else:
            has_scene = True
            for entries in run.prefix.entries:
                has_scene &= self._log.add_entries(entries)
                self._log.flush()
            if not has_scene:  # a log of version 1.0
                self._log.add_scene(world.time_ns, world.model)
            self._resume(run.prefix.state)
        self._log.on_exit = self._complete

    def move_to(self, world: World) -> None:
        """Continue recording in another world of the same robots, to which the state was transferred."""
        self.flush()
        previous_world, self._world = self._world, world
        self._layout = SampleLayout(world)
        self._lamps.move_to(world.lamps)
        if world.scene != previous_world.scene:
            self._log.add_scene(world.time_ns, world.model)
        self.flush()

    def sample(self, world: World) -> None:
        """Record the state of all bodies and boards, to be written in batches."""
        if not self._log.open:
            return
        if not self._lamps.matches(world.lamps):
            self.flush()
            self._lamps.switch_to(world.lamps)
        # Append in one operation: another thread may complete the log of a hung controller at any time.
        state, reply_hashes = self._layout.take_sample(), tuple(self._reply_hashes.values)
        self._samples.append(_Sample(world.time_ns, state, reply_hashes, tuple(world.lamps.powers)))
        if self._takes_snapshots and world.time_ns and world.time_ns % SNAPSHOT_NS == 0:
            self._flush(snapshot=True)
        elif len(self._samples) == _BATCH_SAMPLES:
            self.flush()

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Record bytes for the transcript."""
        if self._log.open:
            self._transcript.on_bytes(time_ns, robot, to_robot, data)
            if not to_robot:
                self._reply_hashes.on_bytes(time_ns, robot, data)

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Record a host event."""
        if self._log.open:
            self._host_events[robot].append((time_ns, event))
            # Other flushing kinds log an event, which flushes. Events of one robot are always in order.
            if event.kind is HostEventKind.SCAN and len(self._host_events) > 1:
                self.flush()

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Record an event; flush the file."""
        if self._log.open:
            name = "world" if robot is None else self._world.robots[robot].name
            self._log.add_event(time_ns, name, text)
            self.flush()

    def flush(self) -> None:
        """Write the recorded data to the file system."""
        self._flush(snapshot=False)

    def close(self) -> None:
        """Complete the file, with a last snapshot, and rename it to its path.

        Raises:
            LogError: The file cannot be completed; the data written before remains as NAME.mcap.part.
        """
        # An error may have ended the run within a step.
        self._complete(snapshot=self._takes_snapshots and self._world.is_between_steps)

    def _flush(self, snapshot: bool) -> None:
        if self._log.open:
            with self._log.error_guard():
                self._write(snapshot)
                self._log.flush()

    def _complete(self, snapshot: bool = False) -> None:
        """Complete the file; without a snapshot at any time, also during a step in another thread."""
        if self._log.open:
            with self._log.error_guard():
                self._write(snapshot)
                self._transcript.finish(self._world.time_ns)
                self._log.finish()

    def _resume(self, state: RecorderState) -> None:
        """Resume from the state of the recorder of a previous log."""
        count = len(self._reply_hashes.values)
        if len(state.answered) != count or any(
            robot >= count for *_, robot, _, _ in (*state.rests, *state.early_lines)
        ):
            raise ValueError(f"a recorder's state of {len(state.answered)} robots; expected {count}")
        self._reply_hashes.values[:] = state.answered
        self._transcript.resume(state.rests, state.early_lines)
        self._lamps.resume(state)

    def _write(self, snapshot: bool = False) -> None:
        """Write the recorded samples and lines, and a snapshot of the present state if requested."""
        samples, self._samples = self._samples, []
        times_ns = np.array([sample.time_ns for sample in samples], np.int64)
        table = self._layout.table([sample.state for sample in samples])
        transforms = self._layout.transforms(times_ns, table)
        self._log.add_rows("/tf", TRANSFORMS, times_ns, transforms)
        powers = self._lamps.messages([sample.powers for sample in samples])
        if powers is not None:
            self._log.add_rows(self._lamps.topic, FLOATS, times_ns, powers)
        for channel in self._layout.channels:
            messages = channel.messages(times_ns, table)
            self._log.add_rows(channel.topic, channel.schema, times_ns, messages)
        self._transcript.write(self._world.time_ns)
        for index, robot in enumerate(self._world.robots):
            events, self._host_events[index] = self._host_events[index], []
            if events:
                self._log.add(f"/{robot.name}/host_events", INTEGERS, events[0][0], events_message(events))
        # Written last, so that a truncated file contains all data up to its last hashes.
        if samples:
            reply_hashes = np.array([sample.reply_hashes for sample in samples], np.int64)
            hash_values = hash_samples(reply_hashes, self._layout.states(table))
            self._log.add("/state", INTEGERS, samples[0].time_ns, states_message(hash_values))
        if snapshot:
            lamps, transcript = (self._lamps.n_sets, self._lamps.is_recorded), self._transcript
            lines = transcript.partial_lines, *lamps, transcript.early_lines
            state = RecorderState(tuple(self._reply_hashes.values), *lines)
            message = snapshot_message(self._world, state)
            self._log.add(SNAPSHOT_TOPIC, BYTES, self._world.time_ns, message)


class Recorder(WorldRecorder, FileRecorder):
    """Recorder of one run in one file.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        world: World to record.
        run: Description of the run.
        on_failure: Function that takes the message of a write error, after which the run continues without a
            log; None raises a `LogError`.

    Attributes:
        path: Path of the finished log.
        part: Path of the file while it is written.

    Raises:
        LogError: The file cannot be created.
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
        # An error at the start of a log is always raised.
        self._file.on_failure = on_failure


class _Sample(NamedTuple):
    """Memory of all bodies and boards, hash of each robot's replies, and power of each lamp [W]."""

    time_ns: int
    state: bytes
    reply_hashes: tuple[int, ...]
    powers: tuple[float, ...]


class LiveRecorder(WorldRecorder):
    """Recorder of a run for a live view, flushed at the first sample after an interval of wall time [ns].

    With `real_time`, a world ahead of the wall clock is slowed down.
    """

    def __init__(
        self,
        writer: Writer,
        world: World,
        settings: Mapping[str, object],
        *,
        flush_interval_wall_ns: int,
        real_time: bool = False,
    ) -> None:
        self._flush_interval_wall_ns = flush_interval_wall_ns
        self._pacer = Pacer(1.0, world.time_ns) if real_time else None
        self._last_flush_wall_ns = 0
        super().__init__(Output(writer), world, RunDescription(settings))

    def sample(self, world: World) -> None:
        """Record a sample; flush after the interval, and wait for the wall clock in real time."""
        super().sample(world)
        if time.monotonic_ns() - self._last_flush_wall_ns >= self._flush_interval_wall_ns:
            self.flush()
        if self._pacer is not None and (delay_s := self._pacer.wait_s(world.time_ns)) > 0:
            time.sleep(delay_s)
        elif self._pacer is not None:
            self._pacer.slip(world.time_ns)

    def flush(self) -> None:
        """Send the recorded data."""
        super().flush()
        self._last_flush_wall_ns = time.monotonic_ns()

"""Repetition of a run from its log alone: the same world, the same host events at the same times.

The world is rebuilt from the log's attachments, including calibrations. Host events are bytes, baud rate and
connection of a host, and a user's moves of robots, lamps and notes. They are repeated, and so are the changes
of a branch. The state at every sample and every line of the transcript must equal the recorded ones.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest
from operator import attrgetter

import numpy as np

from khep_twin import __version__
from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import first_line, printable, read_line
from khep_twin.log.recorded import RecordedRun
from khep_twin.log.snapshots import ReplyHashes, board_registers, hash_samples
from khep_twin.log.transcript import Transcript
from khep_twin.observers import SAMPLE_NS, Observer
from khep_twin.ports.replay import RecordedHosts, Setup, repeat_event
from khep_twin.ports.resume import ResumedRun
from khep_twin.ports.twin import Twin
from khep_twin.world import World


@dataclass(frozen=True, slots=True, order=True)
class Divergence:
    """First difference between a repeated run and the recorded one: its time, channel and both values."""

    time_ns: int
    channel: str
    recorded: str = field(compare=False)
    repeated: str = field(compare=False)


def require_states(recorded: RecordedRun) -> None:
    """Raise a `LogError` if a log has no states to compare a run with."""
    if not recorded.states:
        version = recorded.label.metadata.get("khep_twin", "an unknown version")
        reason = (
            "it was made at a real robot; expected --port, with a port to send the same to"
            if "relay" in recorded.label.metadata
            else f"it has no states to compare, as logs of khep_twin {__version__} have; this is of {version}"
        )
        raise LogError(f"{recorded.path}: cannot be repeated: {reason}")


def repeat(recorded: RecordedRun, progress: Callable[[float], None] | None = None) -> Divergence | None:
    """Repeat a run and compare it with its log; return the first difference, or None.

    Raises:
        LogError: The log lacks data that a repetition needs.
    """
    require_states(recorded)
    try:
        setup = Setup(recorded.path, recorded.label)
        with setup.open() as twin:
            return _repeat_on_twin(recorded, setup, twin, progress)
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{recorded.path}: cannot be repeated: {first_line(error)}") from error


def _repeat_on_twin(
    recorded: RecordedRun, setup: Setup, twin: Twin, progress: Callable[[float], None] | None
) -> Divergence | None:
    """Repeat a run on a twin of its setup; return the first difference, or None."""
    comparison = _Comparison(twin.world, recorded)
    twin.world.add_observer(comparison)
    run = ResumedRun(setup, changes=(), twin=twin, hosts=RecordedHosts(twin, iter(())), upcoming=[])
    last_ns = recorded.last_ns
    events = [event for event in recorded.events if not recorded.is_truncated or event[0] <= recorded.end_ns]
    end_ns = recorded.end_ns if recorded.is_truncated else last_ns
    changes = list(recorded.changes)
    for time_ns, robot_index, event in [*events, (end_ns, 0, None)]:
        while run.twin.world.time_ns < time_ns and comparison.difference is None:
            next_ns = changes[0].at_ns if changes else time_ns
            world = run.twin.world
            world.advance_to(max(min(time_ns, next_ns, world.time_ns + NS_PER_S), world.time_ns))
            if progress is not None:
                progress(min(world.time_ns / max(last_ns, 1), 1.0))
            if changes and world.time_ns == next_ns and comparison.difference is None:
                run.change(changes.pop(0))
        if comparison.difference is not None:
            break
        if event is not None:
            repeat_event(run.twin, robot_index, event)
    return min(filter(None, [comparison.difference, *comparison.line_differences(recorded)]), default=None)


class _Comparison(Observer):
    """Observer that stores the transcript and the first state that differs from the recorded one."""

    def __init__(self, world: World, recorded: RecordedRun) -> None:
        self.difference: Divergence | None = None
        self._recorded_states = recorded.states
        self._replies = ReplyHashes(len(world.robots))
        self._names = [robot.name for robot in world.robots]
        self._lines: dict[str, list[TextLine]] = {f"/{name}/serial": [] for name in self._names}
        self._transcript = Transcript(self, {robot.name: robot.dialect.framing for robot in world.robots})

    def sample(self, world: World) -> None:
        """Compare the state with the recorded one."""
        sample_number = world.time_ns // SAMPLE_NS
        if self.difference is None and sample_number < len(self._recorded_states):
            registers = (board for robot in world.robots for board in board_registers(robot))
            state_arrays = (np.array(self._replies.values), world.data.qpos, world.data.qvel, *registers)
            old = self._recorded_states[sample_number]
            new = int(hash_samples(*(array.reshape(1, -1) for array in state_arrays))[0])
            if old != new:
                hash_texts = [f"{state % 2**64:016x}" for state in (old, new)]
                self.difference = Divergence(world.time_ns, "/state", *hash_texts)

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Add bytes to the transcript."""
        self._transcript.on_bytes(time_ns, robot, to_robot, data)
        if not to_robot:
            self._replies.on_bytes(time_ns, robot, data)

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add complete lines of the transcript."""
        self._lines[topic] += map(read_line, messages)

    def line_differences(self, recorded: RecordedRun) -> list[Divergence]:
        """Return the first difference of each robot's transcript."""
        if recorded.is_truncated:
            self._transcript.write()
        else:
            self._transcript.finish(recorded.end_ns)
        end_ns = recorded.end_ns if self.difference is None else self.difference.time_ns
        differences: list[Divergence] = []
        for name, recorded_lines in zip(self._names, recorded.lines, strict=True):
            topic = f"/{name}/serial"
            # A tool that sorts a log by time changes the order of lines at different times.
            pair = recorded_lines, self._lines[topic]
            old_lines, new_lines = (sorted(lines, key=attrgetter("time_ns", "name")) for lines in pair)
            for old, new in zip_longest(old_lines, new_lines):
                if (old and (old.name, old.text)) == (new and (new.name, new.text)) and (
                    old is None or new is None or old.time_ns == new.time_ns or old.time_ns >= recorded.end_ns
                ):
                    continue
                time_ns = min(line.time_ns for line in (old, new) if line is not None)
                # After the last sample the end of the run is unknown.
                is_complete = self.difference is None and not recorded.is_truncated
                if time_ns <= end_ns or (old is not None and is_complete):
                    differences.append(Divergence(time_ns, topic, _format_line(old), _format_line(new)))
                break
        return differences


def _format_line(line: TextLine | None) -> str:
    if line is None:
        return "nothing"
    return f"{printable(line.name)}: {printable(line.text)} at {line.time_ns / NS_PER_S:.4f} s"

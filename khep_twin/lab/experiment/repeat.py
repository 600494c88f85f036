"""Repetition of a run from its log alone: the same world, the same host events at the same times.

The world is rebuilt from the log's attachments, calibrations included, and its host events are repeated, as
are the changes of a run that was branched off another one.
Every sample's state and every line of the transcript must equal the recorded one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np

from khep_twin import __version__
from khep_twin.board.uart import HostEvent
from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import first_line, read_line, shown
from khep_twin.log.recorded import Recorded
from khep_twin.log.run_description import versions
from khep_twin.log.snapshots import Answered, boards, hashes
from khep_twin.log.transcript import Transcript
from khep_twin.ports.replay import RecordedHosts, Setup, repeat_event
from khep_twin.ports.resume import ResumedRun
from khep_twin.ports.twin import Twin
from khep_twin.world import SAMPLE_NS, Observer, World


@dataclass(frozen=True, slots=True, order=True)
class Divergence:
    """First difference between a repeated run and the recorded one: its time, channel and both values."""

    time_ns: int
    channel: str
    recorded: str = field(compare=False)
    repeated: str = field(compare=False)


def elsewhere(recorded: Recorded) -> list[str]:
    """Return the differences between the versions of a log and those installed, a line each."""
    made = recorded.label.metadata
    return [
        f"made with {key} {shown(made.get(key, 'unknown'))}, here is {value}"
        for key, value in versions().items()
        if made.get(key) != value
    ]


def check(recorded: Recorded) -> None:
    """Raise a `LogError` if a log has no states to compare a run with."""
    if not recorded.states:
        made = recorded.label.metadata.get("khep_twin", "an unknown version")
        reason = (
            "it was made at a real robot; expected --port, with a port to send the same to"
            if "relay" in recorded.label.metadata
            else f"it has no states to compare, as logs of khep_twin {__version__} have; this is of {made}"
        )
        raise LogError(f"{recorded.path}: cannot be repeated: {reason}")


def repeat(recorded: Recorded, progress: Callable[[float], None] | None = None) -> Divergence | None:
    """Repeat a run and compare it with its log; return the first difference, None without.

    Raises:
        LogError: The log lacks what a repetition needs.
    """
    check(recorded)
    try:
        setup = Setup(recorded.path, recorded.label)
        with setup.open() as twin:
            return _run(recorded, setup, twin, progress)
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{recorded.path}: cannot be repeated: {first_line(error)}") from error


def _run(
    recorded: Recorded, setup: Setup, twin: Twin, progress: Callable[[float], None] | None
) -> Divergence | None:
    watch = _Watch(twin.world, recorded)
    twin.world.add_observer(watch)
    run = ResumedRun(setup, (), twin, RecordedHosts(twin, iter(())), [])
    last_ns = recorded.last_ns
    events = [each for each in recorded.events if not recorded.torn or each[0] <= recorded.end_ns]
    end: list[tuple[int, int, HostEvent | None]] = [(recorded.end_ns if recorded.torn else last_ns, 0, None)]
    changes = list(recorded.changes)
    for time_ns, index, event in [*events, *end]:
        while run.twin.world.time_ns < time_ns and watch.difference is None:
            next_ns = changes[0].at_ns if changes else time_ns
            world = run.twin.world
            world.advance_to(max(min(time_ns, next_ns, world.time_ns + NS_PER_S), world.time_ns))
            if progress is not None:
                progress(min(world.time_ns / max(last_ns, 1), 1.0))
            if changes and world.time_ns == next_ns and watch.difference is None:
                run.change(changes.pop(0))
        if watch.difference is not None:
            break
        if event is not None:
            repeat_event(run.twin, index, event)
    return min(filter(None, [watch.difference, *watch.lines(recorded)]), default=None)


class _Watch(Observer):
    """Observer that keeps the transcript and the first difference between a sample and the recorded one."""

    def __init__(self, world: World, recorded: Recorded) -> None:
        self.difference: Divergence | None = None
        self._recorded = recorded.states
        self._answers = Answered(len(world.robots))
        self._names = [robot.name for robot in world.robots]
        self._lines: dict[str, list[TextLine]] = {f"/{name}/serial": [] for name in self._names}
        self._transcript = Transcript(self, self._names)

    def sample(self, world: World) -> None:
        """Compare the state."""
        place = world.time_ns // SAMPLE_NS
        if self.difference is None and place < len(self._recorded):
            registers = (each for robot in world.robots for each in boards(robot))
            parts = (np.array(self._answers.numbers), world.data.qpos, world.data.qvel, *registers)
            before, now = self._recorded[place], int(hashes(*(part.reshape(1, -1) for part in parts))[0])
            if before != now:
                self.difference = Divergence(world.time_ns, "/state", _hexadecimal(before), _hexadecimal(now))

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Add bytes to the transcript."""
        self._transcript.on_bytes(time_ns, robot, to_robot, data)
        if not to_robot:
            self._answers.on_bytes(time_ns, robot, data)

    def add_lines(self, topic: str, times_ns: list[int], messages: list[bytes]) -> None:
        """Add whole lines of the transcript."""
        self._lines[topic] += map(read_line, messages)

    def lines(self, recorded: Recorded) -> list[Divergence]:
        """Return the first difference of each robot's transcript."""
        self._transcript.write()
        if not recorded.torn:
            self._transcript.write_rests(recorded.end_ns)
        until_ns = recorded.end_ns if self.difference is None else self.difference.time_ns
        found: list[Divergence] = []
        for name, before in zip(self._names, recorded.lines, strict=True):
            topic = f"/{name}/serial"
            for old, new in zip_longest(before, self._lines[topic]):
                if (old and (old.name, old.text)) == (new and (new.name, new.text)) and (
                    old is None or new is None or old.time_ns == new.time_ns or old.time_ns >= recorded.end_ns
                ):
                    continue
                time_ns = min(line.time_ns for line in (old, new) if line is not None)
                # After the last sample the end of the run is unknown.
                if time_ns <= until_ns or (old is not None and self.difference is None and not recorded.torn):
                    found.append(Divergence(time_ns, topic, _told(old), _told(new)))
                break
        return found


def _told(line: TextLine | None) -> str:
    if line is None:
        return "nothing"
    return f"{shown(line.name)}: {shown(line.text)} at {line.time_ns / NS_PER_S:.4f} s"


def _hexadecimal(state: int) -> str:
    return f"{state % 2**64:016x}"

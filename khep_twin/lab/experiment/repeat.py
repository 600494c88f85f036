"""Repetition of a run from its log alone: the same world, the same host events at the same times.

The world is rebuilt from the log's attachments, calibrations included, and its host events are repeated.
Every sample's state and every line of the transcript must equal the recorded one.
"""

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import zip_longest
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
from pydantic import TypeAdapter, ValidationError

from khep_twin import __version__
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.interventions.move_robot import repeat_move, scan
from khep_twin.interventions.switching import repeat_relight, repeat_switch
from khep_twin.log.attached import playpen_of
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import LATEST_NS, Misfit, first_line, read_line, shown
from khep_twin.log.host_events import read_events
from khep_twin.log.reader import Label, read_raw
from khep_twin.log.recorder import versions
from khep_twin.log.state_hashes import Answered, boards, hashes, read_states
from khep_twin.log.transcript import Transcript
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.world import SAMPLE_NS, World


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recorded run to be repeated.

    Attributes:
        path: Path of the log.
        label: Metadata and attachments of the log.
        events: World time [ns], robot index and host event, in order.
        states: Hash of each sample.
        lines: Transcripts by robot.
        torn: True if the end of the run may be missing.
    """

    path: Path
    label: Label
    events: Sequence[tuple[int, int, HostEvent]]
    states: Sequence[int]
    lines: Sequence[Sequence[TextLine]]
    torn: bool

    @property
    def end_ns(self) -> int:
        """Time of the last sample [ns]."""
        return (len(self.states) - 1) * SAMPLE_NS


@dataclass(frozen=True, slots=True, order=True)
class Divergence:
    """First difference between a repeated run and the recorded one: its time, channel and both values."""

    time_ns: int
    channel: str
    recorded: str = field(compare=False)
    repeated: str = field(compare=False)


def read_recorded(path: Path) -> Recorded:
    """Read a recorded run from a log.

    Raises:
        LogError: There is no log, it is not whole, or it lacks what a repetition needs.
    """
    channels = ("/host_events", "/serial", "/state")
    label, found, recovered = read_raw(path, lambda topic: topic.endswith(channels))
    if label.metadata.get("line") == "none":
        raise LogError(
            f"{path}: cannot be repeated: its controller ran without a line, of which the log has nothing; "
            "expected a log of khep-twin run or serve"
        )
    states: list[int] = []
    for time_ns, hashed in _decoded(path, found, "/state", read_states):
        if time_ns != len(states) * SAMPLE_NS:
            at_s = len(states) * SAMPLE_NS / NS_PER_S
            raise LogError(f"{path}: cannot be repeated: the state at {at_s:.2f} s is missing")
        states += hashed
    last_ns = (len(states) - 1) * SAMPLE_NS + _OVERTIME_NS if states and not recovered else LATEST_NS
    events: list[tuple[int, int, HostEvent]] = []
    lines: list[list[TextLine]] = [[] for _ in label.robots]
    for index, name in enumerate(label.robots):
        for _, done in _decoded(path, found, f"/{name}/host_events", lambda data: list(read_events(data))):
            events += [(at_ns, index, event) for at_ns, event in done]
        lines[index] = [line for _, line in _decoded(path, found, f"/{name}/serial", read_line)]
    for time_ns in (*(at_ns for at_ns, _, _ in events), *(line.time_ns for each in lines for line in each)):
        if time_ns > last_ns:
            wish = f"at most {last_ns / NS_PER_S:.2f} s, {_OVERTIME_NS // NS_PER_S} s after the last state"
            what = f"something at {time_ns / NS_PER_S:.2f} s"
            raise Misfit(what, wish).at(path, "/host_events and /serial")
    # Robots do not interact on their lines, so events at the same time may be in the order of the robots.
    return Recorded(path, label, sorted(events, key=lambda each: each[0]), states, lines, recovered)


_OVERTIME_NS = 10 * NS_PER_S
"""Longest time from the last state to any event or line [ns]."""

_Decoded = TypeVar("_Decoded")


def _decoded(
    path: Path,
    found: Mapping[str, Sequence[tuple[int, bytes]]],
    topic: str,
    decode: Callable[[bytes], _Decoded],
) -> Iterator[tuple[int, _Decoded]]:
    """Yield times [ns] and contents of a channel's messages."""
    for time_ns, data in found.get(topic, ()):
        try:
            yield time_ns, decode(data)
        except Misfit as misfit:
            raise misfit.at(path, topic, time_ns) from None


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
        with _twin(recorded) as twin:
            return _run(recorded, twin, progress)
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{recorded.path}: cannot be repeated: {first_line(error)}") from error


def _twin(recorded: Recorded) -> Twin:
    """Open the twin of a log from its attachments alone."""
    path, attached = recorded.path, recorded.label.attachments
    for name in ("playpen.toml", "configuration.json"):
        if name not in attached:
            raise LogError(f"{path}: cannot be repeated: its {name} is missing")
    options = _options(path, attached["configuration.json"])
    playpen = playpen_of(attached, path)
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        twin = open_twin(_calibrated(recorded, playpen, Path(folder)), options)
    there = tuple(robot.name for robot in twin.world.robots)
    if there != recorded.label.robots:
        found = f"robots = {shown(','.join(recorded.label.robots))}"
        raise Misfit(found, f"{','.join(there)}, those of its playpen.toml").at(path, "metadata")
    return twin


def _options(path: Path, text: str) -> TwinOptions:
    """Return the options of a log's twin."""
    known = [each.name for each in fields(TwinOptions)]
    try:
        settings: object = json.loads(text)
        if not isinstance(settings, dict):
            raise Misfit(f"{type(settings).__name__}", f"an object with {', '.join(known)}")
        if unknown := [key for key in cast(dict[str, object], settings) if key not in known]:
            raise Misfit(f"key {shown(unknown[0])}", f"one of {', '.join(known)}")
        # A repeated run must not write the log named in the options.
        wanted = {**cast(dict[str, object], settings), "log": None}
        return _OPTIONS.validate_json(json.dumps(wanted), strict=True)
    except Misfit as misfit:
        raise misfit.at(path, "configuration.json") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        misfit = Misfit(f"{key} = {shown(first['input'])}", first["msg"].removeprefix("Input should be "))
        raise misfit.at(path, "configuration.json") from None
    except KhepTwinError as error:
        raise LogError(f"{path}: configuration.json: {error}") from None
    except (ValueError, RecursionError) as error:
        misfit = Misfit(f"{shown(text)} ({shown(error)})", "JSON")
        raise misfit.at(path, "configuration.json") from None


_OPTIONS = TypeAdapter(TwinOptions)


def _calibrated(recorded: Recorded, playpen: Playpen, folder: Path) -> Playpen:
    """Return the playpen with its robots' calibrations from the log instead of this machine."""
    robots = list(playpen.robots)
    for index, robot in enumerate(robots):
        name = f"khepera{index}.toml"
        text = recorded.label.attachments.get(f"calibration/{name}")
        if text is None:
            raise LogError(f"{recorded.path}: cannot be repeated: its calibration/{name} is missing")
        (folder / name).write_text(text, encoding="utf-8")
        robots[index] = robot.model_copy(update={"calibration": str(folder / name)})
    return playpen.model_copy(update={"robots": tuple(robots)})


def _run(recorded: Recorded, twin: Twin, progress: Callable[[float], None] | None) -> Divergence | None:
    world = twin.world
    watch = _Watch(world, recorded)
    world.add_observer(watch)
    last_ns = max([recorded.end_ns, *(line.time_ns for lines in recorded.lines for line in lines)])
    events = [each for each in recorded.events if not recorded.torn or each[0] <= recorded.end_ns]
    end: list[tuple[int, int, HostEvent | None]] = [(recorded.end_ns if recorded.torn else last_ns, 0, None)]
    for time_ns, index, event in [*events, *end]:
        while world.time_ns < time_ns and watch.difference is None:
            world.advance_to(min(time_ns, world.time_ns + NS_PER_S))
            if progress is not None:
                progress(min(world.time_ns / max(last_ns, 1), 1.0))
        if watch.difference is not None:
            break
        if event is not None:
            _repeat_event(twin, index, event)
    return min(filter(None, [watch.difference, *watch.lines(recorded)]), default=None)


def _repeat_event(twin: Twin, index: int, event: HostEvent) -> None:
    """Repeat a host event on its robot's line."""
    robot = twin.world.robots[index]
    # Discard unread bytes; that changes nothing for the robot.
    robot.uart.tx.read(twin.world.time_ns)
    match event.kind:
        case HostEventKind.SEND:
            robot.send(event.data, event.at_ns)
        case HostEventKind.DISCONNECT:
            robot.disconnect()
        case HostEventKind.FLUSH:
            robot.flush()
        case HostEventKind.SET:
            robot.compare_line(event.host)
        case HostEventKind.PUT:
            repeat_move(twin.world, index, event)
        case HostEventKind.SWITCH:
            repeat_switch(twin.world, event)
        case HostEventKind.SCAN:
            scan(twin.world)
        case HostEventKind.RELIGHT:
            repeat_relight(twin.world, event)


class _Watch:
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

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Ignore host events: they are the recorded ones."""

    def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Ignore events: they follow from the state."""

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

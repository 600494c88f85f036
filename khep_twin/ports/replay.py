"""The twin of a log, opened from its attachments, and its hosts, whose recorded events are repeated."""

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Self, cast

from pydantic import TypeAdapter, ValidationError

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.errors import KhepTwinError, LogError, PlaypenError
from khep_twin.interventions.move_robot import repeat_move, scan
from khep_twin.interventions.switching import repeat_set_lamps, repeat_switch
from khep_twin.log.attached import playpen_of
from khep_twin.log.decoding import DecodeError, first_line, printable
from khep_twin.log.entries import Label
from khep_twin.log.reader import read_label
from khep_twin.log.recorded import BranchPoint, RecordedEvent
from khep_twin.playpen import Playpen
from khep_twin.playpen.changes import set_values
from khep_twin.ports.twin import Twin, TwinOptions, open_twin


class Setup(NamedTuple):
    """Description of a twin in its log."""

    path: Path
    label: Label

    @classmethod
    def of(cls, path: Path) -> Self:
        """Return the setup of a log."""
        return cls(path, read_label(path))

    def open(self, changes: Iterable[BranchPoint] = ()) -> Twin:
        """Open the twin of the log at its start, from its attachments alone, as it is after some changes.

        Raises:
            LogError: The log lacks what that needs.
        """
        path, changes = self.path, tuple(changes)
        for name in ("playpen.toml", "configuration.json"):
            if name not in self.label.attachments:
                raise LogError(f"{path}: cannot be repeated: its {name} is missing")
        options = self.options
        options = replace(options, faults=(*options.faults, *chain(*(change.faults for change in changes))))
        try:
            with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
                twin = open_twin(self._calibrated(self.playpen(changes), changes, Path(folder)), options)
        except OSError as error:
            reason = f"no calibration can be kept in a temporary folder: {error.strerror}"
            raise LogError(f"{path}: cannot be repeated: {reason}") from error
        there = tuple(robot.name for robot in twin.world.robots)
        if there != self.label.robots:
            found = f"robots = {printable(','.join(self.label.robots))}"
            raise DecodeError(found, f"{','.join(there)}, those of its playpen.toml").to_log_error(path, "metadata")
        return twin

    @property
    def options(self) -> TwinOptions:
        """Options of the twin."""
        known = [each.name for each in fields(TwinOptions)]
        text = self.label.attachments.get("configuration.json", "")
        try:
            settings: object = json.loads(text)
            if not isinstance(settings, dict):
                raise DecodeError(f"{type(settings).__name__}", f"an object with {', '.join(known)}")
            if unknown := [key for key in cast(dict[str, object], settings) if key not in known]:
                raise DecodeError(f"key {printable(unknown[0])}", f"one of {', '.join(known)}")
            # A repeated run must not write the log named in the options.
            wanted: Mapping[str, object] = {**cast(dict[str, object], settings), "log": None}
            return _OPTIONS.validate_json(json.dumps(wanted), strict=True)
        except DecodeError as error:
            invalid = error
        except ValidationError as error:
            first = error.errors()[0]
            found = f"{'.'.join(map(str, first['loc']))} = {printable(first['input'])}"
            invalid = DecodeError(found, first["msg"].removeprefix("Input should be "))
        except KhepTwinError as error:
            raise LogError(f"{self.path}: configuration.json: {error}") from None
        except (ValueError, RecursionError) as error:
            invalid = DecodeError(f"{printable(text)} ({printable(error)})", "JSON")
        raise invalid.to_log_error(self.path, "configuration.json")

    def playpen(self, changes: Iterable[BranchPoint] = ()) -> Playpen:
        """Return the playpen of the log at its start, as it is after some changes."""
        found = playpen_of(self.label.attachments, self.path)
        return set_values(found, chain(*(change.edits for change in changes)))

    def _calibrated(self, playpen: Playpen, changes: Iterable[BranchPoint], folder: Path) -> Playpen:
        """Return the playpen with its robots' calibrations from the log instead of this machine."""
        others = {name: text for each in changes for name, text in (each.calibrations or {}).items()}
        robots = list(playpen.robots)
        for index, robot in enumerate(robots):
            name = f"khepera{index}.toml"
            text = others.get(f"khepera{index}", self.label.attachments.get(f"calibration/{name}"))
            if text is None:
                raise LogError(f"{self.path}: cannot be repeated: its calibration/{name} is missing")
            (folder / name).write_text(text, encoding="utf-8")
            robots[index] = robot.model_copy(update={"calibration": str(folder / name)})
        return playpen.model_copy(update={"robots": tuple(robots)})


class RecordedHosts:
    """Recorded hosts that go on in a twin, a `TimeSource`: as time passes, their events are repeated."""

    def __init__(self, twin: Twin, events: Iterator[RecordedEvent]) -> None:
        self.twin = twin
        self._events = events
        self._next = next(events, None)

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns`, with what was done up to then."""
        self.repeat(lambda event_ns: event_ns < time_ns)
        self.twin.world.advance_to(max(time_ns, self.twin.world.time_ns))
        self.repeat(lambda event_ns: event_ns <= time_ns)

    def attend(self) -> None:
        """Do nothing: what is due is done as time passes."""

    def repeat(self, due: Callable[[int], bool]) -> None:
        """Repeat the events at times that are due."""
        while self._next is not None and due(self._next[0]):
            (time_ns, index, event), self._next = self._next, next(self._events, None)
            world = self.twin.world
            # Without time on the line, what was sent at this time would already be read.
            if time_ns > world.time_ns:
                world.advance_to(time_ns)
            try:
                repeat_event(self.twin, index, event)
            except PlaypenError as error:  # in another playpen there may be no room
                world.log_event(index, f"left out, as it was recorded: {first_line(error)}")

    def replace(self, index: int) -> None:
        """Let another host take over a robot: the recorded one leaves its line."""
        before = self._next
        rest = self._events if before is None else chain([before], self._events)
        self._events = (each for each in rest if each[1] != index or each[2].kind in _OF_THE_WORLD)
        self._next = next(self._events, None)
        self.twin.world.robots[index].disconnect()


_OF_THE_WORLD = (HostEventKind.SWITCH, HostEventKind.SET_LAMPS, HostEventKind.SCAN)
"""What was done to the world, and not to a robot."""


def repeat_event(twin: Twin, index: int, event: HostEvent) -> None:
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
        case HostEventKind.SET_LAMPS:
            repeat_set_lamps(twin.world, event)
        case HostEventKind.NOTE:
            twin.world.log_event(
                None if event.data[:1] == b"\1" else index, event.data[1:].decode("utf-8", "replace")
            )


_OPTIONS = TypeAdapter(TwinOptions)

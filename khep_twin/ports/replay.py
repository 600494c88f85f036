"""Replay of a log: its twin, opened from its attachments, and its hosts, whose events are repeated."""

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
from khep_twin.robots.model import robot_name

_WORLD_EVENT_KINDS = (HostEventKind.SWITCH_LAMP, HostEventKind.SET_LAMPS, HostEventKind.SCAN)
"""Kinds of actions on the world, not on one robot."""

_OPTIONS_ADAPTER = TypeAdapter(TwinOptions)


class Setup(NamedTuple):
    """Description of a twin in its log, with its attachments."""

    path: Path
    label: Label

    @classmethod
    def of(cls, path: Path) -> Self:
        """Return the setup of a log."""
        return cls(path, read_label(path))

    def open(self, changes: Iterable[BranchPoint] = ()) -> Twin:
        """Open the twin of the log at its start, from its attachments only, with some changes applied.

        Raises:
            LogError: The log lacks a necessary attachment.
        """
        path, changes = self.path, tuple(changes)
        for name in ("playpen.toml", "configuration.json"):
            if name not in self.label.attachments:
                raise LogError(f"{path}: cannot be repeated: its {name} is missing")
        options = self.options
        options = replace(options, faults=(*options.faults, *chain(*(change.faults for change in changes))))
        try:
            with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
                twin = open_twin(self._calibrate(self.playpen(changes), changes, Path(folder)), options)
        except OSError as error:
            reason = f"no calibration can be saved in a temporary folder: {error.strerror}"
            raise LogError(f"{path}: cannot be repeated: {reason}") from error
        robot_names = tuple(robot.name for robot in twin.world.robots)
        if robot_names != self.label.robots:
            problem = f"robots = {printable(','.join(self.label.robots))}"
            error = DecodeError(problem, f"{','.join(robot_names)}, those of its playpen.toml")
            raise error.to_log_error(path, "metadata")
        return twin

    @property
    def options(self) -> TwinOptions:
        """Options of the twin."""
        names = [field.name for field in fields(TwinOptions)]
        text = self.label.attachments.get("configuration.json", "")
        try:
            settings: object = json.loads(text)
            if not isinstance(settings, dict):
                raise DecodeError(f"{type(settings).__name__}", f"an object with {', '.join(names)}")
            if unknown := [key for key in cast(dict[str, object], settings) if key not in names]:
                raise DecodeError(f"key {printable(unknown[0])}", f"one of {', '.join(names)}")
            # A repeated run must not write the log named in the options.
            run_settings: Mapping[str, object] = {**cast(dict[str, object], settings), "log": None}
            return _OPTIONS_ADAPTER.validate_json(json.dumps(run_settings), strict=True)
        except DecodeError as error:
            decode_error = error
        except ValidationError as error:
            first_error = error.errors()[0]
            problem = f"{'.'.join(map(str, first_error['loc']))} = {printable(first_error['input'])}"
            decode_error = DecodeError(problem, first_error["msg"].removeprefix("Input should be "))
        except KhepTwinError as error:
            raise LogError(f"{self.path}: configuration.json: {error}") from None
        except (ValueError, RecursionError) as error:
            decode_error = DecodeError(f"{printable(text)} ({printable(error)})", "JSON")
        raise decode_error.to_log_error(self.path, "configuration.json")

    def playpen(self, changes: Iterable[BranchPoint] = ()) -> Playpen:
        """Return the playpen of the log at its start, with some changes applied."""
        playpen = playpen_of(self.label.attachments, self.path)
        return set_values(playpen, chain(*(change.edits for change in changes)))

    def _calibrate(self, playpen: Playpen, changes: Iterable[BranchPoint], folder: Path) -> Playpen:
        """Return the playpen with its robots' calibrations from the log, not from this machine."""
        texts = {name: text for change in changes for name, text in (change.calibrations or {}).items()}
        robots = list(playpen.robots)
        for index, robot in enumerate(robots):
            name = f"{robot_name(index)}.toml"
            text = texts.get(robot_name(index), self.label.attachments.get(f"calibration/{name}"))
            if text is None:
                raise LogError(f"{self.path}: cannot be repeated: its calibration/{name} is missing")
            (folder / name).write_text(text, encoding="utf-8")
            robots[index] = robot.model_copy(update={"calibration": str(folder / name)})
        return playpen.model_copy(update={"robots": tuple(robots)})


class RecordedHosts:
    """Recorded hosts of a twin, a `TimeSource` that repeats their events, and users' changes, in time."""

    def __init__(self, twin: Twin, events: Iterator[RecordedEvent]) -> None:
        self.twin = twin
        self._events = events
        self._next_entry = next(events, None)

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns`, and repeat the events up to that time."""
        self.repeat(lambda event_ns: event_ns < time_ns)
        self.twin.world.advance_to(max(time_ns, self.twin.world.time_ns))
        self.repeat(lambda event_ns: event_ns <= time_ns)

    def attend(self) -> None:
        """Do nothing: events are repeated as time passes."""

    def repeat(self, is_due: Callable[[int], bool]) -> None:
        """Repeat the next events while `is_due` returns True for their time [ns]."""
        while self._next_entry is not None and is_due(self._next_entry[0]):
            (time_ns, index, event), self._next_entry = self._next_entry, next(self._events, None)
            world = self.twin.world
            # On a line without delay, bytes sent at this time would already be read.
            if time_ns > world.time_ns:
                world.advance_to(time_ns)
            try:
                repeat_event(self.twin, index, event)
            except PlaypenError as error:  # a changed playpen may have no room
                world.log_event(index, f"left out, as it was recorded: {first_line(error)}")

    def drop_host(self, index: int) -> None:
        """Drop the rest of a robot's recorded events, except of lamps and scans, and disconnect its host."""
        next_entry = self._next_entry
        entries = self._events if next_entry is None else chain([next_entry], self._events)
        self._events = (
            (time_ns, robot, event)
            for time_ns, robot, event in entries
            if robot != index or event.kind in _WORLD_EVENT_KINDS
        )
        self._next_entry = next(self._events, None)
        self.twin.world.robots[index].disconnect()


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
        case HostEventKind.LINE_SETTINGS:
            robot.set_host_line(event.host)
        case HostEventKind.MOVE_ROBOT:
            repeat_move(twin.world, index, event)
        case HostEventKind.SWITCH_LAMP:
            repeat_switch(twin.world, event)
        case HostEventKind.SCAN:
            scan(twin.world)
        case HostEventKind.SET_LAMPS:
            repeat_set_lamps(twin.world, event)
        case HostEventKind.NOTE:
            twin.world.log_event(
                None if event.data[:1] == b"\1" else index, event.data[1:].decode("utf-8", "replace")
            )

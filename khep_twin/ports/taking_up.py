"""Runs of logs taken up at any moment, to go on with another host, or with something changed.

A run is taken up from the last snapshot before the moment, or from its start, and what its hosts did is
repeated up to there. Then another host may take over; seed, faults, calibrations or playpen may change.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import mujoco

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError, PlaypenError, PortError, SnapshotError
from khep_twin.files.atomic import is_same
from khep_twin.interventions.move_robot import as_it_stands
from khep_twin.log.decoding import LATEST_NS, Misfit, first_line
from khep_twin.log.entries import Entry
from khep_twin.log.label import Label
from khep_twin.log.reader import hash_of, read_end_ns, read_label, read_since, read_until
from khep_twin.log.recorded import BRANCH, BranchPoint, changes_of, changes_text, check_line, events_in
from khep_twin.log.recorder import Beginning, versions
from khep_twin.log.snapshots import TOPIC, LoggedState, read_snapshot
from khep_twin.log.state_hashes import read_states
from khep_twin.playpen import Block, Cylinder, Playpen, Robot
from khep_twin.playpen.changes import changed_tables, no_room_for, set_values
from khep_twin.ports.replay import RecordedHosts, Setup
from khep_twin.ports.twin import Twin
from khep_twin.simulation.carrying_over import carry_over, place
from khep_twin.simulation.physics_state import physics_state
from khep_twin.units import STEP_NS, metres
from khep_twin.world import SAMPLE_NS, World


@dataclass(slots=True)
class TakenUp:
    """Run that was taken up.

    Attributes:
        setup: What the log says of its twin.
        changes: Changes of the run so far.
        twin: Twin at the moment.
        hosts: Recorded hosts, which go on with it.
        later: Changes of the recorded run that are still to come.
    """

    setup: Setup
    changes: tuple[BranchPoint, ...]
    twin: Twin
    hosts: RecordedHosts
    later: list[BranchPoint]

    def run_to(
        self,
        end_ns: int,
        progress: Callable[[float], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """Let the run go on as recorded to a time [ns], before what was done at that very time.

        Args:
            end_ns: Time [ns].
            progress: Function that takes the part of the way that is done, 0 to 1.
            stop: Function that returns whether to end early.
        """
        start_ns = self.twin.world.time_ns
        while True:
            now_ns = self.twin.world.time_ns
            while self.later and (self.later[0].at_ns <= now_ns or not self.later[0].text):
                self.change(self.later.pop(0))
            if now_ns >= end_ns or (stop is not None and stop()):
                return
            # A stop at a whole second, between two steps, leaves no trace; amid a step, in times of events.
            moments = [each.at_ns for each in self.later]
            goal_ns = min((now_ns // NS_PER_S + 1) * NS_PER_S, end_ns, *moments)
            self.hosts.repeat(lambda time_ns, goal_ns=goal_ns: time_ns < goal_ns)
            if goal_ns > self.twin.world.time_ns:
                self.twin.world.advance_to(goal_ns)
            if progress is not None:
                progress((self.twin.world.time_ns - start_ns) / (end_ns - start_ns))

    def change(self, change: BranchPoint) -> None:
        """Change the run from now on.

        Raises:
            KhepTwinError: That is not possible.
        """
        self.changes = (*self.changes, change)
        before = self.twin
        if change.faults or change.edits or change.calibrations:
            self.twin = self.setup.open(self.changes)
            if self.twin.world.scene == before.world.scene:
                self.twin.world.set_state(before.world.state())
            else:
                _go_on_in(self.twin.world, before.world, self.setup.playpen(self.changes[:-1]), change)
            self.twin.world.observers = before.world.observers
            self.twin.recorder = before.recorder
            if self.twin.recorder is not None:
                self.twin.recorder.move_to(self.twin.world)
            self.hosts.twin = self.twin
        if change.seed is not None:
            self.twin.world.reseed(change.seed)
        if change.text:
            self.twin.world.log_event(None, f"branched off, with {change.text}")


def take_up(
    path: Path,
    at_ns: int,
    start: Callable[[Twin, Label, Beginning], None] | None = None,
) -> TakenUp:
    """Take up the run of a log at a moment, before what was done at that very moment.

    Args:
        path: Path of the log.
        at_ns: Moment [ns].
        start: Function called with the twin before the rest up to the moment, to record it.

    Raises:
        LogError: The log lacks what that needs, or ends before.
    """
    label = read_label(path)
    check_line(path, label)
    setup, pieces = Setup(path, label), read_since(path, TOPIC, at_ns)
    changes, last = changes_of(path, label), next(iter(next(pieces)), None)
    try:
        state = None if last is None else _logged(path, last, None)
        from_ns = 0 if state is None else state.world.time_ns
        if last is not None and last.time_ns != from_ns:
            raise Misfit(f"a state at {from_ns} ns", "its message's time").at(path, TOPIC, last.time_ns)
        done = tuple(change for change in changes if last is not None and change.at_ns < from_ns)
        twin = setup.open(done)
        if state is not None and last is not None:
            twin.world.set_state(_logged(path, last, twin.world.scene).world)
        if start is not None:
            begun = () if last is None else read_until(path, last)
            start(twin, label, Beginning(begun, state and state.recorder))
        hosts = RecordedHosts(twin, events_in(path, pieces, label.robots))
        taken = TakenUp(setup, done, twin, hosts, [*changes[len(done) :]])
        taken.run_to(at_ns)
        return taken
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{path}: cannot be taken up: {first_line(error)}") from error


class Described(NamedTuple):
    """Facts and attachments of a log."""

    facts: Mapping[str, str] = {}
    attachments: Mapping[str, str] = {}


_NOTHING = Described()


def branch_off(
    path: Path,
    change: BranchPoint,
    log: Path | None = None,
    more: Described = _NOTHING,
    on_failure: Callable[[str], None] | None = None,
    *,
    same: bool = False,
) -> TakenUp:
    """Take up the run of a log, and change it; the recorded hosts are still there.

    Args:
        path: Path of the log.
        change: Moment, and what is different from then on.
        same: True if nothing is, so that the recorded run goes on with its own later changes.
        log: Path of a new log, which begins as the old one; None for none.
        more: More facts and attachments of the new log.
        on_failure: Function that takes the line about a log that cannot be written any more; None to end.

    Raises:
        LogError: The log lacks what that needs, or the new one cannot be written.
        KhepTwinError: The change cannot be made.
    """
    last_ns = read_end_ns(path)
    if not 0 < change.at_ns <= last_ns:
        found = f"{path}: the run cannot be taken up at {change.at_ns / NS_PER_S:g} s"
        raise LogError(f"{found}; expected above 0 and up to its end at {last_ns / NS_PER_S:g} s")
    if log is not None and is_same(log, path):
        raise LogError(f"{log}: this is the log that is taken up; expected a file of its own")
    begun: list[Twin] = []

    def start(twin: Twin, label: Label, beginning: Beginning) -> None:
        told = replace(change, parent=path.name, sha256=hash_of(path))
        facts = {
            **label.metadata,
            **versions(),
            **more.facts,
            "parent": told.parent,
            "parent_sha256": told.sha256,
            "branched_at_s": f"{told.at_ns / NS_PER_S:.9g}",
        }
        before = [each for each in changes_of(path, label) if each.at_ns < told.at_ns]
        later = [each for each in changes_of(path, label) if same and each.at_ns >= told.at_ns]
        text = changes_text([*before, told, *later])
        attachments = {**label.attachments, BRANCH: text, **more.attachments}
        begun.append(twin)
        if log is not None:
            twin.record(log, facts=facts, attachments=attachments, beginning=beginning, on_failure=on_failure)

    try:
        # A run that stays the same need not stop amid a step.
        at_ns = change.at_ns // STEP_NS * STEP_NS if same else change.at_ns
        taken = take_up(path, at_ns, None if log is None else start)
        if not same:
            taken.later.clear()
            taken.change(change)
    except BaseException:
        for recorder in filter(None, [twin.recorder for twin in begun]):
            recorder.discard()
        raise
    return taken


def open_log(
    path: Path,
    change: BranchPoint,
    robot: int | None,
    log: Path | None = None,
    *,
    served: bool = False,
    on_failure: Callable[[str], None] | None = None,
) -> Twin:
    """Take up the run of a log for other hosts.

    Args:
        path: Path of the log.
        change: Moment, and what is different from then on.
        robot: Index of the robot on the line; None for that of the log.
        log: Path of a new log, which begins as the old one; None for none.
        served: Whether without a robot all of them are on the line.
        on_failure: Function that takes the line about a log that cannot be written any more; None to end.

    Raises:
        KhepTwinError: As `branch_off`; or there is no such robot.
    """
    taken = branch_off(path, change, log, on_failure=on_failure)
    there = range(len(taken.twin.world.robots))
    if robot is None and not served:
        robot = taken.setup.options.robot or 0
    if robot is not None and robot not in there:
        if taken.twin.recorder is not None:
            taken.twin.recorder.discard()
        raise PortError(f"robot = {robot}: not in {path}", key="robot", value=robot, expected=there)
    on_the_line = there if robot is None else [robot]
    for index in on_the_line:
        taken.hosts.replace(index)
    world, options = taken.twin.world, taken.twin.options
    twin = Twin(world, tuple(world.robots[index] for index in on_the_line), options, taken.hosts)
    twin.recorder = taken.twin.recorder
    return twin


def end_of(path: Path) -> int:
    """Return the time at which a logged run ended [ns]: that of its last snapshot, or of its last message.

    Raises:
        LogError: The log cannot be read.
    """
    last, *rest = read_since(path, TOPIC, LATEST_NS)
    end_ns = max((entry.time_ns for entry in last), default=0)
    try:
        for entry in chain(*rest):
            if entry.topic == "/state":
                end_ns = max(end_ns, entry.time_ns + (len(read_states(entry.data)) - 1) * SAMPLE_NS)
    except Misfit as misfit:
        raise misfit.at(path, "/state") from None
    events = events_in(path, rest, read_label(path).robots)
    return max([end_ns, *(time_ns for time_ns, _, _ in events)])


def _logged(path: Path, entry: Entry, scene: str | None) -> LoggedState:
    """Return the state of a message."""
    try:
        return read_snapshot(entry.data, scene)
    except Misfit as misfit:
        raise misfit.at(path, entry.topic, entry.time_ns) from None
    except SnapshotError as error:
        raise LogError(f"{path}: {entry.topic} at {entry.time_ns / NS_PER_S:.4f} s: {error}") from None


def _go_on_in(new: World, old: World, before: Playpen, change: BranchPoint) -> None:
    """Take over the state of a world in another scene; what an edit changes stands where it says.

    Args:
        new: World of the other scene, at its start.
        old: World whose state goes on.
        before: Playpen of the old scene, at its start.
        change: Change of the scene.

    Raises:
        PlaypenError: What was changed has no room.
    """
    stands = as_it_stands(old)
    edited = set_values(stands, change.edits)
    if problem := no_room_for(edited, stands):
        raise PlaypenError(f"{', '.join(change.edits)}: {problem}")
    moved = changed_tables(set_values(before, change.edits), before)
    scene, placed = (new.model, new.data), dict[str, tuple[float, float, float]]()
    for index in moved.pop("robot"):
        entry = edited.robots[index]
        if _pose(entry) != _pose(stands.robots[index]):
            placed[f"khepera{index}/base"] = _pose(entry)
    for kind, indices in moved.items():
        for index in indices:
            if (entry := edited.objects[kind][index]).movable:
                placed[f"{kind}{index}"] = _pose(entry)
    mujoco.mj_resetData(new.model, new.data)
    carry_over((old.model, old.data), scene, list(placed))
    for body, (x_mm, y_mm, heading_deg) in placed.items():
        place(scene, body, metres(x_mm), metres(y_mm), math.radians(heading_deg))
    state = old.state()._replace(physics=physics_state(*scene))
    relit = set_values(before, change.edits)
    new.set_state(state)
    if (relit.lamps, relit.lighting) != (before.lamps, before.lighting):
        new.relight(new.playpen.model_copy(update={"lamps": edited.lamps, "lighting": edited.lighting}))


def _pose(entry: Robot | Block | Cylinder) -> tuple[float, float, float]:
    """Return the position [mm] and heading [deg] of a robot or an object."""
    heading: float = getattr(entry, "heading_deg", getattr(entry, "angle_deg", 0.0))
    return entry.x_mm, entry.y_mm, heading

"""Runs of logs resumed at any moment, to go on with something changed.

A run is resumed from the last snapshot before the moment, or from its start, and what its hosts did is
repeated up to there. Then seed, faults, calibrations or playpen may change; what was edited stands where the
edit says, all else as it was. See `branching` for other hosts.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import mujoco

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, LogError, PlaypenError, SnapshotError
from khep_twin.interventions.move_robot import current_playpen
from khep_twin.log.decoding import LATEST_NS, DecodeError, first_line
from khep_twin.log.entries import Entry, Label
from khep_twin.log.reader import read_label, read_since, read_until
from khep_twin.log.recorded import BranchPoint, read_changes, require_line, order_events
from khep_twin.log.recorder import WorldRecorder
from khep_twin.log.run_description import LogPrefix
from khep_twin.log.snapshots import SNAPSHOT_TOPIC, LoggedState, read_snapshot, read_states
from khep_twin.playpen import Block, Cylinder, Playpen, RobotEntry
from khep_twin.playpen.changes import changed_tables, no_room_for, posed, set_values
from khep_twin.ports.replay import RecordedHosts, Setup
from khep_twin.ports.twin import Twin
from khep_twin.simulation.physics_state import physics_state
from khep_twin.simulation.scene_transfer import place, transfer_state
from khep_twin.units import metres
from khep_twin.world import SAMPLE_NS, World


@dataclass(slots=True)
class ResumedRun:
    """Run that was resumed.

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

        `progress` takes the part of the way that is done, 0 to 1.
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
        """Change the run from now on."""
        self.changes = (*self.changes, change)
        before = self.twin
        if change.faults or change.edits or change.calibrations:
            self.twin = self.setup.open(self.changes)
            # What the compiled scene does not hold, such as a lamp's dimming, is edited as well.
            if not change.edits and self.twin.world.scene == before.world.scene:
                self.twin.world.set_state(before.world.state())
            else:
                take_over_state(self.twin.world, before.world, self.setup.playpen(self.changes[:-1]), change)
            self.twin.world.observers = before.world.observers
            self.twin.recorder = before.recorder
            for observer in self.twin.world.observers:
                if isinstance(observer, WorldRecorder):
                    observer.move_to(self.twin.world)
            self.hosts.twin = self.twin
        if change.seed is not None:
            self.twin.world.reseed(change.seed)
        if change.text:
            self.twin.world.on_event(None, f"branched off, with {change.text}")


def resume_run(
    path: Path,
    at_ns: int,
    start: Callable[[Twin, Label, LogPrefix], None] | None = None,
) -> ResumedRun:
    """Take up the run of a log at a moment, before what was done at that very moment.

    Args:
        path: Path of the log.
        at_ns: Moment [ns].
        start: Function called with the twin before the rest up to the moment, to record it.

    Raises:
        LogError: The log lacks what that needs, or ends before.
    """
    label = read_label(path)
    require_line(path, label)
    # A log's last snapshot may lie at the very moment, after what was done at it.
    setup, pieces = Setup(path, label), read_since(path, SNAPSHOT_TOPIC, at_ns - 1)
    changes, last = read_changes(path, label), next(iter(next(pieces)), None)
    try:
        state = None if last is None else _logged(path, last, None)
        from_ns = 0 if state is None else state.world.time_ns
        if last is not None and last.time_ns != from_ns:
            raise DecodeError(f"a state at {from_ns} ns", "its message's time").to_log_error(path, SNAPSHOT_TOPIC, last.time_ns)
        done = tuple(change for change in changes if last is not None and change.at_ns < from_ns)
        twin = setup.open(done)
        if state is not None and last is not None:
            twin.world.set_state(_logged(path, last, twin.world.scene).world)
        if start is not None:
            begun = () if last is None else read_until(path, last)
            start(twin, label, LogPrefix(begun, state and state.recorder))
        hosts = RecordedHosts(twin, order_events(path, pieces, label.robots))
        resumed = ResumedRun(setup, done, twin, hosts, [*changes[len(done) :]])
        resumed.run_to(at_ns)
        return resumed
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{path}: cannot be resumed: {first_line(error)}") from error


def run_end_ns(path: Path) -> int:
    """Return the time at which a logged run ended [ns]: that of its last snapshot, or of its last message."""
    last, *rest = read_since(path, SNAPSHOT_TOPIC, LATEST_NS)
    end_ns = max((entry.time_ns for entry in last), default=0)
    try:
        for entry in chain(*rest):
            if entry.topic == "/state":
                end_ns = max(end_ns, entry.time_ns + (len(read_states(entry.data)) - 1) * SAMPLE_NS)
    except DecodeError as error:
        raise error.to_log_error(path, "/state") from None
    events = order_events(path, rest, read_label(path).robots)
    return max([end_ns, *(time_ns for time_ns, _, _ in events)])


def _logged(path: Path, entry: Entry, scene: str | None) -> LoggedState:
    """Return the state of a message."""
    try:
        return read_snapshot(entry.data, scene)
    except DecodeError as error:
        raise error.to_log_error(path, entry.topic, entry.time_ns) from None
    except SnapshotError as error:
        raise LogError(f"{path}: {entry.topic} at {entry.time_ns / NS_PER_S:.4f} s: {error}") from None


def take_over_state(new: World, old: World, before: Playpen, change: BranchPoint) -> None:
    """Take over the state of a world in another scene, at its start; what is edited is where the edit says.

    Raises:
        PlaypenError: What was changed has no room.
    """
    stands = current_playpen(old)
    # The poses of now may be outside the arena, where no file may put a thing.
    edited = posed(set_values(old.playpen, change.edits), stands, change.edits)
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
    transfer_state((old.model, old.data), scene, list(placed))
    for body, (x_mm, y_mm, heading_deg) in placed.items():
        place(scene, body, metres(x_mm), metres(y_mm), math.radians(heading_deg))
    state = old.state()._replace(physics=physics_state(*scene))
    relit = set_values(before, change.edits)
    new.set_state(state)
    if (relit.lamps, relit.lighting) != (before.lamps, before.lighting):
        new.set_lamps(edited.lamps, edited.lighting, keep_switched=True)


def _pose(entry: RobotEntry | Block | Cylinder) -> tuple[float, float, float]:
    """Return the position [mm] and heading [deg] of a robot or an object."""
    heading: float = getattr(entry, "heading_deg", getattr(entry, "angle_deg", 0.0))
    return entry.x_mm, entry.y_mm, heading

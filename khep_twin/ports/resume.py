"""Resumption of logged runs at any time, optionally with changes.

A run is resumed from the last snapshot before a time, or from its start, and the recorded actions of its
hosts are repeated up to that time. Then seed, faults, calibrations or playpen may change; edited objects move
to their new poses, all others stay. See `branching` for other hosts.
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
from khep_twin.log.recorded import BranchPoint, order_events, read_changes, require_serial_line
from khep_twin.log.recorder import WorldRecorder
from khep_twin.log.run_description import LogPrefix
from khep_twin.log.snapshots import SNAPSHOT_TOPIC, LoggedState, read_snapshot, read_states
from khep_twin.observers import SAMPLE_NS
from khep_twin.playpen import Block, Cylinder, Playpen, RobotEntry
from khep_twin.playpen.changes import changed_tables, copy_poses, find_new_problem, set_values
from khep_twin.ports.replay import RecordedHosts, Setup
from khep_twin.ports.twin import Twin
from khep_twin.robots.model import robot_name
from khep_twin.simulation.physics_state import physics_state
from khep_twin.simulation.scene_transfer import place_body, transfer_state
from khep_twin.units import metres
from khep_twin.world import World


@dataclass(slots=True)
class ResumedRun:
    """Resumed run.

    Attributes:
        setup: Description of its twin in the log.
        changes: Changes of the run so far.
        twin: Twin at the present time.
        hosts: Recorded hosts.
        upcoming: Later changes of the recorded run.
    """

    setup: Setup
    changes: tuple[BranchPoint, ...]
    twin: Twin
    hosts: RecordedHosts
    upcoming: list[BranchPoint]

    def run_to(
        self,
        end_ns: int,
        progress: Callable[[float], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """Continue the run as recorded to a time [ns], before the actions at exactly that time.

        `progress` is called with the completed fraction, 0 to 1.
        """
        start_ns = self.twin.world.time_ns
        while True:
            now_ns = self.twin.world.time_ns
            while self.upcoming and (self.upcoming[0].at_ns <= now_ns or not self.upcoming[0].text):
                self.change(self.upcoming.pop(0))
            if now_ns >= end_ns or (stop is not None and stop()):
                return
            # A stop at a whole second, between steps, has no effect; within a step it changes event times.
            change_times_ns = [change.at_ns for change in self.upcoming]
            goal_ns = min((now_ns // NS_PER_S + 1) * NS_PER_S, end_ns, *change_times_ns)
            self.hosts.repeat(lambda time_ns, goal_ns=goal_ns: time_ns < goal_ns)
            if goal_ns > self.twin.world.time_ns:
                self.twin.world.advance_to(goal_ns)
            if progress is not None:
                progress((self.twin.world.time_ns - start_ns) / (end_ns - start_ns))

    def change(self, change: BranchPoint) -> None:
        """Apply a change to the run."""
        self.changes = (*self.changes, change)
        old_twin = self.twin
        if change.faults or change.edits or change.calibrations:
            self.twin = self.setup.open(self.changes)
            # Edits also change values that are not in the compiled scene, for example a lamp's dimming.
            if not change.edits and self.twin.world.scene == old_twin.world.scene:
                self.twin.world.set_state(old_twin.world.state())
            else:
                transfer_world(self.twin.world, old_twin.world, self.setup.playpen(self.changes[:-1]), change)
            self.twin.world.observers[:] = old_twin.world.observers
            self.twin.recorder = old_twin.recorder
            for observer in self.twin.world.observers:
                if isinstance(observer, WorldRecorder):
                    observer.move_to(self.twin.world)
            self.hosts.twin = self.twin
        if change.seed is not None:
            self.twin.world.reseed(change.seed)
        if change.text:
            self.twin.world.observers.on_event(None, f"branched off, with {change.text}")


def resume_run(
    path: Path,
    at_ns: int,
    start_log: Callable[[Twin, Label, LogPrefix], None] | None = None,
) -> ResumedRun:
    """Resume the run of a log at a time, before the actions at exactly that time.

    Args:
        path: Path of the log.
        at_ns: Time at which it is resumed [ns].
        start_log: Function called with the twin at the snapshot, to record the run from there.

    Raises:
        LogError: The log lacks necessary records, or ends before.
    """
    label = read_label(path)
    require_serial_line(path, label)
    # A snapshot at exactly that time may be after the actions at that time.
    setup, entry_groups = Setup(path, label), read_since(path, SNAPSHOT_TOPIC, at_ns - 1)
    changes, snapshot = read_changes(path, label), next(iter(next(entry_groups)), None)
    try:
        state = None if snapshot is None else _read_state(path, snapshot, None)
        start_ns = 0 if state is None else state.world.time_ns
        if snapshot is not None and snapshot.time_ns != start_ns:
            error = DecodeError(f"a state at {start_ns} ns", "its message's time")
            raise error.to_log_error(path, SNAPSHOT_TOPIC, snapshot.time_ns)
        past_changes = tuple(change for change in changes if snapshot is not None and change.at_ns < start_ns)
        twin = setup.open(past_changes)
        if state is not None and snapshot is not None:
            twin.world.set_state(_read_state(path, snapshot, twin.world.scene).world)
        if start_log is not None:
            entries = () if snapshot is None else read_until(path, snapshot)
            start_log(twin, label, LogPrefix(entries, state and state.recorder))
        hosts = RecordedHosts(twin, order_events(path, entry_groups, label.robots))
        resumed = ResumedRun(setup, past_changes, twin, hosts, [*changes[len(past_changes) :]])
        resumed.run_to(at_ns)
        return resumed
    except LogError:
        raise
    except KhepTwinError as error:
        raise LogError(f"{path}: cannot be resumed: {first_line(error)}") from error


def run_end_ns(path: Path) -> int:
    """Return the end of a logged run [ns]: the time of its last snapshot or of its last message."""
    snapshot_entries, *later_groups = read_since(path, SNAPSHOT_TOPIC, LATEST_NS)
    end_ns = max((entry.time_ns for entry in snapshot_entries), default=0)
    try:
        for entry in chain(*later_groups):
            if entry.topic == "/state":
                end_ns = max(end_ns, entry.time_ns + (len(read_states(entry.data)) - 1) * SAMPLE_NS)
    except DecodeError as error:
        raise error.to_log_error(path, "/state") from None
    events = order_events(path, later_groups, read_label(path).robots)
    return max([end_ns, *(time_ns for time_ns, _, _ in events)])


def _read_state(path: Path, entry: Entry, scene: str | None) -> LoggedState:
    """Decode the state in a snapshot message."""
    try:
        return read_snapshot(entry.data, scene)
    except DecodeError as error:
        raise error.to_log_error(path, entry.topic, entry.time_ns) from None
    except SnapshotError as error:
        raise LogError(f"{path}: {entry.topic} at {entry.time_ns / NS_PER_S:.4f} s: {error}") from None


def transfer_world(new: World, old: World, old_playpen: Playpen, change: BranchPoint) -> None:
    """Transfer the state of a world to one in another scene, with edited objects at their new poses.

    Raises:
        PlaypenError: A changed object has no room.
    """
    present_playpen = current_playpen(old)
    # Present poses may be outside the arena, which is invalid in a playpen file.
    edited_playpen = copy_poses(set_values(old.playpen, change.edits), present_playpen, change.edits)
    if problem := find_new_problem(edited_playpen, present_playpen):
        raise PlaypenError(f"{', '.join(change.edits)}: {problem}")
    changed_indices = changed_tables(set_values(old_playpen, change.edits), old_playpen)
    scene, new_poses = (new.model, new.data), dict[str, tuple[float, float, float]]()
    for index in changed_indices.pop("robot"):
        entry = edited_playpen.robots[index]
        if _pose(entry) != _pose(present_playpen.robots[index]):
            new_poses[f"{robot_name(index)}/base"] = _pose(entry)
    for kind, indices in changed_indices.items():
        for index in indices:
            if (entry := edited_playpen.objects[kind][index]).movable:
                new_poses[f"{kind}{index}"] = _pose(entry)
    mujoco.mj_resetData(new.model, new.data)
    transfer_state((old.model, old.data), scene, list(new_poses))
    for body, (x_mm, y_mm, heading_deg) in new_poses.items():
        place_body(scene, body, metres(x_mm), metres(y_mm), math.radians(heading_deg))
    state = old.state()
    state = state._replace(
        physics=physics_state(*scene),
        robots=tuple(robot.in_scene(new.data.qpos) for robot in state.robots),
    )
    changed_playpen = set_values(old_playpen, change.edits)
    new.set_state(state)
    if (changed_playpen.lamps, changed_playpen.lighting) != (old_playpen.lamps, old_playpen.lighting):
        new.set_lamps(edited_playpen.lamps, edited_playpen.lighting, keep_switched=True)


def _pose(entry: RobotEntry | Block | Cylinder) -> tuple[float, float, float]:
    """Return the position [mm] and heading [deg] of a robot or an object."""
    heading: float = getattr(entry, "heading_deg", getattr(entry, "angle_deg", 0.0))
    return entry.x_mm, entry.y_mm, heading

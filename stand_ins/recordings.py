"""Stand-in robots: recordings of a robot's line as by a relay, and the truth of each recording.

A twin with hidden differences stands in for a robot: another robot of the same model, faults, and changes
of its world that the playpen does not have. A scripted host asks N and sets speeds, one exchange at a time.
The log NAME.mcap has only the line's bytes, with the times at which a relay forwards them (`line_times`);
NAME.npz has the truth. Simulated time is the only clock, so a recording is the same each time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.fault_injection import parse_fault
from khep_twin.clock import NEVER_NS, to_ns
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import Start, at_spots, at_start, find_obstruction
from khep_twin.randomness import stream
from stand_ins.hidden_changes import Change, LampMoved, reachable
from stand_ins.hosts import HOSTS
from stand_ins.line_times import LineTimes
from stand_ins.runs import Run, converse, noticeable


@dataclass(frozen=True)
class Truth:
    """Truth of a recording.

    A hidden change is noticeable from the first reply on that differs from that of a second world. That world
    has the same seed and gets the same bytes at the same times, but lacks this change. The end of a fault is
    noticeable from the first reply on that differs from that of a world in which the fault continues. A reply
    differs if

    - a count of N or O is off by more than 100 counts and more than 25 % of the larger one, a counter of H by
      more than 100 pulses, in this reply and, in the same channel, in the next to the same command;
    - or it is missing, malformed or of another kind, or its first byte comes more than 10 ms late, or another
      line, for example a banner, precedes it.

    Attributes:
        times_ns: Times of the poses, every 20 ms (n,) [ns].
        poses: x, y [m] and heading [rad] (n, 3).
        start: Pose at the start (3,).
        twin_start: Start pose that the twin knows (3,).
        hidden: Faults and changes, in words (k,).
        changed_ns: Time of each (k,) [ns]; -1 if there was no room for it.
        ended_ns: End of each (k,) [ns]; -1 if it does not end.
        noticeable_ns: Arrival of the first reply that each changes noticeably (k,) [ns]; -1 if none is.
        over_ns: Arrival of the first reply that the end of each changes noticeably, or the end itself of a
            fault of the line (k,) [ns]; -1 if none is, as without an end, and for changes.
    """

    times_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    start: NDArray[np.float64]
    twin_start: NDArray[np.float64]
    hidden: NDArray[np.str_]
    changed_ns: NDArray[np.int64]
    ended_ns: NDArray[np.int64]
    noticeable_ns: NDArray[np.int64]
    over_ns: NDArray[np.int64]

    def save(self, path: Path) -> None:
        """Write the truth as NumPy's .npz."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the truth from the .npz of a log."""
        with np.load(path) as arrays:
            return cls(**{field.name: arrays[field.name] for field in fields(cls)})


def record(
    path: Path,
    playpen: Playpen,
    *,
    seed: int,
    seconds: float,
    host: str,
    asks_counters: bool = False,
    asks_light: bool = False,
    asks_echoes: bool = True,
    vary: bool = True,
    faults: Sequence[str] = (),
    changes: Sequence[Change] = (),
    start: Start | None = None,
    start_error: Start | None = None,
    times: str = "exact",
) -> Truth:
    """Record a run of a stand-in robot; return the truth, which is also saved beside the log.

    Args:
        path: Path of the log, NAME.mcap; the truth goes to NAME.npz.
        playpen: Playpen of one robot, as the twin knows it.
        seed: Seed of the robot, the host and all that is drawn.
        seconds: Length of the recording [s].
        host: Name of the host in `stand_ins.hosts.HOSTS`.
        asks_counters: Also ask H in each cycle.
        asks_light: Also ask O in each cycle.
        asks_echoes: Also ask the distances by ultrasound in each cycle, if the model has them.
        vary: Draw another robot of the same model.
        faults: Faults of the robot, in the syntax of `khep_twin.board.fault_injection`.
        changes: Changes of its world.
        start: Start that the twin knows; by default the playpen's, or a spot drawn by the seed.
        start_error: Error of that, in mm and degrees; drawn within 10 mm and 5 degrees if not given.
        times: Times of the line, one of `stand_ins.line_times.TIMES`.
    """
    twin_playpen = at_spots(playpen, seed) if start is None else at_start(playpen, 0, start)
    actual = _misplaced(twin_playpen, seed, start_error)
    parsed = [parse_fault(fault) for fault in faults]
    run = Run(actual, seed, vary, parsed, changes)
    dialect = playpen.robots[0].robot_model.dialect
    is_asked = {"position": asks_counters, "ambient": asks_light, "ultrasonic": asks_echoes}
    channels = ["proximity", *(name for name in is_asked if is_asked[name] and name in dialect.reads)]
    asks = [dialect.reads[channel].request.encode() + b"\n" for channel in channels]
    settings = {"relay": "stand-in", "baud": dialect.baud}
    recorder = LineRecorder(path, settings, lambda: run.relayed_ns)
    line_times = LineTimes(times, seed)
    exchanges = list(converse(run, recorder, line_times, seed, HOSTS[host], asks, to_ns(seconds)))
    recorder.close()
    starts_ns = [fault.start_ns for fault in parsed]
    ends_ns = [fault.end_ns if fault.has_end else -1 for fault in parsed]
    seen_ns, over_ns = list[int](), [*ends_ns, *[-1] * len(changes)]
    for index in range(len(over_ns)):
        other_faults = [*parsed[:index], *parsed[index + 1 :]]
        without = _without(run.applied_changes, index - len(parsed))
        seen_ns.append(noticeable(exchanges, Run(actual, seed, vary, other_faults, without)))
        if index < len(parsed) and parsed[index].device and parsed[index].has_end:
            lasting = [*parsed[:index], replace(parsed[index], end_ns=NEVER_NS), *parsed[index + 1 :]]
            over_ns[index] = noticeable(exchanges, Run(actual, seed, vary, lasting, run.applied_changes))
    truth = Truth(
        np.array(run.times_ns),
        np.array(run.poses),
        np.array(run.poses[0]),
        np.array(_pose(twin_playpen)),
        np.array(
            [*faults, *(str(run.applied_changes[i] or change) for i, change in enumerate(changes))], np.str_
        ),
        np.array(
            [*starts_ns, *(-1 if change is None else to_ns(change.at_s) for change in run.applied_changes)],
            np.int64,
        ),
        np.array([*ends_ns, *[-1] * len(changes)], np.int64),
        np.array(seen_ns, np.int64),
        np.array(over_ns, np.int64),
    )
    truth.save(path.with_suffix(".npz"))
    return truth


def _without(changes: Sequence[Change | None], index: int) -> list[Change | None]:
    """Return changes without one of them and later moves of its lamp, which may lack room then."""

    def stays(number: int, change: Change | None) -> bool:
        removed_change = changes[index] if index >= 0 else None
        moved = (
            isinstance(removed_change, LampMoved)
            and isinstance(change, LampMoved)
            and change.lamp == removed_change.lamp
        )
        return number != index and not (moved and number > index)

    return [change if stays(number, change) else None for number, change in enumerate(changes)]


def _misplaced(playpen: Playpen, seed: int, error: Start | None) -> Playpen:
    """Return the playpen with its robot off by an error; a drawn one is halved until there is room."""
    entry = playpen.robots[0]
    if error is None:
        rng = stream(seed, "stand-in", "start")
        radius, angle = 10 * math.sqrt(rng.random()), math.tau * rng.random()
        error = radius * math.cos(angle), radius * math.sin(angle), float(rng.uniform(-5, 5))
        while find_obstruction(playpen, 0, entry.x_mm + error[0], entry.y_mm + error[1]):
            error = error[0] / 2, error[1] / 2, error[2]
    return at_start(playpen, 0, (entry.x_mm + error[0], entry.y_mm + error[1], entry.heading_deg + error[2]))


def _pose(playpen: Playpen) -> Start:
    """Return the start of a playpen's robot in metres and radians."""
    entry = playpen.robots[0]
    return entry.x_mm / 1e3, entry.y_mm / 1e3, math.radians(entry.heading_deg)


def free_start(playpen: Playpen, seed: int) -> Start:
    """Return a random start that a robot can reach from the playpen's start."""
    rng = stream(seed, "stand-in", "free start")
    places = reachable(at_spots(playpen, seed))
    return (*places[int(rng.integers(len(places)))], round(float(rng.uniform(-180, 180)), 1))

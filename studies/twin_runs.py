"""Shadows of recorded stand-in robots: what the trials of `studies.twin_trials` look at."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start
from khep_twin.shadow.following import LastingAlarms
from khep_twin.shadow.recording import recorded
from khep_twin.shadow.shadow import Shadow, ShadowSettings, Update
from stand_ins.hidden_changes import Change
from stand_ins.hosts import HOSTS
from stand_ins.recordings import Truth, free_start, record

Floats = NDArray[np.float64]


class Recording(NamedTuple):
    """A recording to be made.

    Attributes:
        name: Name of its files.
        playpen: Name of its playpen.
        seed: Seed of the robot, the host, its start and all that is drawn.
        seconds: Length [s].
        host: Name of the host; by default they alternate, each with three seeds.
        asks_counters: Ask H, too.
        asks_light: Ask O, too.
        faults: Faults of the robot.
        changes: Changes of its world.
    """

    name: str
    playpen: str
    seed: int
    seconds: float
    host: str = ""
    asks_counters: bool = False
    asks_light: bool = False
    faults: Sequence[str] = ()
    changes: Sequence[Change] = ()

    def path(self, folder: Path) -> Path:
        """Return the path of the log; the recording is made unless it is there."""
        path = folder / f"{self.name}_{self.playpen}_{self.seed}_{self.seconds:g}s.mcap"
        if not path.with_suffix(".npz").exists():
            playpen = Playpen.load(self.playpen)
            record(
                path,
                playpen,
                seed=self.seed,
                seconds=self.seconds,
                host=self.host or list(HOSTS)[self.seed // 3 % len(HOSTS)],
                asks_counters=self.asks_counters,
                asks_light=self.asks_light,
                faults=self.faults,
                changes=self.changes,
                start=free_start(playpen, self.seed),
            )
        return path


class Raised(NamedTuple):
    """An alarm that was raised.

    Attributes:
        fault: Name of the fault.
        raised_ns: Time of the reply that raised it [ns].
        ended_ns: Time of the reply that ended it [ns]; -1 if none did.
        readings: Proximity as replied last then (8,) [counts].
    """

    fault: str
    raised_ns: int
    ended_ns: int
    readings: tuple[float, ...]


@dataclass(frozen=True)
class Followed:
    """Updates of a shadow, beside the truth at their times.

    Attributes:
        truth: Truth of the recording.
        times_ns: Times (n,) [ns].
        poses: Estimated x, y [m] and heading [rad] (n, 3).
        actual: Actual ones (n, 3).
        reckoned: Those of dead reckoning (n, 3).
        alarms: Alarms in the order in which they were raised.
        cpu_s: CPU time of each second of the recording (n_seconds,) [s].
    """

    truth: Truth
    times_ns: NDArray[np.int64]
    poses: Floats
    actual: Floats
    reckoned: Floats
    alarms: list[Raised]
    cpu_s: Floats

    def errors(self, poses: Floats) -> Floats:
        """Return the errors of poses: distance [mm] and heading [degrees] (n, 2)."""
        off = poses - self.actual
        turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        return np.stack([np.hypot(off[:, 0], off[:, 1]) * 1e3, np.degrees(turned)], axis=1)


def told_playpen(name: str, truth: Truth) -> Playpen:
    """Return a playpen whose robot stands where the shadow is told."""
    x, y, heading = truth.told.tolist()
    return at_start(Playpen.load(name), 0, (x * 1e3, y * 1e3, float(np.degrees(heading))))


def follow(path: Path, playpen: str, settings: ShadowSettings) -> Followed:
    """Follow a recorded robot by its line alone.

    Args:
        path: Path of the log, with the truth beside it.
        playpen: Name of the playpen.
        settings: Settings of the shadow.
    """
    truth = Truth.load(path.with_suffix(".npz"))
    heard = recorded(path).heard
    shadow = Shadow(told_playpen(playpen, truth), settings)
    updates: list[tuple[int, tuple[float, ...], tuple[float, ...]]] = []
    watch = _Watch()
    cpu_s = np.zeros(heard[-1].time_ns // NS_PER_S + 1)
    for time_ns, to_robot, data in heard:
        began = time.process_time()
        found = shadow.feed(time_ns, to_robot, data)
        cpu_s[time_ns // NS_PER_S] += time.process_time() - began
        for update in found:
            watch.see(update)
            updates.append((update.time_ns, update.estimate.pose, update.reckoned))
    times_ns = np.array([each[0] for each in updates], np.int64)
    return Followed(
        truth,
        times_ns,
        np.array([each[1] for each in updates]),
        _poses_at(truth, times_ns),
        np.array([each[2] for each in updates]),
        watch.raised(),
        cpu_s,
    )


class _Watch:
    """Watch of the alarms of a shadow's updates."""

    def __init__(self) -> None:
        self._alarms = LastingAlarms()
        self._found: dict[tuple[str, int], Raised] = {}

    def see(self, update: Update) -> None:
        """Note the alarms that an update begins and ends."""
        for _, alarm in self._alarms.changes(update.time_ns, update.alarms, update.ended):
            key = alarm.fault, alarm.raised_ns
            if alarm.ended_ns is None:
                self._found[key] = Raised(*key, -1, tuple(update.measured.tolist()))
            else:
                self._found[key] = self._found[key]._replace(ended_ns=update.time_ns)

    def raised(self) -> list[Raised]:
        """Return the alarms in the order in which they were raised."""
        return sorted(self._found.values(), key=lambda each: each.raised_ns)


def _poses_at(truth: Truth, times_ns: NDArray[np.int64]) -> Floats:
    """Return the actual poses at times [ns] (n, 3); headings are not wrapped."""
    headings = np.unwrap(truth.poses[:, 2])
    columns = truth.poses[:, 0], truth.poses[:, 1], headings
    return np.stack([np.interp(times_ns, truth.times_ns, column) for column in columns], axis=1)

"""Shadows of recorded stand-in robots, the data of the trials of `studies.twin_trials`."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NS_PER_S
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start
from khep_twin.shadow.following import Follower, LastingAlarms
from khep_twin.shadow.recording import read_recording
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.update import Update
from stand_ins.hidden_changes import Change
from stand_ins.hosts import hosts_of
from stand_ins.recordings import Truth, free_start, record

Floats = NDArray[np.float64]

LEVELS = 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0
"""Ends of the bins of probabilities."""


class Recording(NamedTuple):
    """Parameters of a recording.

    Attributes:
        name: Name of its files.
        playpen: Name of its playpen.
        seed: Seed of the robot, the host, its start and all other random values.
        seconds: Length [s].
        host: Name of the host; by default those of the seed alternate, each with three seeds.
        asks_counters: Also ask H, or the model's request for counters.
        asks_light: Also ask O.
        asks_echoes: Also ask the distances by ultrasound, if the model has them.
        faults: Faults of the robot.
        changes: Changes of its world.
        times: Timing of its line.
        default_start: True to start at the playpen's start or a spot; False to start anywhere, which the
            shadow knows.
    """

    name: str
    playpen: str
    seed: int
    seconds: float
    host: str = ""
    asks_counters: bool = False
    asks_light: bool = False
    asks_echoes: bool = True
    faults: Sequence[str] = ()
    changes: Sequence[Change] = ()
    times: str = "exact"
    default_start: bool = False

    def path(self, folder: Path) -> Path:
        """Return the path of the log; record it if it does not exist."""
        ways = [self.host.replace(" ", "-"), "own" * self.default_start, self.times.replace("exact", "")]
        words = [self.name, self.playpen, *filter(None, ways), str(self.seed), f"{self.seconds:g}s.mcap"]
        path = folder / "_".join(words)
        if not path.with_suffix(".npz").exists():
            playpen = Playpen.load(self.playpen)
            record(
                path,
                playpen,
                seed=self.seed,
                seconds=self.seconds,
                host=self.host or alternate(hosts_of(self.seed), self.seed // 3),
                asks_counters=self.asks_counters,
                asks_light=self.asks_light,
                asks_echoes=self.asks_echoes,
                faults=self.faults,
                changes=self.changes,
                start=None if self.default_start else free_start(playpen, self.seed),
                times=self.times,
            )
        return path


class AlarmRecord(NamedTuple):
    """An alarm that was raised.

    Attributes:
        fault: Name of the fault.
        raised_ns: Time of the reply that raised it [ns].
        ended_ns: Time of the reply that ended it [ns]; -1 if none did.
        readings: Proximity as replied last then (8,) [counts].
        sureness: How sure it was when it was raised.
    """

    fault: str
    raised_ns: int
    ended_ns: int
    readings: tuple[float, ...]
    sureness: float = 1.0


class SuspicionRecord(NamedTuple):
    """A suspicion whose probability entered a bin of `LEVELS` for the first time.

    Attributes:
        faults: Names that it had then.
        time_ns: Time of the reply [ns].
        probability: Probability then.
        readings: Proximity as replied last then (8,) [counts].
    """

    faults: tuple[str, ...]
    time_ns: int
    probability: float
    readings: tuple[float, ...]


@dataclass(frozen=True)
class ShadowRun:
    """Updates of a shadow, beside the truth at their times.

    Attributes:
        truth: Truth of the recording.
        times_ns: Times (n,) [ns].
        poses: Estimated x, y [m] and heading [rad] (n, 3).
        actual: Actual poses (n, 3).
        reckoned: Poses by dead reckoning (n, 3).
        covariances: Covariances of the estimated poses (n, 3, 3).
        states: States (n,).
        readings: Largest proximity as replied last (n,) [counts].
        alarms: Alarms in the order in which they were raised.
        suspected: Suspicions.
        cpu_s: CPU time of each second of the recording (n_seconds,) [s].
    """

    truth: Truth
    times_ns: NDArray[np.int64]
    poses: Floats
    actual: Floats
    reckoned: Floats
    covariances: Floats
    states: NDArray[np.str_]
    readings: Floats
    alarms: list[AlarmRecord]
    suspected: list[SuspicionRecord]
    cpu_s: Floats

    def errors(self, poses: Floats) -> Floats:
        """Return the errors of poses: distance [mm] and heading [degrees] (n, 2)."""
        off = poses - self.actual
        turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        return np.stack([np.hypot(off[:, 0], off[:, 1]) * 1e3, np.degrees(turned)], axis=1)


def playpen_at_known_start(name: str, truth: Truth) -> Playpen:
    """Return a playpen whose robot stands at the start that the shadow knows."""
    x, y, heading = truth.twin_start.tolist()
    return at_start(Playpen.load(name), 0, (x * 1e3, y * 1e3, float(np.degrees(heading))))


def follow(path: Path, playpen: str, settings: ShadowSettings, start_known: bool = True) -> ShadowRun:
    """Follow a recorded robot by its serial line alone.

    Args:
        path: Path of the log, with the truth beside it.
        playpen: Name of the playpen.
        settings: Settings of the shadow.
        start_known: True to give the shadow the robot's start, False to use that of the playpen.
    """
    truth = Truth.load(path.with_suffix(".npz"))
    chunks, settings = (
        (line := read_recording(path)).chunks,
        replace(settings, baud=line.baud or settings.baud),
    )
    follower = Follower(
        Shadow(playpen_at_known_start(playpen, truth) if start_known else Playpen.load(playpen), settings)
    )
    updates: list[Update] = []
    watch = _Watch()
    cpu_s = np.zeros(chunks[-1].time_ns // NS_PER_S + 1)
    for chunk in chunks:
        began = time.process_time()
        chunk_updates = list(follower.feed(chunk))
        cpu_s[chunk.time_ns // NS_PER_S] += time.process_time() - began
        for update in chunk_updates:
            watch.see(update)
            # Thousands of particles each would fill the memory.
            updates.append(replace(update, particles=np.empty((0, 3))))
    times_ns = np.array([update.time_ns for update in updates], np.int64)
    return ShadowRun(
        truth,
        times_ns,
        np.array([update.estimate.pose for update in updates]),
        poses_at(truth, times_ns),
        np.array([update.reckoned for update in updates]),
        np.array([update.estimate.covariance for update in updates]),
        np.array([str(update.state) for update in updates]),
        np.array([update.measured.max() for update in updates]),
        watch.raised(),
        watch.suspected,
        cpu_s,
    )


_SAME_NS = 5 * NS_PER_S
"""Longest gap within one suspicion [ns]."""


@dataclass
class _LastingSuspicion:
    """A lasting suspicion: its present names, the time of its last update [ns], and its bins."""

    faults: tuple[str, ...]
    seen_ns: int
    bins: set[int]


class _Watch:
    """Watch of the alarms and suspicions of a shadow's updates.

    The probability of a suspicion changes. If it is calibrated, suspicions that enter a bin for the first
    time are right as often as their probability then. Their highest probabilities would not be calibrated.
    """

    def __init__(self) -> None:
        self._alarms = LastingAlarms()
        self._records: dict[tuple[str, int], AlarmRecord] = {}
        self._episodes: list[_LastingSuspicion] = []
        self.suspected: list[SuspicionRecord] = []

    def see(self, update: Update) -> None:
        """Record the alarms that an update raises and ends, and its suspicions."""
        readings = tuple(update.measured.tolist())
        for _, alarm in self._alarms.changes(update.time_ns, update.alarms, update.ended):
            key = alarm.fault, alarm.raised_ns
            if alarm.ended_ns is None:
                self._records[key] = AlarmRecord(*key, -1, readings, alarm.sureness)
            else:
                self._records[key] = self._records[key]._replace(ended_ns=update.time_ns)
        for suspicion in update.suspected:
            episode = self._episode(suspicion.faults, update.time_ns)
            level = int(np.searchsorted(LEVELS, suspicion.probability, "right"))
            if level not in episode.bins:
                episode.bins.add(level)
                record = SuspicionRecord(suspicion.faults, update.time_ns, suspicion.probability, readings)
                self.suspected.append(record)

    def raised(self) -> list[AlarmRecord]:
        """Return the alarms in the order in which they were raised."""
        return sorted(self._records.values(), key=lambda alarm: alarm.raised_ns)

    def _episode(self, faults: tuple[str, ...], time_ns: int) -> _LastingSuspicion:
        """Return the episode that has one of these names, or a new one."""
        self._episodes = [candidate for candidate in self._episodes if time_ns - candidate.seen_ns < _SAME_NS]
        episode = next(
            (candidate for candidate in self._episodes if set(candidate.faults) & set(faults)), None
        )
        if episode is None:
            self._episodes.append(episode := _LastingSuspicion(faults, time_ns, set()))
        episode.faults, episode.seen_ns = faults, time_ns
        return episode


def alternate(names: Sequence[str], number: int) -> str:
    """Return the name for a number, by turns."""
    return names[number % len(names)]


def poses_at(truth: Truth, times_ns: NDArray[np.int64]) -> Floats:
    """Return the actual poses at times [ns] (n, 3); headings are not wrapped."""
    headings = np.unwrap(truth.poses[:, 2])
    columns = truth.poses[:, 0], truth.poses[:, 1], headings
    return np.stack([np.interp(times_ns, truth.times_ns, column) for column in columns], axis=1)

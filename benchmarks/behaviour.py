"""Behaviour of the twin beside that of a world of sampled tables: `python -m benchmarks.behaviour`.

The same controllers run in both from the same poses, near a wall, a cylinder or a lamp. Deviations of the
twin from the tables, root mean square and worst, without noise and with it; the floor is the deviation of
the world of tables from itself, its noise drawn twice. "Motion" is the twin with the tables' readings, which
tells what is not due to its sensors. Beside them are worlds with the responses of other simulators. The
tables are found as in `benchmarks.infrared_fits`; the twin is the calibration `khepera1`.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.behaviour_controllers import (
    avoider,
    light_follower,
    light_stop,
    networks,
    proportional_stop,
    threshold_stop,
    wall_follower,
)
from benchmarks.infrared_fits import reference, sampled
from benchmarks.infrared_picture import PEERS
from benchmarks.lamp_fits import sampled_lamp
from benchmarks.one_object import (
    CYLINDER,
    LAMP,
    PERIOD_S,
    WALL,
    Controller,
    Floats,
    Readings,
    Thing,
    Track,
    TwinWorld,
    run,
)
from benchmarks.sampled_world import Kinematics, SampledWorld, Samples, along_axes, one_sense, table_readings
from khep_twin.units import BODY_RADIUS

Deviation = Callable[[Track, Track], Floats]
"""Function of two tracks that returns a number for each robot (n,); NaN for one that does not count."""

ARRIVED = 0.02
"""Distance from the robot's edge to the bulb's glass at which it has arrived at a lamp [m]."""

NEAREST = 0.005
"""Distance of the nearest samples of wall and cylinder [m]."""

EVOROBOT = "nearest sample (evorobot)"
"""Name of the world that reads the table as evorobot's simulator does."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A controller, its starts, and what is compared.

    Attributes:
        thing: Object.
        controller: Controller.
        starts: Start poses (n, 3) [m, rad].
        seconds: Duration [s].
        measures: Deviations by name; the name ends with its unit in brackets.
    """

    thing: Thing
    controller: Controller
    starts: Floats
    seconds: float
    measures: Mapping[str, Deviation]


@dataclass(frozen=True, slots=True)
class Row:
    """Deviations of one measure, root mean square and worst.

    Attributes:
        thing: Name of the object.
        measure: Name of the measure, with its unit.
        controller: Name of the controller.
        count: Number of robots.
        quiet: Twin less tables, both without noise.
        motion: The same for the twin with the tables' readings: what is not due to its sensors.
        noisy: Twin less tables, both with noise.
        floor: Tables less themselves, their noise drawn twice.
        peers: Worlds with other responses less tables, without noise.
    """

    thing: str
    measure: str
    controller: str
    count: int
    quiet: tuple[float, float]
    motion: tuple[float, float]
    noisy: tuple[float, float]
    floor: tuple[float, float]
    peers: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])


def stopping(track: Track, other: Track) -> Floats:
    """Return how much farther from the object a robot stops, mean of the last half second [mm]."""
    last = round(0.5 / PERIOD_S)
    return (track.gaps[-last:].mean(axis=0) - other.gaps[-last:].mean(axis=0)) * 1e3


def turning(track: Track, other: Track) -> Floats:
    """Return how much farther left a robot turns from its start to its end [deg]."""
    return np.degrees(track.poses[-1, :, 2] - other.poses[-1, :, 2])


def apart(track: Track, other: Track) -> Floats:
    """Return the distance between two paths at the same time, root mean square [mm].

    It ends where one of the two is nearer than any sample (`NEAREST`): tables tell nothing there.
    """
    squares = ((track.poses[..., :2] - other.poses[..., :2]) ** 2).sum(axis=-1)
    before = np.logical_and.accumulate((track.gaps >= NEAREST) & (other.gaps >= NEAREST))
    return np.sqrt((squares * before).sum(axis=0) / before.sum(axis=0)) * 1e3


def following(track: Track, other: Track) -> Floats:
    """Return how much farther from the object a robot drives in the second half, on average [mm]."""
    half = len(track.gaps) // 2
    return (track.gaps[half:].mean(axis=0) - other.gaps[half:].mean(axis=0)) * 1e3


def arriving(track: Track, other: Track) -> Floats:
    """Return how much later a robot arrives [s]; one that does not is taken to arrive at the end."""
    times = [
        np.where(near.any(axis=0), near.argmax(axis=0), len(near)) * PERIOD_S
        for near in (track.gaps < ARRIVED, other.gaps < ARRIVED)
    ]
    return times[0] - times[1]


def trials() -> list[Trial]:
    """Return all trials."""
    found: list[Trial] = []
    stop: dict[str, Deviation] = {"stopping distance [mm]": stopping}
    path: dict[str, Deviation] = {"path [mm]": apart}
    for thing in (WALL, CYLINDER):
        ahead = heading_for(thing, 60, np.arange(-60, 61, 10) if thing is WALL else np.arange(-12, 13, 2))
        back = heading_for(thing, 60, np.arange(140, 221, 10) if thing is WALL else np.arange(172, 189, 2))
        found += [Trial(thing, threshold_stop(level), ahead, 5.0, stop) for level in (300, 900)]
        found.append(Trial(thing, threshold_stop(600, -1), back, 4.0, stop))
        found.append(Trial(thing, proportional_stop(), ahead, 6.0, stop))
        offsets = np.arange(-60, 61, 5) if thing is WALL else np.arange(-30, 31, 2.5)
        away = heading_for(thing, 60, offsets)
        found.append(Trial(thing, avoider(), away, 3.0, {"turn [deg]": turning, **path}))
        for side, sign in (("right", 1), ("left", -1)):
            along = np.concatenate(
                [heading_for(thing, gap, sign * np.arange(75, 106, 10)) for gap in (8, 15, 22)]
            )
            measures: dict[str, Deviation] = {"following distance [mm]": following, **path}
            found.append(Trial(thing, wall_follower(side), along, 6.0, measures))
        around = np.concatenate([heading_for(thing, gap, np.arange(0, 360, 45)) for gap in (12, 24)])
        found += [Trial(thing, each, around, 4.0, path) for each in networks(4)]
    around = np.concatenate([heading_for(LAMP, gap, np.arange(-120, 121, 30)) for gap in (150, 300)])
    found.append(Trial(LAMP, light_stop(), around, 9.0, stop))
    found.append(Trial(LAMP, light_follower(), around, 1.5, {"turn [deg]": turning}))
    arrival: dict[str, Deviation] = {"arrival [s]": arriving, **path}
    found.append(Trial(LAMP, light_follower(), around, 9.0, arrival))
    around = np.concatenate([heading_for(LAMP, gap, np.arange(0, 360, 45)) for gap in (120, 240)])
    return [*found, *(Trial(LAMP, each, around, 4.0, path) for each in networks(4))]


def heading_for(thing: Thing, gap_mm: float, offsets_deg: Floats) -> Floats:
    """Return poses before an object, heading so much to the left of it (n, 3)."""
    away = gap_mm / 1e3 + BODY_RADIUS + thing.radius
    offsets = np.radians(np.asarray(offsets_deg, np.float64))
    return np.column_stack([np.full(len(offsets), -away), np.zeros(len(offsets)), offsets])


def tables(folder: Path) -> dict[Thing, Samples]:
    """Return the tables of the sampled robot."""
    wall, cylinder = (Samples(each.distances, each.bearings, each.counts) for each in sampled(folder))
    distances, lamp = sampled_lamp(folder)
    bearings = np.arctan2(lamp.positions[:, 1], lamp.positions[:, 0])
    # Light falls off too steeply from one distance to the next to be smoothed along it.
    return {WALL: wall, CYLINDER: cylinder, LAMP: Samples(distances, bearings, lamp.counts, (1, 7))}


def motor_table(folder: Path) -> Kinematics:
    """Return the kinematics of the sampled robot."""
    path = folder / "data" / "evorobot_motor_table.csv"
    return Kinematics.of_table(np.genfromtxt(path, delimiter=",", skip_header=1))


def judge(
    samples: Mapping[Thing, Samples], kinematics: Kinematics, chosen: Sequence[Trial], seed: int = 0
) -> list[Row]:
    """Run trials in all worlds; return a row for each of their measures."""
    things = list(dict.fromkeys(trial.thing for trial in chosen))
    twins = {(thing, noise): TwinWorld(thing, noise=noise, seed=seed) for thing in things for noise in (0, 1)}
    rows: list[Row] = []
    for trial in chosen:
        thing, table = trial.thing, samples[trial.thing]
        away = partial(
            run, thing=thing, controller=trial.controller, starts=trial.starts, seconds=trial.seconds
        )

        def sampled_track(
            readings: Readings, thing: Thing = thing, away: Callable[..., Track] = away
        ) -> Track:
            return away(SampledWorld(thing, readings, kinematics))

        quiet = sampled_track(table_readings(thing, table))
        first, again = (sampled_track(table_readings(thing, table, 2 * seed + each)) for each in (0, 1))
        still, shaken = (away(twins[thing, noise]) for noise in (0, 1))
        moved = away(TwinWorld(thing, readings=table_readings(thing, table)))
        peers = {name: sampled_track(readings) for name, readings in peer_readings(thing, table).items()}
        pairs = (still, quiet), (moved, quiet), (shaken, first), (again, first)
        for name, measure in trial.measures.items():
            rows.append(
                Row(
                    thing.name,
                    name,
                    trial.controller.name,
                    len(trial.starts),
                    *(_both(measure(*pair)) for pair in pairs),
                    {peer: _both(measure(track, quiet)) for peer, track in peers.items()},
                )
            )
    return rows


def peer_readings(thing: Thing, table: Samples) -> dict[str, Readings]:
    """Return the readings of other simulators; of a lamp, only those of evorobot."""
    nearest = one_sense(thing, table.nearest)
    if not thing.solid:
        return {EVOROBOT: nearest}
    curves = {
        name: along_axes(
            thing, lambda lengths, at=at, counts=counts: np.interp(lengths * 1e3, at, counts, right=0)
        )
        for name, (at, counts) in PEERS.items()
    }
    return {EVOROBOT: nearest, **curves}


def pooled(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each object and measure, over all vehicles, and one over all networks."""
    groups: dict[tuple[str, str, bool], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.thing, row.measure, row.controller.startswith("network")), []).append(row)

    def over(group: Sequence[Row], values: Callable[[Row], tuple[float, float]]) -> tuple[float, float]:
        count = sum(row.count for row in group)
        square = sum(values(row)[0] ** 2 * row.count for row in group) / count
        return math.sqrt(square), max((values(row)[1] for row in group), key=abs)

    return [
        Row(
            thing,
            measure,
            f"{len(group)} {'networks' if random else 'vehicles'}" if len(group) > 1 else group[0].controller,
            sum(row.count for row in group),
            over(group, lambda row: row.quiet),
            over(group, lambda row: row.motion),
            over(group, lambda row: row.noisy),
            over(group, lambda row: row.floor),
            {peer: over(group, lambda row, peer=peer: row.peers[peer]) for peer in group[0].peers},
        )
        for (thing, measure, random), group in groups.items()
    ]


def text(rows: Sequence[Row]) -> str:
    """Return a table of rows."""
    lines = [f"{'':58}{'n':>5}{'no noise':>16}{'motion':>16}{'noise':>16}{'floor':>16}   peers, no noise"]
    for row in rows:
        numbers = "".join(
            f"{rms:9.3g}{worst:7.3g}" for rms, worst in (row.quiet, row.motion, row.noisy, row.floor)
        )
        peers = ", ".join(f"{name} {rms:.3g}" for name, (rms, _) in row.peers.items())
        lines.append(f"{row.thing:10}{row.measure:25}{row.controller:23}{row.count:5}{numbers}   {peers}")
    return "\n".join(lines)


def _both(deviations: Floats) -> tuple[float, float]:
    """Return root mean square and worst."""
    return float(np.sqrt(np.mean(deviations**2))), float(deviations[np.abs(deviations).argmax()])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="seed of all noise")
    parser.add_argument("--odometry", action="store_true", help="move by the twin's own pulse and wheel base")
    given = parser.parse_args(arguments)
    folder, begun = reference(), time.perf_counter()
    rows = judge(
        tables(folder), Kinematics() if given.odometry else motor_table(folder), trials(), given.seed
    )
    print("deviations from the world of sampled tables, rms and worst; floor: its noise drawn twice")
    print(text(rows))
    print("\nall controllers")
    print(text(pooled(rows)))
    print(f"\n{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    sys.exit(main())

"""Comparison of the twin's behaviour with that of a world of sampled tables.

The same controllers run in both from the same poses, near a wall, a cylinder or a lamp. The study prints
deviations of the twin from the tables, root mean square and worst, without and with noise. The floor is the
deviation between two runs in the world of tables with different noise. "Motion" is the twin with the tables'
readings: its deviations are not due to its sensors. Further columns have worlds with the responses of other
simulators. The tables are located as in `studies.infrared_fits`; the twin is the calibration `khepera1`.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from studies.behaviour_trials import Trial, trials
from studies.infrared_fits import reference, sampled
from studies.infrared_picture import PEERS
from studies.lamp_fits import sampled_lamp
from studies.one_object import CYLINDER, LAMP, WALL, Floats, Readings, Target, Track, TwinWorld, run
from studies.sampled_world import Kinematics, SampledWorld, Samples, along_axes, one_sense, table_readings
from tools.command_table import command_line

EVOROBOT = "nearest sample (evorobot)"
"""Name of the world that reads the table as evorobot's simulator does."""


@dataclass(frozen=True, slots=True)
class Row:
    """Deviations of one measure, root mean square and worst.

    Attributes:
        target: Name of the object.
        measure: Name of the measure, with its unit.
        controller: Name of the controller.
        count: Number of robots.
        quiet: Twin less tables, both without noise.
        motion: The same for the twin with the tables' readings: deviations that its sensors do not cause.
        noisy: Twin less tables, both with noise.
        floor: Difference of two runs with the tables, with different noise.
        peers: Worlds with other responses less tables, without noise.
    """

    target: str
    measure: str
    controller: str
    count: int
    quiet: tuple[float, float]
    motion: tuple[float, float]
    noisy: tuple[float, float]
    floor: tuple[float, float]
    peers: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])


def tables(folder: Path) -> dict[Target, Samples]:
    """Return the tables of the sampled robot."""
    wall, cylinder = (Samples(table.distances, table.bearings, table.counts) for table in sampled(folder))
    distances, lamp = sampled_lamp(folder)
    _, bearings = lamp.placement.object_positions()
    # Light falls off too steeply from one distance to the next to be smoothed along it.
    return {WALL: wall, CYLINDER: cylinder, LAMP: Samples(distances, bearings, lamp.counts, (1, 7))}


def motor_table(folder: Path) -> Kinematics:
    """Return the kinematics of the sampled robot."""
    path = folder / "data" / "evorobot_motor_table.csv"
    return Kinematics.of_table(np.genfromtxt(path, delimiter=",", skip_header=1))


def judge(
    samples: Mapping[Target, Samples], kinematics: Kinematics, chosen: Sequence[Trial], seed: int = 0
) -> list[Row]:
    """Run trials in all worlds; return a row for each of their measures."""
    targets = list(dict.fromkeys(trial.target for trial in chosen))
    noises = False, True
    twins = {
        (target, noise): TwinWorld(target, noise=noise, seed=seed) for target in targets for noise in noises
    }
    rows: list[Row] = []
    for trial in chosen:
        target, table = trial.target, samples[trial.target]
        run_trial = partial(
            run, target=target, controller=trial.controller, starts=trial.starts, seconds=trial.seconds
        )

        def sampled_track(
            readings: Readings, target: Target = target, run_trial: Callable[..., Track] = run_trial
        ) -> Track:
            return run_trial(SampledWorld(target, readings, kinematics))

        table_track = sampled_track(table_readings(target, table))
        noisy_track, repeat_track = (
            sampled_track(table_readings(target, table, 2 * seed + offset)) for offset in (0, 1)
        )
        twin_track, noisy_twin_track = (run_trial(twins[target, noise]) for noise in noises)
        motion_track = run_trial(TwinWorld(target, readings=table_readings(target, table)))
        peers = {name: sampled_track(readings) for name, readings in peer_readings(target, table).items()}
        pairs = (
            (twin_track, table_track),
            (motion_track, table_track),
            (noisy_twin_track, noisy_track),
            (repeat_track, noisy_track),
        )
        for name, measure in trial.measures.items():
            rows.append(
                Row(
                    target.name,
                    name,
                    trial.controller.name,
                    len(trial.starts),
                    *(_rms_and_worst(measure(*pair)) for pair in pairs),
                    {peer: _rms_and_worst(measure(track, table_track)) for peer, track in peers.items()},
                )
            )
    return rows


def peer_readings(target: Target, table: Samples) -> dict[str, Readings]:
    """Return the readings of other simulators; of a lamp, only those of evorobot."""
    nearest = one_sense(target, table.nearest)
    if not target.solid:
        return {EVOROBOT: nearest}
    curves = {
        name: along_axes(
            target, lambda lengths, at=at, counts=counts: np.interp(lengths * 1e3, at, counts, right=0)
        )
        for name, (at, counts) in PEERS.items()
    }
    return {EVOROBOT: nearest, **curves}


def pooled(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each object and measure, over all vehicles, and one over all networks."""
    groups: dict[tuple[str, str, bool], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.target, row.measure, row.controller.startswith("network")), []).append(row)

    def combine(group: Sequence[Row], values: Callable[[Row], tuple[float, float]]) -> tuple[float, float]:
        count = sum(row.count for row in group)
        square = sum(values(row)[0] ** 2 * row.count for row in group) / count
        return math.sqrt(square), max((values(row)[1] for row in group), key=abs)

    return [
        Row(
            target,
            measure,
            f"{len(group)} {'networks' if random else 'vehicles'}" if len(group) > 1 else group[0].controller,
            sum(row.count for row in group),
            combine(group, lambda row: row.quiet),
            combine(group, lambda row: row.motion),
            combine(group, lambda row: row.noisy),
            combine(group, lambda row: row.floor),
            {peer: combine(group, lambda row, peer=peer: row.peers[peer]) for peer in group[0].peers},
        )
        for (target, measure, random), group in groups.items()
    ]


def text(rows: Sequence[Row]) -> str:
    """Return a table of rows."""
    lines = [f"{'':58}{'n':>5}{'no noise':>16}{'motion':>16}{'noise':>16}{'floor':>16}   peers, no noise"]
    for row in rows:
        numbers = "".join(
            f"{rms:9.3g}{worst:7.3g}" for rms, worst in (row.quiet, row.motion, row.noisy, row.floor)
        )
        peers = ", ".join(f"{name} {rms:.3g}" for name, (rms, _) in row.peers.items())
        lines.append(f"{row.target:10}{row.measure:25}{row.controller:23}{row.count:5}{numbers}   {peers}")
    return "\n".join(lines)


def _rms_and_worst(deviations: Floats) -> tuple[float, float]:
    """Return root mean square and worst."""
    return float(np.sqrt(np.mean(deviations**2))), float(deviations[np.abs(deviations).argmax()])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command_line(__doc__)
    parser.add_argument("--seed", type=int, default=0, help="seed of all noise")
    parser.add_argument("--odometry", action="store_true", help="move by the twin's own pulse and wheel base")
    options = parser.parse_args(arguments)
    folder, start_s = reference(), time.perf_counter()
    rows = judge(
        tables(folder), Kinematics() if options.odometry else motor_table(folder), trials(), options.seed
    )
    print("deviations from the world of sampled tables, rms and worst; floor: its noise drawn twice")
    print(text(rows))
    print("\nall controllers")
    print(text(pooled(rows)))
    print(f"\n{time.perf_counter() - start_s:.0f} s")

"""Twenty robots that gather, by their infrared sensors alone; one or two minutes on two cores.

    .venv/bin/python examples/06_aggregation.py --picture aggregation.png

After the rules of cockroaches that Garnier et al. (2008, Artificial Life 14) gave to small robots: a robot
moves at random, rests where it meets another one, and rests longer with more robots around it. The numbers
are ours. A wall is bright and wide: three sensors or more detect it from 25 mm on. Another robot is dark and
round: one or two sensors detect it when it is near. Each robot has a separate host program on its serial
line, all of them in lock-step. The seed determines the result.

A cluster is a set of robots that are linked by gaps of at most 15 mm from shell to shell.
"""

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from khep_twin import Khepera, Playpen, TwinOptions, read_log
from khep_twin.drawing import save
from khep_twin.files import unusable
from khep_twin.lab.experiment import run_together
from khep_twin.randomness import stream
from khep_twin.units import BODY_RADIUS

parser = argparse.ArgumentParser(description="Let twenty robots gather.")
parser.add_argument("--seconds", type=float, default=600.0, help="simulated duration")
parser.add_argument("--robots", type=int, default=20, help="number of robots, of the playpen's 20")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--picture", type=Path, help="draw start, end, and the clusters over time to this file")
options = parser.parse_args()
if options.picture is not None and (reason := unusable(options.picture)):
    parser.error(f"{options.picture}: cannot be written: {reason}")

PERIOD = 0.1  # of the rules [s]
SPEED = 8  # of the wheels [pulses/10 ms]
DETECTION, NEAR = 100, 500  # counts of a sensor that detects an object, and of one near an object
LEAVING = 2.0  # chance per second to leave, for a resting robot that detects nothing
STAYING = 0.15  # factor of that chance for each sensor that detects an object
GAP = 0.015  # largest gap between robots of a cluster [m]


def gather(index: int, robot: Khepera) -> None:
    """Follow the rules until the end."""
    rng = stream(options.seed, "aggregation", index)
    is_resting, turn_until, turn = False, 0.0, 0
    while robot.time < options.seconds:
        proximity = robot.proximity()
        detections = [count > DETECTION for count in proximity]
        if is_resting:
            if rng.random() < LEAVING * STAYING ** sum(detections) * PERIOD:
                is_resting, turn_until = False, robot.time + rng.uniform(0.4, 1.2)
                turn = int(rng.choice([-SPEED, SPEED]))
        elif robot.time < turn_until:
            pass
        elif max(proximity[1:5]) > NEAR and sum(detections[:6]) <= 2:  # a robot ahead
            is_resting = True
        elif sum(detections[:6]) > 2:  # a wall
            turn = SPEED if sum(proximity[:3]) < sum(proximity[3:6]) else -SPEED
            turn_until = robot.time + rng.uniform(0.2, 0.8)
        elif rng.random() < 0.5 * PERIOD:  # once in a while
            turn = int(rng.choice([-SPEED, SPEED]))
            turn_until = robot.time + rng.uniform(0.1, 0.5)
        if is_resting:
            robot.set_speed(0, 0)
        elif robot.time < turn_until:
            robot.set_speed(-turn, turn)
        else:
            robot.set_speed(SPEED, SPEED)
        robot.sleep(PERIOD)


def clusters(places: np.ndarray) -> list[list[int]]:
    """Return the clusters of robots at some places (n, 2) [m], the largest first."""
    gaps = np.hypot(*(places[:, None] - places[None]).T) - 2 * BODY_RADIUS
    unvisited, components = set(range(len(places))), list[list[int]]()
    while unvisited:
        cluster, fresh = list[int](), [min(unvisited)]
        while fresh:
            robot = fresh.pop()
            if robot in unvisited:
                unvisited.remove(robot)
                cluster.append(robot)
                fresh += [other for other in sorted(unvisited) if gaps[robot, other] <= GAP]
        components.append(sorted(cluster))
    return sorted(components, key=len, reverse=True)


scene = Playpen.load("swarm")
scene = scene.model_copy(update={"robots": scene.robots[: options.robots]})
began = time.monotonic()
with tempfile.TemporaryDirectory() as folder:
    log = Path(folder) / "swarm.mcap"
    scripts = [partial(gather, index) for index in range(len(scene.robots))]
    run_together(scene, scripts, TwinOptions(seed=options.seed, log=str(log)))
    tracks = list(read_log(log).robots.values())
times = tracks[0].times_ns / 1e9
poses = np.stack([track.pose[:, :2] for track in tracks], axis=1)[::50]  # each second (n, n_robots, 2) [m]
times = times[::50]
sizes = [[len(cluster) for cluster in clusters(places)] for places in poses]
print("time, s   largest cluster   in clusters   clusters")
for second, cluster_sizes in zip(times, sizes, strict=True):
    several = [size for size in cluster_sizes if size > 1]
    if round(second) % 30 == 0:
        print(f"{second:7.0f}{cluster_sizes[0]:18}{sum(several):14}{len(several):11}")
print(f"{times[-1]:.0f} s of {len(tracks)} robots in {time.monotonic() - began:.0f} s")


def show(axes: Axes, places: np.ndarray, title: str) -> None:
    """Draw the arena with robots at some places (n, 2) [m]; those in clusters are dark."""
    linked = {robot for cluster in clusters(places) if len(cluster) > 1 for robot in cluster}
    axes.add_patch(Polygon(np.array(scene.arena.outline_mm), fill=False))
    for robot, place in enumerate(places):
        colour = "tab:blue" if robot in linked else "lightsteelblue"
        axes.add_patch(Circle(tuple(1000 * place), 1000 * BODY_RADIUS, color=colour, lw=0))
    axes.set(title=title, aspect="equal", xlim=(-10, 1010), ylim=(-10, 1010))
    axes.axis("off")


if options.picture:
    figure = Figure(figsize=(9, 3), layout="constrained")
    first, last, graph = figure.subplots(1, 3)
    show(first, poses[0], "start")
    show(last, poses[-1], f"after {times[-1]:.0f} s")
    graph.plot(
        times,
        [sum(size for size in cluster_sizes if size > 1) for cluster_sizes in sizes],
        color="lightsteelblue",
    )
    graph.plot(times, [cluster_sizes[0] for cluster_sizes in sizes], color="tab:blue")
    graph.legend(["robots in clusters", "largest cluster"], frameon=False)
    graph.set(xlabel="time [s]", ylabel="robots", ylim=(0, len(tracks)), yticks=range(0, len(tracks) + 1, 5))
    save(figure, options.picture)

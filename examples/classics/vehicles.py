"""Braitenberg's vehicles 2a, 2b, 3a and 3b (1984): four behaviours towards a lamp from four sets of weights.

    .venv/bin/python examples/classics/vehicles.py --picture vehicles.png

The light of three receivers on each side excites (2) or inhibits (3) the motor of the same side (a) or of the
other side (b). Each vehicle starts about 350 mm from a lamp on a post, looking roughly at it, many times;
episodes run in MuJoCo at the default time step. The picture has the paths of all four from two starts.
"""

import argparse
from pathlib import Path

import numpy as np
from trajectories import trajectories

from khep_twin import EpisodeSetup, Network, playpen
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.files import unusable
from khep_twin.randomness import stream

parser = argparse.ArgumentParser(description="Drive Braitenberg's vehicles 2a, 2b, 3a and 3b near a lamp.")
parser.add_argument("--starts", type=int, default=40, help="episodes of each vehicle")
parser.add_argument("--seconds", type=float, default=7.0, help="duration of an episode")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--picture", type=Path, help="draw the paths to this PNG, SVG or PDF file")
options = parser.parse_args()
if options.picture is not None and (reason := unusable(options.picture)):
    parser.error(f"{options.picture}: cannot be written: {reason}")

LAMP_MM = np.array((700.0, 550.0))
ARENA = playpen.parse(
    """
    version = 1
    name = "vehicles"
    arena = { width_mm = 1400, height_mm = 1100 }

    [[cylinder]]
    name = "post"
    x_mm = 700
    y_mm = 550
    radius_mm = 8
    height_mm = 30

    [[lamp]]
    x_mm = 700
    y_mm = 550
    z_mm = 45
    power_w = 4

    [[robot]]
    x_mm = 360
    y_mm = 450
    heading_deg = 0
    """,
    "the arena of the vehicles",
)
TOUCHING_MM = 40.0
"""Distance between the robot's and the post's centres at which they touch: 27.5 and 8 mm, and sensors."""

SAMPLE_S = 0.1
NETWORK = Network(ambient=True)
"""Direct connections; a motor's speed is 160 mm/s times the hyperbolic tangent of its sum."""


def weights(base: float, same_side: float, other_side: float) -> np.ndarray:
    """Return the genes of a vehicle.

    Args:
        base: Sum of each motor in the dark.
        same_side: Weight of the mean light of the motor's side, three receivers.
        other_side: Weight of the mean light of the other side.
    """
    motors = np.zeros((2, 1 + 8 + 8))  # bias, proximity, light
    motors[:, 0] = base
    left, right = slice(9, 12), slice(12, 15)
    motors[0, left] = motors[1, right] = same_side / 3
    motors[0, right] = motors[1, left] = other_side / 3
    return motors.ravel()


VEHICLES = {
    "2a": ("fear", weights(0.15, 2.0, 0.0)),
    "2b": ("aggression", weights(0.15, 0.0, 2.0)),
    "3a": ("love", weights(0.5, -1.5, 0.0)),
    "3b": ("exploration", weights(0.5, 0.0, -1.5)),
}

setup = EpisodeSetup(ARENA)
rng = stream(options.seed, "vehicles")
starts = [
    (*(LAMP_MM + 350 * np.array((np.cos(angle), np.sin(angle)))), np.degrees(angle) + heading)
    for angle, heading in rng.uniform((-np.pi, 120), (np.pi, 240), (options.starts, 2))
]
print(f"means of {options.starts} episodes of {options.seconds:g} s, begun 350 mm from the lamp")
print("vehicle          touch the post   nearest   at the end   lamp's bearing    top speed at a distance of")
for name, (feeling, genes) in VEHICLES.items():
    poses = trajectories(setup, NETWORK, genes, starts, options.seconds, first_seed=options.seed)
    to_lamp = LAMP_MM - poses[..., :2]
    distances = np.hypot(to_lamp[..., 0], to_lamp[..., 1])
    steps = np.diff(poses[..., :2], axis=1)
    speeds = np.hypot(steps[..., 0], steps[..., 1]) / SAMPLE_S
    bearings = np.arctan2(to_lamp[:, -1, 1], to_lamp[:, -1, 0]) - poses[:, -1, 2]
    nearest, fastest = distances.min(axis=1), speeds.argmax(axis=1)
    print(
        f"{name} {feeling:12}"
        f"{(nearest < TOUCHING_MM).mean():15.0%}"
        f"{nearest.mean():7.0f} mm"
        f"{distances[:, -1].mean():10.0f} mm"
        f"{np.degrees(np.abs((bearings + np.pi) % (2 * np.pi) - np.pi)).mean():13.0f} deg"
        f"{speeds.max(axis=1).mean():8.0f} mm/s"
        f"{distances[np.arange(len(speeds)), fastest].mean():11.0f} mm"
    )

if options.picture:
    tracks = []
    for start in ((360, 450, 0), (1040, 650, 180)):
        for name, (feeling, genes) in VEHICLES.items():
            [poses] = trajectories(setup, NETWORK, genes, [start], options.seconds, first_seed=options.seed)
            times = np.arange(len(poses)) * SAMPLE_S
            tracks.append(DrawnPath(f"{name} {feeling}", times, poses[:, :2]))
    save(draw(ARENA, tracks, title="Braitenberg's vehicles from two starts", longer_side=5), options.picture)

"""Distance at half scale of robots of the same model.

A white wall straight ahead of 100 robots (seeds 1 to 100) approaches in steps of 1 mm, without noise. The
study prints the distance from the robot's edge at which the mean of both front sensors passes half of 1023
counts, for them and for the nominal robot.
"""

import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen
from khep_twin.board.kernel import PROXIMITY
from khep_twin.units import BODY_RADIUS, COUNTS_LIMIT, Sensor
from khep_twin.world import World
from tools.command_table import command_line

ROBOTS = range(1, 101)
DISTANCES_MM = tuple(range(60, -1, -1))

_SCENE = """
version = 1
name = "wall"
[arena]
width_mm = 600
height_mm = 600
[[robot]]
x_mm = 300
y_mm = 300
heading_deg = 0
"""


def half_scale(seed: int, world: World) -> float:
    """Return the distance of a robot of the same model, or of the nominal one for seed 0 [mm]."""
    counts: list[float] = []
    for distance_mm in DISTANCES_MM:
        x_mm = 600 - BODY_RADIUS * 1e3 - max(distance_mm, 0.1)
        world.reset(seed, noise=False, vary=seed > 0, starts=[(x_mm, 300.0, 0.0)])
        readings = world.robots[0].registers[PROXIMITY]
        counts.append((readings[Sensor.LEFT_10] + readings[Sensor.RIGHT_10]) / 2)
    return float(np.interp(COUNTS_LIMIT / 2, counts, DISTANCES_MM))


def main() -> None:
    command_line(__doc__).parse_args()
    world = World(playpen.parse(_SCENE, "wall"), compiled=True)
    print(f"nominal robot: {half_scale(0, world):.1f} mm")
    distances_mm: NDArray[np.float64] = np.array([half_scale(seed, world) for seed in ROBOTS])
    low, middle, high = np.percentile(distances_mm, (10, 50, 90))
    print(
        f"{len(distances_mm)} robots of the same make: "
        f"{distances_mm.min():.1f} to {distances_mm.max():.1f} mm, "
        f"median {middle:.1f} mm, 10 to 90 %: {low:.1f} to {high:.1f} mm"
    )

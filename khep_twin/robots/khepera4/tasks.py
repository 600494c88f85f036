"""Tasks for the Khepera IV.

KheperaIVObstacleAvoidance  forwards, fast and straight, away from obstacles, with ultrasonic distances
KheperaIVLineFollowing      forwards along a black line on the floor
"""

import numpy as np

from khep_twin.envs.tasks import State, Task, avoiding, batched
from khep_twin.episodes.fitness import Number

OBSTACLE_AVOIDANCE = Task(
    "KheperaIVObstacleAvoidance", "arena4", ("proximity", "ultrasonic", "speed"), avoiding, model="khepera4"
)

_LINE_COUNTS = 512
"""Reading of a ground sensor below which it is above the line (assumed)."""


@batched
def following_line(state: State) -> Number:
    """Return the speed forwards, 0 to 1, if a front ground sensor is above the line, otherwise 0."""
    _, left, right, _ = state.read("ground")
    speed = (state.left + state.right) / 2 / state.interface.top_speed
    return np.clip(speed, 0.0, 1.0) * (np.minimum(left, right) < _LINE_COUNTS)


LINE_FOLLOWING = Task(
    "KheperaIVLineFollowing",
    "arena4-line",
    ("ground", "speed", "gyroscope"),
    following_line,
    starts="playpen",
    model="khepera4",
)

"""Controllers that ship with the package. A controller is a function of a robot, called once a cycle."""

from collections.abc import Callable, Mapping

from khep_twin.host import Khepera

Controller = Callable[[Khepera], None]

BRAITENBERG_WEIGHTS = (
    (4, -5),
    (4, -15),
    (6, -18),
    (-18, 6),
    (-15, 4),
    (-5, 4),
    (5, 3),
    (3, 5),
)
"""What each proximity sensor adds to the left and right speed, in 1/400 pulses/10 ms per count: the matrix of
the robot's own demonstration program, as the toolbox gives it."""

BRAITENBERG_SPEED_PULSES = 10
"""Speed with nothing in view [pulses/10 ms] (toolbox)."""


def braitenberg(robot: Khepera) -> None:
    """Wanders and avoids obstacles: speeds = proximity x weights / 400 + 10."""
    proximity = robot.proximity()
    left, right = (
        sum(weights[side] * count for weights, count in zip(BRAITENBERG_WEIGHTS, proximity, strict=True))
        for side in (0, 1)
    )
    robot.set_speed(
        round(left / 400) + BRAITENBERG_SPEED_PULSES, round(right / 400) + BRAITENBERG_SPEED_PULSES
    )


BUILT_IN: Mapping[str, Controller] = {"braitenberg": braitenberg}
"""By the name that `khep-twin run` knows them by."""

"""Controllers that ship with the package. A controller is a function of a robot, called once a cycle."""

from collections.abc import Callable, Mapping

from khep_twin.host import Khepera
from khep_twin.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS

Controller = Callable[[Khepera], None]


def braitenberg(robot: Khepera) -> None:
    """Wanders and avoids obstacles: speeds = proximity x weights / 400 + 10."""
    proximity = robot.proximity()
    left, right = (
        sum(weights[side] * count for weights, count in zip(DEMO_WEIGHTS, proximity, strict=True))
        for side in (0, 1)
    )
    robot.set_speed(
        round(left / DEMO_DIVISOR) + DEMO_SPEED_PULSES, round(right / DEMO_DIVISOR) + DEMO_SPEED_PULSES
    )


BUILT_IN: Mapping[str, Controller] = {"braitenberg": braitenberg}
"""By the name that `khep-twin run` knows them by."""

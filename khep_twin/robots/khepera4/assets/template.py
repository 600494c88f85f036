"""Controller of a Khepera IV: a template to fill in.

    khep-twin run FILE.py --playpen arena4 --seconds 60

The same file drives a robot and a twin. Unchanged, it wanders and turns away from obstacles.
"""

from khep_twin import Khepera4

SPEED = 0.2  # [m/s]
NEAR_COUNTS = 200  # proximity from about 100, nothing there, to 1020, touching


def controller(robot: Khepera4) -> None:
    """Read sensors, decide, drive; called once per cycle."""
    near = robot.proximity()  # counts: left, front_left, front, ..., back, ground_left, ..., ground_right
    # robot.ultrasonic()  distances [m]: left, front_left, front, front_right, right
    # robot.ambient()     counts of light as in proximity, about 980 in the dark
    # robot.position()    ways of the wheels [m]: left, right
    if max(near.front_left, near.front, near.front_right) < NEAR_COUNTS:
        robot.set_speed(SPEED, SPEED)
    else:
        robot.set_speed(SPEED, -SPEED)  # to the right

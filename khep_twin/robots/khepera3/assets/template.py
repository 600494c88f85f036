"""Controller of a Khepera III: a template to fill in.

    khep-twin run FILE.py --playpen arena3 --seconds 60

The same file drives a robot and a twin. Unchanged, it wanders and turns away from obstacles.
"""

from khep_twin.robots.khepera3 import Khepera3

SPEED = 0.08  # [m/s]
NEAR_COUNTS = 400  # proximity from about 50, nothing there, to 3980, touching


def controller(robot: Khepera3) -> None:
    """Read sensors, decide, drive; called once per cycle."""
    near = robot.proximity()  # counts: back_left, left, front_side_left, front_left, ..., ground_left
    # robot.ultrasonic()  distances [m]; robot.configure_ultrasonic() makes all sensors active
    # robot.ambient()     counts of light as in proximity, about 4000 in the dark
    # robot.position()    ways of the wheels [m]: left, right
    counts = near.front_side_left, near.front_left, near.front_right, near.front_side_right
    if max(counts) < NEAR_COUNTS:
        robot.set_speed(SPEED, SPEED)
    else:
        robot.set_speed(SPEED, -SPEED)  # to the right

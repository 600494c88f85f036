"""Steers by the difference of the two front ground sensors, which are above the edges of the line."""

SPEED = 0.5  # m/s
GAIN = 0.2  # m/s for a difference of 1000 counts


def controller(robot):
    counts = robot.proximity()
    turn = GAIN * (counts.ground_front_right - counts.ground_front_left) / 1000
    robot.set_speed(SPEED - turn, SPEED + turn)

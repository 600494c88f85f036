"""Braitenberg vehicle with the weights of the robot's demonstration program, but faster and sharper."""

WEIGHTS = [(4, -5), (4, -15), (6, -18), (-18, 6), (-15, 4), (-5, 4), (5, 3), (3, 5)]  # left, right wheel
SPEED_PULSES, TOP_PULSES = 18, 20
DIVISOR = 250


def controller(robot):
    proximity = robot.proximity()
    speeds = [sum(map(lambda weight, count: weight[wheel] * count, WEIGHTS, proximity)) for wheel in (0, 1)]
    left, right = (round(speed / DIVISOR) + SPEED_PULSES for speed in speeds)
    robot.set_speed(max(-TOP_PULSES, min(left, TOP_PULSES)), max(-TOP_PULSES, min(right, TOP_PULSES)))

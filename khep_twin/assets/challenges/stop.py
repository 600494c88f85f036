"""Drives fast, then slowly, and stops at the readings of the front sensors 25 mm from a white wall."""

FAR_COUNTS, STOP_COUNTS = 30, 200  # proximity, from 0, nothing there, to 1023, touching


def controller(robot):
    proximity = robot.proximity()
    near = (proximity.left_10 + proximity.right_10) / 2
    speed = 12 if near < FAR_COUNTS else 2 if near < STOP_COUNTS else 0
    robot.set_speed(speed, speed)

"""Drives fast, then slowly, and stops where the front sensors read what they do 25 mm before a white wall."""

FAR_COUNTS, STOP_COUNTS = 30, 200  # proximity, from 0, nothing there, to 1023, touching


def controller(robot):
    ahead = robot.proximity()
    near = (ahead.left_10 + ahead.right_10) / 2
    speed = 12 if near < FAR_COUNTS else 2 if near < STOP_COUNTS else 0
    robot.set_speed(speed, speed)

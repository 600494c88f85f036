"""Turns to the brighter side, away from obstacles, and stops where it is bright enough."""

BRIGHT_COUNTS = 60  # ambient light: about 500 in the dark, 50 in bright light
NEAR_COUNTS = 150  # proximity, from 0, nothing there, to 1023, touching


def controller(robot):
    proximity = robot.proximity()
    left = max(proximity.left_90 / 2, proximity.left_45, proximity.left_10)
    right = max(proximity.right_10, proximity.right_45, proximity.right_90 / 2)
    if max(left, right) > NEAR_COUNTS:
        turn = 8 if left > right else -8
        robot.set_speed(2 + turn, 2 - turn)
        return
    light = robot.ambient()
    if min(light) < BRIGHT_COUNTS:
        robot.set_speed(0, 0)
        return
    dark_left = light.left_90 + light.left_45 + light.left_10
    dark_right = light.right_10 + light.right_45 + light.right_90
    turn = max(-6, min(6, (dark_left - dark_right) // 15))
    robot.set_speed(12 + turn, 12 - turn)

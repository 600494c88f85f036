"""Drives ahead where there is room, and turns to the side with more of it by the ultrasonic sensors."""

SPEED, TURN_SPEED = 0.6, 0.15  # m/s
ROOM = 0.35  # m
NEAR_COUNTS = 200  # proximity, from 100, nothing there, to 1023, touching

turn, speeds = 0, None


def controller(robot):
    global turn, speeds
    distances, counts = robot.ultrasonic(), robot.proximity()
    is_near = max(counts.front_left, counts.front, counts.front_right) > NEAR_COUNTS
    if not is_near and distances.front > ROOM:
        turn = 0
    elif not turn:
        turn = 1 if distances.left + distances.front_left > distances.right + distances.front_right else -1
    new_speeds = (-turn * TURN_SPEED, turn * TURN_SPEED) if turn else (SPEED, SPEED)
    if new_speeds != speeds:
        robot.set_speed(*new_speeds)
        speeds = new_speeds

"""Turns to the darker of the two front ground sensors; beside the line it continues the last turn."""

SPEED, TURN_SPEED = 0.3, 0.15  # m/s
WHITE_COUNTS = 700  # ground sensor: about 930 on white, 50 on black

turn = 0.0


def controller(robot):
    global turn
    counts = robot.proximity()
    left, right = counts.ground_front_left, counts.ground_front_right
    if min(left, right) < WHITE_COUNTS:
        turn = TURN_SPEED * (right - left) / 900
    elif turn:
        turn = TURN_SPEED if turn > 0 else -TURN_SPEED
    robot.set_speed(SPEED - turn, SPEED + turn)

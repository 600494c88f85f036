"""A state machine: drives up the stem and finds the brighter side, turns to it, and drives to the end."""

NEAR_COUNTS = 120  # proximity, from 0, nothing there, to 1023, touching
SPEED_PULSES = 15
TURN_PULSES = 511  # a quarter of a circle of the wheels, 52 mm apart

state = "stem"
brighter = 0


def between_walls(robot, proximity):
    turn = (max(proximity.left_90, proximity.left_45) - max(proximity.right_90, proximity.right_45)) / 100
    turn = max(-4.0, min(4.0, turn))
    robot.set_speed(round(SPEED_PULSES + turn), round(SPEED_PULSES - turn))


def controller(robot):
    global state, brighter
    proximity = robot.proximity()
    front = max(proximity.left_10, proximity.right_10)
    if state == "stem":
        light = robot.ambient()
        brighter += light.right_90 - light.left_90
        between_walls(robot, proximity)
        if front > NEAR_COUNTS:
            state = "turn"
    elif state == "turn":
        robot.set_speed(0, 0)
        robot.set_position(0, 0)
        side = 1 if brighter > 0 else -1
        robot.set_target(-side * TURN_PULSES, side * TURN_PULSES)
        robot.wait_for_target()
        state = "arm"
    elif front > NEAR_COUNTS:
        robot.set_speed(0, 0)
    else:
        between_walls(robot, proximity)

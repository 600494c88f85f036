"""Follows the wall on its right, by the side sensor's difference from a setpoint and its rate of change."""

SETPOINT_COUNTS = 512
NEAR_COUNTS = 100  # proximity, from 0, nothing there, to 1023, touching
SPEED_PULSES, TURN_PULSES, MOST_PULSES = 18, 7, 6
GAIN, DAMPING = 4, 16

wall_reached = False
last_error = 0.0


def controller(robot):
    global wall_reached, last_error
    proximity = robot.proximity()
    if max(proximity.left_10, proximity.right_10, proximity.right_45 * 0.4) > NEAR_COUNTS:
        wall_reached = True
        robot.set_speed(-TURN_PULSES, TURN_PULSES)
    elif not wall_reached:
        robot.set_speed(SPEED_PULSES, SPEED_PULSES)
    else:
        error = proximity.right_90 / SETPOINT_COUNTS - 1
        turn = GAIN * error + DAMPING * (error - last_error)
        turn = round(max(-MOST_PULSES, min(turn, MOST_PULSES)))
        robot.set_speed(SPEED_PULSES - turn, SPEED_PULSES + turn)
        last_error = error

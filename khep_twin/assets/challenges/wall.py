"""Follows the wall on its right by the side sensor's difference to a setpoint, and by its change."""

SETPOINT_COUNTS = 512
NEAR_COUNTS = 100  # proximity, from 0, nothing there, to 1023, touching
SPEED_PULSES, TURN_PULSES, MOST_PULSES = 18, 7, 6
GAIN, DAMPING = 4, 16

found = False
last = 0.0


def controller(robot):
    global found, last
    seen = robot.proximity()
    if max(seen.left_10, seen.right_10, seen.right_45 * 0.4) > NEAR_COUNTS:
        found = True
        robot.set_speed(-TURN_PULSES, TURN_PULSES)
    elif not found:
        robot.set_speed(SPEED_PULSES, SPEED_PULSES)
    else:
        error = seen.right_90 / SETPOINT_COUNTS - 1
        turn = GAIN * error + DAMPING * (error - last)
        turn = round(max(-MOST_PULSES, min(turn, MOST_PULSES)))
        robot.set_speed(SPEED_PULSES - turn, SPEED_PULSES + turn)
        last = error

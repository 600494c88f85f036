"""Moves the wheels to target positions, with a faster speed profile than after a reset."""

SIDE_PULSES = 1875  # 150 mm in pulses of 0.08 mm
TURN_PULSES = 511  # a quarter of a circle of the wheels, 52 mm apart


def controller(robot):
    robot.configure_profile(60, 255, 60, 255)
    robot.set_position(0, 0)
    left = right = 0
    for _ in range(4):
        for left_pulses, right_pulses in ((SIDE_PULSES, SIDE_PULSES), (-TURN_PULSES, TURN_PULSES)):
            left, right = left + left_pulses, right + right_pulses
            robot.set_target(left, right)
            robot.wait_for_target()
    while True:  # the time limit ends it
        robot.sleep(1)

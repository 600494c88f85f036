"""Grips the cylinder ahead, drives back, turns to the goal and puts it down there."""

from khep_twin import Gripper

NEAR_COUNTS = 400  # reading of the front sensors about a centimetre from a bright object
TURN_PULSES = 511  # a quarter of a circle of the wheels, 52 mm apart
PULSES_PER_MM = 12.5


def drive(robot, left, right):
    robot.set_position(0, 0)
    robot.set_target(round(left), round(right))
    robot.wait_for_target()


def controller(robot):
    gripper = Gripper(robot)
    gripper.lift()
    gripper.open()
    gripper.wait()
    robot.set_position(0, 0)
    robot.set_speed(5, 5)
    while max(robot.proximity()[2:4]) < NEAR_COUNTS:
        pass
    robot.set_speed(0, 0)
    gripper.lower()
    gripper.wait()
    robot.set_speed(2, 2)
    while gripper.barrier() < 200:  # until the object darkens the barrier between the fingers
        pass
    robot.set_speed(0, 0)
    gripper.close()
    gripper.wait()
    gripper.lift()
    gripper.wait()
    distance = robot.position().left
    drive(robot, -distance, -distance)
    drive(robot, -TURN_PULSES, TURN_PULSES)
    offset = 45 * PULSES_PER_MM  # the gripper holds it 45 mm before the robot's middle
    drive(robot, 150 * PULSES_PER_MM - offset, 150 * PULSES_PER_MM - offset)
    gripper.lower()
    gripper.wait()
    gripper.open()
    gripper.wait()
    drive(robot, -40 * PULSES_PER_MM, -40 * PULSES_PER_MM)
    while True:  # the time limit ends it
        robot.sleep(1)

"""Wanders until a lamp shines, turns to it away from obstacles, and stops where it is bright enough."""

import math
import random

SPEED, TURN_SPEED = 0.4, 0.1  # m/s
TURN_S = 0.3, 1.5  # duration of a turn
DARK_COUNTS, LIT_COUNTS, BRIGHT_COUNTS = 980, 955, 835  # ambient light, low in the light
NEAR_COUNTS = 200  # proximity, from 100, nothing there, to 1023, touching
BEARINGS = [math.radians(bearing) for bearing in (135, 90, 45, 0, -45, -90, -135, 180)]  # of the sensors

turn, turn_end, speeds = 0, 0.0, None


def drive(robot, *new_speeds):
    global speeds
    if new_speeds != speeds:
        robot.set_speed(*new_speeds)
        speeds = new_speeds


def controller(robot):
    global turn, turn_end
    counts, light = robot.proximity(), robot.ambient()[:8]
    if min(light) < BRIGHT_COUNTS:
        return drive(robot, 0, 0)
    left, right = counts.front_left, counts.front_right
    is_near = max(left, counts.front, right) > NEAR_COUNTS
    if is_near and not turn:
        turn, turn_end = (1 if left < right else -1), robot.time + random.uniform(*TURN_S)
    if is_near or robot.time < turn_end:
        return drive(robot, -turn * TURN_SPEED, turn * TURN_SPEED)
    turn = 0
    if min(light) > LIT_COUNTS:
        return drive(robot, SPEED, SPEED)
    lights = [max(DARK_COUNTS - count, 0) for count in light]
    x = sum(map(lambda brightness, bearing: brightness * math.cos(bearing), lights, BEARINGS))
    y = sum(map(lambda brightness, bearing: brightness * math.sin(bearing), lights, BEARINGS))
    bearing = math.atan2(y, x)
    if abs(bearing) > math.radians(60):
        return drive(robot, math.copysign(TURN_SPEED, -bearing), math.copysign(TURN_SPEED, bearing))
    curve = 0.05 * round(2 * bearing)
    return drive(robot, SPEED - curve, SPEED + curve)

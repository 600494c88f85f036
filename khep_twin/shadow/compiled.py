"""Many planar twins side by side, compiled by numba: their motion, the light at their sensors, commands.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false, reportArgumentType=false

import math
from typing import Any, NamedTuple

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.compilable import compilable, compilable_once
from khep_twin.episodes.planar import casting, contact_solver, motion, plane, pushing, shadows
from khep_twin.episodes.planar import compiled as planar_compiled
from khep_twin.episodes.planar.plane import Plane
from khep_twin.sensing import light, optics, reflection, robot_sensors, seen_surfaces
from khep_twin.sensing.light import Light, light_counts, received
from khep_twin.sensing.optics import SLIGHT
from khep_twin.sensing.reflection import reflected, sift
from khep_twin.sensing.robot_sensors import lobe_of
from khep_twin.sensing.scene import chip, position, surfaces
from khep_twin.sensing.seen_surfaces import Chip
from khep_twin.shadow.wheel_commands import DUTY, SPEED, TARGET
from khep_twin.simulation.compiled import compiled

assert planar_compiled.run  # its queries of a plane are those used here

_SOURCES = (
    units,
    kernel,
    seen_surfaces,
    reflection,
    robot_sensors,
    light,
    optics,
    casting,
    contact_solver,
    motion,
    plane,
    pushing,
    shadows,
)

_RIGHT = kernel.RIGHT
_LEFT_DUTY, _RIGHT_DUTY = kernel.DUTIES

_TURN = math.radians(1)
"""Turn of a sensor for whose slope its light is computed again [rad]."""

_HOLD = 6.0
"""Brake of a wheel that is blocked, as a part of that of a motor without voltage."""


class MotorDrive(NamedTuple):
    """Constants of all twins' motors.

    Attributes:
        left_angle: Index of the left wheel's position.
        right_angle: Index of the right wheel's position.
        left_speed: Index of the left wheel's speed.
        right_speed: Index of the right wheel's speed.
        constant: Torque per current [N m/A].
    """

    left_angle: int
    right_angle: int
    left_speed: int
    right_speed: int
    constant: float


def _advance(things, order, near, none, planes, registers, processor, strength, drive, voltage, ticks):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], near, none, none, planes[twin])
        board = registers[twin]
        for _ in range(ticks):
            motion.step(scene)
            left, right = scene.robot.joints[drive[0].left_angle], scene.robot.joints[drive[0].right_angle]
            kernel.run(board, processor[twin], units.wheel_pulses(left), units.wheel_pulses(right))
            speeds, constant = scene.robot.speeds, drive[0].constant
            own = constant * speeds[drive[0].left_speed]
            wanted = units.duty_voltage(board[_LEFT_DUTY], voltage)
            scene.robot.ctrl[0] = _voltage(strength[twin, 0], own, wanted, voltage)
            own = constant * speeds[drive[0].right_speed]
            wanted = units.duty_voltage(board[_RIGHT_DUTY], voltage)
            scene.robot.ctrl[1] = _voltage(strength[twin, 1], own, wanted, voltage)


@compilable
def _voltage(strength, own, wanted, most):
    """Return the voltage of a motor [V], which generates its own one without current."""
    if strength >= 0:
        return own + (wanted - own) * strength
    # A brake that takes its speed from the start of a tick would overshoot more and more without a limit.
    return own + min(max(_HOLD * strength * own, -most), most)


def _illuminate(things, order, near, none, planes, sensors, turns, light, slope):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], near, none, none, planes[twin])
        motion.look_around(scene)
        for channel in range(units.N_SENSORS):
            mounted, turn = chip(scene, sensors[0], channel), turns[twin, channel]
            light[twin, channel] = seen = _light(scene, sensors[0], channel, mounted, turn)
            slope[twin, channel] = 0.0
            if seen > 0:
                turned = _light(scene, sensors[0], channel, mounted, turn + _TURN)
                slope[twin, channel] = (turned - seen) / _TURN


@compilable_once
def _light(scene, sensors, channel, mounted, turn):
    """Return the light that a sensor gets back [counts], whose chip is turned about its face [rad]."""
    proximity = sensors.proximity
    c, s, offset = math.cos(turn), math.sin(turn), proximity.offset[channel]
    ahead, left = c * mounted.ahead - s * mounted.left, s * mounted.ahead + c * mounted.left
    x, y = mounted.x + offset * (mounted.ahead - ahead), mounted.y + offset * (mounted.left - left)
    at = Chip(x, y, ahead, left, mounted.height, mounted.reach)
    count = surfaces(scene, sensors, channel, at, 0.0)
    lobe = lobe_of(proximity, channel)
    gain, found = proximity.gain[channel], proximity.found
    count, _ = sift(found, count, lobe, SLIGHT / gain)
    return gain * reflected(found, count, at, lobe) if count else 0.0


def _explain(
    light, slope, range_left, readings, use, new, law, traits, covariances, counts, deviations, chances
):
    for twin in range(len(traits)):
        for channel in range(units.N_SENSORS):
            sensor, known = traits[twin, channel], covariances[twin, channel]
            gain = math.exp(sensor[0])
            scaled, along = gain * light[twin, channel], gain * slope[twin, channel]
            count, reading = scaled - law.threshold[channel] - sensor[2], readings[channel]
            low, high = reading <= law.quiet, reading >= law.full
            if low or high:
                reading = law.quiet if low else law.full
            if not high:
                count = min(count, law.limit * range_left[twin, channel])
            first = known[0, 0] * scaled + known[0, 1] * along - known[0, 2]
            second = known[1, 0] * scaled + known[1, 1] * along - known[1, 2]
            third = known[2, 0] * scaled + known[2, 1] * along - known[2, 2]
            apart = law.model * max(count, 0.0)
            own = law.noise[channel] + apart * apart
            variance = own + scaled * first + along * second - third
            deviation = math.sqrt(variance)
            off = (reading - count) / deviation
            bell = math.exp(-0.5 * off * off) / math.sqrt(math.tau)
            if low or high:
                # Only that the count is beyond: its expectation and variance are those of a normal tail.
                beyond = off if low else -off
                inside = 1 / (1 + math.exp(-1.702 * max(min(beyond, 400.0), -400.0)))
                tail = bell / max(inside, 1e-6)
                learned, off = max(min(tail * (tail + beyond), 1.0), 0.0), -tail if low else tail
                outside = 1.0
            else:
                inside, learned, outside = bell / deviation, 1.0, 1 / (law.limit + 1)
            chance = (1 - law.outliers) * inside + law.outliers * outside
            counts[twin, channel], deviations[twin, channel] = count, deviation
            chances[twin, channel] = chance
            if use[channel] and range_left[twin, channel] >= 1:
                # Of an observation that is new in part, its own variance counts as much more.
                trust = (1 - law.outliers) * inside / chance * variance / (variance + own * (1 / new - 1))
                step = trust * off / deviation
                sensor[0] += step * first
                sensor[1] += step * second
                sensor[2] += step * third
                step = trust * learned / variance
                for row, by in ((0, first), (1, second), (2, third)):
                    known[row, 0] -= step * by * first
                    known[row, 1] -= step * by * second
                    known[row, 2] -= step * by * third
                    known[row, row] = max(known[row, row], law.least[row])


def _lamplight(things, order, near, none, planes, sensors, law, bulbs, hidden, powers, least, light):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], near, none, none, planes[twin])
        for channel in range(units.N_SENSORS):
            for lamp in range(len(bulbs)):
                bulb, ambient = bulbs[lamp], sensors[0].ambient
                x, y, _ = position(scene, sensors[0], channel)
                away = (bulb.x - x) * (bulb.x - x) + (bulb.y - y) * (bulb.y - y)
                if powers[lamp] * received(ambient, channel, math.sqrt(away), 1.0) < least:
                    continue
                lit = Light(law[0], bulbs[lamp : lamp + 1], hidden)
                light[twin, channel, lamp], _ = light_counts(
                    scene, sensors[0], lit, powers[lamp : lamp + 1], channel
                )


def _command(registers, command, left, right):
    for twin in range(len(registers)):
        board = registers[twin]
        if command == SPEED:
            kernel.set_speed(board, 0, left)
            kernel.set_speed(board, _RIGHT, right)
        elif command == DUTY:
            kernel.set_duty(board, 0, left)
            kernel.set_duty(board, _RIGHT, right)
        elif command == TARGET:
            kernel.set_target(board, 0, left)
            kernel.set_target(board, _RIGHT, right)
        else:
            kernel.set_position(board, 0, left)
            kernel.set_position(board, _RIGHT, right)


def _clear(things, planes, poses, free):
    for twin in range(len(planes)):
        free[twin] = True
        for thing in range(things.shape[1]):
            away = plane.distance_to(things[twin], thing, poses[twin, 0], poses[twin, 1])
            if things[twin, thing, plane.TOUCHED] and away < planes[twin].radius:
                free[twin] = False
                break


def _measure(things, order, near, none, planes):
    for twin in range(len(planes)):
        motion.measure(Plane(things[twin], order[twin], near, none, none, planes[twin]))


advance: Any = compiled(_advance, _SOURCES)
"""Advance twins by control ticks of 10 ms: motion, encoders, controllers, voltages."""

illuminate: Any = compiled(_illuminate, _SOURCES)
"""Compute the light at each sensor, at the gains of the shared calibration, and its slope as it turns (n, 8)
[counts, counts/rad]."""

explain: Any = compiled(_explain, _SOURCES)
"""Compute what each sensor is expected to read, and the probability of its reading; learn its traits.

A reading that is not clipped is a Kalman filter's observation of gain, turn and threshold; of one that is,
the mean and the variance of the normal tail beyond the limit are taken.
"""

lamplight: Any = compiled(_lamplight, _SOURCES)
"""Compute the light of each lamp at each receiver, below its dark level (n, 8, n_lamps) [counts].

What cannot reach `least`, even in full sight, counts as 0.
"""

command: Any = compiled(_command, _SOURCES)
"""Execute a command on all boards."""

clear: Any = compiled(_clear, _SOURCES)
"""Compute whether each twin stands free of obstacles (n,)."""

measure: Any = compiled(_measure, _SOURCES)
"""Measure the distances of each twin to its obstacles."""

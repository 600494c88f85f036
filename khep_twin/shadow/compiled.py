"""Many planar twins side by side, compiled by numba: their motion, the light at their sensors, commands.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false, reportArgumentType=false

import math
from typing import Any, NamedTuple

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.rollout.planar import casting, contact_solver, motion, plane, shadows
from khep_twin.rollout.planar import compiled as planar_compiled
from khep_twin.rollout.planar.plane import Plane
from khep_twin.sensing import optics, reflection, seen_surfaces
from khep_twin.sensing.optics import SLIGHT, Light, chip_of, light_counts, received
from khep_twin.sensing.reflection import Lobe, reflected, sift
from khep_twin.sensing.scene import position, surfaces
from khep_twin.shadow.planes import DUTY, SPEED, TARGET
from khep_twin.simulation.compiled import compiled

assert planar_compiled.run  # its queries of a plane are those used here

_SOURCES = (
    units,
    kernel,
    seen_surfaces,
    reflection,
    optics,
    casting,
    contact_solver,
    motion,
    plane,
    shadows,
)

_RIGHT = kernel.RIGHT
_LEFT_DUTY, _RIGHT_DUTY = kernel.DUTIES

_HOLD = 6.0
"""Brake of a wheel that is blocked, as a part of that of a motor without voltage."""


class Drive(NamedTuple):
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


def _advance(things, order, planes, registers, processor, strength, drive, voltage, ticks):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], planes[twin])
        board = registers[twin]
        for _ in range(ticks):
            motion.step(scene)
            left, right = scene.robot.joints[drive[0].left_angle], scene.robot.joints[drive[0].right_angle]
            kernel.run(board, processor[twin], units.wheel_pulses(left), units.wheel_pulses(right))
            # A weak motor gives a part of its torque; without any it generates its own voltage.
            speeds, constant = scene.robot.speeds, drive[0].constant
            part, held = max(strength[twin, 0], 0.0), _HOLD * min(strength[twin, 0], 0.0)
            own = constant * speeds[drive[0].left_speed]
            wanted = units.duty_voltage(board[_LEFT_DUTY], voltage)
            scene.robot.ctrl[0] = own + (wanted - own) * part + own * held
            part, held = max(strength[twin, 1], 0.0), _HOLD * min(strength[twin, 1], 0.0)
            own = constant * speeds[drive[0].right_speed]
            wanted = units.duty_voltage(board[_RIGHT_DUTY], voltage)
            scene.robot.ctrl[1] = own + (wanted - own) * part + own * held


def _illuminate(things, order, planes, sensors, light):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], planes[twin])
        proximity = sensors[0].proximity
        for channel in range(units.N_SENSORS):
            chip = chip_of(scene, sensors[0], channel)
            count = surfaces(scene, sensors[0], channel, chip, proximity.reach[channel])
            lobe = Lobe(
                proximity.whole[channel],
                proximity.part[channel],
                proximity.norm[channel],
                proximity.width[channel],
                proximity.table[channel],
            )
            gain, found = proximity.gain[channel], proximity.found
            count, _ = sift(found, count, lobe, SLIGHT / gain)
            light[twin, channel] = gain * reflected(found, count, chip, lobe) if count else 0.0


def _lamplight(things, order, planes, sensors, law, bulbs, hidden, powers, least, light):
    for twin in range(len(planes)):
        scene = Plane(things[twin], order[twin], planes[twin])
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


def _measure(things, order, planes):
    for twin in range(len(planes)):
        motion.measure(Plane(things[twin], order[twin], planes[twin]))


advance: Any = compiled(_advance, _SOURCES)
"""Advance twins by control ticks of 10 ms: motion, encoders, controllers, voltages."""

illuminate: Any = compiled(_illuminate, _SOURCES)
"""Compute the light at each sensor, at the gains of the shared calibration (n, 8) [counts]."""

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

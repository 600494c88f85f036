"""Functions of many planar twins, compiled by numba: commands, motion, echoes, light at the sensors.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false, reportArgumentType=false

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from khep_twin import units
from khep_twin.compilable import compilable, compilable_once
from khep_twin.episodes.planar import casting, contact_solver, motion, plane, pushing, shadows
from khep_twin.episodes.planar import compiled as planar_compiled
from khep_twin.episodes.planar.plane import Plane
from khep_twin.robots import core
from khep_twin.sensing import light, optics, reflection, robot_sensors, seen_surfaces
from khep_twin.sensing.light import Light, light_counts, light_per_watt
from khep_twin.sensing.optics import NEGLIGIBLE
from khep_twin.sensing.reflection import reflected_light, remove_faint
from khep_twin.sensing.robot_sensors import sensor_lobe
from khep_twin.sensing.scene import chip, position, surfaces
from khep_twin.sensing.seen_surfaces import Chip
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.simulation.compiled import compiled, named, sources_of

assert planar_compiled.run_of  # Its import registers the queries of a plane for numba.

_SENSING = seen_surfaces, reflection, robot_sensors, light, optics
_PLANE = casting, contact_solver, motion, plane, pushing, shadows
_SOURCES = units, *_SENSING, *_PLANE

_TURN = math.radians(1)
"""Turn of a sensor by which the slope of its light is computed [rad]."""

_BRAKING = 6.0
"""Brake of a blocked wheel, as a multiple of that of a motor without voltage."""


def _run(scene_arrays, boards, states, strength, rows, command, ticks, end_ns, limit, lag, distances):
    obstacles, order, near, empty, robots = scene_arrays
    robot, memory, columns, tables = boards
    (letter, left, right), state = command, robot[0]
    for twin in range(rows[0], len(robots), rows[1]):
        for word in range(len(columns)):
            memory[columns[word]] = states[twin, word]
        scene = Plane(obstacles[twin], order[twin], near, empty, empty, empty, robots[twin])
        simulated, inputs = Simulated(scene, empty, empty, empty, empty), StepInputs(empty, tables)
        if letter:
            core.command(state, letter, left, right)
        if ticks:
            core.measure_supply(state, simulated, end_ns)
        for _ in range(ticks):
            motion.step(scene)
            core.tick(state, simulated, inputs, end_ns)
            for side, joint in ((0, plane.LEFT_ANGLE), (1, plane.RIGHT_ANGLE)):
                back_emf, applied = state.motor_constant * scene.robot.speeds[joint], scene.robot.ctrl[side]
                scene.robot.ctrl[side] = _motor_voltage(strength[twin, side], back_emf, applied, limit)
        for word in range(len(columns)):
            states[twin, word] = memory[columns[word]]
        if distances.shape[1]:
            _hear(scene, state, lag, distances[twin])


@compilable
def _hear(scene, robot, lag, distances):
    """Compute the distances by all ultrasonic sensors at the pose some time ago [s]."""
    joints, last, speeds = scene.robot.joints, scene.robot.last_step, scene.robot.speeds
    forward, aside, spin = speeds[0], speeds[1], speeds[plane.HEADING]
    x, y, heading = joints[plane.X], joints[plane.Y], joints[plane.HEADING]
    cosine, sine = last[plane.HEADING_COSINE], last[plane.HEADING_SINE]
    joints[plane.X] = x - lag * (cosine * forward - sine * aside)
    joints[plane.Y] = y - lag * (sine * forward + cosine * aside)
    last[plane.HEADING_COSINE] = math.cos(heading - lag * spin)
    last[plane.HEADING_SINE] = math.sin(heading - lag * spin)
    for sensor in range(len(distances)):
        distances[sensor] = core.echo(robot, scene, sensor)
    joints[plane.X], joints[plane.Y] = x, y
    last[plane.HEADING_COSINE], last[plane.HEADING_SINE] = cosine, sine


@compilable
def _motor_voltage(strength, back_emf, applied, supply):
    """Return the voltage of a motor [V]; without current it is the back EMF."""
    if strength >= 0:
        return back_emf + (applied - back_emf) * strength
    # As the brake uses the speed at the start of a tick, it would oscillate without a limit.
    return back_emf + min(max(_BRAKING * strength * back_emf, -supply), supply)


def _illuminate(obstacles, order, near, empty, robots, sensors, turns, light, slope):
    for twin in range(len(robots)):
        scene = Plane(obstacles[twin], order[twin], near, empty, empty, empty, robots[twin])
        motion.find_near(scene)
        for channel in range(len(sensors[0].proximity.gain)):
            face, turn = chip(scene, sensors[0], channel), turns[twin, channel]
            light[twin, channel] = straight = _light(scene, sensors[0], channel, face, turn)
            slope[twin, channel] = 0.0
            if straight > 0:
                turned = _light(scene, sensors[0], channel, face, turn + _TURN)
                slope[twin, channel] = (turned - straight) / _TURN


@compilable_once
def _light(scene, sensors, channel, face, turn):
    """Return the reflected light at a sensor [counts] whose chip is turned about its face [rad]."""
    proximity = sensors.proximity
    c, s, offset = math.cos(turn), math.sin(turn), proximity.offset[channel]
    cosine, sine = c * face.cosine - s * face.sine, s * face.cosine + c * face.sine
    x, y = face.x + offset * (face.cosine - cosine), face.y + offset * (face.sine - sine)
    turned = Chip(x, y, cosine, sine, face.height, face.reach)
    count = surfaces(scene, sensors, channel, turned, 0.0)
    lobe = sensor_lobe(proximity, channel)
    gain, buffer = proximity.gain[channel], proximity.surfaces
    count, _ = remove_faint(buffer, count, lobe, NEGLIGIBLE / gain)
    return gain * reflected_light(buffer, count, turned, lobe) if count else 0.0


def _observe(
    light, slope, usable, readings, is_used, novelty, law, traits, covariances, counts, spreads, likelihoods
):
    for twin in range(len(traits)):
        for channel in range(len(readings)):
            estimate, covariance = traits[twin, channel], covariances[twin, channel]
            gain = math.exp(estimate[0])
            by_gain, by_turn = gain * light[twin, channel], gain * slope[twin, channel]
            count, reading = by_gain - law.threshold[channel] - estimate[2], readings[channel]
            is_low, is_high = reading <= law.quiet, reading >= law.full
            if is_low or is_high:
                reading = law.quiet if is_low else law.full
            if not is_high:
                count = min(count, law.limit * usable[twin, channel])
            gain_column = covariance[0, 0] * by_gain + covariance[0, 1] * by_turn - covariance[0, 2]
            turn_column = covariance[1, 0] * by_gain + covariance[1, 1] * by_turn - covariance[1, 2]
            threshold_column = covariance[2, 0] * by_gain + covariance[2, 1] * by_turn - covariance[2, 2]
            # A negative threshold is no light of obstacles.
            model_error = law.model_deviation * max(min(count, by_gain), 0.0)
            noise = law.noise[channel] + model_error * model_error
            variance = noise + by_gain * gain_column + by_turn * turn_column - threshold_column
            deviation = math.sqrt(variance)
            innovation = (reading - count) / deviation
            density = math.exp(-0.5 * innovation * innovation) / math.sqrt(math.tau)
            if is_low or is_high:
                # The reading is beyond a limit: mean and variance are those of the tail.
                excess = innovation if is_low else -innovation
                likelihood = 1 / (1 + math.exp(-1.702 * max(min(excess, 400.0), -400.0)))
                hazard = density / max(likelihood, 1e-6)
                shrinkage = max(min(hazard * (hazard + excess), 1.0), 0.0)
                innovation, outlier = -hazard if is_low else hazard, 1.0
            else:
                likelihood, shrinkage, outlier = density / deviation, 1.0, 1 / (law.limit + 1)
            mixture = (1 - law.outliers) * likelihood + law.outliers * outlier
            counts[twin, channel], spreads[twin, channel] = count, deviation
            likelihoods[twin, channel] = mixture
            # A sensor that rests above 0 reads far below the limit that lamps leave.
            is_free = law.threshold[channel] < 0 and 2 * count < law.limit * usable[twin, channel]
            if is_used[channel] and (usable[twin, channel] >= 1 or is_free):
                # The less novel an observation is, the larger is the variance of its noise.
                trust = (1 - law.outliers) * likelihood / mixture
                trust = trust * variance / (variance + noise * (1 / novelty - 1))
                step = trust * innovation / deviation
                estimate[0] += step * gain_column
                estimate[1] += step * turn_column
                estimate[2] += step * threshold_column
                step = trust * shrinkage / variance
                for row, column in ((0, gain_column), (1, turn_column), (2, threshold_column)):
                    covariance[row, 0] -= step * column * gain_column
                    covariance[row, 1] -= step * column * turn_column
                    covariance[row, 2] -= step * column * threshold_column
                    covariance[row, row] = max(covariance[row, row], law.min_variances[row])


def _lamplight(obstacles, order, near, empty, robots, sensors, law, bulbs, hidden, powers, min_count, light):
    for twin in range(len(robots)):
        scene = Plane(obstacles[twin], order[twin], near, empty, empty, empty, robots[twin])
        for channel in range(len(sensors[0].ambient.gain_mm2)):
            for lamp in range(len(bulbs)):
                bulb, ambient = bulbs[lamp], sensors[0].ambient
                x, y, _ = position(scene, sensors[0], channel)
                square = (bulb.x - x) * (bulb.x - x) + (bulb.y - y) * (bulb.y - y)
                if powers[lamp] * light_per_watt(ambient, channel, math.sqrt(square), 1.0) < min_count:
                    continue
                lamp_light = Light(law[0], bulbs[lamp : lamp + 1], hidden)
                power = powers[lamp : lamp + 1]
                light[twin, channel, lamp], _ = light_counts(scene, sensors[0], lamp_light, power, channel)


def _clear(obstacles, robots, poses, is_clear):
    for twin in range(len(robots)):
        is_clear[twin] = True
        for obstacle in range(obstacles.shape[1]):
            distance = plane.distance_to(obstacles[twin], obstacle, poses[twin, 0], poses[twin, 1])
            if obstacles[twin, obstacle, plane.TOUCHABLE] and distance < robots[twin].radius:
                is_clear[twin] = False
                break


def _measure(obstacles, order, near, empty, robots):
    for twin in range(len(robots)):
        motion.measure_distances(Plane(obstacles[twin], order[twin], near, empty, empty, empty, robots[twin]))


@cache
def run_of(family: str) -> Callable[..., None]:
    """Return the function that runs twins of a family of models, compiled.

    It executes a command, unless its letter is 0; advances the twins by control ticks of 10 ms: motion,
    controllers and voltages; and computes the distances by ultrasonic sensors some time ago, unless there is
    no room for them (n, 0). A twin's state is copied to that of `boards` for this.
    """
    return compiled(named(_run, "run", family), (*sources_of(family), *_SOURCES))


illuminate: Any = compiled(_illuminate, _SOURCES)
"""Compute the light at each sensor, at the calibration's gains, and its slope (n, s) [counts, counts/rad]."""

observe: Any = compiled(_observe, _SOURCES)
"""Compute the expected reading of each sensor and the likelihood of the reading; update the sensor's traits.
The reading is an observation of log gain, turn and threshold for a Kalman filter. If it is clipped, mean and
variance of the normal tail beyond the limit replace it."""

lamplight: Any = compiled(_lamplight, _SOURCES)
"""Compute the light of each lamp at each receiver, below its dark level (n, s, n_lamps) [counts]; light that
cannot reach `min_count`, even without obstacles, is 0."""

clear: Any = compiled(_clear, _SOURCES)
"""Compute whether each twin is clear of obstacles (n,)."""

measure: Any = compiled(_measure, _SOURCES)
"""Measure the distances of each twin to its obstacles."""

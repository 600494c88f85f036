"""Controllers of `studies.behaviour`: each is a function of the counts of n robots."""

import numpy as np

from khep_twin.board.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.networks import forward
from khep_twin.randomness import stream
from khep_twin.units import COUNTS_LIMIT, SENSOR_HEADINGS, Sensor
from studies.one_object import Controller, Decide, Floats
from studies.sampled_world import DARK_COUNTS

_SLOW, _BRISK = 3.0, 6.0
_BRIGHT = 75.0
_SIDES = np.sin(SENSOR_HEADINGS)


def threshold_stop(level: float, direction: int = 1) -> Controller:
    """Return a controller that drives straight ahead, or back, and stops when a sensor reaches a level."""

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        memory[proximity.max(axis=1) >= level, 0] = 1
        return np.outer(direction * _SLOW * (memory[:, 0] == 0), [1.0, 1.0])

    return Controller(f"stop at {level:g}{', backwards' if direction < 0 else ''}", decide, 1)


def proportional_stop(level: float = 700) -> Controller:
    """Return a Braitenberg vehicle that slows down near an object, and drives back above a level."""

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        return np.outer(2 * _SLOW * (1 - proximity.max(axis=1) / level), [1.0, 1.0])

    return Controller("Braitenberg stop", decide)


def avoider() -> Controller:
    """Return the ROM's Braitenberg vehicle, with its integers: weights x counts / 400 + 10."""
    weights = np.array(DEMO_WEIGHTS, np.float64)

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        return np.trunc(proximity @ weights / DEMO_DIVISOR) + DEMO_SPEED_PULSES

    return Controller("ROM's Braitenberg", decide)


def wall_follower(side: str) -> Controller:
    """Return a controller that keeps objects at its "left" or "right" at half scale and turns before it."""
    names = (Sensor.RIGHT_90, Sensor.RIGHT_45) if side == "right" else (Sensor.LEFT_90, Sensor.LEFT_45)
    sign = 1.0 if side == "right" else -1.0

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        near = proximity[:, list(names)].mean(axis=1) / COUNTS_LIMIT
        front = proximity[:, [Sensor.LEFT_10, Sensor.RIGHT_10]].max(axis=1) / COUNTS_LIMIT
        turn = sign * (_BRISK * (near - 0.5) + _BRISK * front)
        return np.column_stack([_BRISK - turn, _BRISK + turn])

    return Controller(f"wall follower, {side}", decide)


def light_follower() -> Controller:
    """Return a Braitenberg vehicle that turns to the side that sees more light."""
    return Controller("light follower", lambda proximity, ambient, memory: _to_light(ambient))


def light_stop(level: float = 150) -> Controller:
    """Return a light follower that stops at a level of light, counts low in bright light."""

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        memory[ambient.min(axis=1) <= level, 0] = 1
        return _to_light(ambient) * (memory == 0)

    return Controller(f"light, stop at {level:g}", decide, 1)


def networks(count: int, seed: int = 0) -> list[Controller]:
    """Return random recurrent networks with inputs of proximity and light."""
    network = Network(hidden=(5,), recurrent=True, ambient=True, top_speed=10)
    return [
        Controller(f"network {number}", _network(network, rng.normal(size=network.n_genes)), network.sizes[1])
        for number, rng in enumerate(stream(seed, "behaviour", "network", index) for index in range(count))
    ]


def _network(network: Network, genes: Floats) -> Decide:
    weights = genes.tolist()

    def decide(proximity: Floats, ambient: Floats, memory: Floats) -> Floats:
        inputs = np.hstack([proximity / COUNTS_LIMIT, (DARK_COUNTS - ambient) / (DARK_COUNTS - _BRIGHT)])
        speeds: list[list[float]] = []
        for robot, row in enumerate(inputs.tolist()):
            values = [*row, *[0.0] * sum(network.sizes[1:])]
            state = memory[robot].tolist()
            out = forward(network.sizes, network.recurrent, weights, state, values)
            memory[robot] = state
            speeds.append([network.top_speed * values[out], network.top_speed * values[out + 1]])
        return np.array(speeds)

    return decide


def _to_light(ambient: Floats) -> Floats:
    light = np.maximum(DARK_COUNTS - ambient, 0)
    turn = 2 * _BRISK * (light @ _SIDES) / (light.sum(axis=1) + 10)
    return np.column_stack([_BRISK - turn, _BRISK + turn])

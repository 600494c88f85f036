"""Terms of turrets for the controllers of an episode, between calls of the stepping core."""

from collections.abc import Sequence
from math import isnan

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import installed_turrets
from khep_twin.episodes.controllers import Driver, Network, commands_of, terms_of
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes
from khep_twin.episodes.planar.planar_world import PlanarWorld
from khep_twin.errors import ControllerError
from khep_twin.robots.robot import Robot
from khep_twin.sensing.buffers import Vector
from khep_twin.world import World


class TurretLink:
    """Link between the controllers of an episode and the turrets of its robots.

    Args:
        driver: Controller of the robots.
        line: Line between controllers and robots.
        setup: Setup of the episode.

    Raises:
        ControllerError: A robot lacks a turret, as in a plane, or the episode has a line.
    """

    def __init__(self, driver: Driver, line: LineTimes, setup: EpisodeSetup) -> None:
        model, robots = setup.entry.robot_model, setup.playpen.robots
        terms = [term for term in model.find_terms(terms_of(driver)) if term.turret]
        commands = model.find_terms(commands_of(driver), commanded=True)
        for term in (*terms, *commands):
            if line is not None or not all(term.turret in robot.turrets for robot in robots):
                problem = f"no {term.turret}" if line is None else f"the {term.turret} at a line of {line}"
                expected = f"robots with a {term.turret}, in MuJoCo and without a line"
                raise ControllerError(f"{setup.playpen.name}: {term.name}: {problem}; expected {expected}")
        kinds = installed_turrets()
        self._readings = [(kinds[term.turret], n) for term in terms for n in range(*term.registers)]
        self._commands = [(kinds[term.turret], term) for term in commands]
        self._is_network = isinstance(driver, Network)
        self._orders = [[""] * len(commands) for _ in robots]

    def read(self, world: World | PlanarWorld, registers: Sequence[Vector[int]]) -> None:
        """Copy the readings to the end of the registers that controllers read (n_robots, n)."""
        robots = zip(_robots(world), registers, strict=True) if self._readings else ()
        for robot, values in robots:
            for index, (kind, register) in enumerate(self._readings, len(values) - len(self._readings)):
                values[index] = int(robot.firmware.turrets[kind].registers[register])

    def give_orders(self, world: World | PlanarWorld, outputs: NDArray[np.float64]) -> None:
        """Give the orders for outputs (n_robots, 2 + n_commands) that have changed; NaN is none."""
        for index, (kind, term) in enumerate(self._commands):
            for robot, values, orders in zip(_robots(world), outputs, self._orders, strict=True):
                value = float(values[2 + index])
                if isnan(value) or not robot.firmware.powered:
                    continue
                order = term.order_for(term.unscale(value) if self._is_network else value)
                if order != orders[index]:
                    robot.firmware.turrets[kind].receive(order.encode())
                    orders[index] = order


def _robots(world: World | PlanarWorld) -> Sequence[Robot]:
    """Return the robots of a world; a plane has none with turrets."""
    return world.robots if isinstance(world, World) else ()

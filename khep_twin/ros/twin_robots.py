"""Robots of one twin in this process as nodes: one world, whose time one of the nodes publishes."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from math import isinf
from typing import Self

from khep_twin.clock import to_ns
from khep_twin.errors import PortError
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.experiment.multi_robot import drive_together
from khep_twin.log.cdr import encode
from khep_twin.log.qos import qos_of
from khep_twin.ports.protocol_khep import open_url, parse_url
from khep_twin.ports.twin import Twin, equip_playpen, open_twin
from khep_twin.ros.graph import Node
from khep_twin.ros.standard import CLOCK
from khep_twin.ros.standard_output import StandardOutput
from khep_twin.ros.twin_services import TwinServices
from khep_twin.ros.twin_time import TwinTime
from khep_twin.sensing.calibration import read_for


class TwinRobots:
    """Robots of a twin; a context.

    Args:
        urls: URL khep:// of each robot by the name of its node.
        nodes: Nodes by name.
        speed: Simulated seconds per second; inf without pacing.
        step: Time of a step of a paused twin [s]; None if time is not paused.

    Attributes:
        titles: Titles of the robots' models by the names of their nodes.
        time: Time of the twin.
        world: World of the twin.

    Raises:
        KhepTwinError: A URL cannot be used, or they are of two worlds.
    """

    def __init__(
        self, urls: Mapping[str, str], nodes: Mapping[str, Node], speed: float, step: float | None
    ) -> None:
        self._twin, self._indices = _open_world(urls)
        self._nodes, self._is_paused = nodes, step is not None
        self.world, robots = self._twin.world, self._twin.robots
        self._numbers = {name: robots[index].index for name, index in self._indices.items()}
        self.titles = {
            name: self.world.playpen.robots[number].robot_model.title
            for name, number in self._numbers.items()
        }
        clock = next(iter(nodes.values())).publisher("/clock", CLOCK, qos_of("/clock"))
        if not isinf(speed):
            # Loading compiled code later would stop the time for half a second.
            self.world.code.switch_step = None
        self.time = self._twin.time_source = TwinTime(
            self.world,
            speed,
            None if step is None else to_ns(step),
            lambda time_ns: clock.send(encode(CLOCK, {"clock": time_ns})),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Complete the log of the twin."""
        self._twin.close()

    def make_output(self, name: str) -> StandardOutput:
        """Return the receiver of a robot's readings, by the name of its node."""
        number = self._numbers[name]
        entry, robot = self.world.playpen.robots[number], self.world.robots[number]
        calibration = read_for(entry.calibration, entry.robot_model)
        return StandardOutput(
            self._nodes[name], entry.robot_model, calibration, lambda: self.world.time_ns, lambda: robot.pose
        )

    def drive(self, run: Callable[[str, HostRobot], None]) -> None:
        """Offer the twin's services, and call `run` with each robot, in threads that take turns.

        Raises:
            KhepTwinError: The twin ended, or motors could not be stopped.
        """
        for name, node in self._nodes.items():
            TwinServices(node, self.time, self.world, self._numbers[name], is_paused=self._is_paused)
        scripts = {index: partial(run, name) for name, index in self._indices.items()}
        with ExitStack() as stack:
            for node in self._nodes.values():
                stack.enter_context(node)
            stack.callback(self.time.end)
            drive_together(self._twin, scripts)


def _open_world(urls: Mapping[str, str]) -> tuple[Twin, dict[str, int]]:
    """Open the twin of one or several URLs by name; return it, and the place of each robot in it.

    Raises:
        KhepTwinError: A URL cannot be used, or they differ in more than the robot.
    """
    if len(urls) == 1:
        [(name, url)] = urls.items()
        return open_url(url), {name: 0}
    worlds = {name: parse_url(url) for name, url in urls.items()}
    playpens = {(playpen, replace(options, robot=None)) for playpen, options in worlds.values()}
    if len(playpens) > 1:
        raise PortError(f"{' and '.join(urls.values())}: two worlds; expected one, with another ?robot=")
    for playpen, options in worlds.values():
        equip_playpen(playpen, options)  # refuses a robot that is not there
    indices = {name: options.robot or 0 for name, (_, options) in worlds.items()}
    if len({*indices.values()}) < len(indices):
        raise PortError(f"{' and '.join(urls.values())}: a robot is there twice; expected another ?robot=")
    [(playpen, options)] = playpens
    return open_twin(playpen, options), indices

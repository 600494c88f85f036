"""Robots at several ports as nodes of one graph, each driven until the end of all or a signal.

Twins of one playpen at khep:// share a world, in which the threads of their robots take turns. An error of a
robot ends its node alone.
"""

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import isinf
from typing import Self

from khep_twin.clock import to_ns
from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host.connection import connect
from khep_twin.host.host_robot import HostRobot
from khep_twin.host.opening import resolve_port
from khep_twin.lab.experiment.multi_robot import drive_together
from khep_twin.log.cdr import encode
from khep_twin.log.qos import CLOCK
from khep_twin.ports.protocol_khep import open_url, parse_url
from khep_twin.ports.twin import Twin, equip_playpen, open_twin
from khep_twin.ros.graph import Graph, Node
from khep_twin.ros.raw_output import RawOutput
from khep_twin.ros.robot_node import RobotNode
from khep_twin.ros.twin_services import TwinServices
from khep_twin.ros.twin_time import TwinTime

_CLOCK = "rosgraph_msgs/msg/Clock"

_TIMEOUT = 0.6
"""Time-out of a reply of a robot [s], as in teleoperation."""

_WATCH_INTERVAL = 0.1
"""Interval at which the router, the robots and signals are looked at [s]."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of all robots.

    Attributes:
        rate: Largest number of cycles per second.
        timeout: Time after the last velocity at which a robot stops [s].
        speed: Simulated seconds per second of twins at khep://; inf without pacing.
        is_paused: Whether time at khep:// passes in steps of a cycle only, by the service `step`.
    """

    rate: float = 20.0
    timeout: float = 0.5
    speed: float = 1.0
    is_paused: bool = False


class Fleet:
    """Robots at ports, and their nodes in a graph; a context.

    Args:
        graph: Graph of the nodes.
        ports: Ports of the robots.
        names: Names of their nodes.
        settings: Settings of all robots.

    Attributes:
        nodes: Nodes, in the order of the ports.
        titles: Titles of the robots' models, in this order.

    Raises:
        KhepTwinError: A port cannot be opened, a name cannot be used, or there are two worlds.
    """

    def __init__(self, graph: Graph, ports: Sequence[str], names: Sequence[str], settings: Settings) -> None:
        self._graph, self._settings = graph, settings
        self._n_failures = 0
        self._is_stopping = False
        self._time: TwinTime | None = None
        titles: dict[str, str] = {}
        urls = dict(zip(names, map(resolve_port, ports), strict=True))
        simulated = {name: url for name, url in urls.items() if url.startswith("khep://")}
        with ExitStack() as stack:
            self._nodes = {name: stack.enter_context(Node(graph, name)) for name in names}
            self._jobs: list[Callable[[], None]] = []
            for name in [name for name in names if name not in simulated]:
                robot = stack.enter_context(connect(urls[name], _TIMEOUT))
                robot.check_clock("a node of ROS")
                titles[name] = robot.model.title
                self._jobs.append(partial(self._drive, name, robot))
            if simulated:
                twin, indices = _open_world(simulated)
                stack.enter_context(twin)
                for name, index in indices.items():
                    titles[name] = twin.world.playpen.robots[twin.robots[index].index].robot_model.title
                self._time = twin.time_source = self._make_time(twin, self._nodes[next(iter(indices))])
                self._jobs.append(partial(self._drive_twin, twin, self._time, indices))
            self._stack = stack.pop_all()
        self.nodes = [self._nodes[name] for name in names]
        self.titles = [titles[name] for name in names]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, stop: Callable[[], bool]) -> int:
        """Drive all robots until they have failed or `stop` returns true; return the number that failed."""
        with ThreadPoolExecutor(len(self._jobs), "ros") as pool:
            results = [pool.submit(job) for job in self._jobs]
            try:
                while not (stop() or all(result.done() for result in results)):
                    self._graph.watch()
                    time.sleep(_WATCH_INTERVAL)
            finally:
                self._is_stopping = True
                if self._time is not None:
                    self._time.end()
        for result in results:
            result.result()
        return self._n_failures

    def _drive(self, name: str, robot: HostRobot) -> None:
        """Drive a robot, and then stop its motors and close its port."""
        with self._nodes[name], self._reporting(), robot:
            self._run_node(name, robot)

    def _drive_twin(self, twin: Twin, twin_time: TwinTime, indices: Mapping[str, int]) -> None:
        """Drive robots of a twin, by their places in it."""

        def script(name: str, robot: HostRobot) -> None:
            index = twin.robots[indices[name]].index
            with self._reporting():
                TwinServices(
                    self._nodes[name], twin_time, twin.world, index, is_paused=self._settings.is_paused
                )
                self._run_node(name, robot)

        scripts = {index: partial(script, name) for name, index in indices.items()}
        with ExitStack() as stack:
            # One of the nodes publishes the time, as long as any robot is driven.
            for name in indices:
                stack.enter_context(self._nodes[name])
            stack.callback(twin_time.end)
            with self._reporting():
                drive_together(twin, scripts)

    def _run_node(self, name: str, robot: HostRobot) -> None:
        settings, node = self._settings, self._nodes[name]
        output = RawOutput(node)
        robot_node = RobotNode(robot, node, output, interval=1 / settings.rate, timeout=settings.timeout)
        robot_node.run(lambda: self._is_stopping)

    @contextmanager
    def _reporting(self) -> Generator[None]:
        """Report the error that ends the drive of a robot."""
        try:
            yield
        except KhepTwinError as error:
            self._n_failures += 1
            self._graph.report_once(str(error), str(error))

    def _make_time(self, twin: Twin, node: Node) -> TwinTime:
        settings = self._settings
        clock = node.publisher("/clock", _CLOCK, CLOCK)
        step_ns = to_ns(1 / settings.rate) if settings.is_paused else None
        if not isinf(settings.speed):
            # Loading compiled code later would stop the time for half a second.
            twin.world.code.switch_step = None
        return TwinTime(
            twin.world,
            settings.speed,
            step_ns,
            lambda time_ns: clock.put(encode(_CLOCK, {"clock": time_ns})),
        )


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

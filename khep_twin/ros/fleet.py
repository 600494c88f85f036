"""Robots at several ports as nodes of one graph, each driven until the end of all or a signal.

Each robot has a thread; those of twins at khep:// take turns in one world. An error of a robot ends its node
alone.
"""

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Self

from khep_twin.errors import KhepTwinError
from khep_twin.host.connection import connect
from khep_twin.host.host_robot import HostRobot
from khep_twin.host.opening import resolve_port
from khep_twin.lab.experiment.teleoperation import TIMEOUT
from khep_twin.ros.graph import Graph, Node
from khep_twin.ros.robot_node import RobotNode
from khep_twin.ros.standard_output import StandardOutput
from khep_twin.sensing.calibration import read_for

if TYPE_CHECKING:
    from khep_twin.ros.twin_robots import TwinRobots

_WATCH_INTERVAL = 0.1
"""Interval at which the router, the robots and signals are looked at [s]."""


@dataclass(frozen=True, slots=True)
class NodeSettings:
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
        twin: Robots of a twin at khep://; None without.

    Raises:
        KhepTwinError: A port cannot be opened, a name cannot be used, or there are two worlds.
    """

    def __init__(
        self, graph: Graph, ports: Sequence[str], names: Sequence[str], settings: NodeSettings
    ) -> None:
        self._graph, self._settings = graph, settings
        self._n_failures = 0
        self._is_stopping = False
        self.twin: TwinRobots | None = None
        self._jobs: list[Callable[[], None]] = []
        titles: dict[str, str] = {}
        urls = dict(zip(names, map(resolve_port, ports), strict=True))
        simulated = {name: url for name, url in urls.items() if url.startswith("khep://")}
        with ExitStack() as stack:
            self._nodes = {name: stack.enter_context(Node(graph, name)) for name in names}
            for name in [name for name in names if name not in simulated]:
                robot = stack.enter_context(connect(urls[name], TIMEOUT))
                robot.check_clock("a node of ROS")
                titles[name] = robot.model.title
                self._jobs.append(partial(self._drive, name, robot))
            if simulated and len(simulated) < len(names):
                text = "robots have the time of the wall clock, twins at khep:// simulated time"
                graph.report(f"{text}; expected one kind, unless all listeners ignore stamps")
            if simulated:
                if graph.has_publisher("/clock"):
                    graph.report("/clock: another node publishes simulated time; expected one in a domain")
                self.twin = stack.enter_context(self._open_twin(simulated))
                titles |= self.twin.titles
                self._jobs.append(partial(self._drive_twin, self.twin))
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
                while not stop() and wait(results, _WATCH_INTERVAL, FIRST_EXCEPTION).not_done:
                    self._graph.watch()
                    for result in results:
                        if result.done():
                            result.result()  # raises a fault of the program
            finally:
                self._is_stopping = True
                if self.twin is not None:
                    self.twin.time.end()
        for result in results:
            result.result()
        return self._n_failures

    def _open_twin(self, urls: Mapping[str, str]) -> "TwinRobots":
        # Nodes of robots alone need no simulator.
        from khep_twin.ros.twin_robots import TwinRobots

        nodes = {name: self._nodes[name] for name in urls}
        step = 1 / self._settings.rate if self._settings.is_paused else None
        return TwinRobots(urls, nodes, self._settings.speed, step)

    def _drive(self, name: str, robot: HostRobot) -> None:
        """Drive a robot, and then stop its motors and close its port."""
        with self._nodes[name], self._reporting(), robot:
            self._run_node(name, robot)

    def _drive_twin(self, twin: "TwinRobots") -> None:
        """Drive the robots of a twin; its nodes stay as long as any of them is driven."""

        def script(name: str, robot: HostRobot) -> None:
            with self._reporting():
                self._run_node(name, robot)

        with self._reporting():
            twin.drive(script)

    def _run_node(self, name: str, robot: HostRobot) -> None:
        settings, node = self._settings, self._nodes[name]
        if self.twin is not None and name in self.twin.titles:
            output = self.twin.make_output(name)
        else:
            calibration = read_for(robot.model.calibration, robot.model)
            output = StandardOutput(node, robot.model, calibration, time.time_ns)
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

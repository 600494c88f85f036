"""One robot as a node of ROS 2: commands from topics to its line, and its readings to topics.

The robot's thread does all exchanges on the line, one request at a time. Callbacks of topics and services
only store the latest command. It is sent between two requests, so that it waits for one exchange at most.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Protocol

from khep_twin.errors import KhepTwinError, PortTimeout, ProtocolError
from khep_twin.host.host_robot import HostRobot
from khep_twin.log.message_types import Message
from khep_twin.robots.model import Dialect
from khep_twin.ros.graph import Node
from khep_twin.ros.standard import SUPPLY_VOLTAGE
from khep_twin.ros.velocity import STOP, TWIST, TWIST_STAMPED, Velocity, setpoint_limit, setpoints_of

_POLL_INTERVAL = 0.01
"""Interval at which a robot that waits for its next cycle looks for commands [s of the robot's time]."""

_VOLTAGE_INTERVAL = 1.0
"""Interval of the voltage of the supply [s]."""

_RESOLUTION = 1e-6
"""Shortest wait [s]; simulated time has whole nanoseconds."""

ANSWER_LIMIT = 5.0
"""Longest wait of a service for a robot or a twin [s]."""

TRIGGER, BOOL = "std_srvs/srv/Trigger", "std_msgs/msg/Bool"


class ReadingsOutput(Protocol):
    """Receiver of a robot's readings."""

    def begin(self) -> None:
        """Take the time of a cycle, immediately before its first reading."""

    def publish(self, channels: Mapping[str, Sequence[float]]) -> None:
        """Publish the readings of the cycle by channel."""

    def restart(self) -> None:
        """Restart the odometry: the position counters are 0."""


class RobotNode:
    """Node of a robot.

    The node subscribes `cmd_vel`, of both types of velocities, and `led0`, `led1` and so on, and serves
    `reset_position`, all below the name of the node.

    Args:
        robot: Robot, used only by the thread that calls `run`.
        node: Node in the graph.
        output: Receiver of its readings.
        interval: Shortest time of a cycle [s].
        timeout: Time after the last velocity at which the robot stops [s].
    """

    def __init__(
        self, robot: HostRobot, node: Node, output: ReadingsOutput, *, interval: float, timeout: float
    ) -> None:
        self._robot, self._node, self._output = robot, node, output
        self._interval, self._timeout = interval, timeout
        self._is_simulated = hasattr(robot.port, "time_ns")
        self._requests, self._limit = _requests_of(robot.dialect), setpoint_limit(robot.model)
        self._voltage_time = robot.time
        self._wake, self._lock = threading.Event(), threading.Lock()
        self._command = STOP, robot.time
        self._leds: tuple[bool, ...] | None = None
        self._resets: list[Future[None]] = []
        self._sent_setpoints: tuple[int, int] | None = None
        self._sent_leds: tuple[bool, ...] | None = None
        node.subscribe("~/cmd_vel", (TWIST, TWIST_STAMPED), self._on_velocity)
        for number in range(len(robot.leds)):
            node.subscribe(
                f"~/led{number}", (BOOL,), lambda _, message, led=number: self._on_led(led, message)
            )
        node.serve("~/reset_position", TRIGGER, self._on_reset)

    # Threads of Zenoh ----------------------------------------------------------------------------------

    def _on_velocity(self, type_name: str, message: Message) -> None:
        velocity = STOP
        try:
            velocity = Velocity.of_message(type_name, message)
        finally:
            self._command = velocity, self._robot.time
            self._wake.set()

    def _on_led(self, led: int, message: Message) -> None:
        with self._lock:
            are_lit = list(self._leds or (False,) * len(self._robot.leds))
            are_lit[led] = bool(message["data"])
            self._leds = tuple(are_lit)
        self._wake.set()

    def _on_reset(self, _: Message) -> Message:
        reset = Future[None]()
        self._resets.append(reset)
        self._wake.set()
        return await_outcome(reset, "the position counters are 0")

    # The robot's thread --------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool]) -> None:
        """Exchange commands and readings until `stop` returns true.

        Raises:
            KhepTwinError: The connection is lost, or two cycles in a row got no reply.
        """
        was_unanswered = False
        try:
            while not stop():
                try:
                    self._cycle(stop)
                    was_unanswered = False
                except (PortTimeout, ProtocolError):
                    # The robot may have missed any command; the next cycle sends all of them again.
                    self._sent_setpoints = self._sent_leds = None
                    if was_unanswered:
                        raise
                    was_unanswered = True
        finally:
            while self._resets:
                self._resets.pop().set_exception(KhepTwinError("the robot is not driven any more"))

    def _cycle(self, stop: Callable[[], bool]) -> None:
        end = self._robot.time + self._interval
        channels: dict[str, list[float]] = {}
        for number, names in enumerate(self._requests):
            self._send_commands()
            if not number:
                self._output.begin()
            for name, values in self._robot.read_channels(*names).items():
                channels.setdefault(_channel_of(name), []).extend(values)
        if self._robot.time >= self._voltage_time:
            self._send_commands()
            channels |= self._read_voltage()
        self._output.publish(channels)
        while (rest := end - self._robot.time) > _RESOLUTION and not stop():
            self._send_commands()
            if self._is_simulated:
                self._robot.sleep(min(rest, _POLL_INTERVAL))
            elif self._wake.wait(min(rest, _POLL_INTERVAL)):
                self._wake.clear()

    def _read_voltage(self) -> dict[str, list[float]]:
        """Return the voltage of the supply as a channel, if the robot reports it."""
        self._voltage_time = self._robot.time + _VOLTAGE_INTERVAL
        try:
            voltage = self._robot.supply_voltage()
        except ProtocolError as error:
            self._voltage_time = math.inf
            self._node.report_once("voltage", f"no battery_state: {error}")
            return {}
        return {} if voltage is None else {SUPPLY_VOLTAGE: [voltage]}

    def _send_commands(self) -> None:
        """Send commands that have changed."""
        velocity, time = self._command
        if self._robot.time - time > self._timeout:
            velocity = STOP
        setpoints = setpoints_of(self._robot.model, velocity, self._limit)
        if setpoints.is_clamped:
            text = f"linear.x = {velocity.forward:g}, angular.z = {velocity.turn:g}: beyond the motors' limit"
            self._node.report_once("limit", f"{text}; clamped, with the same curvature")
        if (wheels := (setpoints.left, setpoints.right)) != self._sent_setpoints:
            self._robot.set_setpoints(*wheels)
            self._sent_setpoints = wheels
        leds = self._leds
        if leds is not None and leds != self._sent_leds:
            self._robot.light_leds(leds)
            self._sent_leds = leds
        while self._resets:
            self._reset()

    def _reset(self) -> None:
        reset = self._resets.pop()
        try:
            self._robot.reset_position()
        except KhepTwinError as error:
            reset.set_exception(error)
            if isinstance(error, PortTimeout | ProtocolError):
                raise
        else:
            self._output.restart()
            reset.set_result(None)


def await_outcome(future: Future[None], message: str) -> Message:
    """Return the response of a service of type Trigger or SetBool, after the end of its work."""
    try:
        future.result(ANSWER_LIMIT)
    except TimeoutError:
        return {"success": False, "message": f"not done within {ANSWER_LIMIT:g} s"}
    except KhepTwinError as error:
        return {"success": False, "message": str(error)}
    return {"success": True, "message": message}


def _requests_of(dialect: Dialect) -> list[list[str]]:
    """Return the names of all channels that can be read, those of one request together.

    The position is first: its age matters most.
    """
    names_by_request: dict[str, list[str]] = {}
    for name, read in sorted(dialect.reads.items(), key=lambda item: item[0] != "position"):
        names_by_request.setdefault(read.request, []).append(name)
    return [*names_by_request.values()]


def _channel_of(name: str) -> str:
    """Return the channel of a read of one of its parts, like "ultrasonic 1"."""
    return name.partition(" ")[0]

"""Robots and twins as nodes, driven by zenoh-ros2-sdk in another process."""

import math
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from command_line import complaint
from ros_network import DOMAIN, LIMIT, ForeignNode, Lines, assert_soon
from served_twin import served, stop

from khep_twin.errors import PortError, ProtocolError
from khep_twin.host.khepera import Khepera
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.serve import serve
from khep_twin.ports.twin import open_twin
from khep_twin.ros.fleet import Fleet, NodeSettings
from khep_twin.ros.graph import Graph, Node
from khep_twin.ros.wire import NodeName
from stand_ins.fake_robot import TerminalRobot

TWIST, BOOL, TRIGGER = "geometry_msgs/msg/Twist", "std_msgs/msg/Bool", "std_srvs/srv/Trigger"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
NO_FIELDS = {"structure_needs_at_least_one_member": 0}
QUICK = NodeSettings(rate=100.0, timeout=0.2)


class Drive:
    """Robots that are driven in another thread, until `end`."""

    def __init__(self, graph: Graph, ports: Sequence[str], settings: NodeSettings) -> None:
        names = [f"khepera{number}" for number in range(len(ports))]
        self.fleet = Fleet(graph, ports, names, settings)
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(1)
        self._result = self._pool.submit(self.fleet.run, self._stop.is_set)

    def end(self) -> int:
        """Stop the robots; return the number of those that had failed."""
        self._stop.set()
        return self._result.result(LIMIT)

    def wait_until(self, is_done: Callable[[], object]) -> None:
        """Wait until something has happened, while the robots are driven."""
        deadline = time.monotonic() + LIMIT
        while not is_done():
            assert not self._result.done(), f"ended: {self._result.result()} robots have failed"
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def close(self) -> None:
        self._stop.set()
        self._pool.shutdown()
        self.fleet.__exit__()


@contextmanager
def driven(graph: Graph, *ports: str, settings: NodeSettings = QUICK) -> Iterator[Drive]:
    drive = Drive(graph, ports, settings)
    try:
        yield drive
    finally:
        drive.close()


@contextmanager
def twin_at_terminal(playpen: str) -> Iterator[str]:
    """Serve a twin in another thread at a pseudo-terminal; yield its path."""
    ended = threading.Event()
    with open_twin(playpen) as twin, PtyPort() as port, ThreadPoolExecutor(1) as pool:
        server = pool.submit(serve, twin, [port], stop=ended.is_set, notify=lambda _: None)
        try:
            yield port.path
        finally:
            ended.set()
            server.result(LIMIT)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the replies of robots in other threads; a late reply warns, which ends the drive in tests."""
    monkeypatch.setattr("khep_twin.ros.fleet.TIMEOUT", LIMIT)


@pytest.fixture
def fake() -> Iterator[TerminalRobot]:
    with TerminalRobot() as robot:
        yield robot


def speeds(fake: TerminalRobot) -> list[str]:
    """Return the speeds that were sent, each once."""
    requests = [request for request in fake.requests if request.startswith("D")]
    return [speed for index, speed in enumerate(requests) if index == 0 or speed != requests[index - 1]]


def test_a_robot_obeys_velocities_and_stops_without_them(
    graph: Graph, foreign: ForeignNode, fake: TerminalRobot, lines: Lines
) -> None:
    with driven(graph, fake.url) as drive:
        foreign.publish(topic="/khepera0/cmd_vel", type=TWIST, message={"linear": {"x": 0.08}})
        drive.wait_until(lambda: "D,10,10" in fake.requests)
        foreign.stop()
        drive.wait_until(lambda: speeds(fake)[-1] == "D,0,0")
        foreign.publish(topic="/khepera0/led1", type=BOOL, message={"data": 1})
        drive.wait_until(lambda: "L,1,1" in fake.requests)
        foreign.stop()
        assert drive.end() == 0
    assert speeds(fake)[-2:] == ["D,10,10", "D,0,0"]
    assert lines.all() == []


def test_an_impossible_velocity_is_reported_once(
    graph: Graph, foreign: ForeignNode, fake: TerminalRobot, lines: Lines
) -> None:
    with driven(graph, fake.url) as drive:
        foreign.publish(topic="/khepera0/cmd_vel", type=TWIST, message={"linear": {"x": 5.0}})
        drive.wait_until(lambda: "D,127,127" in fake.requests)
        text = "linear.x = 5, angular.z = 0: beyond the motors' limit; clamped, with the same curvature"
        assert lines.next() == f"/khepera0: {text}"
        foreign.publish(topic="/khepera0/cmd_vel", type=TWIST, message={"linear": {"x": math.nan}})
        assert lines.next() == (
            "/khepera0/cmd_vel: linear.x = nan, angular.z = 0.0: the robot stops; expected finite numbers"
        )
        drive.wait_until(lambda: speeds(fake)[-1] == "D,0,0")
        foreign.stop()
    assert lines.all() == []


def test_a_robot_that_is_lost_leaves_the_graph_and_the_others_stay(
    graph: Graph, foreign: ForeignNode, fake: TerminalRobot, lines: Lines
) -> None:
    with twin_at_terminal("arena4") as path, driven(graph, fake.url, path) as drive:
        assert [*drive.fleet.titles] == ["Khepera", "Khepera IV"]
        topics = {"/khepera0/odom", "/khepera0/battery_state", "/khepera1/imu"}
        drive.wait_until(lambda: foreign.topics().keys() >= topics)
        fake.unplug()
        assert re.match(rf"{fake.url}: the port failed at .*; the motors may still run: ", lines.next())
        drive.wait_until(lambda: "/khepera0/cmd_vel" not in foreign.topics())
        foreign.subscribe(topic="/khepera1/imu", type="sensor_msgs/msg/Imu")
        for _ in range(3):
            assert "frame_id='khepera1/base_link'" in foreign.hear(topic="/khepera1/imu")
        assert drive.end() == 1
    assert_soon(lambda: any(graph.session_id in token for token in foreign.tokens()), False)
    assert lines.all() == []


def test_a_robot_that_refuses_the_voltage_is_driven_without(
    graph: Graph, fake: TerminalRobot, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Khepera) -> float:
        raise ProtocolError("'I,0' was answered 'z'")

    monkeypatch.setattr(Khepera, "supply_voltage", refuse)
    with driven(graph, fake.url) as drive:
        assert lines.next() == "/khepera0: no battery_state: 'I,0' was answered 'z'"
        n_requests = len(fake.requests)
        drive.wait_until(lambda: len(fake.requests) > n_requests + 10)
        assert drive.end() == 0
    assert lines.all() == []


def test_a_second_source_of_simulated_time_is_reported(router: Graph, graph: Graph, lines: Lines) -> None:
    with Node(router, "simulator") as simulator:
        simulator.publisher("/clock", "rosgraph_msgs/msg/Clock")
        with Fleet(graph, ["khep://default"], ["khepera0"], QUICK):
            text = "another node publishes simulated time; expected one in a domain"
            assert lines.all() == [f"/clock: {text}"]


def test_a_paused_twin_advances_in_steps_and_publishes_its_time(
    graph: Graph, foreign: ForeignNode, lines: Lines
) -> None:
    settings = NodeSettings(rate=10.0, is_paused=True)
    with driven(graph, "khep://default?unpaced=on", settings=settings) as drive:
        assert drive.fleet.twin is not None
        world = drive.fleet.twin.world
        drive.wait_until(lambda: "/khepera0/step" in foreign.services())
        foreign.subscribe(topic="/clock", type="rosgraph_msgs/msg/Clock")

        def step() -> str:
            return foreign.call(service="/khepera0/step", type=TRIGGER, request=NO_FIELDS)

        for number in range(1, 4):
            assert f"success=True, message='{number / 10:g} s'" in step()
            assert world.time_ns == number * 100_000_000
        clock = re.search("sec=0, nanosec=([0-9]+)", foreign.hear(topic="/clock"))
        assert clock is not None
        assert int(clock[1]) > 0
        headings = [world.robots[0].pose[2]]
        foreign.publish(topic="/khepera0/cmd_vel", type=TWIST, message={"angular": {"z": 1.0}})
        while headings[-1] < headings[0] + 0.1:
            step()
            headings.append(world.robots[0].pose[2])
            assert len(headings) < 1000
        foreign.stop()
        while abs(headings[-1] - headings[-2]) > 1e-3:
            step()
            headings.append(world.robots[0].pose[2])
            assert len(headings) < 1000
        assert drive.end() == 0
    assert lines.all() == []


def test_a_twin_is_moved_and_its_lamps_are_switched(graph: Graph, foreign: ForeignNode, lines: Lines) -> None:
    with driven(graph, "khep://two-lamps", settings=NodeSettings(is_paused=True)) as drive:
        assert drive.fleet.twin is not None
        world = drive.fleet.twin.world
        drive.wait_until(lambda: "/khepera0/lamps" in foreign.services())
        place = {"position": {"x": 0.3, "y": 0.2}, "orientation": {"z": math.sqrt(0.5), "w": math.sqrt(0.5)}}
        message = {"header": {"frame_id": "map"}, "pose": {"pose": place}}
        foreign.publish(topic="/khepera0/set_pose", type=POSE, message=message)
        pose = pytest.approx((0.3, 0.2, math.pi / 2))
        drive.wait_until(lambda: world.robots[0].pose == pose)
        foreign.publish(topic="/khepera0/set_pose", type=POSE, message={"header": {"frame_id": "odom"}})
        assert lines.next() == "/khepera0: set_pose: a pose in frame 'odom'; expected 'map'"
        foreign.publish(topic="/khepera0/set_pose", type=POSE, message={})
        assert lines.next().startswith("/khepera0: set_pose: robot 1 at (0, 0) overlaps")
        foreign.stop()
        for is_on, state in ((0, "off"), (1, "by their schedules")):
            response = foreign.call(
                service="/khepera0/lamps", type="std_srvs/srv/SetBool", request={"data": bool(is_on)}
            )
            assert f"success=True, message='the lamps are {state}'" in response
            assert world.lamps.is_switched_off(0) == world.lamps.is_switched_off(1) == (not is_on)
    assert lines.all() == []


def test_robots_of_one_playpen_share_a_world(graph: Graph, foreign: ForeignNode) -> None:
    settings = NodeSettings(speed=math.inf)
    with driven(graph, "khep://arena4-two?robot=1", "khep://arena4-two", settings=settings) as drive:
        assert drive.fleet.twin is not None
        robots = drive.fleet.twin.world.robots
        headings = [robot.pose[2] for robot in robots]
        foreign.publish(topic="/khepera1/cmd_vel", type=TWIST, message={"angular": {"z": 1.0}})
        drive.wait_until(lambda: abs(robots[0].pose[2] - headings[0]) > 0.1)
        foreign.stop()
        assert robots[1].pose[2] == pytest.approx(headings[1], abs=0.01)


@pytest.mark.parametrize(
    ("urls", "reason"),
    [
        (["khep://default", "khep://obstacles"], "two worlds"),
        (["khep://swarm", "khep://swarm?robot=0"], "a robot is there twice"),
        (["khep://swarm", "khep://swarm?robot=20"], "robot = 20: not in playpen 'swarm'"),
    ],
)
def test_robots_that_cannot_share_a_world_are_refused(graph: Graph, urls: list[str], reason: str) -> None:
    with pytest.raises(PortError, match=reason):
        Fleet(graph, urls, ["khepera0", "khepera1"], QUICK)
    assert_soon(lambda: graph.has_node(NodeName.of("khepera0")), False)


def test_a_signal_stops_the_robot(router: Graph, foreign: ForeignNode, fake: TerminalRobot) -> None:
    options = f"--router={router.address}", f"--domain={DOMAIN}", "--timeout=60"
    with served(fake.url, *options, command="ros") as (process, line):
        assert line == f"/khepera0  Khepera at {fake.url}"
        foreign.publish(topic="/khepera0/cmd_vel", type=TWIST, message={"linear": {"x": 0.08}})
        assert_soon(lambda: "D,10,10" in fake.requests, True)
        foreign.stop()
        status, output = stop(process, signal.SIGINT)
        assert status == 130, output
    assert speeds(fake)[-2:] == ["D,10,10", "D,0,0"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["khep://default", "--namespace=a", "--namespace=b"], "--namespace: /a, /b for 1 ports"),
        (["1", "2", "--namespace=a", "--namespace=/a"], "--namespace: /a, /a for 2 ports"),
        (["khep://default", "--be-router", "--peer"], "--peer: has no effect with --be-router"),
        (["/dev/ttyUSB0", "--paused"], "--paused is for twins at khep://"),
        (["/dev/ttyUSB0", "--speed=2"], "--speed is for twins at khep://"),
        (["khep://default", "--paused", "--speed=2"], "--speed: has no effect with --paused"),
        (["khep://default", "--speed=0"], "--speed 0: expected a number from 0.001 to 1000, or max"),
        (["khep://default", "--domain=233"], "Invalid value for '--domain'"),
    ],
)
def test_unusable_options_are_refused(words: list[str], reason: str) -> None:
    assert complaint("ros", *words).startswith(reason)

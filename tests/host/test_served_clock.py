"""Waits of hosts at served twins, by the clock in the server's registry entry."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import complaint
from served_twin import served

from khep_twin.episodes.controllers import Network
from khep_twin.errors import PortError
from khep_twin.host import Khepera, Radio, robot_port
from khep_twin.lab.experiment import run
from khep_twin.lab.experiment.periodic_controllers import NetworkController
from stand_ins.fake_robot import FakeRobot

NETWORK = Network(genes=(0.1,) * Network().n_genes)


@pytest.fixture
def fake() -> Iterator[FakeRobot]:
    with FakeRobot() as robot:
        robot.answers |= {"K": "k,0,1,5,0,1,5", "T": "t,4,f,0"}
        yield robot


def poll_radio(robot: Khepera) -> None:
    """Wait for a message of a radio that has none."""
    radio = Radio.__new__(Radio)
    radio._robot = robot
    radio.wait_for_message()


WAITS: list[Callable[[Khepera], object]] = [
    lambda robot: robot.sleep(0.1),
    lambda robot: robot.wait_for_target(),
    poll_radio,
    lambda robot: run(NetworkController(NETWORK), robot, cycles=3),
    lambda robot: run(lambda robot: robot.proximity(), robot, seconds=1),
]


@pytest.mark.parametrize(("speed", "option"), [(0.0, "--clock wire"), (math.inf, "--speed max")])
def test_a_wait_at_a_server_whose_clock_does_not_pass_with_it_is_refused(
    speed: float, option: str, fake: FakeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = f" at a server with {option}, where waits have no .*expected khep://"
    monkeypatch.setattr(robot_port, "served_speed", lambda _: speed)
    with Khepera(fake.url) as robot:
        for wait in WAITS:
            with pytest.raises(PortError, match=message):
                wait(robot)
        # A controller that does not wait has its cycles.
        assert run(lambda robot: robot.proximity(), robot, cycles=2).cycles == 2


@pytest.mark.parametrize("speed", [0.25, 4.0])
def test_a_wait_is_in_simulated_time_at_each_speed(
    speed: float, fake: FakeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    monkeypatch.setattr(robot_port, "served_speed", lambda _: speed)
    with Khepera(fake.url) as robot:
        monkeypatch.setattr(robot_port.time, "sleep", waits.append)
        robot.sleep(1.0)
        assert waits == [1 / speed]
        monkeypatch.setattr(robot_port.time, "monotonic_ns", lambda: 3_000_000_000)
        assert robot.time == 3 * speed
        monkeypatch.undo()


def test_a_host_at_a_slow_server_waits_longer_for_replies(
    fake: FakeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_port, "served_speed", lambda _: 0.25)
    with Khepera(fake.url) as robot:
        assert robot.port.timeout == 2.0


def test_a_network_that_waits_is_refused_by_the_wire_clock_and_the_checks_too(tmp_path: Path) -> None:
    NETWORK.save(tmp_path / "best.npz", np.array(NETWORK.genes))
    with served("default", "--clock", "wire") as (_, path):
        for words in (("run", "best.npz", "--cycles", "3", "--port", path), ("conform", path)):
            text = complaint(*words, folder=tmp_path)
            assert text.startswith(f"{path}: ")
            assert (
                " at a server with --clock wire, where waits have no simulated time; expected khep://" in text
            )

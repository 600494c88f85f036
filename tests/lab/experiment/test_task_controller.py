"""Policies of a task as controllers: observations and actions as in the training environment."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from khep_twin.clock import to_ns
from khep_twin.envs.gymnasium import KheperaEnvironment
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.errors import ControllerError
from khep_twin.host import Khepera, Khepera4
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.task_controller import TaskController
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_start
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin


class BoardOf:
    """The robot of an environment, as seen by a host on a serial line without delay."""

    def __init__(self, environment: KheperaEnvironment) -> None:
        self.environment, self.time = environment, 0.0

    def read_registers(self, registers: Sequence[int]) -> list[int]:
        return self.environment._episode.registers[0][[*registers]].tolist()


@pytest.mark.parametrize("normalize", [True, False])
def test_a_policy_observes_and_acts_as_in_the_environment(normalize: bool) -> None:
    environment = KheperaEnvironment("LightSeeking", planar=True, compiled=False, normalize=normalize)
    robot: Any = BoardOf(environment)
    observations: list[NDArray[np.float32]] = []
    rng, limit = np.random.default_rng(1), 1.0 if normalize else 20.0
    actions = rng.uniform(-1.2 * limit, 1.2 * limit, (20, 2)).astype(np.float32)

    def policy(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        observations.append(observation)
        return actions[len(observations) - 1]

    controller = TaskController("LightSeeking", policy, normalize=normalize)
    observation, _ = environment.reset(seed=1)
    controller.start(robot)
    for action in actions:
        speeds = controller.decide(robot)
        np.testing.assert_array_equal(observations[-1], observation)
        assert observations[-1].dtype == observation.dtype
        assert speeds == tuple(TaskSetup("LightSeeking", normalize=normalize).speeds(action))
        observation, *_ = environment.step(action)
        robot.time += 0.05


def test_a_policy_on_a_line_observes_what_it_does_in_the_environment_with_that_line() -> None:
    start = 300.0, 300.0, 40.0
    actions = np.random.default_rng(2).uniform(-1, 1, (30, 2))
    environment = KheperaEnvironment("LightSeeking", line=38400, compiled=False)
    expected = [environment.reset(options={"seed": 5, "start": start})[0]]
    expected += [environment.step(action)[0] for action in actions[:-1]]
    observations: list[NDArray[np.float32]] = []

    def policy(observation: NDArray[np.float32]) -> NDArray[np.float64]:
        observations.append(observation)
        return actions[len(observations) - 1]

    playpen = at_start(Playpen.load("light-seeking"), 0, start)
    with Khepera(Serial.of(open_twin(playpen, TwinOptions(seed=5, mode=3)))) as robot:
        run(TaskController("LightSeeking", policy), robot, cycles=30)
    np.testing.assert_array_equal(observations, expected)


def test_a_robot_is_asked_for_what_the_task_observes_once_a_period() -> None:
    requests: list[str] = []
    ends: list[int] = []
    with Khepera("khep://light-seeking?mode=3", baudrate=38400) as robot:
        robot.listen(lambda request, reply: requests.append(request))
        controller = TaskController("LightSeeking", lambda observation: (0.5, -0.25))
        run(controller, robot, cycles=4, after_cycle=lambda: ends.append(to_ns(robot.time)))
    assert requests == [*["N", "O", "H", "D,10,-5"] * 4, "D,0,0"]
    assert np.diff(ends).tolist() == [50_000_000] * 3


def test_a_khepera_4_is_asked_for_the_terms_of_its_task() -> None:
    requests: list[str] = []
    observations: list[NDArray[np.float32]] = []

    def policy(observation: NDArray[np.float32]) -> tuple[float, float]:
        observations.append(observation)
        return 0.25, 0.5

    controller = TaskController("KheperaIVLineFollowing", policy)
    with Khepera4("khep://arena4-line") as robot:
        robot.listen(lambda request, reply: requests.append(request))
        run(controller, robot, cycles=20)
    assert requests[:5] == ["N", "R", "S", "D,150,300", "N"]
    ground, speed, turn = np.split(observations[-1], [4, 6])
    assert ground.max() > 0.5  # white floor
    assert speed == pytest.approx([0.25, 0.5], abs=0.05)
    assert 0 < turn[0] < 0.5  # to the left
    with (
        Khepera("khep://default") as other,
        pytest.raises(ControllerError, match="KheperaIVLineFollowing: model = "),
    ):
        run(controller, other, cycles=1)


class Box:
    """A space of Gymnasium."""

    def __init__(self, low: float, high: float, count: int) -> None:
        self.low, self.high = np.full(count, low), np.full(count, high)

    def __repr__(self) -> str:
        return f"Box({self.low[0]}, {self.high[0]}, {self.low.shape})"


class Model:
    """A model with the interface of stable-baselines3."""

    def __init__(self, observation_space: object, action_space: object) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def predict(self, observation: object, state: object = None, deterministic: bool = False) -> object:
        assert deterministic
        return np.array([1.0, 0.0]), state


RIGHT_ONES = Box(-1, 1, 10), Box(-1, 1, 2)


def test_a_model_is_asked_without_chance() -> None:
    controller = TaskController("ObstacleAvoidance", Model(*RIGHT_ONES))  # type: ignore[arg-type]
    with Khepera("khep://obstacles") as robot:
        controller.start(robot)
        assert controller.decide(robot) == (20.0, 0.0)


@pytest.mark.parametrize(
    ("task", "policy", "message"),
    [
        (
            "Homing",
            len,
            "task Homing: no robot reports its charge; expected a task that observes proximity, light, speed",
        ),
        (
            "LightSeeking",
            Model(*RIGHT_ONES),
            r"Model: made for observations Box\(-1, 1, \(10,\)\); expected those of task LightSeeking, "
            r"of 18 numbers \(proximity, light, speed\) from -1 to 1$",
        ),
        (
            "ObstacleAvoidance",
            Model(Box(0, 1023, 10), Box(-20, 20, 2)),
            r"expected those of task ObstacleAvoidance, of 10 numbers .*, or normalize=False$",
        ),
        (
            "ObstacleAvoidance",
            Model(RIGHT_ONES[0], SimpleNamespace(n=4)),
            r"made for actions namespace\(n=4\); expected .*, of two numbers from -1 to 1$",
        ),
    ],
    ids=["charge", "shape", "scale", "actions"],
)
def test_a_policy_for_something_else_is_refused_at_once(task: str, policy: Any, message: str) -> None:
    with pytest.raises(ControllerError, match=message) as caught:
        TaskController(task, policy)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("None", "the policy returned None; expected two finite numbers, left and right, from -1 to 1"),
        ("(0.5, float('nan'))", r"the policy returned \(0.5, nan\); expected two finite"),
        ("np.zeros((1, 2))", "the policy returned array.*; expected two finite"),
        (
            "np.zeros((2, 8)) @ observation",
            r":7: at an observation of 10 numbers \(proximity, speed\) from -1 to 1: ValueError: matmul",
        ),
    ],
    ids=["nothing", "no number", "a batch", "other numbers"],
)
def test_a_policy_that_returns_no_speeds_is_told_with_its_file(
    returned: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(f"""
import numpy as np
from khep_twin import TaskController

def policy(observation):
    # An untrained one.
    return {returned}

avoid = TaskController("ObstacleAvoidance", policy)
""")
    controller = find_controller(str(file))
    source = source_of(controller)
    assert source.facts == {"controller": "mine.py:TaskController"}
    assert source.attachments == {"controller/mine.py": file.read_text()}
    with (
        Khepera("khep://obstacles") as robot,
        pytest.raises(ControllerError, match=f"mine.py.*{message}") as caught,
    ):
        run(controller, robot, cycles=1)
    assert "\n" not in str(caught.value)

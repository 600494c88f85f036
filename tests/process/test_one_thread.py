"""A second thread that calls into an object while another one is inside of it gets an error."""

import dataclasses
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import TASKS, State
from khep_twin.episodes.controllers import Function
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import open_twin
from khep_twin.world import World

SPEEDS = np.full(2, 0.5, np.float32)


def error_elsewhere(call: Callable[[], object]) -> str:
    """Return the error of a call in another thread; empty if there is none."""
    messages: list[str] = [""]

    def run() -> None:
        try:
            call()
        except RuntimeError as error:
            messages[0] = str(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return messages[0]


class Intruder:
    """Calls into an object from another thread, once, while this one is inside of it."""

    def __init__(self) -> None:
        self.calls: list[Callable[[], object]] = []
        self.errors: list[str] = []

    def intrude(self) -> None:
        calls, self.calls = self.calls, []
        self.errors += map(error_elsewhere, calls)

    def reward(self, state: State) -> float:
        self.intrude()
        return 0.0

    @property
    def task(self) -> Any:
        return dataclasses.replace(TASKS["ObstacleAvoidance"], reward=self.reward)


def gym(task: Any, planar: bool) -> tuple[Any, Any]:
    environments = pytest.importorskip("khep_twin.envs.gymnasium")
    return environments.KheperaEnvironment(task, planar=planar, compiled=False), SPEEDS


def vector(task: Any, planar: bool) -> tuple[Any, Any]:
    environments = pytest.importorskip("khep_twin.envs.gymnasium_vector")
    return environments.KheperaVectorEnvironment(2, task, planar=planar, compiled=False), [SPEEDS, SPEEDS]


def zoo(task: Any, planar: bool) -> tuple[Any, Any]:
    environments = pytest.importorskip("khep_twin.envs.pettingzoo")
    environment = environments.ParallelEnvironment(task, 1, planar=planar, compiled=False)
    return environment, {"khepera0": SPEEDS}


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("make", [gym, vector, zoo])
def test_an_environment_is_stepped_by_one_thread_at_a_time(make: Any, planar: bool) -> None:
    intruder = Intruder()
    environment, action = make(intruder.task, planar)
    environment.reset(seed=1)
    calls = [environment.reset, environment.render, environment.close]
    intruder.calls = [lambda: environment.step(action), *calls]
    environment.step(action)
    name = type(environment).__name__
    assert [error.split(";")[0] for error in intruder.errors[:3]] == [
        f"{method}: another thread is inside this {name}" for method in ("step", "reset", "render")
    ]
    assert "expected one thread at a time" in intruder.errors[3]
    # Between two calls it may pass to another thread.
    assert error_elsewhere(lambda: environment.step(action)) == ""
    environment.close()


def test_an_episode_of_a_task_is_stepped_by_one_thread_at_a_time() -> None:
    intruder = Intruder()
    episode = TaskEpisode(TaskSetup(intruder.task, planar=True, compiled=False))
    episode.begin(1)
    intruder.calls = [lambda: episode.step([SPEEDS]), lambda: episode.begin(2)]
    episode.step([SPEEDS])
    assert [error.split(":")[0] for error in intruder.errors] == ["step", "begin"]


@pytest.mark.parametrize("planar", [False, True])
def test_an_episode_runs_in_one_thread_at_a_time(planar: bool) -> None:
    intruder = Intruder()

    def drive(*arguments: object) -> tuple[float, float]:
        intruder.intrude()
        return 5.0, 5.0

    episode = Episode(EpisodeSetup("obstacles", planar=planar), Function(drive), compiled=False)
    episode.begin(1)
    intruder.calls = [lambda: episode.run(0.1), lambda: episode.begin(2), lambda: episode.drive(1, 1)]
    episode.run(0.04)
    assert [error.split(":")[0] for error in intruder.errors] == ["step", "begin", "drive"]
    assert episode.registers[:].any()
    assert error_elsewhere(lambda: episode.run(0.02)) == ""
    assert episode.time_ns == 60_000_000


def test_a_world_is_stepped_by_one_thread_at_a_time_which_its_observers_may_use() -> None:
    intruder, world = Intruder(), World("obstacles")

    class Observer:
        def sample(self, world: World) -> None:
            intruder.intrude()
            world.set_lamps(world.playpen.lamps)

        def on_event(self, *event: object) -> None:
            pass

    world.add_observer(Observer(), sample_now=False)  # type: ignore[arg-type]
    intruder.calls = [world.step, world.reset, world.scan, world.state]
    world.advance(0.02)
    assert [error.split(":")[0] for error in intruder.errors] == ["advance_to", "reset", "scan", "state"]
    assert error_elsewhere(world.step) == ""


def test_a_port_is_used_by_one_thread_at_a_time() -> None:
    intruder = Intruder()

    class Observer:
        def sample(self, world: World) -> None:
            intruder.intrude()

        def on_host_event(self, *event: object) -> None:
            pass

        on_bytes = on_host_event

    with closing(Serial.of(open_twin("default"), timeout=1)) as port:
        port.twin.world.add_observer(Observer(), sample_now=False)  # type: ignore[arg-type]
        uses: dict[str, Callable[[], object]] = {
            "write": lambda: port.write(b"B\n"),
            "read": port.read,
            "readline": port.readline,
            "sleep": lambda: port.sleep(0.1),
            "flush": port.flush,
            "in_waiting": lambda: port.in_waiting,
            "reset_input_buffer": port.reset_input_buffer,
            "reset_output_buffer": port.reset_output_buffer,
        }
        intruder.calls = list(uses.values())
        port.write(b"O\n")
        assert port.readline().startswith(b"o,")
        messages = [
            f"{name.replace('readline', 'read')}: another thread is inside this Serial" for name in uses
        ]
        assert [error.split(";")[0] for error in intruder.errors] == messages
        # Between two calls it may pass to another thread.
        assert error_elsewhere(lambda: port.write(b"B\n")) == ""
        assert port.readline() == b"b,5.02,5.01\r\n"

"""The time limit as learning libraries read it, and the render mode "human"."""

from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")

import khep_twin  # noqa: E402
from khep_twin.envs import ParallelEnvironment, load  # noqa: E402
from khep_twin.errors import KhepTwinError  # noqa: E402

NAME = "khep_twin/ObstacleAvoidance-v0"
OPTIONS: dict[str, Any] = {"seconds": 0.5, "compiled": False, "planar": True}


def test_every_way_to_make_an_environment_has_the_limit_in_steps() -> None:
    assert khep_twin.make(NAME, **OPTIONS).spec.max_episode_steps == 10
    assert khep_twin.make(NAME, **{**OPTIONS, "seconds": 120}).spec.max_episode_steps == 2400
    assert khep_twin.make("khep_twin/KheperaIVLineFollowing-v0", seconds=1).spec.max_episode_steps == 20
    vector = khep_twin.make_vec(NAME, num_envs=2, **OPTIONS)
    assert vector.spec.max_episode_steps == 10
    assert gymnasium.make_vec(vector.spec).spec.max_episode_steps == 10
    synchronous = khep_twin.make_vec(NAME, num_envs=2, vectorization_mode="sync", **OPTIONS)
    assert synchronous.envs[0].spec.max_episode_steps == 10
    assert load("Homing", seconds=0.5, compiled=False).max_episode_steps == 10
    assert ParallelEnvironment(seconds=0.5, compiled=False).max_episode_steps == 10


def test_the_time_that_a_wrapper_observes_ends_with_the_episode() -> None:
    environment = gymnasium.wrappers.TimeAwareObservation(
        khep_twin.make(NAME, **OPTIONS), flatten=False, normalize_time=True
    )
    environment.reset(seed=1)
    is_over, observation = False, {}
    while not is_over:
        observation, _, _, is_over, _ = environment.step(np.zeros(2, np.float32))
    assert observation["time"] == pytest.approx(1)


def test_a_limit_in_steps_shortens_the_episodes_of_one_and_of_many() -> None:
    vector = khep_twin.make_vec(NAME, num_envs=2, max_episode_steps=3, **OPTIONS)
    vector.reset(seed=1)
    ends = [vector.step(np.zeros((2, 2), np.float32))[3].tolist() for _ in range(3)]
    assert ends == [[False] * 2, [False] * 2, [True] * 2]
    assert khep_twin.make(NAME, max_episode_steps=3, **OPTIONS).spec.max_episode_steps == 3


def n_steps(environment: Any) -> int:
    """Return the number of steps of an episode."""
    environment.reset(seed=1)
    for n_steps in range(1, 100):
        if np.all(environment.step(np.zeros(environment.action_space.shape, np.float32))[3]):
            return n_steps
    raise AssertionError("an episode of more than 100 steps")


def test_an_environment_of_another_ones_spec_with_another_time_has_the_new_limit() -> None:
    seconds, limit = 1.0, 20
    spec = khep_twin.make(NAME, **OPTIONS).spec
    assert khep_twin.make(spec, seconds=0.2).spec.max_episode_steps == 4
    for source in (spec, khep_twin.make(spec).spec, type(spec).from_json(spec.to_json())):
        other = khep_twin.make(source, seconds=seconds)
        assert n_steps(other) == other.spec.max_episode_steps == limit
    own_limit = gymnasium.make(spec, max_episode_steps=-1, seconds=seconds)
    assert n_steps(own_limit) == own_limit.spec.max_episode_steps == limit
    assert khep_twin.make(spec, period_ns=20_000_000).spec.max_episode_steps == 25
    vector = khep_twin.make_vec(NAME, num_envs=2, **OPTIONS)
    for source in (vector.spec, khep_twin.make_vec(vector.spec).spec):
        other = khep_twin.make_vec(source, seconds=seconds)
        assert n_steps(other) == other.spec.max_episode_steps == limit
    synchronous = khep_twin.make_vec(spec, num_envs=2, vectorization_mode="sync", seconds=seconds)
    assert n_steps(synchronous) == limit
    other = gymnasium.make_vec(vector.spec, seconds=seconds, max_episode_steps=None)
    assert n_steps(other) == other.spec.max_episode_steps == limit


def test_a_spec_keeps_its_own_limit_without_another_time() -> None:
    spec = khep_twin.make(NAME, max_episode_steps=3, **OPTIONS).spec
    assert n_steps(khep_twin.make(spec)) == 3
    assert n_steps(khep_twin.make(spec, seconds=1.0, max_episode_steps=5)) == 5


class Window:
    """A window that records its pictures."""

    opened: list["Window"]

    def __init__(self, title: str, frames_per_second: float) -> None:
        self.frames_per_second, self.pictures, self.is_closed = frames_per_second, list[Any](), False
        self.opened.append(self)

    def show(self, picture: Any) -> None:
        self.pictures.append(picture)

    def close(self) -> None:
        self.is_closed = True


def test_the_render_mode_human_shows_each_step_in_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("khep_twin.drawing.window.PictureWindow", Window)
    monkeypatch.setattr(Window, "opened", [], raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    one = khep_twin.make(NAME, render_mode="human", view="map", **OPTIONS)
    several = ParallelEnvironment(render_mode="human", view="map", seconds=0.5, compiled=False)
    fourth = khep_twin.make("khep_twin/KheperaIVLineFollowing-v0", render_mode="human", view="map", seconds=1)
    for environment in (one, several, fourth):
        environment.reset(seed=1)
    one.step(np.ones(2, np.float32))
    several.step({agent: np.ones(2, np.float32) for agent in several.agents})
    fourth.step(np.ones(2, np.float32))
    for environment, window in zip((one, several, fourth), Window.opened, strict=True):
        assert environment.render() is None
        environment.close()
        assert len(window.pictures) == 2
        assert window.frames_per_second == 20
        assert (window.pictures[0] != window.pictures[1]).any()
        assert window.is_closed


def test_without_a_screen_the_render_mode_human_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(KhepTwinError, match=r"^render_mode = 'human': DISPLAY is not set.*'rgb_array'$"):
        khep_twin.make(NAME, render_mode="human", **OPTIONS)
    with pytest.raises(KhepTwinError, match="expected rgb_array, or one environment"):
        khep_twin.make_vec(NAME, num_envs=2, render_mode="human", **OPTIONS)

"""Hostile arguments of the environments: each is accepted, or is an error of one short line."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")

from khep_twin.envs import (
    KheperaEnvironment,
    KheperaVectorEnvironment,
    ParallelEnvironment,
    Randomization,
    Task,
    TaskSetup,
    load,
)
from khep_twin.errors import KhepTwinError, value_text
from khep_twin.playpen import Playpen

SHORT: dict[str, Any] = {"seconds": 0.1, "compiled": False}
PLANE = {**SHORT, "planar": True}
LAMP = Playpen.load("two-lamps").lamps[0]


class Mute:
    """An object without a text."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")


VALUES = (
    *(
        None,
        True,
        5,
        -1,
        0,
        1.5,
        math.nan,
        math.inf,
        1j,
        10**30,
        10**5000,
        np.float64("nan"),
        len,
        int,
        Mute(),
    ),
    *(
        "x",
        "",
        b"x",
        [],
        [0, math.inf],
        {},
        {"a": 1},
        {1: 2},
        object(),
        np.array([1, 2]),
        np.array(3.5),
        [None],
    ),
    *(
        [1] * 1000,
        [LAMP] * 1000 + [3],
        (1, 2, 3),
        [[1, 2, 3], [4, 5, 6]],
        {(1, 2)},
        np.arange(2000),
        range(3),
    ),
)


def check(function: Callable[[Any], object], values: tuple[Any, ...] = VALUES) -> None:
    for value in values:
        try:
            function(value)
        except (KhepTwinError, ValueError) as error:
            text = str(error)
            assert "expected" in text or "choices" in text, text
            assert "\n" not in text
            assert len(text) < 500


SETUP = (
    "playpen robots start lamps randomize noise vary period_ns seconds planar normalize details line "
    "max_episode_steps compiled"
)


@pytest.mark.parametrize("option", SETUP.split())
def test_an_option_of_a_setup_is_accepted_or_refused_in_one_line(option: str) -> None:
    check(lambda value: TaskSetup("LightSeeking", **{**PLANE, option: value}))


@pytest.mark.parametrize("option", [*"num_envs threads device autoreset_mode render_mode view task".split()])
def test_an_option_of_many_is_accepted_or_refused_in_one_line(option: str) -> None:
    values = VALUES
    if option in ("num_envs", "threads"):
        values = tuple(value for value in values if not (isinstance(value, int) and value > 100))
    check(lambda value: KheperaVectorEnvironment(**{"num_envs": 2, **PLANE, option: value}), values)


@pytest.mark.parametrize("option", ["seed", "task_kwargs", "environment_kwargs", "visualize_reward"])
def test_an_option_of_dm_env_is_accepted_or_refused_in_one_line(option: str) -> None:
    check(lambda value: load("ObstacleAvoidance", **{**SHORT, option: value}))


@pytest.mark.parametrize("name", "starts lamps robots noise delay blocks_mm playpens seed".split())
def test_an_attribute_of_a_randomization_is_accepted_or_refused_in_one_line(name: str) -> None:
    check(lambda value: Randomization(**{name: value}))


@pytest.mark.parametrize(
    "name", "name playpen observation_terms reward starts goal reach_mm charge_s".split()
)
def test_an_attribute_of_a_task_is_accepted_or_refused_in_one_line(name: str) -> None:
    attributes = {"name": "n", "playpen": "obstacles", "observation_terms": ("speed",), "reward": len}
    check(lambda value: Task(**{**attributes, name: value}))


def test_options_seeds_and_actions_are_accepted_or_refused_in_one_line() -> None:
    single, vector = KheperaEnvironment(**PLANE), KheperaVectorEnvironment(2, **PLANE)
    for environment in (single, vector, ParallelEnvironment(**SHORT)):
        environment.reset(seed=0)
        check(lambda value, environment=environment: environment.reset(options=value))
        check(lambda value, environment=environment: (environment.reset(seed=0), environment.step(value)))
    for name in "seed start lamps playpen reset_mask".split():
        check(lambda value, name=name: vector.reset(options={name: value}))
        check(lambda value, name=name: single.reset(options={name: value}))
    check(lambda value: vector.reset(seed=value))


def test_a_value_in_a_message_is_short_and_in_one_line() -> None:
    assert value_text([0, math.inf]) == "[0, inf]"
    assert value_text("text") == "'text'"
    for value in VALUES:
        text = value_text(value)
        assert len(text) <= 160
        assert "\n" not in text
    assert str(KhepTwinError(key="lamps", value=[LAMP] * 1000, expected="fewer")).endswith("; expected fewer")
    assert len(str(KhepTwinError(key="lamps", value=[LAMP] * 1000, expected="fewer"))) < 200

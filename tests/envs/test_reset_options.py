"""Options of `reset` and of `make`: starts, lamps and playpens, and one line for a value that is none."""

from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS

from khep_twin import Lamp
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen

pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")

from khep_twin.envs.gymnasium import KheperaEnvironment
from khep_twin.envs.gymnasium_vector import KheperaVectorEnvironment

SHORT: dict[str, Any] = {"planar": True, "compiled": False, "seconds": 0.5}
LAMP = Lamp(x_mm=500, y_mm=500, power_w=5)


def one(**options: Any) -> KheperaEnvironment:
    return KheperaEnvironment("LightSeeking", **{**SHORT, **options})


def make_vectorized(count: int, **options: Any) -> KheperaVectorEnvironment:
    return KheperaVectorEnvironment(count, "LightSeeking", **{**SHORT, **options})


def place(info: dict[str, Any]) -> tuple[int, int, int]:
    return round(info["x"] * 1e3), round(info["y"] * 1e3), round(np.degrees(info["heading"]))


def test_an_option_replaces_the_environments_own_for_one_episode() -> None:
    environment = one(start=(100, 100, 45))
    usual, info = environment.reset(seed=1)
    assert place(info) == (100, 100, 45)
    info = environment.reset(seed=1, options={"start": (300, 150, -90)})[1]
    assert place(info) == (300, 150, -90)
    lit_observation, _ = environment.reset(seed=1, options={"lamps": [LAMP]})
    assert (lit_observation[8:16] != usual[8:16]).any()
    elsewhere, info = environment.reset(seed=1, options={"playpen": "two-lamps"})
    assert place(info) == (100, 100, 45)
    assert (elsewhere != usual).any()
    assert (environment.reset(seed=1)[0] == usual).all()
    # The environment's start has no room there, but it is not used.
    info = environment.reset(options={"playpen": "looping-maze", "start": (60, 60, 0)})[1]
    assert place(info) == (60, 60, 0)
    with pytest.raises(KhepTwinError, match=r"^start = \(100\.0, 100\.0, 45\.0\): looping-maze: robot 1"):
        environment.reset(options={"playpen": "looping-maze"})


def test_the_arguments_of_make_do_what_the_options_of_reset_do() -> None:
    options = {"start": (300, 150, -90), "lamps": [LAMP], "playpen": "two-lamps"}
    changed, usual = one(**options), one()
    usual.reset(seed=3)
    assert (changed.reset(seed=3)[0] == usual.reset(seed=3, options=options)[0]).all()
    for _ in range(5):
        assert (changed.step(np.ones(2))[0] == usual.step(np.ones(2))[0]).all()


def test_a_playpen_is_prepared_once() -> None:
    environment = one()
    setups = []
    for playpen in ("two-lamps", "light-seeking", "two-lamps", Playpen.load("two-lamps")):
        environment.reset(seed=1, options={"playpen": playpen})
        setups.append(environment._episode.batch._active_setups[0])
    assert setups[0] is setups[2]
    assert len({id(setup) for setup in setups}) == 3
    assert sum(map(len, environment._episode.batch._idle_episodes.values())) == 3


@pytest.mark.share(4)
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("planar", [True, False])
def test_many_with_a_list_of_playpens_are_the_same_as_single_ones(
    planar: bool, compiled: bool, threads: int
) -> None:
    playpens = ["light-seeking", Playpen.load("two-lamps")]
    options = {"planar": planar, "vary": True}
    together = make_vectorized(5, playpen=playpens, threads=threads, **options, compiled=compiled)
    alone = [one(playpen=playpens[index % 2], **options) for index in range(5)]
    first = together.reset(seed=7)[0]
    for index, environment in enumerate(alone):
        assert (environment.reset(seed=7 + index)[0] == first[index]).all()
    for action in np.random.default_rng(0).uniform(-1, 1, (6, 5, 2)):
        observations, rewards, *_ = together.step(action)
        for index, environment in enumerate(alone):
            one_seen, reward, *_ = environment.step(action[index])
            assert (one_seen == observations[index]).all()
            assert reward == rewards[index]
    together.close()


def test_many_take_an_option_for_all_or_one_for_each() -> None:
    environments = make_vectorized(3)
    environments.reset(seed=1)
    infos = environments.reset(options={"start": (200, 200, 0)})[1]
    assert (infos["x"].round(3) == 0.2).all()
    starts = [(200, 200, 0), (300, 200, 0), (400, 200, 0)]
    mask = np.array([True, False, True])
    options = {"start": starts, "reset_mask": mask, "lamps": [[LAMP], [], []], "seed": 5}
    observations, infos = environments.reset(options=options)
    assert infos["x"].round(3).tolist() == [0.2, 0.0, 0.4]
    assert infos["seed"].tolist() == [5, 0, 5]
    third_options = {"start": starts[2], "lamps": [], "seed": 5}
    assert (one().reset(options=third_options)[0] == observations[2]).all()
    observations, _ = environments.reset(
        options={"playpen": ["two-lamps", "light-seeking", "two-lamps"], "seed": [1, 2, 3]}
    )
    assert (one().reset(options={"playpen": "two-lamps", "seed": 3})[0] == observations[2]).all()
    environments.close()


WRONG = [
    ({"playpen": ["two-lamps"]}, r"^playpen = \['two-lamps'\]; expected the name or path of a playpen"),
    ({"lamps": [5]}, r"^lamps = \[5\]; expected a list of khep_twin\.Lamp"),
    ({"lamps": "all"}, r"^lamps = 'all'; expected a list of"),
    ({"start": [(1, 2, 3), (1,)]}, r"^start = .*; expected x, y \[mm\] and heading \[deg\], 1 x 3 finite"),
    ({"start": "here"}, r"^start = \['here'\]; expected x, y \[mm\] and heading \[deg\], 1 x 3 finite"),
    ({"start": (1, 2)}, r"^start = .*; expected x, y \[mm\] and heading \[deg\], 1 x 3 finite numbers"),
    (
        {"start": (9, 9, 0)},
        r"^start = \(9\.0, 9\.0, 0\.0\): light-seeking: robot 1 .* overlaps the left wall",
    ),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_what_an_option_cannot_be_is_one_line_of_reset_and_of_make(
    options: dict[str, Any], message: str
) -> None:
    environment = one()
    for call in (lambda: environment.reset(options=options), lambda: one(**options)):
        with pytest.raises((KhepTwinError, ValueError), match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_an_unknown_option_is_one_line_with_the_nearest_name() -> None:
    message = r"'strat': unknown; did you mean 'start'\? \(choices: .*\)$"
    with pytest.raises(KhepTwinError, match=f"^options: {message}"):
        one().reset(options={"strat": (1, 2, 3)})
    with pytest.raises(KhepTwinError, match=f"^option {message}"):
        one(strat=(1, 2, 3))
    environments = make_vectorized(2)
    with pytest.raises(KhepTwinError, match=f"^options: {message}"):
        environments.reset(options={"strat": [1, 2]})
    with pytest.raises(KhepTwinError, match=r"^options: 3 of playpen; expected one, or one for each of 2$"):
        environments.reset(options={"playpen": ["two-lamps"] * 3})
    environments.close()
    with pytest.raises(
        KhepTwinError, match=r"^playpen = \[\]; expected one playpen, or a list of at least one$"
    ):
        make_vectorized(2, playpen=[])


def test_a_mistake_for_one_of_many_leaves_all_as_they_are() -> None:
    environments, untouched = make_vectorized(2), make_vectorized(2)
    for environment in (environments, untouched):
        environment.reset(seed=1)
    with pytest.raises(KhepTwinError, match="overlaps the left wall"):
        environments.reset(options={"start": [(200, 200, 0), (9, 9, 0)]})
    for _ in range(2):
        stepped = [environment.step(np.ones((2, 2)))[0] for environment in (environments, untouched)]
        assert (stepped[0] == stepped[1]).all()
    for environment in (environments, untouched):
        environment.close()

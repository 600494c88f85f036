"""Domain randomization: drawn by the seed of each episode, and reported."""

from typing import Any

import numpy as np
import pytest

from khep_twin.envs.randomization import Randomization
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Lamp, Playpen, parse
from khep_twin.playpen.model import dump
from khep_twin.playpen.starts import find_obstruction

SHORT: dict[str, Any] = {"planar": True, "compiled": False}


def setup(task: str = "LightSeeking", **randomize: Any) -> TaskSetup:
    return TaskSetup(task, randomize=randomize, **SHORT)


def test_starts_are_spread_around_the_playpens_own() -> None:
    original = Playpen.load("light-seeking").robots[0]
    randomized = setup(starts=(40, 10))
    drawn = np.array([randomized.beginning(seed).options.start[0] for seed in range(20)])
    away = drawn - (original.x_mm, original.y_mm, original.heading_deg)
    assert (abs(away) <= (40, 40, 10)).all()
    assert (abs(away).max(axis=0) > (20, 20, 5)).all()
    assert len(np.unique(drawn[:, 0])) > 15


def test_starts_anywhere_are_those_of_a_task_that_starts_anywhere() -> None:
    usual = TaskSetup("LightSeeking", **SHORT)
    spread = setup("LightSeeking", starts="anywhere")
    assert [spread.beginning(seed).options.start for seed in range(3)] == [
        usual.beginning(seed).options.start for seed in range(3)
    ]


def test_lamps_have_other_powers_and_places_and_what_was_drawn_is_told() -> None:
    randomized, before = setup(lamps=(2, 50)), Playpen.load("light-seeking").lamps
    factors = []
    for seed in range(20):
        beginning = randomized.beginning(seed)
        lamps = beginning.drawn["lamps"]
        assert lamps == tuple((lamp.x_mm, lamp.y_mm, lamp.power_w) for lamp in beginning.options.lamps)
        for old, new in zip(before, beginning.options.lamps, strict=True):
            assert abs(new.x_mm - old.x_mm) <= 50
            assert abs(new.y_mm - old.y_mm) <= 50
            factors.append(new.power_w / old.power_w)
    assert 0.5 <= min(factors) < 0.7
    assert 1.5 < max(factors) <= 2


def test_noise_is_there_in_a_part_of_the_episodes() -> None:
    randomized = setup(noise=0.3)
    noisy = [randomized.beginning(seed).options.noise for seed in range(200)]
    assert 0.2 < np.mean(noisy) < 0.4
    assert setup().beginning(0).options.noise
    assert setup(robots=True).beginning(0).options.vary


def test_delays_are_drawn_and_told_and_change_what_is_seen() -> None:
    delayed = setup(delay=(0.01, 0.04))
    delays = [delayed.beginning(seed).drawn["delay"] for seed in range(30)]
    assert 0.01 <= min(delays) < 0.015
    assert 0.035 < max(delays) <= 0.04
    ways = []
    for task_setup in (delayed, setup(delay=(0.02, 0.02)), TaskSetup("LightSeeking", **SHORT)):
        episode = TaskEpisode(task_setup)
        episode.begin(1)
        ways.append([episode.step([(0.5, 0.4)])[0].observation.tobytes() for _ in range(5)])
    assert len({tuple(way) for way in ways}) == 3
    with pytest.raises(KhepTwinError, match=r"^randomize: delay = \(0\.01, 0\.1\); expected times up to a"):
        setup(delay=(0.01, 0.1))
    with pytest.raises(KhepTwinError, match=r"^randomize: delay = .*: and line = 38400; expected one of"):
        TaskSetup("LightSeeking", line=38400, randomize={"delay": (0.01, 0.04)})


def test_blocks_stand_elsewhere_in_playpens_that_are_whole_and_prepared_once() -> None:
    randomized = setup("WallOrCylinder", blocks_mm=60, playpens=3)
    episode, ways = TaskEpisode(randomized), dict[int, set[bytes]]()
    for seed in range(12):
        observation = episode.begin(seed, ResetOptions(start=(300, 300, 0)))[0]
        ways.setdefault(episode.batch.drawn(0)["playpen"], set()).add(observation.tobytes())
    assert sorted(ways) == [0, 1, 2]
    assert len(randomized._playpen_setups) == 3
    playpens = [variant.playpen for _, variant in randomized._playpen_setups]
    assert len({dump(playpen) for playpen in playpens}) == 3
    for (_, variant), playpen in zip(randomized._playpen_setups, playpens, strict=True):
        assert parse(dump(playpen), "a playpen with moved blocks") == playpen
        target = next(item for item in playpen.cylinders if item.name == "target")
        assert variant.goal == (target.x_mm / 1e3, target.y_mm / 1e3)


def test_blocks_across_the_corners_of_an_arena_stay_there() -> None:
    scene = Playpen.load("obstacles")
    for playpen in Randomization(blocks_mm=50, playpens=2).pool(scene):
        assert playpen.blocks[:4] == scene.blocks[:4]
        assert all(new != old for new, old in zip(playpen.blocks[4:], scene.blocks[4:], strict=True))


def test_moved_blocks_leave_room_for_a_given_start() -> None:
    usual = setup("ObstacleAvoidance", blocks_mm=30, playpens=20)
    assert any(find_obstruction(playpen, 0, 400, 300) for playpen in usual._randomized_playpens)
    with_start = TaskSetup("ObstacleAvoidance", start=(400, 300, 0), randomize=usual.randomize, **SHORT)
    assert not any(find_obstruction(playpen, 0, 400, 300) for playpen in with_start._randomized_playpens)


def test_each_kind_draws_from_its_own_stream_and_the_seed_repeats_all() -> None:
    everything = {"starts": (40, 90), "lamps": (3, 40), "noise": 0.5, "blocks_mm": 30, "robots": True}
    beginnings = [setup(**everything).beginning(seed) for seed in range(2)]
    for seed, beginning in enumerate(beginnings):
        again = setup(**everything).beginning(seed)
        assert again.drawn == beginning.drawn
        assert again.options.start == beginning.options.start
        assert setup(noise=0.5).beginning(seed).options.noise == beginning.options.noise
        # Lamps that stand in the way of moved blocks have other places, not other powers.
        lamps = setup(lamps=(3, 40)).beginning(seed).drawn["lamps"]
        assert [lamp[2] for lamp in lamps] == [lamp[2] for lamp in beginning.drawn["lamps"]]


def test_an_option_of_reset_is_not_randomized() -> None:
    randomized = setup(starts=(40, 90), lamps=(3, 40), blocks_mm=30)
    lamp = Lamp(x_mm=500, y_mm=500, power_w=5)
    beginning = randomized.beginning(
        1, ResetOptions(start=(200, 200, 0), lamps=[lamp], playpen="light-seeking")
    )
    assert beginning.options.start == [(200, 200, 0)]
    assert list(beginning.options.lamps) == [lamp]
    assert beginning.drawn == {}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"start": 5}, r"^randomize: 'start': unknown; did you mean 'starts'\?"),
        ({"starts": 5}, r"^randomize: starts = 5; expected two numbers from 0, \[mm\] and \[deg\], or"),
        ({"starts": (5, -1)}, r"^randomize: starts = \(5, -1\); expected"),
        ({"lamps": (0.5, 1)}, r"^randomize: lamps = \(0\.5, 1\); expected a factor from 1 and a distance"),
        ({"noise": 2}, r"^randomize: noise = 2; expected a probability, 0 to 1"),
        ({"blocks_mm": -1}, r"^randomize: blocks_mm = -1; expected a distance from 0"),
        (
            {"delay": (0.2, 0.1)},
            r"^randomize: delay = \(0\.2, 0\.1\); expected two times",
        ),
        ({"playpens": 0}, r"^0 playpens; expected a whole number"),
        (5, r"^randomize = 5; expected a Randomization, or its attributes"),
    ],
)
def test_what_is_no_randomization_is_one_line(value: Any, message: str) -> None:
    with pytest.raises((KhepTwinError, ValueError), match=message) as caught:
        Randomization.of(value)
    assert "\n" not in str(caught.value)

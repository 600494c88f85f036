"""Random start poses: all callers with a seed draw the same ones."""

import inspect
import sys
from functools import partial

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.lab.experiment.start_poses import starts
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import (
    anywhere,
    at_spots,
    at_start,
    draw_free_pose,
    find_obstruction,
    starts_rng,
)
from khep_twin.world import World

ARENA = Playpen.load("obstacles")


def test_runs_and_trials_draw_the_same_pose_by_the_same_seed() -> None:
    for seed in range(10):
        robot = anywhere(ARENA, seed).robots[0]
        (start,) = starts(["random"], ARENA, 0, 1, seed)
        assert (
            start == (robot.x_mm, robot.y_mm, robot.heading_deg) == draw_free_pose(ARENA, 0, starts_rng(seed))
        )


def test_the_draws_of_a_seed_stay_those_of_earlier_versions() -> None:
    assert draw_free_pose(ARENA, 0, starts_rng(3)) == (470.2, 452.2, 172.4)


def test_a_free_pose_has_room_and_one_decimal() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        start = draw_free_pose(ARENA, 0, rng)
        assert start is not None
        assert not find_obstruction(ARENA, 0, start[0], start[1])
        assert start == tuple(round(value, 1) for value in start)


def test_a_full_floor_has_no_free_pose() -> None:
    width, depth = ARENA.arena.width_mm, ARENA.arena.height_mm
    block = playpen.Block(x_mm=width / 2, y_mm=depth / 2, length_mm=width, width_mm=depth, height_mm=50)
    full = ARENA.model_copy(update={"blocks": (block,)})
    assert draw_free_pose(full, 0, starts_rng(1)) is None


def test_a_world_takes_the_spot_that_the_seed_draws() -> None:
    spots = [playpen.Spot(name=f"s{x}", x_mm=x, y_mm=250, heading_deg=0) for x in (100, 300, 500)]
    robot = ARENA.robots[0].model_copy(update={"spots": tuple(spot.name for spot in spots)})
    arena = Playpen.load("default").model_copy(update={"spots": tuple(spots), "robots": (robot,)})
    for seed in range(3):
        entry = at_spots(arena, seed).robots[0]
        assert World(arena, seed=seed, noise=False).robots[0].pose[0] == pytest.approx(
            entry.x_mm / 1000, abs=1e-6
        )
    assert at_start(arena, 0, (1.0, 2.0, 3.0)).robots[0].spots == ()


def test_more_robots_than_python_has_calls_find_their_spots(request: pytest.FixtureRequest) -> None:
    request.addfinalizer(partial(sys.setrecursionlimit, sys.getrecursionlimit()))
    sys.setrecursionlimit(len(inspect.stack(0)) + 200)
    head = 'version = 1\nname = "many"\n[arena]\nwidth_mm = 10000\nheight_mm = 10000\n'
    positions = [(100 + 65 * (number % 40), 100 + 65 * (number // 40)) for number in range(250)]
    spots = "".join(
        f'[[spot]]\nname = "s{number}"\nx_mm = {x}\ny_mm = {y}\nheading_deg = 0\n'
        for number, (x, y) in enumerate(positions)
    )
    robots = "".join(f'[[robot]]\nspots = ["s{number}"]\n' for number in range(250))
    placed = at_spots(playpen.parse(head + spots + robots, "many"), 1)
    assert [(robot.x_mm, robot.y_mm) for robot in placed.robots] == positions

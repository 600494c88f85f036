"""A second robot of a stranger, the Scout of `second_robot`, beside the Toy and a Khepera."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from command_line import good
from numba_marks import with_numba

from khep_twin import Function, Network, rollout
from khep_twin import playpen as playpens
from khep_twin.errors import SnapshotError
from khep_twin.host.host_robot import open_robot
from khep_twin.robots.registry import find_model
from khep_twin.web import drafts
from khep_twin.world import World

ROBOT = '[[robot]]\nmodel = "{}"\nx_mm = {}\ny_mm = {}\nheading_deg = 0\n'
ROBOTS = [ROBOT.format(*robot) for robot in (("scout", 300, 400), ("toy", 750, 200), ("khepera1", 750, 600))]
START = 'version = 1\nname = "three"\n[arena]\nwidth_mm = 1000\nheight_mm = 800\n'
PATCH = '[[patch]]\nx_mm = 560\ny_mm = 400\nlength_mm = 200\nwidth_mm = 400\nsurface = "black"\n'
THREE, ONE = "".join([START, *ROBOTS, PATCH]), "".join([START, ROBOTS[0], PATCH])
CONTROLLER = (
    "def wander(robot):\n    robot.set_speed(4, 2)\n    return {'x': robot.read_panel()['speed'][0]}\n"
)
pytestmark = pytest.mark.usefixtures("installed_robots")


def drive(world: World, request: bytes = b"drive 400 300\n", seconds: float = 0.6031) -> list[Any]:
    """Drive the Scout, the first robot; return readings and physics of the world."""
    world.robots[0].send(request)
    world.advance(seconds)
    return [*(robot.readings() for robot in world.robots), *world.data.qpos]


def test_three_models_share_a_playpen_and_the_scout_sees_walls_and_floor() -> None:
    world = World(playpens.parse(THREE, "three"), noise=False)
    assert world.simulation.robots.models == ("khepera", "scout", "toy")
    before, after = world.robots[0].readings(), drive(world, b"drive 400 400\nlamp 63 0 5\n", 1.5)[0]
    assert before["ultrasonic"] == [pytest.approx(365, abs=2), 605, pytest.approx(365, abs=2)]
    assert after["ultrasonic"][1] == pytest.approx(605 - 100 * 1.5 + 12, abs=8)
    assert (before["proximity"][3:], after["proximity"][3:]) == ([700, 720], [pytest.approx(60, abs=30)] * 2)
    assert (world.robots[0].lit_leds, after["leds"]) == ([1], [63, 0, 5])


@with_numba
def test_a_scout_and_a_toy_run_compiled_as_plain() -> None:
    pair = playpens.parse("".join([START, *ROBOTS[:2]]), "pair")
    plain, compiled = (World(pair, seed=5, compiled=kind) for kind in (False, True))
    for world in (plain, compiled):
        world.robots[1].send(bytes.fromhex("c502 0064 0032 a3"))
    assert drive(plain) == drive(compiled)
    assert plain.robots[1].readings()["position"][1] > 20


def test_a_scout_continues_from_a_snapshot_and_damaged_ones_are_refused() -> None:
    world, copy = (World(playpens.parse(THREE, "three"), seed=seed) for seed in (3, 9))
    drive(world)
    copy.restore(world.snapshot())
    assert drive(copy) == drive(world)
    state = world.state()
    robot, *further_robots = state.robots
    arrays: list[dict[str, Any]] = [{**robot.arrays, name: b"\x7f" * 40} for name in robot.arrays]
    for damage in (*({"arrays": damaged} for damaged in arrays), {"is_stopped": True}):
        with pytest.raises(SnapshotError, match="robot 0"):
            world.set_state(state._replace(robots=(robot._replace(**damage), *further_robots)))


def test_an_empty_battery_stops_the_scout_and_its_program() -> None:
    world = World(playpens.parse(ONE.replace('"scout"', '"scout"\nbattery_used_min = 59.99'), "one"))
    readings = drive(world, seconds=2)[0]
    assert (readings["battery"], readings["speed"]) == ([6000], [0, 0, 400, 300])
    assert drive(world, b"lamp 63 0 5\n")[0] == {**world.robots[0].readings(), "leds": [0, 0, 0]}


def test_a_scout_is_served(served: Any) -> None:
    with served(playpens.parse(THREE, "three")) as url, open_robot(find_model("scout"), url) as robot:
        robot.check_model()
        cast(Any, robot).set_speed(1, 1)
        assert robot.read_panel()["speed"][2:] == [100, 100]


def test_a_controller_drives_a_scout_and_its_log_has_columns_repeats_and_is_shown(tmp_path: Path) -> None:
    (tmp_path / "three.toml").write_text(THREE)
    (tmp_path / "wander.py").write_text(CONTROLLER)
    conform = "conform khep://three.toml --model scout --move"
    run = "run wander.py --playpen three.toml --seconds 0.5 --log run.mcap"
    reports = "report run.mcap -o run.html", "view run.mcap --save run.rrd", "export run.mcap -o run.csv"
    outputs = [good(*line.split(), folder=tmp_path) for line in (conform, run, "repeat run.mcap", *reports)]
    assert "2 passed, 0 failed" in outputs[0]
    assert outputs[2].startswith("identical: ")
    header = {*(tmp_path / "run.csv").read_text().splitlines()[0].split(",")}
    assert {"ultrasonic_west", "scout_proximity_back", "toy_ultrasonic_beacon", "proximity_left_90"} <= header
    assert ", of a Scout 200" in (tmp_path / "run.html").read_text()
    assert cast(Any, drafts.models()["scout"])["modes"] == {"scout-2": {1: "38400 baud"}}
    assert drafts.problems_of(drafts.draft_of(playpens.parse(ONE, "one"))) == []


def away(proximity, ambient, memory, genes):
    return (200.0, -200.0) if max(proximity) > 200 else (600.0, 600.0)


@pytest.mark.filterwarnings("ignore:.*overflow encountered in scalar multiply:RuntimeWarning")
def test_scouts_run_in_rollouts_in_mujoco_in_the_plane_and_on_a_simulated_card() -> None:
    one, network = playpens.parse(ONE, "one"), Network(hidden=(3,), model="scout")
    runs = [rollout(one, Function(away), [1], 1.0, planar=planar, compiled=False) for planar in (False, True)]
    floors = [run.registers[0, 3:5].tolist() for run in runs]
    assert floors[0] == floors[1] == [pytest.approx(35, abs=9)] * 2
    pytest.importorskip("numba_cuda")  # simulated, as `conftest` sets
    options: Any = {"planar": True, "genes": np.ones((1, network.n_genes)) / 9}
    plain = rollout(one, network, [1], 0.1, compiled=False, **options)
    assert (plain.registers == rollout(one, network, [1], 0.1, device="cuda", **options).registers).all()


def test_scouts_run_in_environments_with_terms_of_their_own() -> None:
    pytest.importorskip("gymnasium")
    from khep_twin.envs import Task, make_vec, tasks

    task = Task("Ranging", "obstacles", ("ground", "ultrasonic", "voltage"), tasks.avoiding, model="scout")
    options: Any = {"task": task, "start": (300, 400, 0), "seconds": 1, "noise": False, "compiled": False}
    options["playpen"] = playpens.parse(ONE, "one")
    for planar in (False, True):
        vector = make_vec("khep_twin/ObstacleAvoidance-v0", 2, planar=planar, **options)
        observations, _ = vector.reset(seed=1)
        assert observations[0] == pytest.approx([0.37, 0.41, -0.76, -0.6, -0.76, 1.0], abs=0.01)

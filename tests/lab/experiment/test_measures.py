"""Metrics of runs against values computed by hand."""

import math
from pathlib import Path

import numpy as np
import pytest
from scenes import hosted

from khep_twin.episodes.fitness import obstacle_avoidance
from khep_twin.host import Khepera
from khep_twin.lab.experiment.measures import GroundTruthMetrics, HostMetrics, coverage
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.registry import default_model, find_model
from khep_twin.sensing import calibration


@pytest.mark.parametrize(
    ("left", "right", "nearest", "value"),
    [
        (20, 20, 0, 1.0),
        (-20, -20, 0, 1.0),
        (10, 10, 0.5, 0.25),
        (20, -20, 0, 0.0),
        (20, 0, 0, 0.5 * (1 - math.sqrt(0.5))),
        (127, 20, 0, 1.0),
        (20, 20, 1, 0.0),
        (0, 0, 0, 0.0),
    ],
)
def test_the_fitness_is_floreanos_and_mondadas(left: int, right: int, nearest: float, value: float) -> None:
    assert obstacle_avoidance(left, right, nearest) == pytest.approx(value)


def test_what_is_heard_is_counted_at_the_end_of_each_cycle() -> None:
    metrics = HostMetrics(default_model())
    for request, reply in [
        ("N", "n,0,0,0,0,0,0,0,1023"),
        ("D,20,20", "d"),
        ("O", "o,500,500,500,500,500,500,500,100"),
    ]:
        metrics(request, reply)
    metrics.end_cycle()
    metrics("N", "n,0,0,0,0,0,0,0,0")
    metrics("D,10,-10", "z,Protocol error")  # refused: the wheels go on
    metrics.end_cycle()
    assert metrics.metrics() == {
        "fitness": 0.5,
        "near_share": 0.5,
        "proximity_max": 1023,
        "proximity_mean": pytest.approx(1023 / 16),
        "ambient_mean": 450,
        "ambient_min": 100,
        "speed_mean": 20,
    }


def test_the_metrics_of_a_khepera_4_are_those_of_its_readings_around_and_its_top_speed() -> None:
    metrics = HostMetrics(find_model("khepera4"))
    ring, ground = "100,100,100,100,100,100,100,1023", "900,900,900,900"
    for request, reply in [
        ("D,600,600", "d"),
        ("N", f"n,{ring},{ground}"),
        ("O", "o" + ",980" * 8 + ",1" * 4),
    ]:
        metrics(request, reply)
    metrics.end_cycle()
    metrics("N", f"n,{ring.replace('1023', '100')},{ground}")
    metrics.end_cycle()
    assert metrics.metrics() == {
        "fitness": 0.5,
        "near_share": 0.5,
        "proximity_max": 1023,
        "proximity_mean": pytest.approx((15 * 100 + 1023) / 16),
        "ambient_mean": 980,
        "ambient_min": 980,
        "speed_mean": 600,
    }


@pytest.mark.parametrize("reply", ["n,1,2,x,4,5,6,7,8", "n,1,2", "", "n", "\xff\xfe", "z,Protocol error"])
def test_a_garbled_reply_counts_for_nothing(reply: str) -> None:
    metrics = HostMetrics(default_model())
    metrics("N", reply)
    metrics("D,1", "d")
    assert metrics.metrics() == {}


def test_coverage_counts_cells_that_the_robot_can_stand_in() -> None:
    # 600 x 500 mm: 12 x 10 cells, of which the outermost are too near to the walls for 27.5 mm.
    playpen = Playpen.load("default")
    places = np.array([[0.301, 0.301], [0.31, 0.31], [0.36, 0.301], [0.01, 0.01]])
    assert coverage(places, playpen, 0.0275) == pytest.approx(2 / (10 * 8))


def test_the_ground_truth_of_a_straight_path_is_closed_form(field: Playpen) -> None:
    with hosted(field, noise=False) as robot:
        twin = robot.port.twin
        robot.set_speed(20, 20)
        robot.sleep(1)
        truth = GroundTruthMetrics(twin.world, 0)
        robot.sleep(2)
        truth.end()
        metrics = truth.metrics()
        assert not [observer for observer in twin.world.observers if isinstance(observer, GroundTruthMetrics)]
    assert metrics["distance_m"] == pytest.approx(2 * 20 * 0.008, rel=0.01)
    assert metrics["mean_speed_m_per_s"] == pytest.approx(0.16, rel=0.01)
    assert metrics["turn_rate_rad_per_s"] == pytest.approx(0, abs=0.01)
    assert metrics["collisions"] == metrics["collision_s"] == metrics["near_s"] == 0
    # Cells of 50 mm: 0.32 m touch 7 or 8 of 100 x 100, without the outermost.
    assert round(metrics["coverage"] * 98 * 98) in (7, 8)


def test_the_shortest_run_has_a_truth() -> None:
    with Khepera("khep://default") as robot:
        truth = GroundTruthMetrics(robot.port.twin.world, 0)
        truth.end()
    assert truth.metrics()["distance_m"] == 0


def test_a_controller_that_goes_to_another_folder_has_a_truth(
    field: Playpen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.toml").write_text(calibration.read("khepera1")[1])
    monkeypatch.chdir(tmp_path)
    robot = field.robots[0].model_copy(update={"calibration": "mine.toml"})
    with open_twin(field.model_copy(update={"robots": (robot,)}), TwinOptions()) as twin:
        truth = GroundTruthMetrics(twin.world, 0)
        monkeypatch.chdir("/")
        truth.end()
    assert truth.metrics()["distance_m"] == 0

"""Several blocking hosts on one world: the run is reproducible."""

import pytest
from scenes import arena, robot

from khep_twin import playpen as playpens
from khep_twin.errors import PortError, PortTimeout
from khep_twin.host import Khepera, Khepera4
from khep_twin.lab.experiment.multi_robot import run_together
from khep_twin.ports.twin import TwinOptions

TWO = playpens.parse(arena() + robot(150, 250) + robot(450, 250, 180, mode=3), "two.toml")


def chase(robot: Khepera) -> list[tuple[int, ...]]:
    robot.set_speed(8, 8)
    readings = [robot.proximity() for _ in range(60)]
    robot.set_speed(0, 0)
    return readings


def wander(robot: Khepera) -> list[tuple[int, ...]]:
    readings = []
    for turn in range(20):
        robot.set_speed(3 + turn % 3, 5)
        robot.sleep(0.13)
        readings.append((*robot.position(), *robot.ambient()))
    return readings


def test_two_scripts_share_one_time_and_run_twice_the_same() -> None:
    runs = [run_together(TWO, [chase, wander], TwinOptions(seed=5)) for _ in range(3)]
    assert runs[0] == runs[1] == runs[2]
    assert len(runs[0][0]) == 60
    assert len(runs[0][1]) == 20
    assert run_together(TWO, [chase, wander], TwinOptions(seed=6)) != runs[0]


def test_robots_of_two_models_share_one_time() -> None:
    def drive(robot: Khepera4) -> float:
        robot.set_speed(0.1, 0.1)
        robot.sleep(0.5)
        return robot.ultrasonic().right or 0.0

    def wait(robot: Khepera) -> float:
        robot.sleep(0.5)
        return robot.time

    runs = [run_together("arena4-two", [drive, drive, wait], TwinOptions(seed=5)) for _ in range(2)]
    assert runs[0] == runs[1]
    assert runs[0] == pytest.approx([0.93, 0.93, 0.5], abs=0.05)


def test_the_turn_goes_to_the_earliest_and_then_to_the_lower_number() -> None:
    order: list[tuple[int, float]] = []

    def sleeper(number: int, nap: float) -> object:
        def script(robot: Khepera) -> None:
            for _ in range(4):
                robot.sleep(nap)
                order.append((number, round(robot.time, 3)))

        return script

    run_together(TWO, [sleeper(0, 0.3), sleeper(1, 0.2)], TwinOptions())  # type: ignore[list-item]
    assert order == sorted(order, key=lambda entry: (entry[1], entry[0]))
    assert (0, 0.6) in order
    assert order.index((0, 0.6)) + 1 == order.index((1, 0.6))


def test_robots_meet_as_they_would_with_one_host() -> None:
    def stand(robot: Khepera) -> int:
        while max(robot.proximity()[2:4]) < 100:
            robot.sleep(0.05)
        return max(robot.proximity()[2:4])

    readings = run_together(TWO, [chase_until_near, stand], TwinOptions(seed=1))
    assert readings[1] >= 100


def chase_until_near(robot: Khepera) -> None:
    robot.set_speed(10, 10)
    while max(robot.proximity()[2:4]) < 100:
        pass
    robot.set_speed(2, 2)
    robot.sleep(3)


def test_a_script_that_fails_is_reported_when_the_others_have_ended() -> None:
    ended: list[str] = []

    def fail(robot: Khepera) -> None:
        robot.sleep(0.1)
        raise PortTimeout("of its own")

    def resume(robot: Khepera) -> None:
        robot.sleep(2)
        ended.append("yes")

    with pytest.raises(PortTimeout, match="of its own"):
        run_together(TWO, [fail, resume], TwinOptions())
    assert ended == ["yes"]


def test_there_is_a_script_for_each_robot() -> None:
    with pytest.raises(PortError, match="1 scripts for 2 robots; expected one for each"):
        run_together(TWO, [chase], TwinOptions())

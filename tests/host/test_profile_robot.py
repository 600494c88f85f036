"""Robots whose wheels move along a profile, on twins in lock-step."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

from khep_twin.errors import MoveError, StoppedError
from khep_twin.host import Khepera3, Khepera4, ProfileRobot

AnyRobot = ProfileRobot[Any]
PORTS = {
    "khep://arena3?noise=off": Khepera3,
    "khep://arena3?noise=off&rom=kh3server": Khepera3,
    "khep://arena4?noise=off": Khepera4,
}


@pytest.fixture(params=PORTS)
def robot(request: pytest.FixtureRequest) -> Iterator[AnyRobot]:
    with PORTS[request.param](request.param) as profile_robot:
        yield profile_robot


def twin_of(robot: AnyRobot) -> Any:
    return robot.port.twin.robot  # type: ignore[attr-defined]


def test_speeds_and_positions_are_in_si_units(robot: AnyRobot) -> None:
    robot.set_speed(0.1, -0.1)
    robot.sleep(1)
    assert robot.speed() == pytest.approx((0.1, -0.1), abs=0.01)
    assert robot.position() == pytest.approx((0.093, -0.093), abs=0.02)
    robot.stop()
    robot.sleep(0.5)
    robot.reset_position()
    assert robot.position() == pytest.approx((0, 0), abs=1e-3)
    robot.set_duty(*(0.5, 0.5) if isinstance(robot, Khepera3) else (1000, 1000))  # type: ignore[attr-defined]
    robot.sleep(0.3)
    assert min(robot.speed()) > 0.05


def test_moves_wait_until_the_wheels_stand_at_their_target(robot: AnyRobot) -> None:
    x, y, heading = twin_of(robot).pose
    assert robot.move(0.1) == pytest.approx((0.1, 0.1), abs=2e-3)
    assert twin_of(robot).pose == pytest.approx((x, y + 0.1, heading), abs=3e-3)
    robot.turn(-math.pi / 2)
    assert twin_of(robot).pose[2] == pytest.approx(heading - math.pi / 2, abs=0.03)
    robot.move(0.001)
    with pytest.raises(MoveError, match=r"not on target after 0\.2 s; stopped at"):
        robot.move(0.3, timeout=0.2)
    assert twin_of(robot).readings()["speed"][2:] == [0, 0]


def test_its_vehicle_stops_at_the_end_whatever_drives(robot: AnyRobot) -> None:
    with type(robot)(robot.port.name) as other:
        other.wander()
        other.wander()
        other.sleep(1)
        assert any(other.speed())
        twin = twin_of(other)
    assert twin.readings()["speed"][2:] == [0, 0]
    robot.hold()
    with pytest.raises(StoppedError, match="'A,0' is not sent"):
        robot.wander()
    assert robot.speed() == (0, 0)


def test_what_is_out_of_range_is_refused_before_it_is_sent(robot: AnyRobot) -> None:
    with pytest.raises(ValueError, match="speed = nan; expected a finite number"):
        robot.set_speed(math.nan, 0)
    with pytest.raises(ValueError, match="wheel_base = 0; expected a number above 0"):
        type(robot)(robot.port.name, wheel_base=0)

"""Checks that are not possible in a robot's surroundings or state: no deviations, but reasons."""

import json
import re

import pytest

from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.check import CheckedPort
from khep_twin.lab.conformance.port.conform import conform, run_check
from khep_twin.lab.conformance.port.motion import sensor_order


def test_a_robot_that_moves_by_itself_passes_what_it_can_be_asked() -> None:
    report = conform("khep://default?mode=0")
    assert report.passed
    text = report.text()
    assert text.count("the robot drives without commands, as in its demonstration (mode 0)") == 1
    assert re.search(r"\d+ passed, 0 failed, \d+ not possible here, 13 of turrets that are absent$", text)
    impossible = [result["name"] for result in json.loads(report.json())["results"] if result["impossible"]]
    assert "E reads two speeds, which are 0 for a robot at rest" in impossible
    assert "N reads eight proximity values of 10 bits" not in impossible


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("stripes", "no sensor detected anything within 40 cm"),
        # An oblique wall: detected ahead, but not by the sensors at the side.
        ("obstacles", "no sensor detected the object after a turn"),
    ],
)
def test_without_a_wall_ahead_the_order_of_the_sensors_is_not_judged(place: str, reason: str) -> None:
    with Khepera(f"khep://{place}") as robot:
        result = run_check(sensor_order, CheckedPort(robot.port))
    assert result.deviation == ""
    assert (
        result.impossible == f"{reason}; needs a light-coloured wall straight ahead, with nothing else near"
    )


def test_readings_at_rest_do_not_hide_the_order_of_the_sensors() -> None:
    with Khepera("khep://default?model=khepera2") as robot:
        result = run_check(sensor_order, CheckedPort(robot.port))
    assert (result.deviation, result.impossible) == ("", "")

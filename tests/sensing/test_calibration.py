"""Calibration files: what ships can be used, and what cannot be used is told by place."""

import re

import pytest

from khep_twin.errors import CalibrationError
from khep_twin.files import toml_files
from khep_twin.sensing import calibration

TEXT = calibration.read("khepera1")[1]


def lines_about(old: str, new: str) -> list[str]:
    assert old in TEXT
    with pytest.raises(CalibrationError) as caught:
        toml_files.validate(calibration.Calibration, TEXT.replace(old, new), "mine.toml", CalibrationError)
    return str(caught.value).splitlines()


def test_what_ships_can_be_used() -> None:
    assert calibration.names() == ["khepera1", "khepera1-manual", "khepera2"]
    for name in calibration.names():
        assert calibration.read(name)[0].name == name


def test_what_is_not_said_of_wheels_and_motors_is_as_the_manual_has_it() -> None:
    found = calibration.read("khepera1")[0]
    assert 2 * 3.14159265 * found.wheels.radius_mm / 600 == pytest.approx(0.08)
    assert found.motors.constant == pytest.approx(5 / 150)
    assert found.motors.resistance == pytest.approx(5 * 5 / 150 / 0.010)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "dark_counts = 484.8",
            "dark_counts = 60",
            "ambient: floor_counts = 75; expected below dark_counts = 60",
        ),
        (
            "noise_counts = 22",
            "noise_counts = -1",
            "proximity: noise_counts = -1; expected a number from 0 to 1023",
        ),
        ("diffuse = 0.062", "diffuse = 2", "ambient: diffuse = 2; expected a number from 0 to 1"),
        (
            "dark_counts = 484.8",
            "drak_counts = 484.8",
            "ambient: drak_counts = 484.8: unknown key; did you mean 'dark_counts'?",
        ),
        (
            "heading_deg = [77.8, ",
            "heading_deg = [",
            "heading_deg; expected a list of eight numbers, one per sensor",
        ),
    ],
)
def test_what_is_wrong_is_reported_by_line_value_and_what_would_be_right(
    old: str, new: str, line: str
) -> None:
    told = [re.sub(r":\d+:", ":", each) for each in lines_about(old, new)]
    assert any(each.startswith(f"mine.toml: {line}") for each in told), told

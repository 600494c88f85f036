"""Calibration files: the built-in ones are valid, and errors are reported with their position."""

import re
from pathlib import Path

import numpy as np
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
    assert calibration.names() == ["khepera1", "khepera1-manual", "khepera2", "khepera2-manual", "khepera4"]
    for name in calibration.names():
        assert calibration.read(name)[0].name == name


def test_what_is_not_said_of_wheels_and_motors_is_as_the_manual_has_it() -> None:
    khepera = calibration.read("khepera1")[0]
    assert 2 * 3.14159265 * khepera.wheels.radius_mm / 600 == pytest.approx(0.08)
    # Full duty overcomes the gear's friction of 0.5 mN m besides, at no load as at a blocked wheel.
    assert khepera.motors.constant == pytest.approx(5 / 150 / 1.05)
    assert khepera.motors.resistance == pytest.approx(5 * 5 / 150 / 1.05 / 0.0105)


def test_wheels_of_different_size_have_the_mean_radius_and_their_ratio() -> None:
    left, right = calibration.WheelCalibration(radius_mm=7.5, right_over_left=1.01).radii
    assert (left + right) / 2 == pytest.approx(0.0075, rel=1e-12)
    assert right / left == pytest.approx(1.01, rel=1e-12)
    equal = calibration.WheelCalibration(radius_mm=7.7)
    assert equal.radii == (0.0077, 0.0077)


def test_robots_of_the_same_make_spread_around_their_calibration_as_told() -> None:
    nominal_robot = calibration.read("khepera1")[0]
    drawn = [calibration.vary(nominal_robot, np.random.default_rng(seed)) for seed in range(600)]

    def spread(values: list[float], nominal: float = 1.0) -> tuple[float, float]:
        parts = np.array(values) / nominal
        return float(parts.mean()), float(parts.std())

    wheels, motors = [robot.wheels for robot in drawn], [robot.motors for robot in drawn]
    spreads = {
        calibration.RADIUS_SPREAD: spread(
            [robot.radius_mm for robot in wheels], nominal_robot.wheels.radius_mm
        ),
        calibration.INEQUALITY_SPREAD: spread([robot.right_over_left for robot in wheels]),
        calibration.NO_LOAD_SPREAD: spread([robot.no_load_speed_rad_s for robot in motors], 150),
        calibration.STALL_SPREAD: spread([robot.stall_torque_n_m for robot in motors], 0.01),
    }
    assert spread([robot.base_mm for robot in wheels], 52)[1] == pytest.approx(
        calibration.BASE_SPREAD, rel=0.1
    )
    assert spread([robot.friction for robot in wheels], 0.9)[1] == pytest.approx(
        calibration.FRICTION_SPREAD, rel=0.1
    )
    for expected, (mean, sd) in spreads.items():
        assert mean == pytest.approx(1, abs=expected / 8)
        assert sd == pytest.approx(expected, rel=0.1)
    gains = np.log(
        [
            np.divide(robot.proximity.gain_counts_mm2, nominal_robot.proximity.gain_counts_mm2)
            for robot in drawn
        ]
    )
    assert gains.mean(axis=1).std() == pytest.approx(calibration.COMMON_GAIN_SPREAD, rel=0.1)
    assert gains.std(axis=1).mean() == pytest.approx(calibration.GAIN_SPREAD, rel=0.1)
    for deviations in (
        np.array([np.subtract(robot.heading_deg, nominal_robot.heading_deg) for robot in drawn]),
        np.array(
            [np.subtract(robot.ambient.heading_deg, nominal_robot.ambient.heading_deg) for robot in drawn]
        ),
    ):
        assert deviations.std() == pytest.approx(calibration.HEADING_SPREAD_DEG, rel=0.05)
        assert abs(deviations.mean()) < 0.2


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
            "proximity: noise_counts = -1; expected a number from 0 to 1023, or a list of numbers",
        ),
        ("diffuse = 0.062", "diffuse = 2", "ambient: diffuse = 2; expected a number from 0 to 1"),
        (
            "dark_counts = 484.8",
            "drak_counts = 484.8",
            "ambient: drak_counts = 484.8: unknown key; did you mean 'dark_counts'?",
        ),
        (
            "heading_deg = [78.1, ",
            "heading_deg = [",
            "heading_deg; expected a list of 8 numbers, one per sensor",
        ),
    ],
)
def test_what_is_wrong_is_reported_by_line_value_and_what_would_be_right(
    old: str, new: str, line: str
) -> None:
    messages = [re.sub(r":\d+:", ":", message) for message in lines_about(old, new)]
    assert any(message.startswith(f"mine.toml: {line}") for message in messages), messages


def test_counts_are_in_the_range_of_the_converter() -> None:
    text = calibration.read("khepera4")[1].replace("limit_counts = 1004", "limit_counts = 4000")
    with pytest.raises(CalibrationError, match="limit_counts = 4000; expected an integer from 1 to 1023"):
        toml_files.validate(calibration.Calibration, text, "mine.toml", CalibrationError)
    twelve_bits = text.replace("version = 1", "version = 1\nlargest_count = 4095")
    twelve_bits = twelve_bits.replace("white_counts = [930", "white_counts = [3975")
    measured = toml_files.validate(calibration.Calibration, twelve_bits, "mine.toml", CalibrationError)
    assert (measured.largest_count, measured.proximity.limit_counts) == (4095, 4000)
    assert (
        toml_files.validate(calibration.Calibration, toml_files.dump(measured), "", CalibrationError)
        == measured
    )


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("limit_counts = 1004\n", "", "proximity: limit_counts is missing; expected at most 4095"),
        (
            "[-96, -96,",
            "[-96, -4096,",
            "threshold_counts 2 = -4096; expected a list of numbers, one per sensor",
        ),
        ("[930, 930,", "[930, 4096,", "ground: white_counts 2 = 4096; expected a list of numbers"),
        ("dark_counts = 980", "dark_counts = 4096", "dark_counts = 4096; expected a number from 0 to 4095"),
        (
            "noise_counts = 3\nidle",
            "noise_counts = 5000\nidle",
            "= 5000; expected a number from 0 to 4095, or",
        ),
        (
            "idle_counts = 0",
            "idle_counts = 0\nfloor_counts = -4096",
            "expected an integer from -4095 to 4095",
        ),
    ],
)
def test_counts_out_of_the_range_of_12_bits_are_refused(old: str, new: str, problem: str) -> None:
    text = calibration.read("khepera4")[1].replace("version = 1", "version = 1\nlargest_count = 4095")
    assert old in text
    with pytest.raises(CalibrationError, match=re.escape(problem)):
        toml_files.validate(calibration.Calibration, text.replace(old, new), "mine.toml", CalibrationError)


BASE = {"mine": 'name = "mine"\nbase = "theirs.toml"\n[proximity]\nidle_counts = 3\n', "theirs": TEXT}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file and its base, beside the present one."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    for name, text in BASE.items():
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def test_the_keys_of_a_file_replace_those_of_its_base_and_the_text_is_complete(folder: Path) -> None:
    (folder / "third.toml").write_text('base = "mine.toml"\n[wheels]\nbase_mm = 54\n')
    measured, text = calibration.read("../third.toml")
    theirs = calibration.read("khepera1")[0]
    assert (measured.name, measured.proximity.idle_counts, measured.wheels.base_mm) == ("mine", 3, 54)
    assert (measured.heading_deg, measured.ambient) == (theirs.heading_deg, theirs.ambient)
    assert "base =" not in text
    assert toml_files.validate(calibration.Calibration, text, "log", CalibrationError) == measured


def test_a_base_may_be_a_calibration_by_its_name(folder: Path) -> None:
    (folder / "mine.toml").write_text('base = "khepera3"\n[motors]\nsupply_v = 7.0\n')
    assert calibration.read("../mine.toml")[0].motors.supply_v == 7


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"theirs.toml"', '"none.toml"', r"mine.toml: base = \"none.toml\": no such file; expected a calibr"),
        ('"theirs.toml"', "3", "mine.toml: base = 3: no such file; expected a calibration's name or path"),
        ('"theirs.toml"', '"mine.toml"', r"mine.toml: base = \"mine.toml\": a circle; expected another file"),
        ('"theirs.toml"', '"../"', 'base = "../": no such file'),
        ("idle_counts", "idle_count", r"mine.toml:4: proximity: idle_count = 3: unknown key; did you mean"),
        ("[proximity]", "[[proximity]]", "mine.toml: proximity; expected a table"),
    ],
)
def test_a_wrong_base_or_key_is_named_in_one_line(old: str, new: str, message: str, folder: Path) -> None:
    (folder / "mine.toml").write_text(BASE["mine"].replace(old, new))
    with pytest.raises(CalibrationError, match=message) as caught:
        calibration.read("../mine.toml")
    assert len(str(caught.value).splitlines()) == 1


def test_a_problem_of_a_base_is_reported_in_its_own_file(folder: Path) -> None:
    (folder / "theirs.toml").write_text(TEXT.replace("dark_counts = 484.8", "dark_counts = true"))
    with pytest.raises(CalibrationError, match=r"theirs.toml:\d+: ambient: dark_counts = true; expected"):
        calibration.read("../mine.toml")

"""Fit and calibration session of a Khepera IV, by the data of its model."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from command_line import good, refusal
from scenes import arena

from khep_twin import playpen
from khep_twin.errors import FitError, RobotModelError
from khep_twin.files.toml_files import dump
from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.lab.fit.fit_inputs import FitTests, SensorData, fit_inputs
from khep_twin.lab.fit.infrared_fit import fit_infrared, mean_counts
from khep_twin.lab.fit.placement import Misplacement, Placement, Readings, Ruler
from khep_twin.lab.fit.robot_fit import fit_robot
from khep_twin.lab.fit.session import CalibrationSession
from khep_twin.lab.fit.session_people import SimulatedPerson
from khep_twin.lab.fit.session_steps import Step, record, steps
from khep_twin.lab.fit.wheel_fit import Drive, fit_wheels, read_pulses
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.randomness import stream
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration

MODEL = find_model("khepera4")
START = calibration.read_for("khepera4", MODEL)
HIDDEN = calibration.vary(START, stream(7, "khepera4_fit"))
ROBOT = scenes.robot(1000, 1000, model="khepera4")
BENCH = arena(2000, 2000) + "wall_height_mm = 200\n" + ROBOT


def hosted(text: str = BENCH, **options: Any) -> tuple[HostRobot, Twin]:
    twin = open_twin(playpen.parse(text, "bench"), TwinOptions(**options))
    return open_robot(MODEL, Serial.of(twin, timeout=1.0)), twin


def never() -> bool:
    return False


def true_value(robot: Calibration, path: tuple[str, str] | tuple[str, str, int]) -> float:
    table, key, *sensor = path
    values = np.atleast_1d(getattr(getattr(robot, table) if table else robot, key))
    return float(values[sensor[0] if sensor else 0])


def test_a_wall_determines_the_gains_of_a_khepera_iv_s_eight_sensors_around() -> None:
    rng, tests = np.random.default_rng(1), list[Readings]()
    headings = np.linspace(0, 2 * math.pi, 24, endpoint=False)
    poses = np.column_stack([np.zeros((24, 2)), headings])
    for distance_mm in (35, 45, 60):
        place = Placement(poses, distance_mm / 1e3, model=MODEL)
        moved = Misplacement(5e-4 * rng.standard_normal(), 0.02 * rng.standard_normal())
        counts = mean_counts(place, HIDDEN, moved) + 3 * rng.standard_normal((24, 8))
        tests.append(Readings(f"{distance_mm} mm", place, np.rint(np.clip(counts, 0, 1004))))
    fit = fit_infrared(tests, START)
    gains = [value for value in fit.values if value.path[1] == "gain_counts_mm2"]
    errors = [(gain.value - true_value(HIDDEN, gain.path)) / gain.interval for gain in gains]
    assert len(gains) == 8
    assert np.abs(errors).max() < 1.5
    assert max(gain.interval / gain.value for gain in gains) < 0.1


def test_wheels_are_fitted_by_the_pulses_of_the_model() -> None:
    pulses_per_m = MODEL.body.pulses_per_turn / (math.tau * 0.0213)
    straight, turn = round(0.6 * pulses_per_m), round(5 * math.pi * 0.107 * pulses_per_m)
    drives = [Drive("straight", straight, straight, 0.6), Drive("turn", -turn, turn, turn=10 * math.pi)]
    wheels, _ = fit_wheels(drives, Ruler(), MODEL)
    assert (wheels.radius_mm, wheels.base_mm) == pytest.approx((21.3, 107.0), abs=1e-3)
    with pytest.raises(FitError, match="are not a Khepera IV's"):
        fit_wheels([Drive("straight", 100, 100, 0.6), drives[1]], Ruler(), MODEL)


def test_other_values_of_wheels_and_motors_keep_those_of_the_start() -> None:
    wheels = START.wheels.model_copy(update={"right_over_left": 1.003, "friction": 1.2})
    drives = (Drive("straight", 88_000, 88_000, 0.6), Drive("turn", -240_000, 240_000, turn=10 * math.pi))
    fit = fit_robot(FitTests(drives, model=MODEL), START.model_copy(update={"wheels": wheels})).calibration
    assert (fit.wheels.right_over_left, fit.wheels.friction) == (1.003, 1.2)
    assert fit.wheels.radius_mm != wheels.radius_mm


def floor_test(reflectance: float, counts: list[int]) -> SensorData:
    dv = np.tile([0, 0, *[100] * 8, *counts], (20, 1))
    run = SensorRun(SensorTest(rotate_deg=15, model="khepera4"), dv, np.linspace(0, 2, 20))
    return SensorData("paper", run, 0.0, model=MODEL, reflectance=reflectance)


def test_white_and_black_paper_determine_the_sensors_of_the_floor() -> None:
    white, black = floor_test(1.0, [900, 910, 920, 930]), floor_test(0.0, [40, 40, 42, 42])
    fit = fit_robot(FitTests(floors=(white, black), model=MODEL), START)
    ground = fit.calibration.ground
    assert ground is not None
    assert (ground.white_counts, ground.nothing_counts) == ((900, 910, 920, 930), 41)
    assert [value.value for value in fit.values] == [900, 910, 920, 930, 41]
    with pytest.raises(FitError, match="the sensors of the floor cannot be determined; expected floor:white"):
        fit_robot(FitTests(floors=(white, white), model=MODEL), START)


def test_a_session_records_a_khepera_iv_s_drives_and_a_fit_of_a_khepera_refuses_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.lab.fit.session_steps.STRAIGHT_MM", 150)
    log, path = tmp_path / "twin.mcap", tmp_path / "straight.mcap"
    robot, twin = hosted(log=str(log))
    with robot:
        person = SimulatedPerson(twin, Ruler(0, 0), lambda _: None)
        person.place(Step("straight"))
        assert record(robot, Step("straight"), path, never)
        length_mm = person.measure(Step("straight"))
    assert read_pulses(path, MODEL) == pytest.approx((22_118, 22_118), abs=300)
    assert length_mm == pytest.approx(150, abs=3)
    assert "of a khepera4; expected a khepera, or --model khepera4" in refusal("fit", f"{log}={length_mm}mm")
    with pytest.raises(FitError, match="the counters were not read twice; expected H before and after"):
        read_pulses(path)


def test_a_khepera_and_a_model_without_a_bench_have_no_such_tests(tmp_path: Path) -> None:
    (tmp_path / "paper.csv").write_text(
        "# khep-twin: sensor test\n# what: proximity\n# motion: rotational\n# rotate_deg: 15\n# speed: 1\n"
        "# acceleration: 1\n# return_to_zero: 0\ntime_s,left_pulses,right_pulses,left_90,left_45,left_10,"
        "right_10,right_45,right_90,back_right,back_left\n0.0,0,0,0,0,0,0,0,0,0,0\n"
    )
    with pytest.raises(FitError, match="a Khepera has no sensors of the floor"):
        fit_inputs([f"{tmp_path}/paper.csv=floor:white"])
    with pytest.raises(RobotModelError, match="model = 'other' gives no bench; expected one for a fit"):
        steps([35.0], None, None, 15.0, replace(MODEL, name="other", bench=None))


def test_a_simulated_person_needs_walls_as_high_as_the_sensors_see() -> None:
    robot, twin = hosted(arena(2000, 2000) + ROBOT)
    with robot, pytest.raises(FitError, match=r"walls 50 mm high; expected .* of 200 mm and more"):
        SimulatedPerson(twin, Ruler(), lambda _: None)


@pytest.mark.long
def test_a_session_recovers_a_khepera_iv_drawn_by_vary(tmp_path: Path) -> None:
    hidden = tmp_path / "hidden.toml"
    hidden.write_text(dump(HIDDEN), encoding="utf-8")
    session = CalibrationSession(tmp_path / "session")
    robot, twin = hosted(f"{BENCH}calibration = '{hidden}'\n", seed=7)
    with robot:
        person = SimulatedPerson(twin, Ruler(), lambda _: None)
        todo = steps(MODEL.fit_bench.walls_mm, None, None, 15.0, MODEL)
        assert session.run(todo, robot, person, lambda _: None, never)
    fit = fit_robot(fit_inputs(session.words_with_folder, MODEL), START)
    errors = [(value.value - true_value(HIDDEN, value.path)) / value.interval for value in fit.values]
    assert len(errors) == 45
    assert np.mean(np.abs(errors) < 1) > 0.8
    assert np.abs(errors).max() < 2
    words = [word for word in session.words_with_folder if "wall" in word]
    assert "gain" in good("fit", *words, "--model", "khepera4", "-o", tmp_path / "mine.toml")

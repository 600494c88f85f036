"""Fit and calibration session of both generations of a Khepera III, by the data of their models."""

import math
from pathlib import Path

import numpy as np
import pytest
import scenes
from scenes import arena

from khep_twin import playpen
from khep_twin.files.toml_files import dump
from khep_twin.host.host_robot import open_robot
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.lab.fit.fit_inputs import FitTests, SensorData, fit_inputs
from khep_twin.lab.fit.infrared_fit import convert, count_deviations, expected_counts, mean_counts
from khep_twin.lab.fit.motor_fit import read_drive, simulate
from khep_twin.lab.fit.placement import FittedValue, Placement, Ruler
from khep_twin.lab.fit.robot_fit import fit_robot
from khep_twin.lab.fit.session import CalibrationSession
from khep_twin.lab.fit.session_people import SimulatedPerson
from khep_twin.lab.fit.session_steps import Step, record, steps
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.randomness import stream
from khep_twin.robots.khepera3.robot import Khepera3Robot
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration
from khep_twin.world import World

MODEL = find_model("khepera3")
START = calibration.read_for(MODEL.calibration, MODEL)
HIDDEN = calibration.vary(START, stream(7, "khepera3_fit"))


def bench(model: str = "khepera3", x_mm: float = 1000) -> str:
    return arena(2000, 2000) + "wall_height_mm = 200\n" + scenes.robot(x_mm, 1000, model=model)


def never() -> bool:
    return False


def error_of(hidden: Calibration, value: FittedValue) -> float:
    """Return the error of a fitted value in its interval."""
    table, key, *sensor = value.path
    values = np.atleast_1d(getattr(getattr(hidden, table) if table else hidden, key))
    return (value.value - float(values[sensor[0] if sensor else 0])) / value.interval


def turn(distance_mm: float, count: int) -> Placement:
    """Return a wall before a robot that turns on the spot."""
    headings = np.linspace(0, 2 * math.pi, count, endpoint=False)
    return Placement(np.column_stack([np.zeros((count, 2)), headings]), distance_mm / 1e3, model=MODEL)


def test_the_optics_of_the_fit_are_those_of_the_scene_with_saturation_and_the_floor_s_mirror() -> None:
    world = World(playpen.parse(bench(), "bench"), noise=False)
    robot, place = world.robots[0], turn(20, 9)
    assert isinstance(robot, Khepera3Robot)
    levels = mean_counts(place, START)
    expected, _ = convert(levels, START.proximity.threshold_counts, START.proximity)
    assert expected.max() < 0.96 * levels.max()
    for heading_deg, counts in zip(range(0, 360, 40), expected, strict=True):
        place_robot(world, 0, 2000 - 1e3 * MODEL.body.radius - 20, 1000, heading_deg)
        scan(world)
        robot.evaluate_all()
        np.testing.assert_allclose(robot.registers[:9], counts, atol=0.7)


def test_noise_grows_with_the_light_and_shrinks_where_readings_saturate() -> None:
    levels, thresholds = np.array([[0.0], [500.0], [4000.0]]), np.array([-100.0])
    draws, near = np.random.default_rng(1).standard_normal((3, 40_000)), START.proximity
    noisy = levels + 5 * draws * (1 + near.noise_growth * (levels + thresholds).clip(0))
    readings, _ = convert(noisy, thresholds, near)
    counts, growth = convert(levels, thresholds, near)
    np.testing.assert_allclose(readings.mean(axis=1), counts[:, 0], atol=0.2)
    np.testing.assert_allclose(readings.std(axis=1), 5 * growth[:, 0], rtol=0.02)
    assert growth[:, 0] == pytest.approx([1, 1.2, 1.23], abs=0.01)


def test_a_dark_reading_is_clipped_to_a_floor_below_0() -> None:
    near = START.proximity.model_copy(update={"floor_counts": -2, "saturates": False})
    readings = np.array([-50.0, 0.0, 100.0]), np.array([2.0]), near
    means, deviations = expected_counts(*readings), count_deviations(*readings)
    assert means[0] == pytest.approx(-2, abs=1e-3)
    assert 0 < means[1] < 0.5
    assert deviations[2] == pytest.approx(2)


def test_a_session_s_steps_of_duty_are_polled_by_positions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.lab.fit.session_steps._DUTY_S", 0.1)
    path, twin = tmp_path / "duty.mcap", open_twin(playpen.parse(bench(), "bench"), TwinOptions())
    with open_robot(MODEL, Serial.of(twin, timeout=1.0)) as robot:
        assert record(robot, Step("duty"), path, never)
    drive = read_drive(path, MODEL)
    assert drive.requests[0][1] == "L,l600,l600"
    assert drive.is_position.all()
    assert len(drive.values) > 50
    assert drive.speeds(drive.values).max() > 30
    residuals = simulate(drive, START) - drive.speeds(drive.values)
    assert np.median(np.abs(residuals)) < 1


def floor_test(surface: str, counts: list[int]) -> SensorData:
    dv = np.tile([0, 0, *[100] * 9, *counts], (20, 1))
    run = SensorRun(SensorTest(rotate_deg=15, model="khepera3"), dv, np.linspace(0, 2, 20))
    reflectance = BUILT_IN_SURFACES[surface].reflectance
    return SensorData("paper", run, 0.0, model=MODEL, reflectance=reflectance)


def test_white_and_black_paper_determine_sensors_of_the_floor_that_white_saturates() -> None:
    tests = floor_test("white", [3978, 3972]), floor_test("black", [339, 339])
    ground = fit_robot(FitTests(floors=tests, model=MODEL), START).calibration.ground
    assert START.ground is not None
    assert ground is not None
    assert ground.white_counts == pytest.approx(START.ground.white_counts, abs=0.3)
    assert ground.nothing_counts < 2


def test_a_simulated_person_s_first_readings_are_those_at_the_new_place() -> None:
    twin = open_twin(playpen.parse(bench(x_mm=1900), "bench"), TwinOptions(noise=False))
    with open_robot(MODEL, Serial.of(twin, timeout=1.0)) as robot:
        near = robot.read_channels("proximity")["proximity"]
        SimulatedPerson(twin, Ruler(0, 0), lambda _: None).place(Step("turns"))
        far = robot.read_channels("proximity")["proximity"]
    assert near[3] > 500
    assert far[3] < 100


@pytest.mark.long
@pytest.mark.parametrize("name", ["khepera3", "khepera3-firmware2"])
def test_a_session_recovers_a_khepera_iii_drawn_by_vary(tmp_path: Path, name: str) -> None:
    model, path = find_model(name), tmp_path / "hidden.toml"
    start = calibration.read_for(model.calibration, model)
    hidden = calibration.vary(start, stream(7, "khepera3_fit"))
    path.write_text(dump(hidden), encoding="utf-8")
    session = CalibrationSession(tmp_path / "session")
    twin = open_twin(playpen.parse(f"{bench(name)}calibration = '{path}'\n", "bench"), TwinOptions(seed=7))
    with open_robot(model, Serial.of(twin, timeout=1.0)) as robot:
        person = SimulatedPerson(twin, Ruler(), lambda _: None)
        todo = steps(model.fit_bench.walls_mm, None, None, 15.0, model)
        assert session.run(todo, robot, person, lambda _: None, never)
    values = fit_robot(fit_inputs(session.words_with_folder, model), start).values
    errors = np.abs([error_of(hidden, value) for value in values])
    assert len(errors) >= 45
    assert np.mean(errors < 1) > 0.8
    assert errors.max() < 2

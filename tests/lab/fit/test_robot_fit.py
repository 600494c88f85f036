"""Fit of a robot from recorded tests: a hidden twin's values are recovered, undetermined ones refused."""

import math
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import scenes
from command_line import good, refusal
from scenes import arena, hosted, table

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.host import Khepera
from khep_twin.lab.fit.fit_inputs import FASTEST_TURN, SensorData, fit_inputs
from khep_twin.lab.fit.lamp_fit import LampPositions
from khep_twin.lab.fit.motor_fit import read_drive
from khep_twin.lab.fit.wheel_fit import Drive, fit_wheels
from khep_twin.lab.sensor_test.sensor_files import save
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest, sense
from khep_twin.sensing import calibration

KHEPERA1 = calibration.read("khepera1")[0]
FACTORS = np.array([1.2, 0.85, 0.9, 1.1, 1.0, 1.15, 0.8, 0.95])


def times(values: tuple[float, ...], factors: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in np.array(values) * factors)


HIDDEN = KHEPERA1.model_copy(
    update={
        "wheels": calibration.WheelCalibration(radius_mm=7.83, base_mm=53.4),
        "motors": calibration.MotorCalibration(
            no_load_speed_rad_s=131.0, stall_torque_n_m=0.0142, friction_torque_n_m=0.0008
        ),
        "proximity": KHEPERA1.proximity.model_copy(
            update={
                "gain_counts_mm2": times(KHEPERA1.proximity.gain_counts_mm2, FACTORS),
                "threshold_counts": tuple(counts + 40 for counts in KHEPERA1.proximity.threshold_counts),
            }
        ),
        "ambient": KHEPERA1.ambient.model_copy(
            update={
                "gain_counts_mm2_per_w": times(KHEPERA1.ambient.gain_counts_mm2_per_w, FACTORS[::-1]),
                "dark_counts": 470.0,
            }
        ),
    }
)


class Bench:
    """A bench with the hidden robot, and its recordings."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.robot_time = 0.0
        (folder / "hidden.toml").write_text(dump(HIDDEN))

    def robot(self, x_mm: float, options: str = "", log: str = "", seed: int = 0) -> Khepera:
        table = scenes.robot(x_mm, 500, calibration=str(self.folder / "hidden.toml"))
        scene = playpen.parse(arena(1000, 1000) + table + options, "bench")
        robot = hosted(scene, seed=seed, log=str(self.folder / log) if log else None)
        robot.port.twin.world.code.switch_if_ready()
        return robot

    def drive(self, log: str, left: int, right: int) -> tuple[float, float]:
        """Drive by position control; return the true distance [m] and turn [rad], as a ruler finds them."""
        with self.robot(100, log=log) as robot:
            body = robot.port.twin.robot
            start, turned, heading = body.pose, 0.0, body.pose[2]
            robot.set_position(0, 0)
            robot.position()
            robot.set_target(left, right)
            while not all(wheel.on_target for wheel in robot.status()):
                turned += (body.pose[2] - heading + math.pi) % (2 * math.pi) - math.pi
                heading = body.pose[2]
            robot.sleep(0.5)
            robot.position()
            self.robot_time += robot.time
            return math.dist(start[:2], body.pose[:2]), turned + body.pose[2] - heading

    def steps(self, log: str, *duties: int) -> None:
        with self.robot(500, log=log) as robot:
            for duty in duties:
                robot.set_duty(duty, duty)
                for _ in range(60):
                    robot.speed()
            self.robot_time += robot.time

    def turn(self, name: str, robot: Khepera, test: SensorTest) -> str:
        with robot:
            save(self.folder / name, sense(robot, test))
            self.robot_time += robot.time
        return str(self.folder / name)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], list[str], Path]:
    """Words for the command line: tests of less than three minutes, and tests for a check."""
    bench = Bench(tmp_path_factory.mktemp("recorded"))
    path = bench.folder
    way, _ = bench.drive("straight.mcap", 10_000, 10_000)
    _, turned = bench.drive("spin.mcap", -10_000, 10_000)
    bench.steps("steps.mcap", 40, 0, -40, 0, 30, -10, 0)
    words = [
        f"{path}/straight.mcap={way * 1e3:.0f}mm",
        f"{path}/spin.mcap={turned / 2 / math.pi:.3f}turns",
        f"{path}/steps.mcap=duty",
    ]
    full_turn = SensorTest("proximity", rotate_deg=360, speed=4)
    light = SensorTest("light", rotate_deg=360, speed=5)
    for seed, distance_mm in enumerate((12, 17, 23, 29)):
        robot = bench.robot(1000 - 27.5 - distance_mm, seed=seed)
        words.append(f"{bench.turn(f'wall{seed}.csv', robot, full_turn)}=wall@{distance_mm}mm")
    for seed, distance_mm in enumerate((60, 150)):
        lamp = table("lamp", x_mm=300 + 27.5 + 10 + distance_mm, y_mm=500, power_w=2)
        robot = bench.robot(300, lamp, seed=seed)
        words.append(f"{bench.turn(f'lamp{seed}.mat', robot, light)}=lamp:2W@{distance_mm}mm")
    assert bench.robot_time < 180
    other, _ = bench.drive("other.mcap", 7_000, 7_000)
    can = table("cylinder", x_mm=300 + 27.5 + 15 + 12.5, y_mm=500, radius_mm=12.5, height_mm=50)
    unused = [
        f"{path}/other.mcap={other * 1e3:.1f}mm",
        f"{bench.turn('can.mcap', bench.robot(300, can), full_turn)}=cylinder:12.5mm@15mm",
    ]
    return words, unused, path


@pytest.mark.long
def test_a_hidden_robot_is_found_and_tests_that_were_not_used_are_met(
    recorded: tuple[list[str], list[str], Path],
) -> None:
    words, unused, folder = recorded
    checks = [part for word in unused for part in ("--check", word)]
    target = folder / "mine.toml"
    output = good("fit", *words, *checks, "-o", target)
    fit = calibration.read(str(target))[0]
    assert fit.name == "mine"
    assert fit.wheels.radius_mm == pytest.approx(HIDDEN.wheels.radius_mm, rel=0.002)
    assert fit.wheels.base_mm == pytest.approx(HIDDEN.wheels.base_mm, rel=0.005)
    assert fit.motors.no_load_speed_rad_s == pytest.approx(HIDDEN.motors.no_load_speed_rad_s, rel=0.01)
    assert fit.motors.stall_torque_n_m == pytest.approx(HIDDEN.motors.stall_torque_n_m, rel=0.03)
    assert fit.motors.friction_torque_n_m == pytest.approx(HIDDEN.motors.friction_torque_n_m, rel=0.05)
    for part, key in (("proximity", "gain_counts_mm2"), ("ambient", "gain_counts_mm2_per_w")):
        gains = np.array(getattr(getattr(fit, part), key)) / getattr(getattr(HIDDEN, part), key)
        np.testing.assert_allclose(gains, 1, atol=0.03)
    assert fit.ambient.dark_counts == pytest.approx(470, abs=1)
    lines = output.splitlines()
    assert "check the object" not in output
    drive, can = (line for line in lines if line.endswith("off, not used for the fit"))
    assert abs(float(drive.split(": ")[1].split(" mm")[0])) < 1
    assert float(can.split(": ")[1].split(" counts")[0]) < 30


@pytest.mark.share(2)
@pytest.mark.parametrize(
    ("unchanged", "message"),
    [
        (["spin.mcap"], "the wheels' radius cannot be determined"),
        (["straight.mcap"], "the wheel base cannot be determined"),
    ],
)
def test_without_a_ruler_wheels_are_refused(
    recorded: tuple[list[str], list[str], Path], unchanged: list[str], message: str
) -> None:
    words = [word for word in recorded[0] if any(name in word for name in unchanged)]
    assert message in refusal("fit", *words)


def test_one_distance_far_away_determines_no_gain(
    recorded: tuple[list[str], list[str], Path], tmp_path: Path
) -> None:
    bench = Bench(tmp_path)
    path = bench.turn("far.csv", bench.robot(700), SensorTest("proximity", rotate_deg=360, speed=8))
    line = refusal("fit", f"{path}=wall@272mm")
    assert "left 90: the gain cannot be determined: 0 readings are neither 0 nor saturated" in line


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("a.csv", "a.csv; expected a file and a measurement"),
        ("a.csv=wall", "expected a file and a measurement"),
        ("a.csv=wall@-5mm", "expected a file and a measurement"),
        ("a.csv=lamp@5mm", "expected a file and a measurement"),
        ("a.mcap", "a.mcap; expected a file and a measurement"),
        ("a.mcap=5", "a.mcap=5; expected a file and a measurement"),
        ("a.mcap=5cm", "a.mcap=5cm; expected a file and a measurement"),
        ("=5mm", "=5mm; expected a file and a measurement"),
        ("nowhere.mcap=5mm", "nowhere.mcap: cannot be read: No such file or directory"),
        ("nowhere.csv=wall@5mm", "nowhere.csv: cannot be read: No such file or directory"),
        ("nowhere.mcap=duty", "nowhere.mcap: cannot be read: No such file or directory"),
    ],
)
def test_wrong_words_are_reported_in_one_line(word: str, message: str) -> None:
    assert message in refusal("fit", word)


def test_a_test_of_light_is_no_test_of_a_wall(recorded: tuple[list[str], list[str], Path]) -> None:
    lamp = next(word for word in recorded[0] if "lamp0" in word).split("=")[0]
    with pytest.raises(FitError, match="a test of light; expected one of proximity"):
        fit_inputs([f"{lamp}=wall@20mm"])


def test_a_drive_with_a_high_duty_or_none_determines_no_motors(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.steps("high.mcap", 60, 0)
    with pytest.raises(FitError, match="P,60,60: the tyres may slip at this duty"):
        read_drive(tmp_path / "high.mcap")
    bench.steps("none.mcap")
    with pytest.raises(FitError, match="the motors cannot be determined: no drive with a fixed duty"):
        read_drive(tmp_path / "none.mcap")


def test_in_a_straight_approach_the_wall_comes_nearer_and_stays_ahead() -> None:
    dv = np.zeros((3, 10), np.int64)
    dv[:, :2] = [[0, 0], [100, 100], [250, 250]]
    run = SensorRun(SensorTest(linear_cm=5), dv, np.array([0.0, 1e6, 2e6]))
    distances, bearings = (
        SensorData("approach", run, 0.03).readings(KHEPERA1.wheels).placement.object_positions()
    )
    np.testing.assert_allclose(distances, [0.03, 0.022, 0.01], atol=1e-5)
    np.testing.assert_allclose(bearings, 0, atol=1e-12)


def test_a_robot_that_turns_left_has_the_object_on_its_right() -> None:
    quarter = round(math.pi / 2 * 26 / 0.08)
    dv = np.zeros((2, 10), np.int64)
    dv[1, :2] = -quarter, quarter
    run = SensorRun(SensorTest(rotate_deg=90), dv, np.array([0.0, 1e6]))
    for data in (SensorData("wall", run, 0.02), SensorData("can", run, 0.02, radius=0.0125)):
        distances, bearings = data.readings(KHEPERA1.wheels).placement.object_positions()
        np.testing.assert_allclose(distances, 0.02, atol=1e-6)
        np.testing.assert_allclose(bearings, [0, -math.pi / 2], atol=2e-3)
    lamp = LampPositions.of(SensorData("lamp", run, 0.1, power=2.0).readings(KHEPERA1.wheels))
    np.testing.assert_allclose(lamp.positions[1], [0, -0.1375, 0.0016], atol=4e-4)


def test_a_test_is_given_once_and_no_output_takes_its_place(
    recorded: tuple[list[str], list[str], Path],
) -> None:
    words, _, folder = recorded
    wall = next(word for word in words if "wall1" in word)
    assert "this file is given twice" in refusal("fit", wall, wall)
    file = Path(wall.split("=")[0])
    before = file.read_bytes()
    assert "this is a recorded test" in refusal("fit", wall, "-o", file)
    message = refusal("fit", wall, "-o", folder / "x.png", "--picture", folder / "x.png")
    assert "this is the calibration" in message
    assert file.read_bytes() == before
    assert not (folder / "x.png").exists()


@pytest.mark.long
def test_a_wrong_distance_is_asked_about(recorded: tuple[list[str], list[str], Path]) -> None:
    walls = [word for word in recorded[0] if "wall" in word]
    output = good("fit", *walls[:2], walls[2].replace("23mm", "18mm"), walls[3])
    questions = [line for line in output.splitlines() if "check the object and its distance" in line]
    assert any("wall@18mm" in line for line in questions)


@pytest.mark.parametrize(
    ("left", "right", "measured_mm", "turned"),
    [
        (1000, 1000, None, 31.0),
        (-1000, 1000, 80.0, None),
        (1000, 1000, -80.0, None),
        (-1000, 1000, None, -3.0),
    ],
)
def test_a_drive_that_is_not_what_was_measured_is_refused(
    left: int, right: int, measured_mm: float | None, turned: float | None
) -> None:
    wrong = Drive("wrong", left, right, measured_mm and measured_mm / 1e3, turned)
    with pytest.raises(FitError, match=f"wrong: the counters went on by {left} left and {right} right"):
        fit_wheels([wrong])


def test_in_a_drive_along_an_arc_the_poses_are_on_the_arc() -> None:
    wheels, steps = KHEPERA1.wheels, np.arange(7)
    dv = np.zeros((7, 10), np.int64)
    dv[:, 0], dv[:, 1] = 100 * steps, 200 * steps
    run = SensorRun(SensorTest(linear_cm=5), dv, np.full(7, np.nan))
    x, y, heading = SensorData("arc", run, 0.03).readings(wheels).placement.poses.T
    radius = 1.5 * wheels.base_mm / 1e3  # of wheels at the ratio 1 : 2
    assert heading[-1] > 0.5
    np.testing.assert_allclose(x, radius * np.sin(heading), rtol=2e-3)
    np.testing.assert_allclose(y, radius * (1 - np.cos(heading)), rtol=2e-3)


@pytest.mark.parametrize(
    ("test", "reason"),
    [
        (SensorTest(rotate_deg=90, speed=None), "turned at an unknown speed"),
        (SensorTest(rotate_deg=90, speed=FASTEST_TURN + 1), f"turned at speed {FASTEST_TURN + 1}"),
        (SensorTest(rotate_deg=90, speed=FASTEST_TURN), ""),
        (SensorTest(linear_cm=5, speed=None), ""),
        (SensorTest(linear_cm=5, speed=FASTEST_TURN + 1), ""),
    ],
)
def test_only_turns_at_a_known_and_low_speed_determine_sensors(
    test: SensorTest, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = SensorRun(test, np.zeros((3, 10), np.int64), np.arange(3) * 1e6)
    monkeypatch.setattr(sys.modules[SensorData.__module__], "load", lambda *_: run)
    with pytest.raises(FitError, match=reason) if reason else nullcontext():
        assert len(fit_inputs(["test.csv=wall@20mm"]).objects) == 1

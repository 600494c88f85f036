"""Sensor tests on twins: they reach their targets, read the sensors, and leave the robot at rest."""

import math
from pathlib import Path

import numpy as np
import pytest
import scenes
from scenes import arena, hosted

from khep_twin import playpen
from khep_twin.errors import KhepTwinError, SensorTestError
from khep_twin.host import Khepera, Khepera4, Vision
from khep_twin.lab.sensor_test.sensor_files import load, save
from khep_twin.lab.sensor_test.sensor_test import BrokenOffError, SensorRun, SensorTest, sense
from khep_twin.units import BODY_RADIUS, SENSOR_LABELS


def before_a_wall(distance_mm: float, faults: tuple[str, ...] = ()) -> Khepera:
    """A robot that faces a white wall at a distance."""
    text = arena(1000, 1000) + scenes.robot(1000 - BODY_RADIUS * 1000 - distance_mm, 500)
    return hosted(playpen.parse(text, "bench"), seed=1, noise=False, faults=faults)


def test_a_way_to_a_wall_begins_with_0_and_ends_saturated_at_the_target() -> None:
    with before_a_wall(155) as robot:
        run = sense(robot, SensorTest(linear_cm=15), text="white")
        assert robot.speed() == pytest.approx((0, 0), abs=1)
    assert run.dv[0].tolist() == [0] * 10
    np.testing.assert_allclose(run.dv[-1, :2], 1875, atol=2)
    assert (run.dv[-1, [4, 5]] == 1023).all()
    assert not run.dv[:, [8, 9]].any()
    assert run.times[0] == 0
    assert (np.diff(run.times) > 0).all()
    assert run.text == "white"
    assert run.travelled[-1] == pytest.approx(15, abs=0.02)


@pytest.mark.parametrize(("motion", "amount"), [("linear_cm", 20.0), ("rotate_deg", -90.0)])
def test_a_khepera_4_drives_by_speeds_to_its_target_and_its_file_is_read_again(
    motion: str, amount: float, tmp_path: Path
) -> None:
    test = SensorTest(what="light", model="khepera4", **{motion: amount})
    with Khepera4("khep://arena4?seed=1") as robot:
        run = sense(robot, test)
        pose = robot.port.twin.robot.pose
    assert run.travelled[-1] == pytest.approx(amount, rel=0.03)
    moved = (pose[1] - 1.0) * 100 if motion == "linear_cm" else math.degrees(pose[2]) - 90
    assert moved == pytest.approx(amount, rel=0.05)
    assert run.dv.shape[1] == 2 + 12
    for name in ("run.csv", "run.mcap"):
        save(tmp_path / name, run)
        read = load(tmp_path / name)
        assert read.test == test
        np.testing.assert_array_equal(read.dv, run.dv)
    with pytest.raises(SensorTestError, match=r"model = 'khepera4'; expected \.csv"):
        save(tmp_path / "run.mat", run)
    with pytest.raises(SensorTestError, match="what = 'vision': model = 'khepera4'; expected proximity or l"):
        SensorTest("vision", 10, model="khepera4")


def test_a_whole_turn_shows_the_wall_to_each_sensor_at_its_own_heading() -> None:
    with before_a_wall(15) as robot:
        run = sense(robot, SensorTest(rotate_deg=360, speed=3))
    np.testing.assert_allclose(run.dv[-1, :2], [-2042, 2042], atol=2)
    # A sensor sees the wall when the robot has turned by the negative angle of the sensor. Lateral sensors
    # are at 67 degrees and face 88 degrees, so that they see a near wall in between.
    for sensor, heading_deg in {"left 90": 283, "right 90": 77, "left 45": 315, "right 45": 45}.items():
        weights = run.dv[:, 2 + SENSOR_LABELS.index(sensor)].astype(np.float64)
        radians = np.radians(run.travelled)
        bearing = math.degrees(math.atan2(weights @ np.sin(radians), weights @ np.cos(radians))) % 360
        assert bearing == pytest.approx(heading_deg, abs=12), sensor


def test_below_0_a_test_drives_backwards_and_turns_clockwise() -> None:
    with before_a_wall(5) as robot:
        back = sense(robot, SensorTest(linear_cm=-10))
        turned = sense(robot, SensorTest(rotate_deg=-90))
    np.testing.assert_allclose(back.dv[-1, :2], -1250, atol=2)
    assert back.dv[0, 4] == 1023
    assert back.dv[-1, 4] == 0
    np.testing.assert_allclose(turned.dv[-1, :2], [511, -511], atol=2)
    assert turned.travelled[-1] == pytest.approx(-90, abs=0.5)


def test_light_is_read_where_it_is_asked_for() -> None:
    with before_a_wall(300) as robot:
        run = sense(robot, SensorTest("light", linear_cm=5))
    assert (run.dv[:, 2:] > 400).all()


def test_returning_waits_5_seconds_and_ends_at_0_without_more_rows() -> None:
    with before_a_wall(300) as robot:
        run = sense(robot, SensorTest(linear_cm=5, return_to_zero=True))
        assert robot.time > run.times[-1] + 5
        np.testing.assert_allclose(robot.position(), 0, atol=2)
    assert run.dv[-1, 0] == pytest.approx(625, abs=2)


def test_the_speed_is_kept_to_and_set_back_afterwards() -> None:
    with before_a_wall(300) as robot:
        slow = sense(robot, SensorTest(linear_cm=10, speed=5))
        assert slow.times[-1] == pytest.approx(1250 / 500, abs=0.7)
        robot.set_position(0, 0)
        robot.set_target(1250, 1250)
        robot.sleep(1.6)
        assert robot.position()[0] == pytest.approx(1250, abs=5)


def test_a_blocked_wheel_ends_the_test_with_how_far_it_came_and_the_rows_so_far() -> None:
    with before_a_wall(300, faults=("dead:left",)) as robot:
        with pytest.raises(
            BrokenOffError, match=r"broke off after \d+\.\d of 20 cm: the left wheel made no"
        ) as caught:
            sense(robot, SensorTest(linear_cm=20))
        robot.sleep(0.5)
        # The wheel of a dead motor rolls on passively; both are in speed mode, at speed 0.
        assert [wheel.mode for wheel in robot.status()] == [0, 0]
        assert robot.speed()[1] == 0
    assert len(caught.value.run.dv) > 10
    assert caught.value.run.dv[-1, 0] < 100


def test_stopping_leaves_the_motors_at_rest_and_keeps_the_rows_so_far() -> None:
    with before_a_wall(300) as robot:
        run = sense(robot, SensorTest(linear_cm=20, return_to_zero=True), stop=lambda: robot.time > 1)
        assert robot.time < 1.5
        robot.sleep(0.3)
        assert robot.speed() == (0, 0)
    assert 0 < run.travelled[-1] < 15


def test_an_interrupt_stops_the_motors() -> None:
    def interrupt(part: float) -> None:
        if part > 0.3:
            raise KeyboardInterrupt

    with before_a_wall(300) as robot:
        with pytest.raises(KeyboardInterrupt):
            sense(robot, SensorTest(linear_cm=20), progress=interrupt)
        robot.sleep(0.3)
        assert robot.speed() == (0, 0)


def test_progress_rises_to_1() -> None:
    parts: list[float] = []
    with before_a_wall(300) as robot:
        sense(robot, SensorTest(rotate_deg=-45), progress=parts.append)
    assert parts[0] == 0
    assert parts[-1] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"what": "lihgt", "linear_cm": 5}, "what = lihgt; expected proximity, light or vision"),
        ({}, "linear and rotate: none given; expected one of them"),
        ({"linear_cm": 5, "rotate_deg": 90}, "linear and rotate: both given; expected one of them"),
        ({"linear_cm": 4.9}, "linear = 4.9 cm; expected 5 to 60, or -5 to -60 to drive backwards"),
        ({"linear_cm": math.nan}, "linear = nan cm; expected 5 to 60, or -5 to -60 to drive backwards"),
        ({"rotate_deg": -361}, "rotate = -361 degrees; expected 15 to 360, or -15 to -360 for clockwise"),
        ({"linear_cm": 5, "speed": 128}, "speed = 128; expected an integer from 1 to 127"),
        ({"linear_cm": 5, "acceleration": 0}, "acceleration = 0; expected an integer from 1 to 255"),
    ],
)
def test_what_is_no_test_is_refused(values: dict[str, object], line: str) -> None:
    with pytest.raises(SensorTestError) as caught:
        SensorTest(**values)  # pyright: ignore[reportArgumentType]
    assert str(caught.value) == line


def test_a_text_that_no_file_could_hold_is_refused_before_the_robot_moves() -> None:
    with before_a_wall(300) as robot:
        with pytest.raises(SensorTestError, match=r"text: has the character '\\r'"):
            sense(robot, SensorTest(linear_cm=5), text="a\rb")
        assert robot.position() == (0, 0)


def test_rows_of_another_shape_are_a_mistake() -> None:
    with pytest.raises(ValueError, match=r"\(3, 9\)"):
        SensorRun(SensorTest(linear_cm=5), np.zeros((3, 9), np.int64), np.zeros(3))


def test_counts_of_another_model_have_the_range_of_its_bar_and_a_sign() -> None:
    test, dv = SensorTest(linear_cm=10, model="khepera4"), np.full((1, 14), -2)
    assert SensorRun(test, dv, np.zeros(1)).dv.min() == -2
    dv[0, 5] = 1024
    with pytest.raises(SensorTestError, match="row 1: front = 1024; expected -1023 to 1023"):
        SensorRun(test, dv, np.zeros(1))


def test_line_images_are_read_on_the_way() -> None:
    with Khepera("khep://stripes?noise=off") as robot:
        run = sense(robot, SensorTest("vision", rotate_deg=15, speed=1))
        last = Vision(robot).image()
    assert run.dv.shape[1] == 66
    assert len(run.dv) > 2
    # The robot stands still at the end, so a later scan is similar.
    assert np.abs(run.dv[-1, 2:] - last).max() < 60
    assert set(run.dv[:, 2:].ravel()) <= set(range(256))
    assert np.ptp(run.dv[-1, 2:]) > 100  # stripes


def test_a_robot_without_vision_is_one_line() -> None:
    with Khepera("khep://default") as robot, pytest.raises(KhepTwinError, match="order not supported"):
        sense(robot, SensorTest("vision", rotate_deg=15))

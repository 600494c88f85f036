"""The gripper in the physics, by its replies on the serial line and by the true state."""

import math
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import scenes
from scenes import arena, table

from khep_twin import playpen as playpens
from khep_twin.board.gripper_body import GAP_CLOSED, GAP_OPEN, SERIES_RESISTANCE, resistivity
from khep_twin.host import Gripper, Khepera
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.world import World

REACH_MM = 52.5  # from the robot's centre to between the fingers, arm down


def scene(*, radius_mm: float = 12.5, surface: str = "white", ahead_mm: float = REACH_MM) -> Playpen:
    place = {"x_mm": 300 + ahead_mm, "y_mm": 250}
    post = table("cylinder", **place, radius_mm=radius_mm, height_mm=40, surface=surface, movable=True)
    return playpens.parse(arena() + post + scenes.robot(300, 250, turrets=["gripper"]), "pick.toml")


def opened(playpen: Playpen) -> tuple[Khepera, World]:
    twin = open_twin(playpen, TwinOptions(noise=False))
    twin.world.compile()
    return Khepera(Serial.of(twin, timeout=1)), twin.world


@pytest.fixture
def pair() -> Iterator[tuple[Khepera, World]]:
    robot, world = opened(scene())
    with robot:
        yield robot, world


def cylinder(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Place [m] and axis of the cylinder."""
    mujoco.mj_kinematics(world.model, world.data)
    body = world.model.body("cylinder0").id
    return world.data.xpos[body].copy(), world.data.xmat[body].reshape(3, 3)[:, 2].copy()


def grip(robot: Khepera) -> Gripper:
    gripper = Gripper(robot)
    gripper.lower()
    gripper.wait()
    gripper.close()
    gripper.wait()
    return gripper


def test_it_starts_with_the_arm_up_and_the_fingers_open(pair: tuple[Khepera, World]) -> None:
    gripper = Gripper(pair[0])
    assert (gripper.arm(), gripper.fingers(), gripper.barrier()) == (152, 200, 0)
    pair[0].sleep(5)
    assert (gripper.arm(), gripper.fingers(), gripper.barrier()) == (152, 200, 0)


@pytest.mark.parametrize("position", [152, 180, 220, 255])
def test_the_arm_goes_to_the_elevation_of_its_position(pair: tuple[Khepera, World], position: int) -> None:
    robot, world = pair
    Gripper(robot).move_arm(position)
    robot.sleep(2)
    elevation_deg = math.degrees(world.data.joint("khepera0/gripper/shoulder").qpos[0])
    assert elevation_deg == pytest.approx(190 - 200 * position / 255, abs=0.8)
    assert Gripper(robot).arm() == pytest.approx(position, abs=1)


def test_the_arm_comes_down_within_a_second_and_bumps_into_nothing(pair: tuple[Khepera, World]) -> None:
    robot, world = pair
    before = cylinder(world)[0]
    gripper = Gripper(robot)
    gripper.lower()
    robot.sleep(1)
    assert gripper.arm() >= 253
    robot.sleep(1)
    assert np.abs(cylinder(world)[0] - before).max() < 0.0005


@pytest.mark.parametrize("radius_mm", [11.5, 12.0, 12.5])
def test_the_fingers_stop_at_what_they_grip(radius_mm: float) -> None:
    robot, _ = opened(scene(radius_mm=radius_mm))
    with robot:
        gripper = grip(robot)
        # Half the gap is the radius, less half a millimetre that rubber and motor give.
        position = (radius_mm / 1000 - GAP_CLOSED) / (GAP_OPEN - GAP_CLOSED) * 200
        assert gripper.fingers() == pytest.approx(position, abs=4)


def test_with_nothing_between_them_the_fingers_close_and_the_barrier_stays_free() -> None:
    robot, _ = opened(scene(ahead_mm=150))
    with robot:
        gripper = grip(robot)
        assert (gripper.fingers(), gripper.barrier(), gripper.resistivity()) == (0, 0, 255)


def test_the_barrier_darkens_ray_by_ray() -> None:
    robot, world = opened(scene(ahead_mm=REACH_MM + 25))
    with robot:
        gripper = Gripper(robot)
        gripper.lower()
        gripper.wait()
        readings = []
        robot.set_speed(2, 2)
        while world.robots[0].pose[0] < 0.325:
            readings.append(gripper.barrier())
        assert sorted(set(readings)) == [0, 85, 170, 255]
        assert readings == sorted(readings)


def test_the_resistivity_is_that_of_the_surface() -> None:
    for surface, expected in (("white", 255), ("copper", 0)):
        robot, _ = opened(scene(surface=surface))
        with robot:
            assert Gripper(robot).resistivity() == 255
            assert grip(robot).resistivity() == expected


def test_resistivity_halves_at_the_series_resistance() -> None:
    assert [resistivity(g) for g in (0, 1 / SERIES_RESISTANCE, 1.0)] == [255, 128, 0]


@pytest.mark.share(2)
@pytest.mark.parametrize("seconds", [10, 60])
def test_what_is_gripped_stays_gripped(pair: tuple[Khepera, World], seconds: int) -> None:
    robot, world = pair
    gripper = grip(robot)
    gripper.lift()
    gripper.wait()
    (position, axis), height = cylinder(world), 0.06
    assert position[2] > height
    robot.sleep(seconds)
    later, later_axis = cylinder(world)
    assert np.linalg.norm(later - position) < 0.0005
    assert math.degrees(math.acos(min(1.0, float(axis @ later_axis)))) < 1


def test_jolts_do_not_shake_it_out(pair: tuple[Khepera, World]) -> None:
    robot, world = pair
    gripper = grip(robot)
    gripper.lift()
    gripper.wait()
    for speeds in ((15, 15), (0, 0), (-15, -15), (0, 0), (20, -20), (-20, 20), (0, 0)):
        robot.set_speed(*speeds)
        robot.sleep(0.6)
    x, y, _ = world.robots[0].pose
    position = cylinder(world)[0]
    assert math.hypot(position[0] - x, position[1] - y) < 0.03
    assert position[2] > 0.06
    assert gripper.barrier() == 255


def test_opened_fingers_let_it_fall_down_and_stand(pair: tuple[Khepera, World]) -> None:
    robot, world = pair
    gripper = grip(robot)
    gripper.lift()
    gripper.wait()
    gripper.lower()
    gripper.wait()
    gripper.open()
    robot.sleep(2)
    position, axis = cylinder(world)
    assert position[2] == pytest.approx(0.02, abs=0.0005)
    assert axis[2] > 0.999
    assert (gripper.barrier(), gripper.resistivity()) == (255, 255)


def test_the_sensors_rays_meet_lowered_fingers_and_not_a_raised_hand() -> None:
    robot, world = opened(scene(ahead_mm=200))

    def nearest(sensor: str) -> float:
        lengths = world.data.sensor(f"khepera0/{sensor}_rays").data.reshape(-1, 4)[:, 0]
        return min(length for length in lengths if length >= 0)

    with robot:
        gripper = Gripper(robot)
        robot.sleep(0.1)
        assert min(nearest(sensor) for sensor in ("left_45", "left_10", "right_10", "right_45")) > 0.1
        gripper.lower()
        gripper.close()
        robot.sleep(2)
        assert nearest("left_10") < 0.015
        assert nearest("left_45") > 0.1
        # Dark plastic: too little comes back to count.
        assert max(robot.proximity()) == 0


@pytest.mark.share(2)
@pytest.mark.parametrize("seconds", [3, 15])
def test_a_hand_touches_walls_and_other_robots(seconds: int) -> None:
    first, second = scenes.robot(100, 200, turrets=["gripper"]), scenes.robot(200, 200)
    two = playpens.parse(arena(400, 400) + first + second, "two.toml")
    robot, world = opened(two)
    with robot:
        gripper = grip(robot)
        assert gripper.barrier() == 0
        robot.set_speed(5, 5)
        robot.sleep(4)
        # Hands pushing shell: the second robot has moved on before the first one's shell could reach it.
        first, second = world.robots[0].pose, world.robots[1].pose
        assert second[0] > 0.21
        assert second[0] - first[0] > 0.080
        robot.sleep(seconds)
        assert world.robots[0].pose[0] < 0.4 - 0.06


def test_the_body_is_that_of_the_sources() -> None:
    model = opened(scene())[1].model
    arm = model.body("khepera0/gripper/arm").id
    assert model.body_pos[arm].tolist() == pytest.approx([-0.01, 0, 0.022])
    assert model.geom("khepera0/gripper/left_pad").size[0] * 2 == pytest.approx(0.033)
    slide = model.joint("khepera0/gripper/left_slide")
    assert slide.range.tolist() == pytest.approx([GAP_CLOSED, GAP_OPEN])


def test_the_same_bytes_give_the_same_run() -> None:
    states = []
    for _ in range(2):
        robot, world = opened(scene())
        with robot:
            grip(robot).lift()
            robot.sleep(3)
            states.append((world.data.qpos.tobytes(), world.robots[0].registers.tobytes()))
    assert states[0] == states[1]

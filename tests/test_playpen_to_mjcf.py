"""Conversion of a playpen to a scene."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from khep_twin import playpen, units
from khep_twin.board.kernel import PROXIMITY
from khep_twin.playpen import Playpen
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.playpen_to_mjcf import to_mjcf, to_spec
from khep_twin.robots.to_mjcf import ASSETS
from khep_twin.sensing import calibration
from khep_twin.units import Sensor
from khep_twin.world import World


@pytest.fixture(scope="module")
def robot() -> mujoco.MjModel:
    """The robot alone, as its file has it."""
    return mujoco.MjModel.from_xml_path(str(ASSETS / "khepera.xml"))


def test_mass_and_centre_of_mass_arrive_in_the_model(robot: mujoco.MjModel) -> None:
    assert robot.body_subtreemass[0] == pytest.approx(units.MASS)
    assert robot.body("left_wheel").mass == pytest.approx(units.WHEEL_MASS)
    data = mujoco.MjData(robot)
    mujoco.mj_resetDataKeyframe(robot, data, robot.key("home").id)
    mujoco.mj_forward(robot, data)
    centre = -units.CENTRE_OF_MASS_BEHIND, 0, units.CENTRE_OF_MASS_HEIGHT
    assert data.subtree_com[1] == pytest.approx(centre, abs=3e-5)


def test_wheels_and_supports_arrive_in_the_model(robot: mujoco.MjModel) -> None:
    for side, y in (("left", units.WHEEL_BASE / 2), ("right", -units.WHEEL_BASE / 2)):
        wheel = robot.body(f"{side}_wheel")
        assert wheel.pos == pytest.approx((0, y, units.WHEEL_RADIUS))
        assert robot.geom(f"{side}_tyre").size[0] == pytest.approx(units.WHEEL_RADIUS)
        rim = robot.geom(f"{side}_rim").size
        assert (rim[0], 2 * rim[1]) == pytest.approx((units.WHEEL_RADIUS, units.WHEEL_WIDTH))
        assert robot.geom(f"{side}_rim").pos == pytest.approx(wheel.pos)
        axle_inertia = units.WHEEL_MASS * units.WHEEL_RADIUS**2 / 2
        across = axle_inertia / 2 + units.WHEEL_MASS * units.WHEEL_WIDTH**2 / 12
        assert wheel.inertia == pytest.approx((across, across, axle_inertia), rel=1e-5)
        assert robot.dof_armature[robot.joint(f"{side}_axle").dofadr[0]] == pytest.approx(units.ROTOR_INERTIA)
    front, back = robot.geom("front_support"), robot.geom("back_support")
    assert front.pos[0] == pytest.approx(units.SUPPORT_POSITION)
    assert back.pos[0] == pytest.approx(-units.SUPPORT_POSITION)
    assert front.pos[2] - front.size[0] == pytest.approx(units.SUPPORT_CLEARANCE)
    assert back.pos[2] == pytest.approx(back.size[0])


def test_the_body_has_its_size(robot: mujoco.MjModel) -> None:
    shell = robot.geom("shell")
    assert shell.size[0] == pytest.approx(units.BODY_RADIUS)
    assert shell.pos[2] + shell.size[1] == pytest.approx(units.BODY_HEIGHT)


def test_a_motor_reaches_its_no_load_speed_and_its_stall_torque(robot: mujoco.MjModel) -> None:
    spec = mujoco.MjSpec.from_file(str(ASSETS / "khepera.xml"))
    spec.option.gravity = [0, 0, 0]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = units.duty_voltage(units.DUTY_LIMIT, units.SUPPLY_VOLTAGE)
    mujoco.mj_step(model, data)
    friction = model.dof_frictionloss[6]
    assert friction == pytest.approx(units.MOTOR_FRICTION_TORQUE)
    assert data.actuator_force[0] - friction == pytest.approx(units.MOTOR_STALL_TORQUE)
    # Until the wheels turn freely; the body turns the other way, so it is held.
    for _ in range(2000):
        mujoco.mj_step(model, data)
        data.qvel[:6] = 0
    assert data.qvel[6] == pytest.approx(units.MOTOR_NO_LOAD_SPEED, rel=0.01)


def test_the_sensors_sit_and_look_as_the_constants_say(robot: mujoco.MjModel) -> None:
    data = mujoco.MjData(robot)
    mujoco.mj_forward(robot, data)
    for sensor in Sensor:
        camera = robot.camera(sensor.key).id
        assert data.cam_xpos[camera] == pytest.approx((*units.SENSOR_POSITIONS[sensor], units.SENSOR_HEIGHT))
        axis = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
        heading = units.SENSOR_HEADINGS[sensor]
        assert axis == pytest.approx((math.cos(heading), math.sin(heading), 0), abs=1e-9)


@pytest.mark.share(2)
@pytest.mark.parametrize("minutes", [2, 10])
def test_the_rangefinders_take_turns_for_minutes(minutes: int) -> None:
    spec = mujoco.MjSpec.from_file(str(ASSETS / "khepera.xml"))
    spec.option.gravity = [0, 0, 0]
    for x, y in ((0.2, 0), (-0.3, 0), (0, 0.25), (0, -0.35)):
        size = [0.01 if x else 0.5, 0.01 if y else 0.5, 0.1]
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[x, y, 0], size=size, contype=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[5] = 3.0  # turning, so that every reading is new, about its centre of mass
    data.qvel[1] = 3.0 * units.CENTRE_OF_MASS_BEHIND
    mujoco.mj_step(model, data)
    # The middle ray of each sensor; a look at the end of each minute.
    middle = data.sensordata[16::36]
    for _ in range(minutes):
        mujoco.mj_step(model, data, 8 * 2997)
        before = middle.copy()
        for step in range(16):
            mujoco.mj_step(model, data)
            changed = np.flatnonzero(middle != before).tolist()
            assert changed == [step % 8]
            before = middle.copy()


@pytest.mark.parametrize("name", playpen.names())
def test_a_shipped_playpen_opens_in_mujoco_alone_and_holds_still(name: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(to_mjcf(Playpen.load(name)))
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    start = data.qpos[:3].copy()
    mujoco.mj_step(model, data, 400)
    assert not data.warning.number.any()
    assert data.qpos[:3] == pytest.approx(start, abs=1e-4)


SCENE = """
version = 1
name = "scene"
[arena]
width_mm = 400
height_mm = 300
wall_height_mm = 60
wall_thickness_mm = 20
surface = "grey"
[[block]]
x_mm = 100
y_mm = 50
length_mm = 60
width_mm = 20
height_mm = 40
angle_deg = 45
surface = "black"
[[cylinder]]
x_mm = 300
y_mm = 200
radius_mm = 12.5
height_mm = 30
movable = true
mass_g = 25
[[lamp]]
x_mm = 20
y_mm = 280
z_mm = 100
power_w = 7
[[robot]]
x_mm = 200
y_mm = 150
heading_deg = 30
"""


def test_everything_stands_where_the_file_says() -> None:
    model = to_spec(playpen.parse(SCENE, "scene")).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    block = model.geom("block0")
    assert block.pos == pytest.approx((0.1, 0.05, 0.02))
    assert block.size == pytest.approx((0.03, 0.01, 0.02))
    assert data.geom("block0").xmat.reshape(3, 3)[:2, 0] == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert data.body("cylinder0").xpos == pytest.approx((0.3, 0.2, 0.015))
    assert model.body("cylinder0").mass == pytest.approx(0.025)
    assert model.site("lamp0").pos == pytest.approx((0.02, 0.28, 0.1))
    assert data.body("khepera0/base").xpos == pytest.approx((0.2, 0.15, 0))
    heading = data.body("khepera0/base").xmat.reshape(3, 3)[:2, 0]
    assert heading == pytest.approx((math.cos(math.pi / 6), 0.5))


def test_the_walls_stand_around_the_arena() -> None:
    model = to_spec(playpen.parse(SCENE, "scene")).compile()
    inner = {
        "wall_left": (0, 1, 0.0),
        "wall_right": (0, -1, 0.4),
        "wall_bottom": (1, 1, 0.0),
        "wall_top": (1, -1, 0.3),
    }
    for name, (axis, side, edge) in inner.items():
        wall = model.geom(name)
        assert wall.pos[axis] + side * wall.size[axis] == pytest.approx(edge)
        assert (2 * wall.size[axis], 2 * wall.size[2]) == pytest.approx((0.02, 0.06))


def test_reflectance_and_power_travel_inside_the_mjcf() -> None:
    model = mujoco.MjModel.from_xml_string(to_mjcf(playpen.parse(SCENE, "scene")))
    assert model.geom("block0").user == pytest.approx([BUILT_IN_SURFACES["black"].reflectance, 0])
    assert model.geom("wall_left").user == pytest.approx([BUILT_IN_SURFACES["grey"].reflectance, 0])
    assert model.geom("khepera0/base").user == pytest.approx([0.3, 0])
    assert model.site("lamp0").user == pytest.approx(7)


def test_the_calibration_turns_the_sensors() -> None:
    model = to_spec(playpen.parse(SCENE.replace("heading_deg = 30", "heading_deg = 0"), "scene")).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for sensor, heading_deg in zip(Sensor, calibration.read("khepera1")[0].heading_deg, strict=True):
        frame = data.cam_xmat[model.camera(f"khepera0/{sensor.key}").id].reshape(3, 3)
        heading = math.radians(heading_deg)
        assert -frame[:, 2] == pytest.approx((math.cos(heading), math.sin(heading), 0), abs=1e-9)


def test_islands_are_off_unless_something_moves_beside_the_robot() -> None:
    still = to_spec(Playpen.load("default")).compile()
    moving = to_spec(playpen.parse(SCENE, "scene")).compile()
    swarm = to_spec(Playpen.load("swarm")).compile()
    assert still.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND
    assert not swarm.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND
    assert not swarm.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    assert not moving.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND
    assert moving.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP


def test_a_khepera_2_has_its_own_body_and_senses() -> None:
    text = (
        'version = 1\nname = "two"\n[arena]\nwidth_mm = 600\nheight_mm = 400\n'
        '[[robot]]\nmodel = "khepera2"\nx_mm = 300\ny_mm = 200\nheading_deg = 0\n'
    )
    two_robots = playpen.parse(text, "two")
    assert (two_robots.robots[0].calibration, two_robots.robots[0].rom) == ("khepera2", "khepera2")
    model = to_spec(two_robots).compile()
    assert model.geom_size[model.geom("khepera0/shell").id][0] == 0.035
    assert model.body_mass[1:].sum() == pytest.approx(0.080)
    inertia = model.body_inertia[model.body("khepera0/base").id]
    np.testing.assert_allclose(sorted(inertia), [2.745e-05, 2.745e-05, 4.41e-05], rtol=0.01)
    wheels = [model.body(f"khepera0/{side}_wheel").pos[1] for side in ("left", "right")]
    assert wheels == [0.0275, -0.0275]
    world = World(two_robots, noise=False)
    world.robots[0].send(b"D,10,10\n")
    world.advance_to(2_000_000_000)
    x, y, _ = world.robots[0].pose
    assert 0.3 + 0.14 < x < 0.3 + 0.16
    assert y == pytest.approx(0.2, abs=1e-4)
    # Its rest is never 0, as that of a Khepera is.
    assert (world.robots[0].registers[PROXIMITY] > 30).all()


def test_a_gripper_stays_up_where_mujoco_alone_opens_the_scene_at_its_keyframe() -> None:
    text = playpen.dump(Playpen.load("gripper"))
    second = "[[robot]]\nx_mm = 100.0\ny_mm = 100.0\nheading_deg = 0\n"
    first, _, rest = text.partition("[[robot]]")
    model = mujoco.MjModel.from_xml_string(to_mjcf(playpen.parse(f"{first}{second}[[robot]]{rest}", "pair")))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    start = data.qpos.copy()
    assert start.tolist() == model.qpos0.tolist()
    mujoco.mj_step(model, data, 400)
    joints = [model.joint(f"khepera1/gripper/{name}").qposadr[0] for name in ("shoulder", "left_slide")]
    assert data.qpos[joints] == pytest.approx(start[joints], abs=0.01)
    assert data.ctrl[:2].tolist() == [0, 0]

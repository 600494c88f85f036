"""Faults of sensors, motors and wheels of a Khepera IV and of the Toy, against closed forms."""

import math
from hashlib import sha256

import numpy as np
import pytest
from numba_marks import KINDS, with_numba

from khep_twin import ConstantSpeed, EpisodeSetup
from khep_twin.board.fault_injection import parse_fault
from khep_twin.episodes.episode import Episode
from khep_twin.errors import FaultError
from khep_twin.playpen import Playpen, parse
from khep_twin.robots.khepera4.gauge import battery_voltage
from khep_twin.robots.khepera4.model import BODY
from khep_twin.robots.khepera4.motor_control import PWM_LIMIT
from khep_twin.robots.khepera4.registers import NO_ECHO, Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration
from khep_twin.world import World

pytestmark = pytest.mark.usefixtures("installed_toy")

ALL = (
    "stuck:3@0.1",
    "dead:ultrasonic_front@0.1-0.4",
    "stuck:12@0.13",
    "dead:proximity_left",
    "dead:11@0.2-0.3",
)
ALL += ("weak:left:0.5@0.0975", "dead:right@0.3-0.4", "slip:left:0.1@0.2", "blocked:right@0.21-0.29")
"""Faults of all kinds of devices of a Khepera IV."""

FRONT, GROUND_LEFT = 3, 8
"""Sensors of a Khepera IV."""

TOY = """version = 1
name = "toys"
[arena]
width_mm = 600
height_mm = 400
[[robot]]
model = "toy"
x_mm = 200
y_mm = 200
heading_deg = 0
"""


def world_with(*faults: str, compiled: bool = False, noise: bool = False, playpen: str = "arena4") -> World:
    return World(playpen, seed=4, noise=noise, compiled=compiled, faults=[*map(parse_fault, faults)])


def drive(world: World, left: int, right: int, control: Control = Control.SPEED) -> None:
    """Drive the robot of a world: a Khepera IV [pulses/10 ms or PWM], or a Toy [mm/s]."""
    robot = world.robots[0]
    if not isinstance(robot, Khepera4Robot):
        robot.registers[13:15] = left, right
        return
    is_open = control is Control.OPEN_LOOP
    first = DspicRegister.PWM_ORDER_LEFT if is_open else DspicRegister.SPEED_ORDER_LEFT
    orders = b"".join(order.to_bytes(2, "little", signed=True) for order in (left, right))
    robot.dspic.write(bytes([first]) + orders)
    robot.dspic.write(bytes([DspicRegister.CONTROL, control]))


def torques(world: World) -> list[float]:
    """Return the torques of the left and the right motor [N m]."""
    motors = world.data.actuator_force[list(world.robots[0].indices.motors)]
    return motors.tolist()


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_a_weak_motor_of_each_model_has_its_part_of_the_stall_torque(part: float) -> None:
    faults = "blocked:left", "blocked:right", f"weak:left:{part}"
    for playpen, (order, control) in (
        (Playpen.load("arena4"), (PWM_LIMIT, Control.OPEN_LOOP)),
        (parse(TOY, "toys"), (200, Control.SPEED)),
    ):
        world = World(playpen, noise=False, compiled=False, faults=[*map(parse_fault, faults)])
        drive(world, order, order, control)
        world.advance(0.05)
        robot, motors = world.robots[0], calibration.read(playpen.robots[0].calibration)[0].motors
        if isinstance(robot, Khepera4Robot):
            voltage = battery_voltage(world.simulation.robots.state_of(0).gauge)
        else:  # its controller's law, with a wheel that stands
            voltage = motors.constant * 5 * (0.2 / playpen.robots[0].body.wheel_radius)
        stall = motors.constant * voltage / motors.resistance
        assert torques(world) == [
            pytest.approx(part * stall, rel=1e-5, abs=1e-9),
            pytest.approx(stall, rel=1e-5),
        ]


@pytest.mark.parametrize("model", ["khepera4", "toy"])
def test_a_blocked_wheel_stands_and_the_robot_turns_about_it(model: str) -> None:
    is_toy, fault = model == "toy", [parse_fault("blocked:left@0.1")]
    world = World(parse(TOY, "toys") if is_toy else "arena4", noise=False, compiled=False, faults=fault)
    drive(world, *((100, 100) if is_toy else (200, 200)))
    world.advance(0.2)
    robot, body = world.robots[0], find_model(model).body
    angles, (x, y, heading) = world.data.qpos[list(robot.indices.wheel_qpos)], robot.pose
    world.advance(0.8)
    turned = (robot.pose[2] - heading) % math.tau
    assert turned > 0.5
    left, right = world.data.qpos[list(robot.indices.wheel_qpos)] - angles
    assert left == pytest.approx(0, abs=1e-6)
    assert right * body.wheel_radius == pytest.approx(turned * body.wheel_base, rel=0.03)
    half = body.wheel_base / 2
    before, after = (
        (px - half * np.sin(angle), py + half * np.cos(angle))
        for px, py, angle in ((x, y, heading), robot.pose)
    )
    assert math.dist(before, after) < 0.004


def test_a_tyre_without_friction_leaves_the_robot_where_it_is() -> None:
    world = world_with("slip:left:0", "slip:right:0")
    start = world.robots[0].pose
    drive(world, 300, 300)
    world.advance(0.5)
    assert math.dist(start, world.robots[0].pose) < 0.002
    assert world.robots[0].readings()["position"][0] > 5000


def test_a_dead_sensor_of_a_khepera_iv_sees_nothing_and_the_dark() -> None:
    world = world_with(
        f"dead:{FRONT}@0.1-0.2", "dead:proximity_ground_left@0.1-0.2", "dead:ultrasonic_front@0.1-0.2"
    )
    counts: list[tuple[int, ...]] = []
    for _ in range(3):
        world.advance(0.0975)
        readings = world.robots[0].readings()
        near, light = readings["proximity"], readings["ambient"]
        counts.append(
            (near[FRONT], light[FRONT], near[GROUND_LEFT], light[GROUND_LEFT], readings["ultrasonic"][2])
        )
        world.advance(0.0025)
    before, during, after = counts
    assert during == (0, 1023, 0, 1023, NO_ECHO)
    assert 0 < before[4] < NO_ECHO
    assert before == after
    assert before[0] > 50
    assert before[2] > 900


def test_a_stuck_sensor_repeats_the_reading_before_its_fault() -> None:
    world, sound = (world_with(*faults, noise=True) for faults in (("stuck:3@0.1", "stuck:14@0.1"), ()))
    for other in (world, sound):
        drive(other, 300, -300)
        other.advance(0.0975)
    last = sound.robots[0].readings()
    fronts: list[tuple[int, int]] = []
    for _ in range(9):
        for other in (world, sound):
            other.advance(0.01731)
        readings, sound_readings = (other.robots[0].readings() for other in (world, sound))
        for name, sensor in (("proximity", 3), ("ambient", 3), ("ultrasonic", 2)):
            assert readings[name][sensor] == last[name][sensor]
            assert (
                np.delete(readings[name], sensor).tolist() == np.delete(sound_readings[name], sensor).tolist()
            )
        fronts.append((sound_readings["proximity"][3], sound_readings["ambient"][3]))
    assert len({*fronts}) > 5


def test_a_dead_and_a_stuck_sensor_of_a_toy() -> None:
    faults = [
        *map(parse_fault, ("dead:proximity_nose", "dead:1", "stuck:ultrasonic_beacon@0.3", "dead:5@0.6"))
    ]
    world = World(parse(TOY, "toys"), noise=False, compiled=False, faults=faults)
    drive(world, 150, 150)
    distances: list[int] = []
    for _ in range(4):
        world.advance(0.1975)
        readings = world.robots[0].readings()
        distances += readings["ultrasonic"]
        assert (readings["proximity"][:2], readings["ambient"][:2]) == ([0, 0], [1023, 1023])
    assert distances[0] > distances[1] == distances[2] > distances[3] == 0


def digests(world: World, n_parts: int = 3, *, reads: bool = False) -> list[str]:
    """Return hashes of a world that drives on for 0.15 s each."""
    hashes: list[str] = []
    for part in range(n_parts):
        drive(world, 300 - 150 * part, 100 * part)
        for _ in range(10):
            world.advance(0.015)
            if reads:
                world.robots[0].readings()
        hashes.append(sha256(world.snapshot()).hexdigest())
    return hashes


def test_faults_do_not_depend_on_when_readings_are_read_and_snapshots_carry_them() -> None:
    world = world_with(*ALL, noise=True)
    expected = digests(world)
    assert digests(world_with(*ALL, noise=True), reads=True) == expected
    assert digests(world_with(noise=True)) != expected
    world.reset(4)  # without faults at first
    digests(world, 1)
    snapshot = world.snapshot()
    rest = digests(world)
    copy = world_with(*ALL, noise=True)
    copy.restore(snapshot)
    assert digests(copy) == rest


@with_numba
def test_faults_of_a_khepera_iv_are_the_same_compiled() -> None:
    plain, compiled = (digests(world_with(*ALL, noise=True, compiled=way)) for way in (False, True))
    assert compiled == plain


@pytest.mark.parametrize("compiled", KINDS)
def test_an_episode_of_a_khepera_iv_has_the_faults_of_a_world(compiled: bool) -> None:
    faults = [*map(parse_fault, ALL)]
    setup = EpisodeSetup("arena4", faults=faults, period_ns=100_000_000)
    episode = Episode(setup, ConstantSpeed(200, 100), compiled=compiled, observed=True)
    world = World("arena4", seed=6, unpaced=True, compiled=False, faults=faults)
    episode.begin(6)
    drive(world, 200, 100)
    episode.run(0.4)
    world.advance(0.4)
    assert episode.joints.tobytes() == world.data.qpos.tobytes()
    assert episode.world.robots[0].readings() == world.robots[0].readings()


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        (
            "stuck:17",
            "robot 0 is a Khepera IV; expected a number below 17, or a name; (choices: proximity_back_left,",
        ),
        ("dead:ground_left", "a name; did you mean 'proximity_ground_left'? (choices: proximity_back_left,"),
        ("dead:both", "robot 0 is a Khepera IV; expected left, right, a number below 17, or a name;"),
    ],
)
def test_a_sensor_that_a_model_lacks_is_refused_with_those_it_has(fault: str, line: str) -> None:
    with pytest.raises(FaultError) as refused:
        world_with(fault)
    message = str(refused.value)
    assert message.startswith(f"fault {fault!r}: robot 0 is a Khepera IV; ")
    assert line in message
    assert "\n" not in message
    assert BODY.fault_sensors[-1] in message

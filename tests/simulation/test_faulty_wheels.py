"""Weak motors, slipping tyres and blocked wheels: against closed forms, and restored when a fault ends."""

import math
from copy import copy

import mujoco
import numpy as np
import pytest

from khep_twin import playpen, units
from khep_twin.board.fault_injection import parse_fault
from khep_twin.board.kernel import RIGHT, Wheel, set_duty
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.robots.registry import find_model
from khep_twin.sensing.calibration import MotorCalibration
from khep_twin.simulation.faulty_wheels import WHEEL_FIELDS
from khep_twin.units import TYRE_FRICTION

FIELD = playpen.parse(
    'version = 1\nname = "field"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    "[[robot]]\nx_mm = 500\ny_mm = 500\nheading_deg = 0\n",
    "field.toml",
)
SETUP = EpisodeSetup(FIELD)
MOTORS = MotorCalibration()


def setup_with(*faults: str) -> EpisodeSetup:
    """Return the same setup with faults, of the same compiled scene."""
    faulty = copy(SETUP)
    faulty.faults = tuple(map(parse_fault, faults))
    return faulty


def episode(*faults: str, x_mm: float = 500, seconds: float = 0.0, duty: int = 0) -> Episode:
    """Return an episode without noise on a square metre, after this time with this duty."""
    twin = Episode(setup_with(*faults), ConstantSpeed(), compiled=False)
    twin.begin(options=EpisodeOptions(noise=False, start=(x_mm, 500, 0)))
    for wheel in (0, RIGHT) if duty else ():
        set_duty(twin.boards[0].data, wheel, duty)
    twin.run(seconds)
    return twin


def angle(twin: Episode, side: int) -> float:
    return float(twin.data.qpos[SETUP.indices.wheel_qpos[side]])


@pytest.mark.parametrize("part", [0.0, 0.25, 1.0])
def test_a_weak_motor_has_its_part_of_the_stall_torque(part: float) -> None:
    # Both wheels stand, so that neither motor generates a voltage.
    twin = episode("blocked:left", "blocked:right", f"weak:left:{part}", seconds=0.1, duty=255)
    left, right = twin.data.actuator_force[list(SETUP.indices.motors)].tolist()
    stall = MOTORS.stall_torque_n_m + MOTORS.friction_torque_n_m
    assert right == pytest.approx(stall, rel=1e-5)
    assert left == pytest.approx(part * stall, rel=1e-5, abs=1e-9)


def test_a_weak_motor_turns_at_the_speed_where_its_part_of_the_torque_holds_the_gears_friction() -> None:
    twin = episode("weak:left:0.4", "weak:right:0.4", seconds=1.0, duty=60)
    voltage = units.SUPPLY_VOLTAGE * 60 / units.DUTY_LIMIT
    speed = (
        voltage - MOTORS.friction_torque_n_m / 0.4 * MOTORS.resistance / MOTORS.constant
    ) / MOTORS.constant
    assert twin.data.qvel[6] == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 1.0])
def test_a_robot_pushes_with_what_is_left_of_its_tyres_friction(part: float) -> None:
    wall_mm = 1000 - find_model("khepera1").body.radius * 1e3
    twin = episode(f"slip:left:{part}", f"slip:right:{part}", x_mm=wall_mm - 0.2, seconds=3.0, duty=100)
    pushes, loads = [], []
    for _ in range(40):
        twin.step(1)
        force = np.zeros(6)
        forces = dict.fromkeys(("left_tyre", "right_tyre", "shell"), 0.0)
        for number, contact in enumerate(twin.data.contact):
            mujoco.mj_contactForce(twin.world.model, twin.data, number, force)
            for geom in contact.geom.tolist():
                name = twin.world.model.geom(geom).name.rpartition("/")[2]
                forces[name] = forces.get(name, 0.0) + float(force[0])
        pushes.append(forces["shell"])
        loads.append(forces["left_tyre"] + forces["right_tyre"])
    assert np.mean(pushes) == pytest.approx(part * TYRE_FRICTION * np.mean(loads), rel=0.02, abs=2e-3)


def test_a_blocked_wheel_stands_and_the_robot_turns_about_it() -> None:
    twin = episode("blocked:left@0.5", seconds=0.5, duty=40)
    (before, right), encoder = (angle(twin, side) for side in (0, 1)), int(twin.registers[Wheel.ENCODER])
    x, y, heading = twin.pose
    twin.run(1.0)
    assert angle(twin, 0) == pytest.approx(before, abs=1e-6)
    assert int(twin.registers[Wheel.ENCODER]) == encoder
    turned = (twin.pose[2] - heading) % math.tau
    assert turned > 1
    # Its contact point stays but for a slip by inertia at the start.
    half = units.WHEEL_BASE / 2
    moved = np.subtract(
        (x - half * np.sin(heading), y + half * np.cos(heading)),
        (twin.pose[0] - half * np.sin(twin.pose[2]), twin.pose[1] + half * np.cos(twin.pose[2])),
    )
    assert np.hypot(*moved) < 0.006
    driven = (angle(twin, 1) - right) * units.WHEEL_RADIUS
    assert driven == pytest.approx(turned * units.WHEEL_BASE, rel=0.03)


def test_wheels_are_sound_to_the_last_bit_when_their_faults_end() -> None:
    twin = episode("slip:left:0.1@0.1-0.3", "blocked:right@0.1-0.2", "weak:left:0.5@0.1-0.3", duty=60)
    for seconds, is_sound in ((0.06, True), (0.08, False), (0.2, True)):
        twin.run(seconds)
        is_same = [
            np.array_equal(getattr(twin.world.model, field), getattr(SETUP.model, field))
            for field in WHEEL_FIELDS
        ]
        assert all(is_same) is is_sound
    angles = angle(twin, 0), angle(twin, 1)
    twin.run(0.5)
    # Both drive again, as fast as each other.
    turned = [angle(twin, side) - before for side, before in enumerate(angles)]
    assert turned[0] == pytest.approx(turned[1], rel=0.02)
    assert turned[0] > 5


def test_faulty_wheels_are_of_one_episode_alone() -> None:
    """The next episode starts without faults, and other episodes of the setup never have them."""
    setup = setup_with("blocked:left@0.3", "slip:right:0@0.1")
    faulty = Episode(setup, Braitenberg(), compiled=False)
    sound = Episode(SETUP, Braitenberg(), compiled=False)
    joints = []
    for runner, seconds in ((sound, 0.2), (faulty, 0.5), (sound, 0.2), (faulty, 0.08)):
        for vary in (False, True):
            runner.begin(3, EpisodeOptions(vary=vary))
            runner.run(0.08)
            joints.append(runner.joints.tobytes())
            runner.run(round(seconds - 0.08, 2))
    assert joints[::2] == [joints[0]] * 4
    assert joints[1::2] == [joints[1]] * 4

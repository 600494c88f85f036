"""Weight on the wheels, friction of tyres and gears, pushing, braking, current: against closed form."""

import math

import mujoco
import numpy as np
import pytest

from khep_twin import playpen, units
from khep_twin.board.kernel import DUTIES, RIGHT, Board, set_duty
from khep_twin.episodes.controllers import ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.robots.registry import find_model
from khep_twin.sensing.calibration import MotorCalibration
from khep_twin.units import TYRE_FRICTION

MODELS = {"khepera1": "", "khepera2": 'model = "khepera2"\n'}
WALL_X_MM = 2000.0


def episode(heading_deg: float = 0, x_mm: float = 1000, model: str = "khepera1") -> Episode:
    """A robot on a floor of two by two metres, without noise."""
    place = f"x_mm = {x_mm}\ny_mm = 1000\nheading_deg = {heading_deg}\n"
    arena = f"[arena]\nwidth_mm = {WALL_X_MM}\nheight_mm = {WALL_X_MM}\n"
    scene = playpen.parse(
        f'version = 1\nname = "field"\n{arena}[[robot]]\n{place}{MODELS[model]}', "field.toml"
    )
    new = Episode(EpisodeSetup(scene), ConstantSpeed(), compiled=False)
    new.begin(options=EpisodeOptions(noise=False))
    return new


def run_with_duty(twin: Episode, duty: int, seconds: float) -> None:
    for wheel in (0, RIGHT):
        set_duty(twin.boards[0].data, wheel, duty)
    twin.run(seconds)


def forces(twin: Episode) -> dict[str, float]:
    """Normal forces of the robot's contacts [N]."""
    model, force = twin.world.model, np.zeros(6)
    forces_by_geom = dict.fromkeys(("left_tyre", "right_tyre", "front_support", "back_support", "shell"), 0.0)
    for number, contact in enumerate(twin.data.contact):
        mujoco.mj_contactForce(model, twin.data, number, force)
        for geom in contact.geom.tolist():
            name = model.geom(geom).name.rpartition("/")[2]
            if name in forces_by_geom:
                forces_by_geom[name] += float(force[0])
    return forces_by_geom


@pytest.mark.parametrize("model", MODELS)
def test_the_wheels_carry_nearly_all_of_the_robot(model: str) -> None:
    twin = episode(model=model)
    twin.run(1.0)
    body, contact_forces = find_model(model).body, forces(twin)
    weight = body.mass * units.GRAVITY
    # Moments about the axle: the mass behind it stands on the back support.
    mass_behind = body.mass - 2 * units.WHEEL_MASS
    lever = units.CENTRE_OF_MASS_BEHIND * units.MASS / (units.MASS - 2 * units.WHEEL_MASS)
    back_load = mass_behind * units.GRAVITY * lever / body.support_position
    assert contact_forces["back_support"] == pytest.approx(back_load, rel=0.01)
    assert contact_forces["front_support"] == 0
    assert contact_forces["left_tyre"] == pytest.approx((weight - back_load) / 2, rel=0.001)
    assert contact_forces["left_tyre"] + contact_forces["right_tyre"] > 0.97 * weight
    assert abs(twin.data.qpos[2]) < 1e-6  # tyres neither sunk in nor above the floor


@pytest.mark.parametrize("heading_deg", [0, 45])
def test_a_tyre_slips_at_friction_times_its_load_and_not_before(heading_deg: float) -> None:
    twin = episode(heading_deg, x_mm=WALL_X_MM - 28)
    if heading_deg:
        # Against the corner of two walls the robot can turn to neither.
        twin.begin(options=EpisodeOptions(noise=False, start=(WALL_X_MM - 28, WALL_X_MM - 28, heading_deg)))
    motors = MotorCalibration()

    def drive_torque(duty: int) -> float:
        stall = motors.stall_torque_n_m + motors.friction_torque_n_m
        return stall * duty / units.DUTY_LIMIT - motors.friction_torque_n_m

    run_with_duty(twin, 52, 1.0)
    start = twin.data.qpos[7]
    twin.run(0.5)
    assert drive_torque(52) > 1.6e-3  # at 0.89 mN m tyres slipped when supports carried 62 % of the robot
    assert (twin.data.qpos[7] - start) * units.WHEEL_RADIUS < 0.5e-3
    run_with_duty(twin, 90, 1.0)
    assert twin.data.qvel[6] * units.WHEEL_RADIUS > 0.02
    contact_forces = forces(twin)
    # Spinning evenly, the motor's torque is that of the tyre and of the gear.
    torque = float(twin.data.actuator_force[0]) - motors.friction_torque_n_m
    load = (contact_forces["left_tyre"] + contact_forces["right_tyre"]) / 2
    assert torque == pytest.approx(TYRE_FRICTION * load * units.WHEEL_RADIUS, rel=0.03)
    assert torque == pytest.approx(2.36e-3, rel=0.2)  # that of the whole weight


def test_at_full_duty_a_robot_accelerates_by_the_friction_of_its_slipping_tyres() -> None:
    twin = episode()
    run_with_duty(twin, 255, 0.02)
    before, impulse = float(twin.data.qvel[0]), 0.0
    for _ in range(24):
        twin.step(1)
        contact_forces = forces(twin)
        impulse += (
            TYRE_FRICTION
            * (contact_forces["left_tyre"] + contact_forces["right_tyre"])
            * units.STEP_NS
            * 1e-9
        )
        assert twin.data.qvel[6] * units.WHEEL_RADIUS - twin.data.qvel[0] > 0.05
    assert (float(twin.data.qvel[0]) - before) * units.MASS == pytest.approx(impulse, rel=0.03)
    assert impulse / 0.06 > 0.6 * TYRE_FRICTION * units.MASS * units.GRAVITY


@pytest.mark.parametrize("model", MODELS)
def test_a_robot_pushes_with_its_tyres_friction(model: str) -> None:
    radius_mm = find_model(model).body.radius * 1e3
    twin = episode(x_mm=WALL_X_MM - radius_mm - 0.5, model=model)
    run_with_duty(twin, 100, 1.5)
    contact_forces = forces(twin)
    weight = find_model(model).body.mass * units.GRAVITY
    assert contact_forces["shell"] == pytest.approx(
        TYRE_FRICTION * (contact_forces["left_tyre"] + contact_forces["right_tyre"]), rel=0.01
    )
    # About 0.6 N for the Khepera: the whole weight less what the wall's push puts on the back support.
    assert 0.8 < contact_forces["shell"] / (TYRE_FRICTION * weight) < 1.03


@pytest.mark.share(2)
@pytest.mark.parametrize(
    ("speed", "heading_deg"), [(2, 0), (5, 0), (10, 0), (20, 0), (40, 0), (10, 30), (20, 45), (40, 60)]
)
def test_a_robot_that_drives_into_a_wall_neither_chatters_nor_hops(speed: int, heading_deg: float) -> None:
    twin = episode(heading_deg, x_mm=WALL_X_MM - 30)
    twin.drive(speed, speed)
    twin.run(3.0)
    velocities, heights, loads = [], [], []
    for _ in range(200):
        twin.step(1)
        velocities.append(twin.data.qvel[:2].copy())
        heights.append(float(twin.data.qpos[2]))
        contact_forces = forces(twin)
        loads.append(min(contact_forces["left_tyre"], contact_forces["right_tyre"]))
    away = np.array(velocities) - np.mean(velocities, axis=0)
    assert np.hypot(*away.T).max() < 1e-3
    assert np.ptp(heights) < 2e-6
    assert min(loads) > 0.2  # no tyre leaves the floor
    assert twin.data.qvel[6] * units.WHEEL_RADIUS == pytest.approx(units.speed(speed), rel=0.25)


@pytest.mark.parametrize("speed", [0, 5, 20])
def test_a_robot_at_rest_or_at_constant_speed_stays_on_wheels_and_back_support(speed: int) -> None:
    twin = episode(x_mm=300)
    twin.drive(speed, speed)
    twin.run(1.0)
    heights, fronts, backs = [], [], []
    for _ in range(200):
        twin.step(1)
        contact_forces = forces(twin)
        heights.append(float(twin.data.qpos[2]))
        fronts.append(contact_forces["front_support"])
        backs.append(contact_forces["back_support"])
    assert max(fronts) == 0
    assert min(backs) > 0
    # The controller's duty changes by whole pulses, which the springs of the tyres show.
    assert np.ptp(heights) < (1e-8 if speed == 0 else 1e-5)


@pytest.mark.parametrize("speed", [10, 20, 60])
def test_a_robot_that_reverses_tips_by_less_than_a_degree(speed: int) -> None:
    twin = episode()
    twin.drive(speed, speed)
    twin.run(0.8)
    twin.drive(-speed, -speed)
    tilts = []
    for _ in range(160):
        twin.step(1)
        w, x, y, z = twin.data.qpos[3:7]
        tilts.append(math.degrees(math.acos(min(w * w - x * x - y * y + z * z, 1.0))))
    assert max(tilts) < 1


def test_gears_hold_below_the_dead_zone_of_the_duty() -> None:
    motors = MotorCalibration()
    total_torque = motors.stall_torque_n_m + motors.friction_torque_n_m
    dead = units.DUTY_LIMIT * motors.friction_torque_n_m / total_torque
    assert dead == pytest.approx(12.1, abs=0.1)
    for duty, moves in ((math.floor(dead), False), (math.ceil(dead) + 1, True)):
        twin = episode()
        run_with_duty(twin, duty, 1.0)
        # A held wheel creeps by 10 micrometres a second.
        assert (float(twin.data.qpos[7]) * units.WHEEL_RADIUS > 5e-4) is moves, duty


def test_a_robot_without_voltage_is_braked_by_its_gears_until_it_stands() -> None:
    twin = episode(x_mm=300)
    twin.drive(10, 10)
    twin.run(1.0)
    run_with_duty(twin, 0, 0.3)
    assert abs(twin.data.qvel[0]) < 1e-5


def test_full_duty_reaches_the_no_load_speed_less_what_the_robot_takes() -> None:
    motors = MotorCalibration()
    used = motors.friction_torque_n_m * motors.resistance / motors.constant
    assert (units.SUPPLY_VOLTAGE - used) / motors.constant == pytest.approx(units.MOTOR_NO_LOAD_SPEED)
    stall = motors.constant * units.SUPPLY_VOLTAGE / motors.resistance - motors.friction_torque_n_m
    assert stall == pytest.approx(units.MOTOR_STALL_TORQUE)


@pytest.mark.parametrize(("model", "capacity_mah", "hours"), [("khepera1", 180, 0.75), ("khepera2", 250, 1)])
def test_a_driving_robot_draws_the_manuals_capacity_over_its_autonomy(
    model: str, capacity_mah: float, hours: float
) -> None:
    twin = episode(x_mm=300, model=model)
    twin.drive(10, 10)
    twin.run(1.0)
    currents, duties = [], []
    for _ in range(100):
        twin.run(0.02)
        currents.append(int(twin.registers[Board.CURRENT]))
        duties.append(int(twin.registers[DUTIES[0]]))
    assert np.mean(currents) == pytest.approx(capacity_mah / hours, abs=1)
    # Friction and the motor's own voltage take this duty, as in closed form.
    motors = MotorCalibration()
    speed = units.speed(10) / units.WHEEL_RADIUS
    current = motors.friction_torque_n_m / motors.constant
    voltage = motors.constant * speed + motors.resistance * current
    assert np.mean(duties) == pytest.approx(units.DUTY_LIMIT * voltage / units.SUPPLY_VOLTAGE, abs=1)
    drawn = find_model(model).body.idle_current + 2 * current * voltage / units.SUPPLY_VOLTAGE
    assert drawn * 1e3 == pytest.approx(capacity_mah / hours, abs=0.5)

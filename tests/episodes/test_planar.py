"""Episodes in a plane: motion against closed forms, counts against MuJoCo, equal results compiled or not."""

import math

import numpy as np
import pytest
from numba_marks import with_numba
from test_batch import are_equal

from khep_twin import playpen, units
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.episodes.batch import RolloutResult, rollout
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed, Network
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.casting import PlaneScene, surfaces
from khep_twin.episodes.planar.motion import step
from khep_twin.episodes.planar.planar import PlanarScene
from khep_twin.episodes.planar.planar_world import PlanarForms, PlanarWorld
from khep_twin.episodes.planar.plane import TOUCHABLE, distance_to, normal_and_distance
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import Start
from khep_twin.sensing.optics import proximity_counts
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.seen_surfaces import Chip

OPEN = """
version = 1
name = "open"
[arena]
width_mm = 9000
height_mm = 9000
[[robot]]
x_mm = 4500
y_mm = 4500
heading_deg = 30
"""

EXTRA_PARTS = """
[[lamp]]
x_mm = 260
y_mm = 480
z_mm = 40
power_w = 6
flicker = 0.4
[[cylinder]]
x_mm = 400
y_mm = 110
radius_mm = 22
height_mm = 30
surface = "black"
[[block]]
x_mm = 330
y_mm = 470
angle_deg = 25
length_mm = 60
width_mm = 15
height_mm = 12
"""


def arena() -> Playpen:
    """Return "obstacles" with a second lamp, a dark cylinder and a block below the sensors."""
    return playpen.parse(playpen.dump(Playpen.load("obstacles")) + EXTRA_PARTS, "arena")


def planar_forms(scene: Playpen, step_ns: int, x_mm: float, y_mm: float, heading_deg: float) -> PlanarForms:
    """Return a plane for plain code, with its robot at a pose."""
    setup = EpisodeSetup(scene)
    backend = PlanarForms(setup.scene_model, PlanarScene(scene, setup.model, setup.indices, step_ns))
    backend.place_robot((x_mm, y_mm, heading_deg))
    return backend


def drive(backend: PlanarForms, left: float, right: float, steps: int) -> None:
    robot = backend.plane.robot
    robot.ctrl[0], robot.ctrl[1] = left, right
    for _ in range(steps):
        step(backend.plane)


def end_of(
    planar: bool, left: int, right: int, seconds: float, start: Start | None = None
) -> tuple[float, float, float]:
    """Return the pose at the end of a drive at constant speeds in the default playpen."""
    setup = EpisodeSetup(Playpen.load("default"), planar=planar)
    episode = Episode(setup, ConstantSpeed(left, right), compiled=False)
    episode.begin(options=EpisodeOptions(noise=False, start=start))
    episode.run(seconds)
    return episode.pose


def test_a_robot_driving_straight_is_a_first_order_lag() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.TICK_NS, 4500, 4500, 30)
    robot = backend.plane.robot
    drive(backend, 0.8, 0.8, 40)
    lag = (robot.mass / 2 * robot.wheel_radius**2 + robot.wheel_inertia) / robot.damping
    fastest, h = (0.8 - robot.dead_voltage) * robot.left_free_speed, robot.substep
    left = 1 / (1 + h / lag)
    way = fastest * sum(h * (1 - left ** (k + 1)) for k in range(160))
    x, y, heading = backend.pose
    assert (x - 4.5, y - 4.5) == pytest.approx((way * math.cos(math.pi / 6), way * math.sin(math.pi / 6)))
    assert heading == pytest.approx(math.pi / 6)
    assert backend.joints[3:].tolist() == pytest.approx([way / robot.wheel_radius] * 2)
    # This equals the lag in continuous time, up to the length of a substep.
    assert way == pytest.approx(fastest * (0.4 - lag * (1 - math.exp(-0.4 / lag))), rel=0.006)


def test_gears_hold_the_robot_below_the_voltage_that_overcomes_their_friction() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.TICK_NS, 4500, 4500, 30)
    dead = backend.plane.robot.dead_voltage
    drive(backend, 0.99 * dead, 0.99 * dead, 50)
    assert backend.joints[3:].tolist() == [0, 0]
    drive(backend, 1.1 * dead, 1.1 * dead, 50)
    assert backend.joints[3] > 0.01
    drive(backend, 0.99 * dead, 2 * dead, 100)
    left = backend.joints[3]
    drive(backend, 0.99 * dead, 2 * dead, 50)
    assert backend.joints[3] == pytest.approx(left, abs=2e-4)  # the robot turns about this wheel


def test_a_robot_without_voltage_is_stopped_by_a_lag_and_dry_friction() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.TICK_NS, 4500, 4500, 0)
    robot = backend.plane.robot
    drive(backend, 1.0, 1.0, 100)
    speed, start = float(backend.plane.robot.speeds[0]), backend.pose[0]
    drive(backend, 0.0, 0.0, 100)
    # m v' = -d (v + u), where u is the free speed at the voltage that overcomes friction.
    lag = (robot.mass / 2 * robot.wheel_radius**2 + robot.wheel_inertia) / robot.damping
    friction = robot.left_free_speed * robot.dead_voltage
    path = lag * speed - friction * lag * math.log1p(speed / friction)
    assert backend.pose[0] - start == pytest.approx(path, abs=speed * robot.substep)
    assert list(backend.plane.robot.speeds) == [0] * 5


def test_the_rate_of_turning_in_place_is_the_tyre_speed_over_half_the_track() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.TICK_NS, 4500, 4500, 0)
    robot = backend.plane.robot
    voltage = 0.3 + robot.dead_voltage
    drive(backend, -voltage, voltage, 100)
    start = backend.joints[2]
    drive(backend, -voltage, voltage, 100)
    assert backend.joints[2] - start == pytest.approx(2 * 0.3 * robot.left_free_speed / robot.track, rel=1e-6)
    assert backend.pose[:2] == pytest.approx((4.5, 4.5), abs=1e-9)


def test_a_circle_closes_with_the_radius_of_its_speeds() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.TICK_NS, 4500, 4500, 0)
    robot = backend.plane.robot
    voltages = 0.3 + robot.dead_voltage, 0.5 + robot.dead_voltage
    drive(backend, *voltages, 200)
    places = []
    for _ in range(800):
        drive(backend, *voltages, 1)
        places.append(backend.pose[:2])
    turn = 0.2 * robot.left_free_speed / robot.track
    n_ticks = round(2 * math.pi / turn / 0.01)
    (x0, y0), (x1, y1) = places[0], places[n_ticks]
    assert math.hypot(x1 - x0, y1 - y0) < 0.4 * robot.left_free_speed * 0.01
    xs = np.array(places[:n_ticks])
    radius = np.ptp(xs, axis=0) / 2
    assert radius == pytest.approx([0.4 * robot.left_free_speed / turn] * 2, rel=2e-3)


def test_a_tyre_slips_beyond_its_largest_force() -> None:
    backend = planar_forms(playpen.parse(OPEN, "open"), units.STEP_NS, 4500, 4500, 0)
    drive(backend, 4.0, 4.0, 12)
    robot = backend.plane.robot
    forward = backend.pose[0] - 4.5
    # The largest force of both tyres, with the load on the support from weight and acceleration.
    fastest = (
        2
        * (robot.tyre_force - robot.pitch_relief * robot.weight_moment)
        / (robot.mass * (1 + 2 * robot.pitch_relief * robot.pitch_arm))
    )
    h = robot.substep
    assert forward == pytest.approx(fastest * h * h * 12 * 13 / 2, rel=0.01)
    assert backend.joints[3] * robot.wheel_radius > 3.5 * forward


def test_the_disc_never_penetrates_an_obstacle() -> None:
    scene = arena()
    rng = np.random.default_rng(0)
    backend = planar_forms(scene, units.TICK_NS, 330, 300, 0)
    n_contacts = 0
    for _ in range(60):
        drive(backend, *rng.uniform(-2, 5, 2).tolist(), 8)
        x, y, _ = backend.pose
        gaps = [
            normal_and_distance(backend.plane.obstacles, obstacle, x, y)[2] - units.BODY_RADIUS
            for obstacle in range(len(backend.plane.obstacles))
            if backend.plane.obstacles[obstacle, TOUCHABLE]
        ]
        assert min(gaps) > -1e-9
        n_contacts += min(gaps) < 1e-6
    assert n_contacts > 10


def test_a_robot_slides_along_a_wall_as_in_mujoco() -> None:
    ends = [end_of(planar, 10, 10, 0.8, (150.0, 40.0, -20.0)) for planar in (False, True)]
    assert ends[1][1] == pytest.approx(units.BODY_RADIUS, abs=1e-9)
    assert ends[1][:2] == pytest.approx(ends[0][:2], abs=0.0015)
    assert ends[0][0] > 0.19
    assert ends[1][2] == pytest.approx(ends[0][2], abs=0.02)


@pytest.mark.parametrize("heading_deg", [0, 20, 45, 60])
def test_a_robot_that_drives_into_a_wall_turns_to_it_as_in_mujoco(heading_deg: float) -> None:
    ends = [end_of(planar, 5, 5, 2.0, (560.0, 200.0, heading_deg)) for planar in (False, True)]
    assert ends[0][0] > 0.572
    assert ends[1][:2] == pytest.approx(ends[0][:2], abs=6e-4)
    assert ends[1][2] == pytest.approx(ends[0][2], abs=0.02)


def test_wheels_stand_at_a_wall_and_spin_at_a_higher_voltage() -> None:
    backend = planar_forms(Playpen.load("default"), units.TICK_NS, 100, 28, -90)
    drive(backend, 0.6, 0.6, 60)
    x, y, heading = backend.pose
    assert (x, y) == pytest.approx((0.1, units.BODY_RADIUS), abs=1e-4)
    assert heading == pytest.approx(-math.pi / 2, abs=1e-5)
    stands = backend.joints[3]
    drive(backend, 0.6, 0.6, 10)
    assert backend.joints[3] == pytest.approx(stands, abs=1e-6)  # the tyres hold; the motors stand
    drive(backend, 3.0, 3.0, 20)
    assert backend.joints[3] > stands + 1  # the tyres do not


@pytest.mark.parametrize("name", ["arena", "looping-maze", "two-lamps"])
def test_counts_equal_those_of_mujoco_at_the_same_pose(name: str) -> None:
    scene = arena() if name == "arena" else Playpen.load(name)
    mujoco_episode, planar_episode = (
        Episode(EpisodeSetup(scene, planar=planar), compiled=False) for planar in (False, True)
    )
    rng = np.random.default_rng(3)
    floor, n_poses, n_visible, differences = scene.arena, 0, 0, []
    backend = planar_forms(scene, units.TICK_NS, 0, 0, 0)
    while n_poses < 60:
        x, y = rng.uniform((0, 0), (floor.width_mm, floor.height_mm)).tolist()
        clear = min(
            distance_to(backend.plane.obstacles, obstacle, x / 1e3, y / 1e3)
            for obstacle in range(len(backend.plane.obstacles))
        )
        if not units.BODY_RADIUS + 1e-3 < clear < 0.05:
            continue
        n_poses += 1
        start = (x, y, float(rng.uniform(-180, 180)))
        for episode in (mujoco_episode, planar_episode):
            episode.begin(0, EpisodeOptions(start=start, noise=False))
        near, far = (
            episode.registers[[*PROXIMITY, *AMBIENT]] for episode in (mujoco_episode, planar_episode)
        )
        differences.append(np.abs(near - far))
        n_visible += int((near[:8] > 50).sum())
    assert n_visible > 60
    # Both round, and MuJoCo's robot has a penetration of some micrometres.
    assert np.max(differences) <= 2
    assert np.mean(np.array(differences) <= 1) > 0.995


@pytest.mark.parametrize("name", ["arena", "looping-maze"])
def test_omitting_distant_obstacles_changes_no_count(name: str) -> None:
    scene = arena() if name == "arena" else Playpen.load(name)
    setup = EpisodeSetup(scene, planar=True)
    assert setup.planar_scene is not None
    sensors = PlanarWorld(setup.scene_model, setup.planar_scene).simulation.plain.groups[0][0].sensors
    backend = planar_forms(scene, units.TICK_NS, 0, 0, 0)
    rng, floor, n_visible, n_omitted = np.random.default_rng(8), scene.arena, 0, 0
    n_near: list[int] = []

    class CountingScene(PlaneScene):
        """A plane that records the numbers of surfaces."""

        def __init__(self) -> None:
            super().__init__(backend.plane)
            self.surfaces = self.count_near

        def count_near(self, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
            n_near.append(surfaces(self.plane, sensors, channel, chip, needed))
            return n_near[-1]

    class FullScene(PlaneScene):
        """A plane whose queries omit no obstacle."""

        def __init__(self) -> None:
            super().__init__(backend.plane)
            self.surfaces = self.all_in_reach

        def all_in_reach(self, sensors: RobotSensors, channel: int, chip: Chip, needed: float) -> int:
            return surfaces(self.plane, sensors, channel, chip, 0.0)

    for _ in range(100):
        backend.place_robot(
            (*rng.uniform((0, 0), (floor.width_mm, floor.height_mm)).tolist(), rng.uniform(0, 360))
        )
        drive(backend, 0.5, 0.5, 1)
        for channel, draw in enumerate(rng.normal(size=8).tolist()):
            noise, idle = draw * sensors.proximity.noise[channel], int(sensors.proximity.idle)
            usual = proximity_counts(CountingScene(), sensors, channel, noise, idle, 1.0, 0.0)
            assert proximity_counts(FullScene(), sensors, channel, noise, idle, 1.0, 0.0) == usual
            chip = CountingScene().chip(sensors, channel)
            in_reach = surfaces(backend.plane, sensors, channel, chip, 0.0)
            n_visible, n_omitted = n_visible + (usual > 10), n_omitted + (n_near[-1] == 0 < in_reach)
    assert n_visible > 50
    assert n_omitted > 50


def test_the_trajectory_in_a_plane_is_similar_to_that_in_mujoco() -> None:
    ends = [end_of(planar, 8, 6, 3.0) for planar in (False, True)]
    assert ends[1][:2] == pytest.approx(ends[0][:2], abs=5e-4)
    assert ends[1][2] == pytest.approx(ends[0][2], abs=0.005)


NETWORK = Network(hidden=(4,), recurrent=True, ambient=True)


def batch_of(compiled: bool, **options: object) -> RolloutResult:
    rng = np.random.default_rng(5)
    genes = rng.normal(size=(6, NETWORK.n_genes))
    starts = [(120.0, 290.0, 25.0), *((350.0 + 10 * i, 300.0, 60.0 * i) for i in range(5))]
    arguments = {"genes": genes, "starts": starts, "options": EpisodeOptions(vary=True), "compiled": compiled}
    setup = EpisodeSetup(arena(), planar=True)
    return rollout(setup, NETWORK, range(6), 3.0, **(arguments | options))  # type: ignore[arg-type]


@with_numba
def test_results_do_not_depend_on_threads_or_compilation() -> None:
    first = batch_of(True, threads=1)
    assert are_equal(first, batch_of(True, threads=2))
    assert are_equal(first, batch_of(False))
    assert len(set(first.metrics["distance_m"].tolist())) == 6


@with_numba
@pytest.mark.parametrize("step_ns", [units.STEP_NS, 2 * units.STEP_NS, 4 * units.STEP_NS])
def test_compiled_episodes_equal_plain_ones_after_other_episodes_and_in_parts(step_ns: int) -> None:
    setup = EpisodeSetup(arena(), step_ns=step_ns, planar=True)
    plain, fast = (
        Episode(setup, Braitenberg(), compiled=False),
        Episode(setup, Braitenberg(), compiled=True),
    )
    fast.begin(9, EpisodeOptions(start=(40.0, 290.0, 170.0)))
    fast.run(1.0)
    for episode in (plain, fast):
        episode.begin(1, EpisodeOptions(noise=step_ns / units.STEP_NS / 2))
    plain.run(2.0)
    for _ in range(100):
        fast.run(0.02)
    assert plain.registers.tolist() == fast.registers.tolist()
    assert plain.joints.tobytes() == fast.joints.tobytes()


def test_a_robot_out_of_bounds_is_a_failure_as_in_mujoco() -> None:
    starts = [(1e6, 0.0, 0.0), (100.0, 150.0, 0.0)]
    for planar in (False, True):
        setup = EpisodeSetup(arena(), planar=planar)
        results = rollout(setup, Braitenberg(), range(2), 0.1, starts=starts, compiled=False)
        assert [failure.index for failure in results.failures] == [0]

"""The world as a whole: physics against closed form, time, order, determinism."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from khep_twin import playpen, units
from khep_twin.board.kernel import AMBIENT, LEFT, PROXIMITY, RIGHT, SETPOINTS, SPEEDS, Wheel
from khep_twin.clock import NS_PER_S
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.robots.robot import Robot
from khep_twin.simulation.mujoco_forms import SceneModel
from khep_twin.world import World


def command(world: World, line: str) -> None:
    """Sends a command and waits until it is carried out."""
    world.robots[0].send(line.encode() + b"\n")
    world.advance(0.05)


def position(robot: Robot) -> tuple[int, int]:
    """Both counters [pulses]."""
    return int(robot.registers[LEFT + Wheel.POSITION]), int(robot.registers[RIGHT + Wheel.POSITION])


def test_a_world_is_made_by_name_and_advances_by_steps_by_seconds_and_to_a_time() -> None:
    world, other = World("obstacles", seed=1), World(Playpen.load("obstacles"), seed=1)
    world.step()
    assert (world.time_ns, world.simulation.steps) == (2_500_000, 1)
    world.advance(0.001)
    assert (world.time_ns, world.simulation.steps) == (3_500_000, 1)
    world.step(3)
    other.advance_to(10_000_000)
    assert (world.time_ns, world.simulation.steps) == (10_000_000, 4)
    assert world.snapshot() == other.snapshot()
    world.reset(seed=1)
    assert world.snapshot() == World("obstacles", seed=1).snapshot()
    with pytest.raises(PlaypenError, match="no-such"):
        World("no-such")


@pytest.mark.parametrize("speed_pulses", [1, 2, 5, 10, 20, 40, 80, 127, -10])
def test_free_speed_is_within_one_percent_of_the_command(field: Playpen, speed_pulses: int) -> None:
    world = World(field, noise=False)
    command(world, f"D,{speed_pulses},{speed_pulses}")
    # The fastest takes longest, since its wheels slip at first.
    world.advance(1.5)
    start = world.robots[0].pose
    world.advance(1.0)
    driven = math.dist(start[:2], world.robots[0].pose[:2])
    assert driven == pytest.approx(abs(units.speed(speed_pulses)), rel=0.01)


def test_a_straight_metre_agrees_with_the_counters_within_one_percent(field: Playpen) -> None:
    world = World(field, noise=False)
    start = world.robots[0].pose
    command(world, "D,10,10")
    world.advance(12.5)
    driven = math.dist(start[:2], world.robots[0].pose[:2])
    counted = position(world.robots[0])[0] * units.PULSE_LENGTH
    assert driven > 0.98
    assert driven == pytest.approx(counted, rel=0.01)
    assert abs(world.robots[0].pose[1] - start[1]) < 0.001


def test_a_spin_of_ten_turns_agrees_with_the_counters_within_two_percent(field: Playpen) -> None:
    world = World(field, noise=False)
    start = world.robots[0].pose
    command(world, "D,5,-5")
    turned, heading = 0.0, start[2]
    while abs(turned) < 10 * 2 * math.pi:
        world.advance(0.05)
        now = world.robots[0].pose[2]
        turned += math.remainder(now - heading, 2 * math.pi)
        heading = now
    left, right = position(world.robots[0])
    assert -turned == pytest.approx((left - right) * units.PULSE_LENGTH / units.WHEEL_BASE, rel=0.02)
    assert math.dist(start[:2], world.robots[0].pose[:2]) < 0.002


def test_a_robot_at_rest_drifts_less_than_a_tenth_of_a_millimetre_in_a_minute(field: Playpen) -> None:
    world = World(field, noise=False)
    start = world.robots[0].pose
    world.advance(60)
    assert math.dist(start[:2], world.robots[0].pose[:2]) < 1e-4
    assert not world.data.warning.number.any()


@pytest.mark.parametrize("target", [1, 10, 100, 1000, 5000, -300])
def test_a_position_is_reached_within_two_pulses(field: Playpen, target: int) -> None:
    world = World(field, noise=False)
    command(world, f"C,{target},{target}")
    for _ in range(120):
        world.advance(0.05)
        if world.robots[0].registers[LEFT + Wheel.ON_TARGET]:
            break
    assert world.robots[0].registers[LEFT + Wheel.ON_TARGET] == 1
    assert position(world.robots[0]) == pytest.approx((target, target), abs=2)
    world.advance(2)
    assert position(world.robots[0]) == pytest.approx((target, target), abs=2)


def test_a_short_move_peaks_below_the_cruising_speed_and_takes_its_time(field: Playpen) -> None:
    # From rest over 1000 pulses at 64/256 pulses/tick^2: v = sqrt(1000 / 4) = 15.8, t = 2 v / a = 1.26 s.
    world = World(field, noise=False)
    command(world, "C,1000,1000")
    peak, start_ns = 0.0, 0
    while not world.robots[0].registers[LEFT + Wheel.ON_TARGET] and world.time_ns < 3 * NS_PER_S:
        world.advance(0.01)
        start_ns = start_ns or world.time_ns
        peak = max(peak, world.robots[0].registers[LEFT + Wheel.PROFILE_SPEED] / 256)
    assert peak == pytest.approx(math.sqrt(250), abs=0.3)
    assert world.time_ns / NS_PER_S == pytest.approx(1.26, abs=0.1)


def test_a_robot_that_hits_a_wall_stops_while_its_wheels_spin_on(field: Playpen) -> None:
    world = World(Playpen.load("default"), noise=False)
    command(world, "D,20,20")
    world.advance(4)
    x, y, _ = world.robots[0].pose
    world.advance(1)
    assert math.dist((x, y), world.robots[0].pose[:2]) < 0.02
    assert 0.5 - units.BODY_RADIUS - 0.002 < y < 0.5 - units.BODY_RADIUS + 0.001
    assert world.robots[0].registers[SPEEDS] == pytest.approx((20, 20), abs=3)
    assert not world.data.warning.number.any()


def test_the_scan_converts_one_sensor_per_step_in_order() -> None:
    world = World(Playpen.load("default"), noise=False)
    world.robots[0].registers[PROXIMITY] = -1
    for channel in range(8):
        assert list(world.robots[0].registers[PROXIMITY] == -1).count(True) == 8 - channel
        world.advance_to(world.time_ns + units.STEP_NS)
        assert world.robots[0].registers[PROXIMITY][channel] >= 0


def test_every_register_holds_a_conversion_at_the_start() -> None:
    world = World(Playpen.load("default"), noise=False)
    assert (world.robots[0].registers[AMBIENT] == 485).all()


def test_how_time_is_cut_does_not_change_the_run() -> None:
    uninterrupted, cut = (World(Playpen.load("obstacles"), seed=3) for _ in range(2))
    for world in (uninterrupted, cut):
        world.robots[0].send(b"D,10,8\n")
    uninterrupted.advance_to(2 * NS_PER_S)
    while cut.time_ns < 2 * NS_PER_S:
        cut.advance_to(min(cut.time_ns + 1_234_567, 2 * NS_PER_S))
    np.testing.assert_array_equal(uninterrupted.data.qpos, cut.data.qpos)
    np.testing.assert_array_equal(uninterrupted.robots[0].registers, cut.robots[0].registers)


def test_the_same_seed_gives_the_same_counts_and_another_does_not() -> None:
    counts = []
    for seed in (1, 1, 2):
        world = World(Playpen.load("default"), seed=seed)
        world.advance(0.5)
        counts.append(tuple(world.robots[0].registers[AMBIENT]))
    assert counts[0] == counts[1] != counts[2]


def test_a_command_acts_when_its_last_byte_has_crossed_the_line(field: Playpen) -> None:
    world = World(field, noise=False)
    robot = world.robots[0]
    robot.send(b"D,7,7\n")
    arrival_ns = 6 * 11 * NS_PER_S // 9600
    world.advance_to(arrival_ns - 1)
    assert not robot.registers[SETPOINTS].any()
    world.advance_to(arrival_ns)
    assert robot.registers[SETPOINTS].tolist() == [7, 7]


def test_time_cannot_go_back(field: Playpen) -> None:
    world = World(field)
    world.advance_to(1000)
    with pytest.raises(ValueError, match="cannot go back from 1000 to 999"):
        world.advance_to(999)


def test_a_simulation_that_diverges_is_an_error_and_no_silent_restart(
    field: Playpen, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    world = World(field)
    world.advance(0.1)
    world.data.qvel[0] = math.nan
    with pytest.raises(DivergedError, match=r"failed at 0\.1\d+ s"):
        world.advance(0.1)
    assert list(tmp_path.iterdir()) == []


def test_a_world_that_has_diverged_stays_stopped(field: Playpen) -> None:
    world = World(field)
    world.data.qvel[0] = math.nan
    messages = []
    for _ in range(2):
        with pytest.raises(DivergedError) as caught:
            world.advance(0.1)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    assert "step 4" in messages[0]


def test_several_robots_see_each_other_and_keep_their_own_noise() -> None:
    two = playpen.dump(Playpen.load("default")) + ("\n[[robot]]\nx_mm = 300\ny_mm = 318\nheading_deg = -90\n")
    alone, together = World(Playpen.load("default"), seed=5), World(playpen.parse(two, "two"), seed=5)
    for world in (alone, together):
        world.advance(0.5)
    ambient = [world.robots[0].registers[AMBIENT].tolist() for world in (alone, together)]
    assert ambient[0] == ambient[1]
    quiet = World(playpen.parse(two.replace("318", "310"), "two"), noise=False)
    assert quiet.robots[0].registers[PROXIMITY][2:4].max() > 100


def test_a_movable_cylinder_is_pushed_along() -> None:
    text = playpen.dump(Playpen.load("default")) + (
        "\n[[cylinder]]\nx_mm = 300\ny_mm = 320\nradius_mm = 12.5\nheight_mm = 30\n"
        "movable = true\nmass_g = 20\n"
    )
    world = World(playpen.parse(text, "push"), noise=False)
    command(world, "D,5,5")
    world.advance(3)
    assert world.data.xpos[world.model.body("cylinder0").id][1] > 0.35
    assert not world.data.warning.number.any()


def test_the_steps_agree_with_the_compiled_model(field: Playpen) -> None:
    world = World(field)
    assert world.model.opt.timestep == units.STEP_NS * 1e-9
    assert world.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert world.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_a_playpen_without_robots_is_a_world_too() -> None:
    world = World(playpen.parse('version = 1\nname = "x"\n[arena]\nwidth_mm = 500\nheight_mm = 500\n', "x"))
    world.advance(0.1)
    assert world.robots == ()


def test_the_next_exchange_is_that_of_a_whole_command_or_of_the_next_byte_of_an_incomplete_one(
    field: Playpen,
) -> None:
    world = World(field, noise=False)
    robot, rx = world.robots[0], world.robots[0].uart.rx
    assert robot.next_exchange_ns() is None
    robot.send(b"D,5")
    assert robot.next_exchange_ns() == rx.arrival_ns(1)
    robot.send(b",5\nN")
    assert robot.next_exchange_ns() == rx.arrival_ns(6) == robot.next_command_ns()
    world.advance_to(rx.arrival_ns(6) or 0)
    assert robot.next_exchange_ns() == rx.arrival_ns(1)
    assert robot.next_command_ns() is None


def test_a_scan_sees_lamps_as_they_are_now() -> None:
    lamp = "[[lamp]]\nx_mm = 360\ny_mm = 250\npower_w = 5\nblink_period_s = 0.1\n"
    world = World(playpen.parse(playpen.dump(Playpen.load("default")) + lamp, "blinking"), noise=False)
    readings: list[list[int]] = []
    for time_ns in (140_000_000, 160_000_000):  # on, and off since 150 ms
        world.advance_to(time_ns)
        world.scan()
        readings.append(world.robots[0].registers[AMBIENT].tolist())
    assert min(readings[0]) < 200
    assert min(readings[1]) > 450


def test_a_world_of_a_compiled_scene_is_whole_at_once_and_the_same_as_that_of_the_playpen() -> None:
    two_lamps = Playpen.load("two-lamps")
    world, other = World(SceneModel.of(two_lamps), seed=2), World(two_lamps, seed=2)
    assert (world.time_ns, len(world.robots), world.observers) == (0, 1, [])
    for changed_world in (world, other):
        changed_world.advance(0.1)
    assert world.snapshot() == other.snapshot()

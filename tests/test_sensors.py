"""The infrared sensors: against closed form, and against the sampled robot's derived figures."""

from pathlib import Path

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, DEMO_SPEED_PULSES, DEMO_WEIGHTS, PROXIMITY
from khep_twin.files.toml_files import dump
from khep_twin.sensing import calibration
from khep_twin.units import BODY_RADIUS
from khep_twin.world import World

KHEPERA1 = calibration.read("khepera1")[0]


def scene(*tables: str, x_mm: float = 300, y_mm: float = 250, heading_deg: float = 0) -> str:
    head = 'version = 1\nname = "scene"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    robot = f"[[robot]]\nx_mm = {x_mm}\ny_mm = {y_mm}\nheading_deg = {heading_deg}\n"
    return head + robot + "\n".join(tables)


def counts(text: str, registers: list[int]) -> np.ndarray:
    """Return the readings of a robot at rest without noise."""
    return World(playpen.parse(text, "scene"), noise=False).robots[0].registers[registers]


def facing_wall(distance_mm: float, bearing_deg: float = 0, surface: str = "white") -> np.ndarray:
    """Proximity with a wall so far off the robot's edge, at a bearing counter-clockwise from ahead."""
    text = scene(x_mm=1000 - BODY_RADIUS * 1000 - distance_mm, y_mm=500, heading_deg=-bearing_deg)
    return counts(text.replace("[arena]", f'[arena]\nsurface = "{surface}"'), PROXIMITY)


@pytest.mark.parametrize(("radius_mm", "base_mm"), [(7.64, 52), (8.2, 54), (9, 60), (9, 40)])
def test_a_robot_never_sees_its_own_wheels(tmp_path: Path, radius_mm: float, base_mm: float) -> None:
    lamps = [f"[[lamp]]\nx_mm = 500\ny_mm = {y_mm}\npower_w = 2" for y_mm in (300, 700)]
    sides = KHEPERA1.model_copy(update={"heading_deg": (92, 45, 8, -8, -45, -92, 180, 180)})
    wheels = calibration.WheelCalibration(radius_mm=radius_mm, base_mm=base_mm)
    path = tmp_path / "wide.toml"
    path.write_text(dump(sides.model_copy(update={"wheels": wheels})))
    text = scene(*lamps, x_mm=500, y_mm=500).replace("[[robot]]", f'[[robot]]\ncalibration = "{path}"')
    readings = counts(text, [*PROXIMITY, *AMBIENT])
    assert readings[:8].tolist() == [0] * 8
    # Nor do they stand in the light.
    assert readings[8:].tolist() == counts(scene(*lamps, x_mm=500, y_mm=500), AMBIENT).tolist()


# Distance at half scale of each sensor before a wall, as derived from the samples [mm].
HALF_SCALE_MM = [23.8, 23.8, 22.5, 19.3, 25.2, 27.6, 22.5, 26.9]


@pytest.mark.share(4)
@pytest.mark.parametrize("off_deg", [18, 180])
@pytest.mark.parametrize("sensor", range(8))
def test_half_scale_before_a_wall_is_where_the_sampled_robot_has_it(sensor: int, off_deg: int) -> None:
    # Taken at the bearing where the sensor sees the wall best, which is about its own.
    heading, offs = round(KHEPERA1.heading_deg[sensor]), range(-off_deg, off_deg + 1, 6)

    def best(distance_mm: float) -> int:
        return max(facing_wall(distance_mm, (heading + off) % 360)[sensor] for off in offs)

    half_mm = HALF_SCALE_MM[sensor]
    assert best(half_mm + 2.5) < 511 < best(half_mm - 2.5)


def test_proximity_saturates_close_by_and_ends_within_five_centimetres() -> None:
    front = [facing_wall(distance)[2:4] for distance in (3, 10, 50, 100)]
    assert (np.array(front[:2]) == 1023).all()
    assert (np.array(front[2:]) == 0).all()


def test_dark_surfaces_reflect_less() -> None:
    white, grey, black = (facing_wall(6, surface=name)[2] for name in ("white", "grey", "black"))
    assert white == 1023
    assert 100 < grey < 900
    assert black == 0


def pair(calibrated: str, x_mm: float, y_mm: float) -> np.ndarray:
    """Proximity of a robot that looks along x, with another one at a place beside its centre."""
    model = calibrated.partition("-")[0]
    text = (
        scene(x_mm=500, y_mm=500)
        + scene(x_mm=500 + x_mm, y_mm=500 + y_mm).partition("1000\nheight_mm = 1000\n")[2]
    )
    return counts(
        text.replace("[[robot]]", f'[[robot]]\nmodel = "{model}"\ncalibration = "{calibrated}"'), PROXIMITY
    )


def test_a_khepera_ii_reads_another_one_as_the_manufacturers_report_has_it() -> None:
    # 10 mm from the faces of the front sensors, and of the right one, to the other's shell.
    frontal, tangential = (pair("khepera2-manual", *at) for at in ((30 + 10 + 35, 0), (0, -26.6 - 10 - 35)))
    assert frontal[1:5].tolist() == pytest.approx([105, 223, 271, 102], abs=22)
    assert tangential[5] == pytest.approx(274, abs=12)


def test_with_the_default_calibration_robots_see_each_other_just_before_they_touch() -> None:
    pairs = [pair("khepera1", 2 * BODY_RADIUS * 1e3 + gap_mm, 0)[[2, 3]].tolist() for gap_mm in (4, 7, 12)]
    assert pairs == [[1023, 501], [348, 11], [0, 0]]


def block_ahead(height_mm: float) -> str:
    """A block 5 mm before the robot's edge."""
    return f"[[block]]\nx_mm = 347.5\ny_mm = 250\nlength_mm = 30\nwidth_mm = 60\nheight_mm = {height_mm}\n"


@pytest.mark.parametrize(
    ("calibrated", "gap_mm"),
    [("khepera1", 5), ("khepera1", 7.5), *(("khepera1-manual", gap_mm) for gap_mm in (5, 7.5, 10, 15))],
)
def test_a_rod_of_4_mm_moved_sideways_changes_proximity_smoothly(calibrated: str, gap_mm: float) -> None:
    rod = f"[[cylinder]]\nx_mm = {300 + 27.5 + gap_mm + 2}\ny_mm = 250\nradius_mm = 2\nheight_mm = 50\n"
    text = scene(rod).replace("[[robot]]", f'[[robot]]\ncalibration = "{calibrated}"')
    world = World(playpen.parse(text, "scene"), noise=False)
    robot, scans = world.robots[0], []
    for aside_mm in np.arange(-10, 10, 0.05).tolist():
        # The robot passes the rod, which is the same.
        world.data.qpos[robot.indices.pose + 1] = 0.25 + aside_mm / 1e3
        world.scan()
        scans.append(robot.registers[PROXIMITY][:6])
    read = np.array(scans)
    assert np.abs(np.diff(read, axis=0)).max() <= 20  # of a noise of 22
    # No kinks either, where a reading is not clipped: steps change by 1 count at most, which is rounding.
    free = (read > 5) & (read < 1023)
    bends = np.abs(np.diff(read, 2, axis=0))[free[:-2] & free[1:-1] & free[2:]]
    assert bends.max(initial=0) <= 1
    assert read.max() > 50


def test_lower_things_are_read_the_weaker_the_lower_they_are() -> None:
    heights = (2, 5, 7, 9, 11, 13, 14, 16, 20, 30, 50)
    text = [
        scene(block_ahead(height)).replace("[[robot]]", '[[robot]]\ncalibration = "khepera2-manual"')
        for height in heights
    ]
    right_counts = [counts(scene_text, PROXIMITY)[2] for scene_text in text]
    empty = counts(scene().replace("[[robot]]", '[[robot]]\ncalibration = "khepera2-manual"'), PROXIMITY)[2]
    assert right_counts == sorted(right_counts)
    assert right_counts[0] - empty < 30 < right_counts[1] - empty < (right_counts[-1] - empty) / 4


def test_paint_on_the_floor_is_not_seen() -> None:
    patch = '[[patch]]\nx_mm = 347.5\ny_mm = 250\nlength_mm = 60\nwidth_mm = 60\nsurface = "white"\n'
    assert counts(scene(patch), PROXIMITY).tolist() == counts(scene(), PROXIMITY).tolist() == [0] * 8
    assert (
        counts(scene(patch, block_ahead(50)), PROXIMITY).tolist()
        == counts(scene(block_ahead(50)), PROXIMITY).tolist()
    )


def test_a_movable_cylinder_that_has_fallen_over_is_read_as_a_block() -> None:
    standing = "[[cylinder]]\nx_mm = 342.5\ny_mm = 250\nradius_mm = 10\nheight_mm = 40\nmovable = true\n"
    world = World(playpen.parse(scene(standing), "scene"), noise=False)
    upright = world.robots[0].registers[PROXIMITY].tolist()
    pose = int(world.model.jnt_qposadr[world.model.body("cylinder0").jntadr[0]])
    world.data.qpos[pose + 2 : pose + 7] = [0.01, np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    world.scan()
    block = "[[block]]\nx_mm = 342.5\ny_mm = 250\nlength_mm = 20\nwidth_mm = 40\nheight_mm = 20\n"
    fallen = world.robots[0].registers[PROXIMITY]
    assert fallen.tolist() == pytest.approx(counts(scene(block), PROXIMITY).tolist(), abs=1)
    assert fallen.tolist() != upright


def test_a_sensor_within_a_thing_saturates() -> None:
    world = World(playpen.parse(scene(block_ahead(50)), "scene"), noise=False)
    world.data.qpos[world.robots[0].indices.pose] = 0.3275
    world.scan()
    assert world.robots[0].registers[PROXIMITY][[2, 3]].tolist() == [1023, 1023]


def test_among_mixed_surfaces_light_takes_that_of_what_it_comes_from() -> None:
    def block(surface: str) -> str:
        return (
            "[[block]]\nx_mm = 362\ny_mm = 250\nlength_mm = 20\nwidth_mm = 200\nheight_mm = 50\n"
            f'surface = "{surface}"'
        )

    uniform = counts(scene(block("white")), PROXIMITY)
    mixed = counts(scene(block("white")).replace("[arena]", '[arena]\nsurface = "black"'), PROXIMITY)
    assert 100 < uniform[2] < 1000
    np.testing.assert_array_equal(uniform[2:4], mixed[2:4])
    assert counts(scene(block("black")), PROXIMITY)[2] == 0


def test_the_vehicle_turns_round_where_the_sampled_robot_does() -> None:
    # The sum of both motors changes sign head-on to a wall at 23 mm.
    def drive(distance_mm: float) -> float:
        turning = facing_wall(distance_mm) @ np.array(DEMO_WEIGHTS).sum(axis=1) / 400
        return float(turning) + 2 * DEMO_SPEED_PULSES

    assert drive(21) < 0 < drive(25)


def test_a_threshold_of_900_is_crossed_head_on_at_20_millimetres() -> None:
    def nearest(distance_mm: float) -> int:
        return int(facing_wall(distance_mm).max())

    assert nearest(22.7) < 900 < nearest(17.7)


def test_bright_light_takes_from_proximity_what_is_left_of_the_converters_range() -> None:
    # Proximity is a reading with the emitter on less one with it off, and the latter is nearly saturated.
    near = {"x_mm": 1000 - BODY_RADIUS * 1000 - 12, "y_mm": 500}
    lamp = "[[lamp]]\nx_mm = 990\ny_mm = 500\nz_mm = 100\npower_w = {power}\n"
    dark, floor = KHEPERA1.ambient.dark_counts, KHEPERA1.ambient.floor_counts
    for power in (0.2, 1.0, 2.0):
        text = scene(lamp.format(power=power), **near)
        proximity, ambient = counts(text, PROXIMITY)[2], counts(text, AMBIENT)[2]
        assert floor < ambient < dark
        assert proximity == pytest.approx(1023 * (ambient - floor) / (dark - floor), abs=2)
    assert counts(scene(lamp.format(power=100), **near), PROXIMITY)[2] == 0
    assert counts(scene(**near), PROXIMITY)[2] == 1023


@pytest.mark.parametrize("lamp", ["", "[[lamp]]\nx_mm = 560\ny_mm = 500\nz_mm = 100\npower_w = 100\n"])
def test_a_khepera_2_never_reads_0_with_noise_in_the_dark_and_in_bright_light(lamp: str) -> None:
    text = scene(lamp, x_mm=500, y_mm=500).replace("[[robot]]", '[[robot]]\nmodel = "khepera2"')
    world = World(playpen.parse(text, "scene"), seed=1)
    history: list[int] = []
    for scan in range(200):
        world.advance_to((scan + 1) * 20_000_000)
        history += world.robots[0].registers[PROXIMITY].tolist()
    # In bright light nothing is left but the lowest step.
    assert min(history) == 4 if lamp else min(history) > 4


def test_a_reading_is_as_old_as_the_sensors_turn_in_the_scan() -> None:
    # Each 2.5 ms one sensor is converted; a robot that drives towards a wall reads what was up to 20 ms ago.
    text = scene(x_mm=1000 - BODY_RADIUS * 1000 - 50, y_mm=500)
    world = World(playpen.parse(text, "scene"), noise=False)
    world.robots[0].send(b"D,20,20\n")
    world.advance_to(200_000_000)
    x_mm: list[float] = []
    left_10: list[int] = []
    for _ in range(16):
        x_mm.append(world.robots[0].pose[0] * 1000)
        world.advance_to(world.time_ns + 2_500_000)
        left_10.append(int(world.robots[0].registers[PROXIMITY][2]))
    # The scan comes to it, the third, in the third of eight steps, with the pose at the step's start.
    for turn in (2, 10):
        facing_counts = facing_wall(1000 - BODY_RADIUS * 1000 - x_mm[turn])[2]
        assert left_10[turn : turn + 8][: 16 - turn] == [left_10[turn]] * min(8, 16 - turn)
        assert left_10[turn] == pytest.approx(facing_counts, abs=6)
    assert left_10[10] > left_10[2] + 50


def readings(text: str, registers: list[int], seconds: int = 30) -> np.ndarray:
    """Return the readings of a noisy robot at rest, one row per scan."""
    world = World(playpen.parse(text, "scene"), seed=1)
    rows = []
    while world.time_ns < seconds * 10**9:
        world.advance_to(world.time_ns + 20_000_000)
        rows.append(world.robots[0].registers[registers])
    return np.array(rows)


def test_noise_has_the_measured_level() -> None:
    text = scene(x_mm=1000 - 27.5 - 24, y_mm=500)
    middle = readings(text, PROXIMITY)[:, 2]
    assert 200 < middle.mean() < 800
    assert middle.std() == pytest.approx(22, abs=1.5)
    assert readings(text, AMBIENT)[:, 7].std() == pytest.approx(5, abs=0.5)


def test_with_nothing_in_reach_only_a_few_counts_are_left() -> None:
    idle = readings(scene(), PROXIMITY)
    assert np.median(idle) in (1, 2)
    assert np.percentile(idle, 99) <= 12


def test_the_same_seed_spreads_a_robot_alike_and_each_robot_of_a_playpen_on_its_own() -> None:
    second = "[[robot]]\nx_mm = 972.5\ny_mm = 700\nheading_deg = 0\n"
    text = scene(second, x_mm=948, y_mm=300).replace("x_mm = 972.5", "x_mm = 948")

    def read(seed: int) -> list[list[int]]:
        world = World(playpen.parse(text, "scene"), seed=seed, noise=False, vary=True)
        return [robot.registers[PROXIMITY].tolist() for robot in world.robots]

    first = read(1)
    assert first == read(1)
    assert first != read(2)
    assert first[0] != first[1]

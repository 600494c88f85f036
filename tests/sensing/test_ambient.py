"""Light at a robot's receivers: closed form, shadows with soft edges, and the toolbox's law."""

import math
from itertools import pairwise

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.sensing import calibration
from khep_twin.sensing import light as lamp_light
from khep_twin.sensing.ambient import ambient_optics, build_light
from khep_twin.sensing.occlusion import SightLines
from khep_twin.units import BULB_RADIUS, SENSOR_HEIGHT, SENSOR_POSITIONS
from khep_twin.world import World

KHEPERA1 = calibration.read("khepera1")[0].ambient
RECEIVERS = ambient_optics(KHEPERA1)
LIGHTING = playpen.Lighting(law="toolbox", min_angle_deg=20, max_angle_deg=80)
DARK = round(KHEPERA1.dark_counts)
LAMP = "[[lamp]]\nx_mm = 700\ny_mm = 250\npower_w = 7\n"
SCREEN = "[[block]]\nx_mm = 400\ny_mm = 250\nlength_mm = 5\nwidth_mm = 400\nheight_mm = 100\n"
LEFT_10 = 2


def scene(*tables: str, heading_deg: float = 0) -> str:
    head = 'version = 1\nname = "scene"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    robot = f"[[robot]]\nx_mm = 300\ny_mm = 250\nheading_deg = {heading_deg}\n"
    return head + robot + "\n".join(tables)


def counts(text: str) -> np.ndarray:
    """Return the ambient counts of a robot at rest, without noise."""
    return World(playpen.parse(text, "scene"), noise=False).robots[0].registers[AMBIENT]


def test_light_falls_with_the_square_of_the_distance() -> None:
    near, far = (lamp_light.light_per_watt(RECEIVERS, LEFT_10, distance, 1.0) for distance in (0.2, 0.4))
    assert near == pytest.approx(KHEPERA1.gain_counts_mm2_per_w[LEFT_10] / 200**2)
    assert near == pytest.approx(4 * far)


def test_off_the_axis_a_lobe_and_a_diffuse_part_are_left() -> None:
    on_axis, at_60_deg, opposite = (
        lamp_light.light_per_watt(RECEIVERS, LEFT_10, 0.2, cosine) for cosine in (1.0, 0.5, -1.0)
    )
    part, exponent = KHEPERA1.diffuse, KHEPERA1.lobe_exponent[LEFT_10]
    assert at_60_deg / on_axis == pytest.approx((1 - part) * 0.5**exponent + part * 0.75)
    assert opposite == 0


@pytest.mark.parametrize(("angle_deg", "left"), [(0, 1), (19, 1), (40, math.cos(math.radians(45))), (81, 0)])
def test_the_toolboxs_law_loses_nothing_up_to_an_angle_and_all_beyond_another(
    angle_deg: float, left: float
) -> None:
    cosine = math.cos(math.radians(angle_deg))
    world = World(playpen.parse(scene(), "scene"))
    light = build_light(SightLines(world.model, world.robots[0].indices, []), LIGHTING)
    light_per_watt = lamp_light.toolbox_light_per_watt(RECEIVERS, light.law, LEFT_10, 0.2, cosine)
    assert light_per_watt == pytest.approx(left * KHEPERA1.gain_counts_mm2_per_w[LEFT_10] / 200**2)


def test_a_lamp_ahead_is_seen_ahead() -> None:
    readings = counts(scene(LAMP))
    assert readings[2:4].max() < 400
    assert (readings[6:] == DARK).all()


def test_a_scene_gives_what_the_law_says() -> None:
    x, y = SENSOR_POSITIONS[LEFT_10]
    ray = np.array([0.4 - x, -y, 0.015 - SENSOR_HEIGHT])
    distance = float(np.linalg.norm(ray))
    heading = math.radians(KHEPERA1.heading_deg[LEFT_10])
    cosine = float(ray @ [math.cos(heading), math.sin(heading), 0]) / distance
    light = 7 * lamp_light.light_per_watt(RECEIVERS, LEFT_10, distance, cosine)
    assert counts(scene(LAMP))[LEFT_10] == pytest.approx(DARK - light, abs=1)


def test_behind_a_wall_it_is_dark() -> None:
    assert (counts(scene(LAMP, SCREEN)) == DARK).all()


def test_behind_another_robot_it_is_dark() -> None:
    robot = "[[robot]]\nx_mm = 400\ny_mm = 250\nheading_deg = 0\n"
    assert (counts(scene(robot, LAMP))[2:4] == DARK).all()
    assert (counts(scene(robot.replace("y_mm = 250", "y_mm = 400"), LAMP))[2:4] < 400).all()


def test_a_lamp_above_a_low_wall_is_seen_over_it() -> None:
    low = SCREEN.replace("height_mm = 100", "height_mm = 1")
    np.testing.assert_array_equal(counts(scene(LAMP, low)), counts(scene(LAMP)))


def test_the_toolboxs_lamps_shine_through_walls() -> None:
    law = '[lighting]\nlaw = "toolbox"\n'
    np.testing.assert_array_equal(counts(scene(law, LAMP, SCREEN)), counts(scene(law, LAMP)))
    assert counts(scene(law, LAMP))[LEFT_10] < 400


def test_the_edge_of_a_shadow_is_as_soft_as_the_bulb_is_wide() -> None:
    # The end of a thin screen moves across the bulb: the visible part of a disc beside a straight line.
    x_mm, y_mm = 300 + SENSOR_POSITIONS[LEFT_10][0] * 1e3, 250 + SENSOR_POSITIONS[LEFT_10][1] * 1e3
    screen_mm, lamp_mm = 400, 700
    stretch = (lamp_mm - x_mm) / (screen_mm - x_mm)
    middle_mm = y_mm + (250 - y_mm) / stretch
    full_light = DARK - counts(scene(LAMP))[LEFT_10]
    parts: list[float] = []
    shifts_mm = np.arange(-4, 4.1, 0.5)
    for shift_mm in shifts_mm:
        screen = (
            f"[[block]]\nx_mm = {screen_mm + 0.5}\ny_mm = {middle_mm + shift_mm + 100}\nlength_mm = 1\n"
            "width_mm = 200\nheight_mm = 100\n"
        )
        parts.append((DARK - counts(scene(LAMP, screen))[LEFT_10]) / full_light)
    across = np.clip(shifts_mm * stretch / (BULB_RADIUS * 1e3), -1, 1)
    np.testing.assert_allclose(
        parts, 0.5 + (across * np.sqrt(1 - across**2) + np.arcsin(across)) / np.pi, atol=0.04
    )
    assert all(earlier <= later for earlier, later in pairwise(parts))


def test_lamps_add_up_down_to_the_floor() -> None:
    near = LAMP.replace("x_mm = 700", "x_mm = 400")
    single, double = counts(scene(LAMP))[2], counts(scene(LAMP, LAMP.replace("250", "260")))[2]
    assert DARK - double == pytest.approx(2 * (DARK - single), rel=0.05)
    assert counts(scene(near))[2] == round(KHEPERA1.floor_counts)


def test_a_lamp_overhead_is_dimly_seen_all_round() -> None:
    overhead = "[[lamp]]\nx_mm = 300\ny_mm = 250\nz_mm = 300\npower_w = 50\n"
    depths = DARK - counts(scene(overhead))
    expected = 50 * KHEPERA1.diffuse / 2 * np.array(KHEPERA1.gain_counts_mm2_per_w) / 287**2
    np.testing.assert_allclose(depths, expected, rtol=0.35)


DEPTH = 0.8


def under(power_w: float, mains_hz: float, x_mm: float) -> World:
    """Return a world with a robot without noise below a lamp that flickers."""
    lamp = f"[[lamp]]\nx_mm = 300\ny_mm = 250\nz_mm = 1000\npower_w = {power_w}\nflicker = {DEPTH}\n"
    text = scene(f"[lighting]\nmains_hz = {mains_hz}\n", lamp).replace("x_mm = 300", f"x_mm = {x_mm}")
    return World(playpen.parse(text, "scene"), noise=False, seed=5)


def scans(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of 100 scans: proximity and ambient counts (100, 8)."""
    rows: list[np.ndarray] = []
    for _ in range(100):
        world.advance_to(world.time_ns + 20_000_000)
        rows.append(world.robots[0].registers.copy())
    return np.array(rows)[:, PROXIMITY], np.array(rows)[:, AMBIENT]


@pytest.mark.parametrize(("mains_hz", "repeat"), [(50, 1), (50.5, 50), (52, 25)])
def test_flicker_is_a_beat_of_the_mains_with_the_scan(mains_hz: float, repeat: int) -> None:
    _, readings = scans(under(400, mains_hz, 300))
    assert (readings[repeat:] == readings[:-repeat]).all()
    if repeat > 1:
        assert (np.ptp(readings, axis=0) > 30).all()


def test_sensors_see_flicker_in_the_order_of_the_scan() -> None:
    # Each is converted 2.5 ms after the one before it.
    _, readings = scans(under(400, 52, 300))
    light = KHEPERA1.dark_counts - readings
    parts = light / light.mean(axis=0) - 1
    times = 0.02 * np.arange(100)[:, None] + 0.0025 * np.arange(8)
    phase = under(400, 52, 300).simulation.plain.light.law.flicker_phase
    np.testing.assert_allclose(parts, DEPTH * np.cos(2 * np.pi * (104 * times + phase)), atol=0.08)


def test_light_that_changes_between_the_two_conversions_of_a_sensor_is_added_to_its_proximity() -> None:
    near, low = scans(under(400, 52, 1000 - 27.5 - 24))
    sensor, scale = 3, 1023 / (KHEPERA1.dark_counts - KHEPERA1.floor_counts)
    swing = np.ptp(low[:, sensor]) / 2
    # A sine of this amplitude changes by so much in 1.25 ms.
    change = 2 * math.sin(math.pi * 104 * 0.00125) * swing * scale
    assert 10 < near[:, sensor].min() < near[:, sensor].max() < 850
    assert np.ptp(near[:, sensor]) / 2 == pytest.approx(change, rel=0.08)
    assert change > 20


def test_light_that_rises_between_the_two_conversions_raises_the_proximity() -> None:
    world = under(400, 52, 1000 - 27.5 - 24)
    near, low = scans(world)
    sensor, scale = 3, 1023 / (KHEPERA1.dark_counts - KHEPERA1.floor_counts)
    phase, times = world.simulation.plain.light.law.flicker_phase, 0.02 * np.arange(100) + 0.0025 * sensor
    before, after = (np.cos(2 * np.pi * (104 * (times + delay) + phase)) for delay in (0, 0.00125))
    rise = np.ptp(low[:, sensor]) / 2 * scale * (after - before)
    changes = near[:, sensor] - near[:, sensor].mean()
    np.testing.assert_allclose(changes, rise - rise.mean(), atol=0.15 * np.ptp(rise))


def test_in_light_that_saturates_a_receiver_nothing_flickers() -> None:
    text = scene(LAMP.replace("x_mm = 700", "x_mm = 345") + "flicker = 0.5\n", "[lighting]\nmains_hz = 52\n")
    near, low = scans(World(playpen.parse(text, "scene"), noise=False))
    assert (low[:, LEFT_10] == KHEPERA1.floor_counts).all()
    assert (near[:, LEFT_10] == 0).all()


def test_a_lamp_is_seen_by_a_robot_that_turns_towards_it() -> None:
    bearings = {heading: counts(scene(LAMP, heading_deg=heading))[2] for heading in range(-180, 180, 10)}
    brightest = min(bearings, key=lambda heading: bearings[heading])
    assert abs(brightest) <= 10
    assert bearings[-180] == DARK

"""Walls and blocks, thin ones above all: contacts where the robot touches them, and a robot that stays in."""

import math

import mujoco
import numpy as np
import pytest

from checks.edges import COMMANDS
from khep_twin import playpen, units
from khep_twin.clock import NS_PER_S
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.world import World

THICKNESSES_MM = (1, 2, 3, 5, 8, 20, 60)
CASES = [(1, 50, 7), (1, 50, 12), (2, 20, 13), (5, 50, 10)]
"""Thickness [mm], height [mm] and seed, all of which overturned the robot or flung it away."""


def with_wall(thickness_mm: float, table: str) -> Playpen:
    wall = f"[[wall]]\npoints_mm = [[300, 100], [300, 200]]\nthickness_mm = {thickness_mm}\n"
    block = f"[[block]]\nx_mm = 300\ny_mm = 150\nlength_mm = {thickness_mm}\nwidth_mm = 100\nheight_mm = 50\n"
    return playpen.parse(
        'version = 1\nname = "thin"\n[arena]\nwidth_mm = 600\nheight_mm = 300\n'
        + (wall if table == "wall" else block)
        + "[[robot]]\nx_mm = 200\ny_mm = 120\nheading_deg = 0\n",
        "thin",
    )


@pytest.mark.share(2)
@pytest.mark.parametrize("table", ["wall", "block"])
@pytest.mark.parametrize("thickness_mm", THICKNESSES_MM)
def test_a_contact_is_as_deep_as_the_robot_reaches_into_a_wall(thickness_mm: float, table: str) -> None:
    model = to_spec(with_wall(thickness_mm, table)).compile()
    data = mujoco.MjData(model)
    start = int(model.joint("khepera0/pose").qposadr[0])
    shell = model.geom("khepera0/shell").id
    rng = np.random.default_rng(1)
    half = np.array([thickness_mm / 2000, 0.05])
    looked = 0
    while looked < 200:
        x, y = rng.uniform((0.265, 0.065), (0.335, 0.235))
        off = np.abs([x - 0.3, y - 0.15]) - half
        reach = math.hypot(*np.maximum(off, 0)) if off.max() > 0 else off.max()
        if not 0.0005 < (depth := units.BODY_RADIUS - reach) < 0.008:
            continue
        looked += 1
        data.qpos[start : start + 2] = x, y
        mujoco.mj_fwdPosition(model, data)
        depths = [contact.dist for contact in data.contact if shell in contact.geom]
        assert -min(depths) == pytest.approx(depth, abs=0.0001), (x, y)


WALLS = """
[[wall]]
points_mm = [[100, 60], [100, 240]]
thickness_mm = {t}
height_mm = {h}
[[wall]]
points_mm = [[300, 60], [300, 150], [390, 150]]
thickness_mm = {t}
height_mm = {h}
[[block]]
x_mm = 200
y_mm = 250
length_mm = {t}
width_mm = 40
height_mm = {h}
angle_deg = 30
"""


@pytest.mark.parametrize(("thickness_mm", "height_mm", "seed"), CASES)
def test_a_robot_at_full_speed_among_thin_walls_stays_upright(
    thickness_mm: float, height_mm: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    text = (
        'version = 1\nname = "thin"\n[arena]\nwidth_mm = 400\nheight_mm = 300\n'
        f"wall_thickness_mm = {thickness_mm}\nwall_height_mm = {height_mm}\n"
        + WALLS.format(t=thickness_mm, h=height_mm)
        + f"[[robot]]\nx_mm = 200\ny_mm = 100\nheading_deg = {rng.uniform(0, 360)}\n"
    )
    world = World(playpen.parse(text, "thin"), noise=False)
    start = int(world.model.joint("khepera0/pose").qposadr[0])
    while world.time_ns < 10 * NS_PER_S:
        left, right = COMMANDS[rng.integers(len(COMMANDS))]
        world.robots[0].send(b"D,%d,%d\n" % (left, right))
        until_ns = world.time_ns + int(rng.integers(10, 150)) * units.TICK_NS
        while world.time_ns < until_ns:
            world.advance_to(world.time_ns + units.TICK_NS)
            x, y, z, _, qx, qy, _ = world.data.qpos[start : start + 7]
            assert 0 < x < 0.4
            assert 0 < y < 0.3
            assert abs(z) < 0.008
            assert 1 - 2 * (qx * qx + qy * qy) > math.cos(math.radians(16))
            assert math.hypot(*world.data.qvel[:2]) < 1.1

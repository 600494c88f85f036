"""Turrets are drawn from above as they stand in the physics."""

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull  # pyright: ignore[reportMissingTypeStubs]

from khep_twin.playpen import Playpen
from khep_twin.web.scene import TurretParts, _hull, _points, start_parts
from khep_twin.world import World


def spans(parts: list[list[list[float]]]) -> NDArray[np.float64]:
    """Return the least and the greatest x and y of parts [mm]."""
    corners = np.vstack([np.array(part) for part in parts])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def test_a_gripper_at_start_is_up_with_its_fingers_open() -> None:
    parts = start_parts("gripper")
    (left, bottom), (right, top) = spans([part["points_mm"] for part in parts])
    assert (bottom, top) == pytest.approx((-31, 31), abs=0.01)  # of the palm and the bars
    assert left == pytest.approx(-26.5, abs=0.5)  # of the board
    assert right < 30
    assert all(len(part["rgb"]) == 3 for part in parts)


def test_the_parts_of_a_robot_in_a_world_are_where_its_joints_have_them() -> None:
    world = World(Playpen.load("gripper"))
    parts = TurretParts(world, 0)
    start = [part["points_mm"] for part in start_parts("gripper")]
    assert spans(parts.corners()) == pytest.approx(spans(start), abs=0.05)
    joint = world.model.joint("khepera0/gripper/shoulder")
    world.data.qpos[joint.qposadr[0]] = 0
    mujoco.mj_kinematics(world.model, world.data)
    # Shoulder 10 mm behind the centre, fingers 62 mm before it, of 33 mm.
    assert spans(parts.corners())[1, 0] == pytest.approx(-10 + 62 + 16.5, abs=0.1)
    assert TurretParts(World(Playpen.load("obstacles")), 0).corners() == []


@pytest.mark.parametrize(
    ("geom", "half"),
    [
        ('type="box" size="1 2 3"', (1, 2)),
        ('type="cylinder" size="2 1"', (2, 2)),
        ('type="sphere" size="2"', (2, 2)),
        ('type="ellipsoid" size="1 2 3"', (1, 2)),
        ('type="capsule" size="1 2" euler="90 0 0"', (1, 3)),
    ],
)
def test_any_geom_has_its_outline(geom: str, half: tuple[float, float]) -> None:
    text = f'<mujoco><worldbody><body name="part"><geom {geom}/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points = _points(model, 0) @ data.geom_xmat[0].reshape(3, 3).T
    assert np.abs(points).max(axis=0)[:2] == pytest.approx(half, rel=0.02)


def test_an_outline_is_the_convex_hull() -> None:
    points = np.random.default_rng(1).normal(size=(200, 2)).round(2)
    expected = points[ConvexHull(points).vertices]
    assert sorted(_hull(points.tolist())) == sorted(expected.tolist())
    assert _hull([[0, 0], [1, 1], [2, 2], [1, 1]]) == [[0, 0], [2, 2]]

"""Ray casting: the scene as the sensors' arithmetic queries it, rays and poses of the sensors.

This is the only part of the sensors that differs between plain and compiled `optics`: here MuJoCo is called
by its Python module and positions are read as lists, which are fastest in Python.
`khep_twin.rollout.compiled_casting` has the same functions for compiled code.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, PROXIMITY, Registers
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_indices import RobotIndices

if TYPE_CHECKING:
    from khep_twin.sensing.optics import Proximity

Floats = NDArray[np.float64]

FEW, MANY = 0, 1
"""Numbers of points on a bulb: 9 or 64."""

LENGTH_AND_NORMAL = 4
"""Numbers per ray that the rangefinders of assets/khepera.xml give."""


class Scene(NamedTuple):
    """A compiled scene as one robot's sensors see it.

    Attributes:
        model: Model of the scene.
        data: State of the scene.
        body: Body of the robot, which its own rays ignore.
        frame: Orientation of that body, live (9,).
        positions: Positions of the sensors, live, each (3,) [m].
        frames: Orientations of the sensors, live, each (9,).
        rays: Readings of the rangefinders, live, each (4 n_rays,): length [m] and normal of each ray.
        reflectances: Reflectances of all geoms (n_geoms,).
        geoms: Buffer for the geoms that rays hit (n_rays,).
        lengths: Buffer for the rays' lengths (n_rays,).
        discs: Points of a bulb, few and many.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    body: int
    frame: Floats
    positions: list[Floats]
    frames: list[Floats]
    rays: list[Floats]
    reflectances: Floats
    geoms: NDArray[np.int32]
    lengths: Floats
    discs: "tuple[Disc, Disc]"


class Disc(NamedTuple):
    """Points of a disc of radius 1, and buffers for rays to them.

    Attributes:
        across: Coordinate of each point to the left (n, 1).
        up: Coordinate of each point upwards (n, 1).
        geoms: Geoms that the rays have hit (n,).
        hits: Lengths of the rays (n,).
    """

    across: Floats
    up: Floats
    geoms: NDArray[np.int32]
    hits: Floats


def scene_of(model: mujoco.MjModel, data: mujoco.MjData, robot: RobotIndices) -> Scene:
    """Return the scene of a robot's sensors."""
    rays = [data.sensordata[part] for part in robot.rays]
    n_rays = len(rays[0]) // LENGTH_AND_NORMAL
    discs = [points_of_a_bulb(number) for number in (FEW, MANY)]
    few, many = (
        Disc(points[:, :1].copy(), points[:, 1:].copy(), np.zeros(len(points), np.int32), points[:, 0].copy())
        for points in discs
    )
    return Scene(
        model,
        data,
        robot.base,
        data.xmat[robot.base],
        [data.cam_xpos[camera] for camera in robot.cameras],
        [data.cam_xmat[camera] for camera in robot.cameras],
        rays,
        model.geom_user[:, 0],
        np.zeros(n_rays, np.int32),
        np.zeros(n_rays),
        (few, many),
    )


def points_of_a_bulb(number: int) -> Floats:
    """Return points of a disc of radius 1 (n, 2): FEW decide between all and nothing, MANY give the part."""
    if number == FEW:  # its centre, and points near its edge
        turns = np.arange(8) * math.pi / 4
        return np.concatenate([[[0.0, 0.0]], 0.97 * np.column_stack([np.cos(turns), np.sin(turns)])])
    # A sunflower pattern, evenly spread and symmetric.
    seeds = np.arange(32)
    turns, radii = seeds * math.pi * (3 - math.sqrt(5)), np.sqrt((seeds + 0.5) / len(seeds))
    half = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)])
    return np.concatenate([half, half * (-1, 1)])


def body_frame(scene: Scene) -> list[float]:
    """Return the orientation of the robot: rows of a matrix (9,)."""
    return scene.frame.tolist()


def position(scene: Scene, channel: int) -> list[float]:
    """Return the position of a sensor (3,) [m]."""
    return scene.positions[channel].tolist()


def sensor_frame(scene: Scene, channel: int) -> list[float]:
    """Return the orientation of a sensor (9,), which looks against its third axis."""
    return scene.frames[channel].tolist()


def rays(scene: Scene, proximity: "Proximity", channel: int, level: float, found: list[float]) -> int:
    """Fill in length [m], below 0 for a miss, and normal of each ray of a sensor.

    The rangefinders have cast them already; compiled code casts them where something may be near enough to
    count.

    Args:
        scene: Scene of the robot.
        proximity: Numbers of proximity.
        channel: Number of the sensor.
        level: Reading with nothing in view, before clipping [counts].
        found: Buffer to fill (4 n_rays,).

    Returns:
        Number of values filled in; 0 where no ray matters.
    """
    found[:] = scene.rays[channel].tolist()
    return len(found)


def direction(
    scene: Scene, frame: Sequence[float], channel: int, ray: int, tangential: float
) -> tuple[float, float, float]:
    """Return the direction of a ray in the world, computed as MuJoCo does, to the last bit.

    Args:
        scene: Scene of the robot; unused here, like `channel` and `ray`.
        frame: Orientation of the sensor (9,).
        channel: Number of the sensor.
        ray: Number of the ray.
        tangential: Tangent of its angle off the sensor's axis.
    """
    return through(frame, tangential)


def through(frame: Sequence[float], tangential: float) -> tuple[float, float, float]:
    """Return the unit vector of a ray at a tangent off the axis of a frame."""
    x, y = frame[0] * tangential - frame[2], frame[3] * tangential - frame[5]
    z = frame[6] * tangential - frame[8]
    scale = 1 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


def surfaces(scene: Scene, channel: int, directions: list[float], cutoff: float, found: list[float]) -> None:
    """Cast a sensor's rays again, as rangefinders do not report what they hit.

    Args:
        scene: Scene of the robot.
        channel: Number of the sensor.
        directions: Directions of the rays in the world (3 n_rays,).
        cutoff: Range of the rays [m].
        found: Buffer for the reflectances (n_rays,), undefined where nothing is hit.
    """
    mujoco.mj_multiRay(
        scene.model,
        scene.data,
        scene.positions[channel],
        np.array(directions),
        None,
        True,
        scene.body,
        scene.geoms,
        scene.lengths,
        None,
        len(scene.geoms),
        cutoff,
    )
    found[:] = scene.reflectances[scene.geoms].tolist()


def stopped(scene: Scene, channel: int, x: float, y: float, z: float, glass: float) -> bool:
    """Return whether light along a vector from a sensor [m] is stopped before a part of it, 0 to 1."""
    ray_direction = np.array((x, y, z))
    position = scene.positions[channel]
    hit = mujoco.mj_ray(scene.model, scene.data, position, ray_direction, None, True, scene.body, None)
    return 0 <= hit < glass


def blocked(
    scene: Scene,
    channel: int,
    disc: int,
    left: tuple[float, float, float],
    up: tuple[float, float, float],
    ray_direction: tuple[float, float, float],
    cutoff: float,
    glass: float,
) -> float:
    """Return the part of the rays from a sensor to points of a bulb that is stopped before its glass.

    Args:
        scene: Scene of the robot.
        channel: Number of the sensor.
        disc: FEW or MANY points.
        left: Vector to the bulb's left edge, as seen from the sensor [m].
        up: Vector to the bulb's upper edge [m].
        ray_direction: Vector from the sensor to the bulb's centre [m].
        cutoff: Range of the rays, in lengths of `ray_direction`.
        glass: Start of the bulb, in lengths of `ray_direction`.
    """
    points = scene.discs[disc]
    # Element by element, so that the result is the same to the last bit on any machine.
    frame = np.array((left, up, ray_direction))
    ray_directions = points.across * frame[0] + points.up * frame[1] + frame[2]
    mujoco.mj_multiRay(
        scene.model,
        scene.data,
        scene.positions[channel],
        ray_directions.ravel(),
        None,
        True,
        scene.body,
        points.geoms,
        points.hits,
        None,
        len(points.hits),
        cutoff,
    )
    stopped = 0
    for hit in points.hits.tolist():
        stopped += 0 <= hit < glass
    return stopped / len(points.hits)


def heading(qpos: Vector[float], pose: int) -> tuple[float, float]:
    """Return cosine and sine of the heading of an upright robot.

    Args:
        qpos: Positions of the scene's joints.
        pose: Index of the robot's free joint in `qpos`.
    """
    w, x, y, z = qpos[pose + 3], qpos[pose + 4], qpos[pose + 5], qpos[pose + 6]
    return 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)


def step(scene: Scene) -> None:
    """Run one step of the physics."""
    mujoco.mj_step(scene.model, scene.data)


def decide(
    function: Callable[..., tuple[float, float]],
    registers: Registers,
    memory: Vector[float],
    genes: Vector[float],
    speeds: Vector[float],
) -> None:
    """Call a controller.

    Args:
        function: Function of proximity (8,), ambient (8,), memory and genes.
        registers: Registers of the board (N_REGISTERS,).
        memory: State of the controller.
        genes: Parameters of the controller, which it does not change.
        speeds: Buffer for the returned speeds, left and right (2,); NaN where its arithmetic fails, as in a
            division by 0.
    """
    board = np.asarray(registers)
    proximity, ambient = board[PROXIMITY[0] : PROXIMITY[-1] + 1], board[AMBIENT[0] : AMBIENT[-1] + 1]
    try:
        speeds[0], speeds[1] = function(proximity, ambient, memory, genes)
    except ArithmeticError:
        speeds[0] = speeds[1] = math.nan

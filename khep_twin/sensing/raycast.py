"""Casting: what the sensors' arithmetic asks of a scene, a few rays and where the sensors are.

This is the only part of the sensors that differs between the arithmetic as it stands, `optics`, and its
compiled form: here MuJoCo is called by its Python module and places are read as lists, which is what Python
is quickest with. `khep_twin.rollout.compiled_casting` has the same functions for compiled code.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.units import Sensor

Floats = NDArray[np.float64]

FEW, MANY = 0, 1
"""How many points of a bulb are looked at: 9 or 64."""

LENGTH_AND_NORMAL = 4
"""Numbers per ray that the rangefinders of assets/khepera.xml give."""


class Scene(NamedTuple):
    """A compiled scene as one robot's sensors see it.

    Attributes:
        model: the scene.
        data: its state.
        body: of the robot, whose own rays go out of it.
        frame: of that body, live (9,).
        positions: of the sensors, live, each (3,) [m].
        frames: of the sensors, live, each (9,).
        rays: what the rangefinders have found, live, each (4 n_rays,): length [m] and normal of each ray.
        reflectances: of all geoms (n_geoms,).
        geoms: room for what rays hit (n_rays,).
        lengths: room for how long they are (n_rays,).
        discs: points of a bulb, few and many.
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
    """Points of a disc of radius 1, and room for rays to them.

    Attributes:
        across: of each point, to the left (n, 1).
        up: of each point (n, 1).
        geoms: what the rays have hit (n,).
        hits: how long they are (n,).
    """

    across: Floats
    up: Floats
    geoms: NDArray[np.int32]
    hits: Floats


def scene_of(model: mujoco.MjModel, data: mujoco.MjData, prefix: str) -> Scene:
    """What the sensors of the robot with this prefix, e.g. "khepera0/", see."""
    body = model.body(prefix + "base").id
    cameras = [model.camera(prefix + sensor.name.lower()).id for sensor in Sensor]
    rays = [data.sensordata[part] for part in ray_slices(model, prefix)]
    n_rays = len(rays[0]) // LENGTH_AND_NORMAL
    discs = [points_of_a_bulb(number) for number in (FEW, MANY)]
    few, many = (
        Disc(points[:, :1].copy(), points[:, 1:].copy(), np.zeros(len(points), np.int32), points[:, 0].copy())
        for points in discs
    )
    return Scene(
        model,
        data,
        body,
        data.xmat[body],
        [data.cam_xpos[camera] for camera in cameras],
        [data.cam_xmat[camera] for camera in cameras],
        rays,
        model.geom_user[:, 0],
        np.zeros(n_rays, np.int32),
        np.zeros(n_rays),
        (few, many),
    )


def ray_slices(model: mujoco.MjModel, prefix: str) -> list[slice]:
    """Where in the scene's sensor data each sensor's rays are."""
    sensors = [model.sensor(f"{prefix}{sensor.name.lower()}_rays") for sensor in Sensor]
    return [slice(int(sensor.adr[0]), int(sensor.adr[0]) + int(sensor.dim[0])) for sensor in sensors]


def points_of_a_bulb(number: int) -> Floats:
    """Points of a disc of radius 1 (n, 2); FEW tell whether all is in sight or nothing, MANY how much."""
    if number == FEW:  # its middle, and near its edge
        turns = np.arange(8) * math.pi / 4
        return np.concatenate([[[0.0, 0.0]], 0.97 * np.column_stack([np.cos(turns), np.sin(turns)])])
    # Spread evenly, as a sunflower has its seeds, left as right.
    seeds = np.arange(32)
    turns, radii = seeds * math.pi * (3 - math.sqrt(5)), np.sqrt((seeds + 0.5) / len(seeds))
    half = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)])
    return np.concatenate([half, half * (-1, 1)])


def body_frame(scene: Scene) -> list[float]:
    """How the robot is turned: rows of a matrix (9,)."""
    return scene.frame.tolist()


def position(scene: Scene, channel: int) -> list[float]:
    """Where a sensor is (3,) [m]."""
    return scene.positions[channel].tolist()


def sensor_frame(scene: Scene, channel: int) -> list[float]:
    """How a sensor is turned (9,); it looks against its third axis."""
    return scene.frames[channel].tolist()


def rays(scene: Scene, near: Any, channel: int, level: float, found: list[float]) -> int:
    """Fills in length [m], below 0 for one that hits nothing, and normal of each ray of a sensor.

    They are all there already, as the rangefinders have found them; compiled code casts them where something
    may be near enough to count.

    Args:
        scene: in which.
        near: how proximity comes about.
        channel: of the sensor.
        level: what it reads with nothing in view, before it is cut off [counts].
        found: is filled (4 n_rays,).

    Returns:
        How many numbers were filled in; 0 where no ray matters.
    """
    found[:] = scene.rays[channel].tolist()
    return len(found)


def direction(
    scene: Scene, frame: Sequence[float], channel: int, ray: int, aside: float
) -> tuple[float, float, float]:
    """Where a ray goes in the world, reckoned as MuJoCo does, to the last bit.

    Args:
        scene: in which; like the next but one it is for those who have directions ready.
        frame: of the sensor (9,).
        channel: of the sensor.
        ray: which of its rays.
        aside: tangent of its angle off the sensor's axis.
    """
    return through(frame, aside)


def through(frame: Sequence[float], aside: float) -> tuple[float, float, float]:
    """Unit vector of a ray at a tangent off the axis of a frame."""
    x, y, z = frame[0] * aside - frame[2], frame[3] * aside - frame[5], frame[6] * aside - frame[8]
    scale = 1 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


def surfaces(scene: Scene, channel: int, directions: list[float], cutoff: float, found: list[float]) -> None:
    """Casts a sensor's rays again, as rangefinders do not tell what they hit.

    Args:
        scene: in which.
        channel: of the sensor.
        directions: of the rays in the world (3 n_rays,).
        cutoff: how far [m].
        found: is filled with the reflectances (n_rays,), anything where nothing is hit.
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
    """Whether light along a vector from a sensor [m] is stopped before a part of it, 0 to 1."""
    way = np.array((x, y, z))
    position = scene.positions[channel]
    hit = mujoco.mj_ray(scene.model, scene.data, position, way, None, True, scene.body, None)
    return 0 <= hit < glass


def blocked(
    scene: Scene,
    channel: int,
    disc: int,
    left: tuple[float, float, float],
    up: tuple[float, float, float],
    way: tuple[float, float, float],
    cutoff: float,
    glass: float,
) -> float:
    """Which part of the rays from a sensor to points of a bulb is stopped before the bulb's glass.

    Args:
        scene: in which.
        channel: of the sensor.
        disc: FEW or MANY points.
        left: to the bulb's edge, as seen from the sensor [m].
        up: likewise [m].
        way: from the sensor to the bulb's centre [m].
        cutoff: how far rays go, in lengths of the way.
        glass: where the bulb begins, likewise.
    """
    points = scene.discs[disc]
    # Element by element, so that it is the same to the last bit on any machine.
    frame = np.array((left, up, way))
    ways = points.across * frame[0] + points.up * frame[1] + frame[2]
    mujoco.mj_multiRay(
        scene.model,
        scene.data,
        scene.positions[channel],
        ways.ravel(),
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


def heading(qpos: Sequence[float], pose: int) -> tuple[float, float]:
    """Cosine and sine of a robot's heading, as far as it stands upright.

    Args:
        qpos: of the scene.
        pose: where in it the robot's free joint is.
    """
    w, x, y, z = qpos[pose + 3], qpos[pose + 4], qpos[pose + 5], qpos[pose + 6]
    return 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)


def step(scene: Scene) -> None:
    """One step of the physics."""
    mujoco.mj_step(scene.model, scene.data)


def decide(
    function: Callable[..., tuple[float, float]], registers: Any, memory: Any, genes: Any, speeds: Any
) -> None:
    """Calls a controller.

    Args:
        function: of proximity (8,), ambient (8,), memory and genes.
        registers: the board's (N_REGISTERS,).
        memory: the controller's own, that lasts.
        genes: the controller's own, that it does not change.
        speeds: are filled with what it returns, left and right (2,); with no numbers where its arithmetic
            fails, as in a division by 0.
    """
    board = np.asarray(registers)
    proximity, ambient = board[PROXIMITY[0] : PROXIMITY[-1] + 1], board[AMBIENT[0] : AMBIENT[-1] + 1]
    try:
        speeds[0], speeds[1] = function(proximity, ambient, memory, genes)
    except ArithmeticError:
        speeds[0] = speeds[1] = math.nan

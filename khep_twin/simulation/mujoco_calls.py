"""MuJoCo's scene for compiled code: the queries of `sensing.scene`, by addresses of MuJoCo's functions.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false, reportGeneralTypeIssues=false

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.sensing import scene as queries
from khep_twin.sensing.buffers import as_records
from khep_twin.sensing.mujoco_scene import fixed, points_of_a_bulb, upright, visible
from khep_twin.sensing.robot_sensors import chip_behind
from khep_twin.sensing.scene import FASTEST, FEW, MANY
from khep_twin.sensing.seen_surfaces import add_upright
from khep_twin.simulation.addresses import function_address, object_address
from khep_twin.simulation.foreign import (
    address_of,
    call_controller,
    call_ray_geom,
    call_step,
    implements,
    load,
    load_int,
    store,
)

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class Addresses(NamedTuple):
    """Addresses of MuJoCo's functions and arrays, their lengths, and buffers.

    Attributes:
        step: Function mj_step.
        ray_geom: Function mju_rayGeom.
        model: Model.
        data: State.
        qpos: Positions of joints (n_qpos,).
        qvel: Speeds of joints (n_qvel,).
        ctrl: Motor voltages.
        force: Actuator forces.
        xpos: Positions of bodies (n_xpos,).
        xmat: Orientations of bodies (n_bodies, 9).
        cam_xpos: Positions of cameras (n_cameras, 3).
        cam_xmat: Orientations of cameras (n_cameras, 9).
        geom_xpos: Positions of geoms (n_geoms, 3).
        geom_xmat: Orientations of geoms (n_geoms, 9).
        geom_size: Sizes of geoms (n_geoms, 3).
        warnings: Counters of warnings, every second number (n_warnings,).
        n_qpos: Number of joint positions.
        n_qvel: Number of joint speeds.
        n_xpos: Number of coordinates of bodies.
        n_warnings: Number of kinds of warnings.
        way: Buffer for a ray's direction (3,).
        few: Few points of a bulb (9, 2).
        many: Many points of a bulb (64, 2).
    """

    step: int
    ray_geom: int
    model: int
    data: int
    qpos: int
    qvel: int
    ctrl: int
    force: int
    xpos: int
    xmat: int
    cam_xpos: int
    cam_xmat: int
    geom_xpos: int
    geom_xmat: int
    geom_size: int
    warnings: int
    n_qpos: int
    n_qvel: int
    n_xpos: int
    n_warnings: int
    way: Any
    few: Any
    many: Any


class Solid(NamedTuple):
    """A geom that is drawn.

    Attributes:
        geom: Index of the geom.
        kind: Type of the geom.
        body: Its body.
        seen: 1 if proximity sensors see it, which is not so of floor and paint.
        fixed: 1 if it cannot move; what follows up to `top` is its shape then, as of `mujoco_scene.upright`.
        x: Centre, x [m].
        y: Centre, y [m].
        cosine: Cosine of its angle.
        sine: Sine of its angle.
        half: Half of its length, or radius [m].
        width: Half of its width [m]; below 0 for a cylinder.
        bottom: Lowest height [m].
        top: Highest height [m].
        bound: Radius of its bounding sphere [m].
        reflectance: Infrared reflectance.
    """

    geom: int = 0
    kind: int = 0
    body: int = 0
    seen: int = 0
    fixed: int = 0
    x: float = 0.0
    y: float = 0.0
    cosine: float = 1.0
    sine: float = 0.0
    half: float = 0.0
    width: float = 0.0
    bottom: float = 0.0
    top: float = 0.0
    bound: float = 0.0
    reflectance: float = 0.0


class MujocoCalls(NamedTuple):
    """MuJoCo's scene for compiled code.

    Attributes:
        at: Addresses, as a record of `Addresses`.
        solids: Geoms that are drawn, in MuJoCo's order, as records of `Solid` (n,).
    """

    at: np.void
    solids: NDArray[np.void]


def calls_of(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return a scene for compiled code, as the arrays of `MujocoCalls`; model and state must outlive it."""
    names = ("qpos", "qvel", "ctrl", "xpos", "xmat", "cam_xpos", "cam_xmat", "geom_xpos", "geom_xmat")
    at = Addresses(
        step=function_address("mj_step"),
        ray_geom=function_address("mju_rayGeom"),
        model=object_address(model),
        data=object_address(data),
        **{name: getattr(data, name).ctypes.data for name in names},
        force=data.actuator_force.ctypes.data,
        geom_size=model.geom_size.ctypes.data,
        warnings=data.warning.number.ctypes.data,
        n_qpos=data.qpos.size,
        n_qvel=data.qvel.size,
        n_xpos=data.xpos.size,
        n_warnings=len(data.warning.number),
        way=np.zeros(3),
        few=points_of_a_bulb(FEW),
        many=points_of_a_bulb(MANY),
    )
    drawn, seen = np.flatnonzero(model.geom_rgba[:, 3] > 0).tolist(), set(visible(model))
    solids = [_solid(model, geom, geom in seen) for geom in drawn]
    return as_records([at], at), as_records(solids, Solid())


def _solid(model: mujoco.MjModel, geom: int, seen: bool) -> Solid:
    solid = Solid(
        geom,
        int(model.geom_type[geom]),
        int(model.geom_bodyid[geom]),
        seen=int(seen),
        bound=float(model.geom_rbound[geom]),
        reflectance=float(model.geom_user[geom, 0]),
    )
    shape = fixed(model, geom)
    if shape is None or not seen:
        return solid
    (x, y), (cosine, sine), (half, width), (bottom, top) = shape
    return Solid(*solid[:4], 1, x, y, cosine, sine, half, width, bottom, top, *solid[-2:])


@implements(queries.step, MujocoCalls)
def _step(scene):
    call_step(scene.at.step, scene.at.model, scene.at.data)


@implements(queries.in_bounds, MujocoCalls)
def _in_bounds(scene, limit):
    at = scene.at
    if not _square(at.xpos, at.n_xpos) <= at.n_xpos * limit * limit:
        return False
    speeds = _square(at.qvel, at.n_qvel)
    return speeds <= at.n_qvel * FASTEST * FASTEST and _square(at.qpos, at.n_qpos) < np.inf


@compilable
def _square(address, count):
    total = 0.0
    for i in range(count):
        number = load(address, i)
        total += number * number
    return total


@implements(queries.warned, MujocoCalls)
def _warned(scene):
    for i in range(scene.at.n_warnings):
        if load_int(scene.at.warnings, 2 * i):
            return True
    return False


@implements(queries.pose, MujocoCalls)
def _pose(scene, index):
    qpos = scene.at.qpos
    w, x, y, z = load(qpos, index + 3), load(qpos, index + 4), load(qpos, index + 5), load(qpos, index + 6)
    return load(qpos, index), load(qpos, index + 1), 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)


@implements(queries.joint_position, MujocoCalls)
def _joint_position(scene, index):
    return load(scene.at.qpos, index)


@implements(queries.joint_speed, MujocoCalls)
def _joint_speed(scene, index):
    return load(scene.at.qvel, index)


@implements(queries.motor_torque, MujocoCalls)
def _motor_torque(scene, index):
    return load(scene.at.force, index)


@implements(queries.set_motor, MujocoCalls)
def _set_motor(scene, index, voltage):
    store(scene.at.ctrl, index, voltage)


@implements(queries.body_frame, MujocoCalls)
def _body_frame(scene, sensors):
    return _nine(scene.at.xmat, sensors.base)


@implements(queries.chip, MujocoCalls)
def _chip(scene, sensors, channel):
    camera = sensors.cameras[channel]
    place, frame = _three(scene.at.cam_xpos, camera), _nine(scene.at.cam_xmat, camera)
    return chip_behind(place, frame, sensors.proximity, channel)


@implements(queries.position, MujocoCalls)
def _position(scene, sensors, channel):
    return _three(scene.at.cam_xpos, sensors.cameras[channel])


@compilable
def _three(address, index):
    return load(address, 3 * index), load(address, 3 * index + 1), load(address, 3 * index + 2)


@compilable
def _flat(address, index):
    return load(address, 3 * index), load(address, 3 * index + 1)


@compilable
def _nine(address, index):
    first, second, third = 3 * index, 3 * index + 1, 3 * index + 2
    return _three(address, first) + _three(address, second) + _three(address, third)


@implements(queries.surfaces, MujocoCalls)
def _surfaces(scene, sensors, channel, chip, needed):
    found, count = sensors.proximity.found, 0
    for i in range(len(scene.solids)):
        solid = scene.solids[i]
        geom = solid.geom
        if not solid.seen or solid.body == sensors.base:
            continue
        if solid.fixed:
            cx, cy = solid.x, solid.y
        else:
            cx, cy = _flat(scene.at.geom_xpos, geom)
        dx, dy, limit = cx - chip.x, cy - chip.y, solid.bound + chip.reach + 1e-9
        if dx * dx + dy * dy > limit * limit:
            continue
        turn, half, span = (solid.cosine, solid.sine), (solid.half, solid.width), (solid.bottom, solid.top)
        shape = (cx, cy), turn, half, span
        if not solid.fixed:
            place, turned = _three(scene.at.geom_xpos, geom), _nine(scene.at.geom_xmat, geom)
            shape = upright(solid.kind, _three(scene.at.geom_size, geom), place, turned)
        count = add_upright(found, count, chip, shape, solid.reflectance)
    return count


@implements(queries.stopped, MujocoCalls)
def _stopped(scene, sensors, channel, way, glass):
    scene.at.way[0], scene.at.way[1], scene.at.way[2] = way
    return _stops(scene, sensors.base, sensors.cameras[channel], way[0], way[1], glass)


@implements(queries.blocked, MujocoCalls)
def _blocked(scene, sensors, channel, disc, left, up, way, glass):
    n = len(scene.at.few) if disc == FEW else len(scene.at.many)
    hits, to = 0, scene.at.way
    for point in range(n):
        across, upward = scene.at.many[point, 0], scene.at.many[point, 1]
        if disc == FEW:
            across, upward = scene.at.few[point, 0], scene.at.few[point, 1]
        x = across * left[0] + upward * up[0] + way[0]
        y = across * left[1] + upward * up[1] + way[1]
        to[0], to[1], to[2] = x, y, across * left[2] + upward * up[2] + way[2]
        if _stops(scene, sensors.base, sensors.cameras[channel], x, y, glass):
            hits += 1
    return hits / n


@compilable
def _stops(scene, base, camera, x, y, glass):
    """Return whether anything stops light on the way from a sensor before the bulb's glass."""
    place = _three(scene.at.cam_xpos, camera)
    flat = x * x + y * y
    length = np.sqrt(flat)
    for i in range(len(scene.solids)):
        solid = scene.solids[i]
        if solid.body == base:
            continue
        if solid.kind != _PLANE:
            cx, cy = _flat(scene.at.geom_xpos, solid.geom)
            dx, dy = cx - place[0], cy - place[1]
            bound = (solid.bound + 1e-9) * length
            ahead, tangential = dx * x + dy * y, dx * y - dy * x
            if ahead < -bound or ahead - bound > flat or abs(tangential) > bound:
                continue
        hit = _length(scene, solid, camera)
        if 0 <= hit < glass:
            return True
    return False


@compilable
def _length(scene, solid, camera):
    """Return MuJoCo's length of a ray along `way` from a camera to a geom."""
    at, geom = scene.at, solid.geom
    return call_ray_geom(
        at.ray_geom,
        at.geom_xpos + 24 * geom,
        at.geom_xmat + 72 * geom,
        at.geom_size + 24 * geom,
        at.cam_xpos + 24 * camera,
        address_of(at.way),
        solid.kind,
        0,
    )


@implements(queries.decide)
def _decide(function, registers, memory, genes, speeds):
    call_controller(
        function,
        address_of(registers),
        address_of(memory),
        len(memory),
        address_of(genes),
        len(genes),
        address_of(speeds),
    )

"""MuJoCo's scene for compiled code: the queries of `sensing.scene`, by the addresses of MuJoCo's functions.

Imported only where numba is installed.
"""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false, reportGeneralTypeIssues=false

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.sensing import scene as queries
from khep_twin.sensing.buffers import as_records
from khep_twin.sensing.mujoco_scene import bulb_points, fixed_shape, is_floor, upright_shape, visible_geoms
from khep_twin.sensing.robot_sensors import chip_behind
from khep_twin.sensing.scene import COARSE, FINE, MAX_SPEED
from khep_twin.sensing.seen_surfaces import add_upright
from khep_twin.simulation.addresses import function_address, object_address
from khep_twin.simulation.foreign import (
    address_of,
    call_ray_geom,
    call_update,
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
        kinematics: Function mj_kinematics.
        com_pos: Function mj_comPos.
        cam_light: Function mj_camlight.
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
        moments: Recorded moments (n, n_moment).
        warnings: Counters of warnings, at every second int32 (n_warnings,).
        n_qpos: Number of joint positions.
        n_qvel: Number of joint speeds.
        n_xpos: Number of coordinates of bodies.
        n_warnings: Number of kinds of warnings.
        n_moment: Numbers of a recorded moment: joint positions, then powers of lamps.
        ray: Buffer for a ray's vector (3,).
        start: Buffer for a ray's start (3,).
        normal: Buffer for the normal at a ray's end (3,).
        coarse: COARSE points of a bulb (9, 2).
        fine: FINE points of a bulb (64, 2).
    """

    step: int
    kinematics: int
    com_pos: int
    cam_light: int
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
    moments: int
    warnings: int
    n_qpos: int
    n_qvel: int
    n_xpos: int
    n_warnings: int
    n_moment: int
    ray: Any
    start: Any
    normal: Any
    coarse: Any
    fine: Any


class Solid(NamedTuple):
    """A visible geom.

    Attributes:
        geom: Index of the geom.
        geom_type: Type of the geom.
        body: Body of the geom.
        is_visible: 1 if proximity sensors see it, 0 for floor and paint.
        is_floor: 1 for floor and paint, which return no echo.
        is_fixed: 1 if it cannot move; only then the fields from `x` to `top` are set.
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
    geom_type: int = 0
    body: int = 0
    is_visible: int = 0
    is_floor: int = 0
    is_fixed: int = 0
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
        address: Addresses, as a record of `Addresses`.
        solids: Visible geoms, in MuJoCo's order, as records of `Solid` (n,).
    """

    address: np.void
    solids: NDArray[np.void]


def make_calls(
    model: mujoco.MjModel, data: mujoco.MjData, moments: NDArray[np.float64]
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return a scene for compiled code, as the arrays of `MujocoCalls`; the arguments must outlive it.

    Args:
        model: Compiled scene.
        data: State of the scene.
        moments: Recorded moments, as for `MujocoScene`.
    """
    array_names = ("qpos", "qvel", "ctrl", "xpos", "xmat", "cam_xpos", "cam_xmat", "geom_xpos", "geom_xmat")
    addresses = Addresses(
        step=function_address("mj_step"),
        kinematics=function_address("mj_kinematics"),
        com_pos=function_address("mj_comPos"),
        cam_light=function_address("mj_camlight"),
        ray_geom=function_address("mju_rayGeom"),
        model=object_address(model),
        data=object_address(data),
        **{name: getattr(data, name).ctypes.data for name in array_names},
        force=data.actuator_force.ctypes.data,
        geom_size=model.geom_size.ctypes.data,
        moments=moments.ctypes.data,
        warnings=data.warning.number.ctypes.data,
        n_qpos=data.qpos.size,
        n_qvel=data.qvel.size,
        n_xpos=data.xpos.size,
        n_warnings=len(data.warning.number),
        n_moment=moments.shape[1],
        ray=np.zeros(3),
        start=np.zeros(3),
        normal=np.zeros(3),
        coarse=bulb_points(COARSE),
        fine=bulb_points(FINE),
    )
    drawn_geoms, visible = np.flatnonzero(model.geom_rgba[:, 3] > 0).tolist(), set(visible_geoms(model))
    floor = is_floor(model)
    solids = [_make_solid(model, geom, geom in visible, floor[geom]) for geom in drawn_geoms]
    return as_records([addresses], addresses), as_records(solids, Solid())


def _make_solid(model: mujoco.MjModel, geom: int, is_visible: bool, is_floor: bool) -> Solid:
    solid = Solid(
        geom,
        int(model.geom_type[geom]),
        int(model.geom_bodyid[geom]),
        is_visible=int(is_visible),
        is_floor=int(is_floor),
        bound=float(model.geom_rbound[geom]),
        reflectance=float(model.geom_user[geom, 0]),
    )
    shape = fixed_shape(model, geom)
    if shape is None or not is_visible:
        return solid
    (x, y), (cosine, sine), (half, width), (bottom, top) = shape
    return Solid(*solid[:5], 1, x, y, cosine, sine, half, width, bottom, top, *solid[-2:])


@implements(queries.step, MujocoCalls)
def _step(scene):
    call_update(scene.address.step, scene.address.model, scene.address.data)


@implements(queries.in_bounds, MujocoCalls)
def _in_bounds(scene, limit):
    addresses = scene.address
    if not _sum_of_squares(addresses.xpos, addresses.n_xpos) <= addresses.n_xpos * limit * limit:
        return False
    speeds = _sum_of_squares(addresses.qvel, addresses.n_qvel)
    joints = _sum_of_squares(addresses.qpos, addresses.n_qpos)
    return speeds <= addresses.n_qvel * MAX_SPEED * MAX_SPEED and joints < np.inf


@compilable
def _sum_of_squares(address, count):
    total = 0.0
    for i in range(count):
        number = load(address, i)
        total += number * number
    return total


@implements(queries.has_warned, MujocoCalls)
def _has_warned(scene):
    for i in range(scene.address.n_warnings):
        if load_int(scene.address.warnings, 2 * i):
            return True
    return False


@implements(queries.pose, MujocoCalls)
def _pose(scene, index):
    qpos = scene.address.qpos
    w, x, y, z = load(qpos, index + 3), load(qpos, index + 4), load(qpos, index + 5), load(qpos, index + 6)
    return load(qpos, index), load(qpos, index + 1), 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)


@implements(queries.joint_position, MujocoCalls)
def _joint_position(scene, index):
    return load(scene.address.qpos, index)


@implements(queries.joint_speed, MujocoCalls)
def _joint_speed(scene, index):
    return load(scene.address.qvel, index)


@implements(queries.motor_torque, MujocoCalls)
def _motor_torque(scene, index):
    return load(scene.address.force, index)


@implements(queries.set_motor, MujocoCalls)
def _set_motor(scene, index, voltage):
    store(scene.address.ctrl, index, voltage)


@implements(queries.body_frame, MujocoCalls)
def _body_frame(scene, sensors):
    return _matrix(scene.address.xmat, sensors.base)


@implements(queries.chip, MujocoCalls)
def _chip(scene, sensors, channel):
    camera = sensors.cameras[channel]
    position, frame = _vector(scene.address.cam_xpos, camera), _matrix(scene.address.cam_xmat, camera)
    return chip_behind(position, frame, sensors.proximity, channel)


@implements(queries.position, MujocoCalls)
def _position(scene, sensors, channel):
    return _vector(scene.address.cam_xpos, sensors.cameras[channel])


@compilable
def _vector(address, index):
    return load(address, 3 * index), load(address, 3 * index + 1), load(address, 3 * index + 2)


@compilable
def _xy(address, index):
    return load(address, 3 * index), load(address, 3 * index + 1)


@compilable
def _matrix(address, index):
    first, second, third = 3 * index, 3 * index + 1, 3 * index + 2
    return _vector(address, first) + _vector(address, second) + _vector(address, third)


@implements(queries.surfaces, MujocoCalls)
def _surfaces(scene, sensors, channel, chip, min_light):
    buffer, count = sensors.proximity.surfaces, 0
    for i in range(len(scene.solids)):
        solid = scene.solids[i]
        geom = solid.geom
        if not solid.is_visible or solid.body == sensors.base:
            continue
        if solid.is_fixed:
            cx, cy = solid.x, solid.y
        else:
            cx, cy = _xy(scene.address.geom_xpos, geom)
        dx, dy, limit = cx - chip.x, cy - chip.y, solid.bound + chip.reach + 1e-9
        if dx * dx + dy * dy > limit * limit:
            continue
        span = solid.bottom, solid.top
        shape = (cx, cy), (solid.cosine, solid.sine), (solid.half, solid.width), span
        if not solid.is_fixed:
            size, position = _vector(scene.address.geom_size, geom), _vector(scene.address.geom_xpos, geom)
            shape = upright_shape(solid.geom_type, size, position, _matrix(scene.address.geom_xmat, geom))
        count = add_upright(buffer, count, chip, shape, solid.reflectance)
    return count


@implements(queries.is_blocked, MujocoCalls)
def _query_blocked(scene, sensors, channel, ray, glass):
    scene.address.ray[0], scene.address.ray[1], scene.address.ray[2] = ray
    return _is_blocked(scene, sensors.base, sensors.cameras[channel], ray[0], ray[1], glass)


@implements(queries.hidden_part, MujocoCalls)
def _hidden_part(scene, sensors, channel, disc, left, up, ray, glass):
    n_points = len(scene.address.coarse) if disc == COARSE else len(scene.address.fine)
    n_blocked, buffer = 0, scene.address.ray
    for point in range(n_points):
        across, upward = scene.address.fine[point, 0], scene.address.fine[point, 1]
        if disc == COARSE:
            across, upward = scene.address.coarse[point, 0], scene.address.coarse[point, 1]
        x = across * left[0] + upward * up[0] + ray[0]
        y = across * left[1] + upward * up[1] + ray[1]
        buffer[0], buffer[1], buffer[2] = x, y, across * left[2] + upward * up[2] + ray[2]
        if _is_blocked(scene, sensors.base, sensors.cameras[channel], x, y, glass):
            n_blocked += 1
    return n_blocked / n_points


@compilable
def _is_blocked(scene, base, camera, x, y, glass):
    """Return whether a solid blocks the ray in `address.ray`, with these x and y, before the bulb's glass."""
    origin = _vector(scene.address.cam_xpos, camera)
    square = x * x + y * y
    length = np.sqrt(square)
    for i in range(len(scene.solids)):
        solid = scene.solids[i]
        if solid.body == base:
            continue
        if solid.geom_type != _PLANE:
            cx, cy = _xy(scene.address.geom_xpos, solid.geom)
            dx, dy = cx - origin[0], cy - origin[1]
            bound = (solid.bound + 1e-9) * length
            along, across = dx * x + dy * y, dx * y - dy * x
            if along < -bound or along - bound > square or abs(across) > bound:
                continue
        hit = _ray_length(scene, solid, scene.address.cam_xpos + 24 * camera, 0)
        if 0 <= hit < glass:
            return True
    return False


@compilable
def _ray_length(scene, solid, start, normal):
    """Return MuJoCo's length of the ray in the buffer from an address to a geom, negative for no hit."""
    addresses, geom = scene.address, solid.geom
    return call_ray_geom(
        addresses.ray_geom,
        addresses.geom_xpos + 24 * geom,
        addresses.geom_xmat + 72 * geom,
        addresses.geom_size + 24 * geom,
        start,
        address_of(addresses.ray),
        solid.geom_type,
        normal,
    )


@implements(queries.update_frames, MujocoCalls)
def _update_frames(scene):
    addresses = scene.address
    call_update(addresses.kinematics, addresses.model, addresses.data)
    call_update(addresses.com_pos, addresses.model, addresses.data)
    call_update(addresses.cam_light, addresses.model, addresses.data)


@implements(queries.save_moment, MujocoCalls)
def _save_moment(scene, moment, powers):
    addresses = scene.address
    first = moment * addresses.n_moment
    for i in range(addresses.n_qpos):
        store(addresses.moments, first + i, load(addresses.qpos, i))
    for i in range(len(powers)):
        store(addresses.moments, first + addresses.n_qpos + i, powers[i])


@implements(queries.copy_moment, MujocoCalls)
def _copy_moment(scene, source, destination):
    moments, count = scene.address.moments, scene.address.n_moment
    for i in range(count):
        store(moments, destination * count + i, load(moments, source * count + i))


@implements(queries.sensor_frame, MujocoCalls)
def _sensor_frame(scene, sensors, channel):
    return _matrix(scene.address.cam_xmat, sensors.cameras[channel])


@implements(queries.ray, MujocoCalls)
def _ray(scene, sensors, start, direction):
    addresses = scene.address
    addresses.start[0], addresses.start[1], addresses.start[2] = start
    addresses.ray[0], addresses.ray[1], addresses.ray[2] = direction
    nearest, reflectance = -1.0, 0.0
    for i in range(len(scene.solids)):
        solid = scene.solids[i]
        if solid.body == sensors.base or not _may_meet(scene, solid, start, direction):
            continue
        length = _ray_length(scene, solid, address_of(addresses.start), 0)
        if length >= 0 and (length < nearest or nearest < 0):
            nearest, reflectance = length, solid.reflectance
    return nearest, reflectance


@compilable
def _may_meet(scene, solid, start, direction):
    """Return whether the line of a ray with a unit vector passes through a geom's bounding sphere."""
    if solid.geom_type == _PLANE:
        return True
    centre = _vector(scene.address.geom_xpos, solid.geom)
    x, y, z = centre[0] - start[0], centre[1] - start[1], centre[2] - start[2]
    along, bound = x * direction[0] + y * direction[1] + z * direction[2], solid.bound + 1e-6
    return along > -bound and x * x + y * y + z * z - along * along <= bound * bound


@implements(queries.cast_rays, MujocoCalls)
def _cast_rays(scene, sensors, beams, start, reach):
    lengths, solids = beams.lengths, beams.geoms
    scene.address.start[0], scene.address.start[1], scene.address.start[2] = start
    for ray in range(len(lengths)):
        lengths[ray], solids[ray] = reach, -1
    for i in range(len(scene.solids)):
        if scene.solids[i].body != sensors.base and not _is_behind(scene, scene.solids[i], beams, start):
            _cast_to_solid(scene, i, beams, start)
    for ray in range(len(lengths)):
        if solids[ray] < 0 or scene.solids[solids[ray]].is_floor:
            lengths[ray] = -1.0


@compilable
def _is_behind(scene, solid, beams, start):
    """Return whether a geom lies behind a beam, whose middle ray is its axis."""
    if solid.geom_type == _PLANE:
        return False
    centre, axis = _vector(scene.address.geom_xpos, solid.geom), 3 * (len(beams.lengths) // 2)
    along = (centre[0] - start[0]) * beams.vectors[axis] + (centre[1] - start[1]) * beams.vectors[axis + 1]
    return along + (centre[2] - start[2]) * beams.vectors[axis + 2] < -solid.bound - 1e-6


@compilable
def _cast_to_solid(scene, index, beams, start):
    """Shorten the rays of a beam that end at a geom, by its index in `solids`."""
    addresses, solid, lengths, vectors = scene.address, scene.solids[index], beams.lengths, beams.vectors
    buffer, normal = addresses.ray, addresses.normal
    for ray in range(len(lengths)):
        x, y, z = vectors[3 * ray], vectors[3 * ray + 1], vectors[3 * ray + 2]
        if not _may_meet(scene, solid, start, (x, y, z)):
            continue
        buffer[0], buffer[1], buffer[2] = x, y, z
        length = _ray_length(scene, solid, address_of(addresses.start), address_of(normal))
        if 0 <= length < lengths[ray]:
            lengths[ray], beams.geoms[ray] = length, index
            for axis in range(3):
                beams.normals[3 * ray + axis] = normal[axis]

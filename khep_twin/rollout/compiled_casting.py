"""`raycast` for compiled code: the same queries of the scene, by the addresses of MuJoCo's functions.

Imported only where numba is installed.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from typing import NamedTuple

import mujoco
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from khep_twin.rollout.addresses import function_address, object_address
from khep_twin.sensing import raycast
from khep_twin.sensing.raycast import FEW, LENGTH_AND_NORMAL, MANY, Floats
from khep_twin.sensing.robot_indices import RobotIndices

__all__ = ["FEW", "LENGTH_AND_NORMAL", "MANY"]


_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class CompiledScene(NamedTuple):
    """A compiled scene as one robot's sensors see it; live arrays are views of MuJoCo's own memory.

    Attributes:
        calls: Addresses of mj_step, the model, its state and mju_rayGeom.
        body: Body of the robot, which its own rays ignore.
        frame: Rotation matrix of that body, live (9,).
        cameras: Cameras of the sensors (8,).
        positions: Positions of all cameras, live (n_cameras, 3) [m].
        frames: Rotation matrices of all cameras, live (n_cameras, 9).
        solid: Geoms that rays can hit, in MuJoCo's order (n_solid,).
        kinds: Types of these geoms (n_solid,).
        extents: Extents of these geoms (n_solid, 8): centre x, y, cosine and sine of the angle, half length
            and width, or radius and -1 [m], bottom and top [m]; the length is below 0 for a geom that is not
            upright or may move.
        bounds: Radii of their bounding spheres (n_solid,) [m].
        places: Positions of all geoms, live (n_geoms, 3) [m].
        turns: Rotation matrices of all geoms, live (n_geoms, 9).
        sizes: Sizes of all geoms (n_geoms, 3) [m].
        reflectances: Reflectances of all geoms (n_geoms,).
        geoms: Buffer for the geoms that rays hit (n_rays,).
        ray_directions: Buffer for a ray's direction (3,).
        normal: Buffer for a surface normal (3,).
        few: Few points of a bulb (9, 2).
        many: Many points of a bulb (64, 2).
    """

    calls: NDArray[np.int64]
    body: int
    frame: Floats
    cameras: NDArray[np.int64]
    positions: Floats
    frames: Floats
    solid: NDArray[np.int64]
    kinds: NDArray[np.int64]
    extents: Floats
    bounds: Floats
    places: Floats
    turns: Floats
    sizes: Floats
    reflectances: Floats
    geoms: NDArray[np.int32]
    ray_directions: Floats
    normal: Floats
    few: Floats
    many: Floats


def scene_of(model: mujoco.MjModel, data: mujoco.MjData, robot: RobotIndices) -> CompiledScene:
    """Return the scene of a robot's sensors; model and state must outlive it."""
    rays = robot.rays[0]
    addresses = [function_address("mj_step"), object_address(model), object_address(data)]
    # Visible geoms, except those of the robot's own body.
    solid = np.flatnonzero((model.geom_rgba[:, 3] > 0) & (model.geom_bodyid != robot.base))
    return CompiledScene(
        np.array([*addresses, function_address("mju_rayGeom")], np.int64),
        robot.base,
        data.xmat[robot.base],
        np.array(robot.cameras, np.int64),
        data.cam_xpos,
        data.cam_xmat,
        solid.astype(np.int64),
        model.geom_type[solid].astype(np.int64),
        np.array([_extent(model, geom) for geom in solid.tolist()]).reshape(-1, 8),
        model.geom_rbound[solid].copy(),
        data.geom_xpos,
        data.geom_xmat,
        model.geom_size,
        model.geom_user[:, 0].copy(),
        np.zeros(rays.stop - rays.start, np.int32),
        np.zeros(3),
        np.zeros(3),
        raycast.points_of_a_bulb(FEW),
        raycast.points_of_a_bulb(MANY),
    )


def _extent(model: mujoco.MjModel, geom: int) -> list[float]:
    """Return a row of `CompiledScene.extents`."""
    x, y, z = model.geom_pos[geom].tolist()
    w, qx, qy, qz = model.geom_quat[geom].tolist()
    size, kind = model.geom_size[geom].tolist(), int(model.geom_type[geom])
    fixed = model.geom_bodyid[geom] == 0 and abs(qx) + abs(qy) < 1e-12
    box, cylinder = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CYLINDER)
    if not fixed or kind not in (box, cylinder):
        return [0.0, 0.0, 1.0, 0.0, -1.0, -1.0, 0.0, 0.0]
    half = size[2] if kind == box else size[1]
    sides = size[:2] if kind == box else [size[0], -1.0]
    angle = 2 * np.arctan2(qz, w)
    return [x, y, float(np.cos(angle)), float(np.sin(angle)), *sides, z - half, z + half]


@njit
def step(scene):
    """Advance the physics by one step."""
    _call_step(scene.calls[0], scene.calls[1], scene.calls[2])


@njit
def body_frame(scene):
    """Return the same as `raycast.body_frame`."""
    return scene.frame


@njit
def position(scene, channel):
    """Return the same as `raycast.position`."""
    return scene.positions[scene.cameras[channel]]


@njit
def sensor_frame(scene, channel):
    """Return the same as `raycast.sensor_frame`."""
    return scene.frames[scene.cameras[channel]]


_through = njit(raycast.through)


@njit
def direction(scene, frame, channel, ray, tangential):
    """Return the same as `raycast.direction`."""
    return _through(frame, tangential)


@njit
def rays(scene, proximity, channel, level, found):
    """Cast the same rays as `raycast.rays`, but none if nothing can be near enough to count."""
    reach = np.inf
    if level < 0:
        # A thing this far away just fails to pass the threshold; a margin is added for rounding.
        reach = np.sqrt(proximity.gain[channel] * proximity.brightest / -level) - proximity.offset[channel]
        reach = reach * (1 + 1e-9) + 1e-9
    camera = scene.cameras[channel]
    frame, place = scene.frames[camera], scene.positions[camera]
    if not _anything_within(scene, frame, place, reach):
        return 0
    tangential = proximity.tangential[channel]
    for ray in range(len(tangential)):
        x, y, z = _through(frame, tangential[ray])
        scene.ray_directions[0], scene.ray_directions[1], scene.ray_directions[2] = x, y, z
        _cast_one(scene, place, x, y, z, ray, found)
    return len(found)


@njit
def _anything_within(scene, frame, place, reach):
    """Return whether anything solid may be within reach [m] in front of a sensor; False is certain."""
    if reach <= 0:
        return False
    if reach == np.inf:
        return True
    x, y, z = place[0], place[1], place[2]
    ahead_x, ahead_y = -frame[2], -frame[5]
    # Rays incline no more than the sensor's own axes do together.
    rise = reach * (abs(frame[6]) + abs(frame[8]))
    for i in range(len(scene.solid)):
        cx, cy = scene.extents[i, 0], scene.extents[i, 1]
        half, other = scene.extents[i, 4], scene.extents[i, 5]
        if half < 0:
            if scene.kinds[i] == _PLANE:
                if z - rise <= 0:
                    return True
                continue
            at = scene.places[scene.solid[i]]
            cx, cy, half = at[0], at[1], scene.bounds[i]
        elif z + rise < scene.extents[i, 6] or z - rise > scene.extents[i, 7]:
            continue
        dx, dy = cx - x, cy - y
        if other < 0:
            limit = reach + half
            if dx * dx + dy * dy <= limit * limit and dx * ahead_x + dy * ahead_y + half >= 0:
                return True
            continue
        cosine, sine = scene.extents[i, 2], scene.extents[i, 3]
        along, across = abs(dx * cosine + dy * sine), abs(dy * cosine - dx * sine)
        beside, before = max(along - half, 0.0), max(across - other, 0.0)
        if beside * beside + before * before <= reach * reach:
            # Distance ahead of its farthest corner.
            most = half * abs(cosine * ahead_x + sine * ahead_y)
            most += other * abs(cosine * ahead_y - sine * ahead_x)
            if dx * ahead_x + dy * ahead_y + most >= 0:
                return True
    return False


@njit
def _cast_one(scene, place, x, y, z, ray, found):
    """Find the first geom that a ray hits: each is tested in MuJoCo's order, by MuJoCo."""
    first = LENGTH_AND_NORMAL * ray
    best, geom = -1.0, -1
    for k in range(4):
        found[first + k] = 0.0
    flat = x * x + y * y
    for i in range(len(scene.solid)):
        here = scene.solid[i]
        if scene.kinds[i] != _PLANE:
            dx, dy = scene.places[here, 0] - place[0], scene.places[here, 1] - place[1]
            bound = scene.bounds[i] + 1e-9
            ahead, tangential = dx * x + dy * y, dx * y - dy * x
            if ahead < -bound or tangential * tangential > bound * bound * flat:
                continue
            if best >= 0 and ahead - bound > best * flat + 1e-9:
                continue
        length = _length(scene, i, place, scene.normal.ctypes.data)
        if length >= 0 and (best < 0 or length < best):
            best, geom = length, here
            for k in range(3):
                found[first + 1 + k] = scene.normal[k]
    found[first] = best
    scene.geoms[ray] = geom


@njit
def surfaces(scene, channel, directions, cutoff, found):
    """Fill in the same as `raycast.surfaces`, from what `rays` has hit."""
    for ray in range(len(found)):
        geom = scene.geoms[ray]
        found[ray] = scene.reflectances[geom] if geom >= 0 else 0.0


@njit
def stopped(scene, channel, x, y, z, glass):
    """Return the same as `raycast.stopped`."""
    scene.ray_directions[0], scene.ray_directions[1], scene.ray_directions[2] = x, y, z
    return _stops(scene, scene.positions[scene.cameras[channel]], x, y, glass)


@njit
def blocked(scene, channel, disc, left, up, ray_direction, cutoff, glass):
    """Return the same as `raycast.blocked`."""
    points = scene.few if disc == FEW else scene.many
    place = scene.positions[scene.cameras[channel]]
    n = len(points)
    hits = 0
    for point in range(n):
        across, upward = points[point, 0], points[point, 1]
        x = across * left[0] + upward * up[0] + ray_direction[0]
        y = across * left[1] + upward * up[1] + ray_direction[1]
        scene.ray_directions[0], scene.ray_directions[1] = x, y
        scene.ray_directions[2] = across * left[2] + upward * up[2] + ray_direction[2]
        if _stops(scene, place, x, y, glass):
            hits += 1
    return hits / n


@njit
def _stops(scene, place, x, y, glass):
    """Return whether anything stops light on a path before the bulb's glass."""
    flat = x * x + y * y
    length = np.sqrt(flat)
    for i in range(len(scene.solid)):
        here = scene.solid[i]
        if scene.kinds[i] != _PLANE:
            dx, dy = scene.places[here, 0] - place[0], scene.places[here, 1] - place[1]
            bound = (scene.bounds[i] + 1e-9) * length
            ahead, tangential = dx * x + dy * y, dx * y - dy * x
            if ahead < -bound or ahead - bound > flat or abs(tangential) > bound:
                continue
        hit = _length(scene, i, place, np.int64(0))
        if 0 <= hit < glass:
            return True
    return False


heading = njit(raycast.heading)


@njit
def _length(scene, i, place, normal):
    """Return MuJoCo's length of a ray along `ray_directions` to a geom; the normal's address may be 0."""
    here = scene.solid[i]
    return _call_ray_geom(
        scene.calls[3],
        scene.places[here].ctypes.data,
        scene.turns[here].ctypes.data,
        scene.sizes[here].ctypes.data,
        place.ctypes.data,
        scene.ray_directions.ctypes.data,
        scene.kinds[i],
        normal,
    )


@njit
def decide(function, registers, memory, genes, speeds):
    """Call a compiled controller by its address (`compiled.address_of`)."""
    _call_controller(
        function,
        registers.ctypes.data,
        memory.ctypes.data,
        len(memory),
        genes.ctypes.data,
        len(genes),
        speeds.ctypes.data,
    )


_ADDRESS, _BYTE_POINTER = types.intp, ir.IntType(8).as_pointer()
_INT, _DOUBLE = ir.IntType(32), ir.DoubleType()


def _foreign(builder, arguments, kinds, result):
    """Call the function at the address of the first argument; the others' kinds are C types."""
    given = []
    for value, kind in zip(arguments[1:], kinds, strict=True):
        if isinstance(kind, ir.PointerType):
            value = builder.inttoptr(value, kind)
        elif isinstance(kind, ir.IntType) and kind.width < value.type.width:
            value = builder.trunc(value, kind)
        given.append(value)
    function = builder.inttoptr(arguments[0], ir.FunctionType(result, kinds).as_pointer())
    return builder.call(function, given)


@intrinsic
def _call_step(typing_context, function, model, data):
    def generate(context, builder, signature, arguments):
        _foreign(builder, arguments, [_BYTE_POINTER] * 2, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 3), generate


@intrinsic
def _call_ray_geom(typing_context, function, place, turn, size, point, ray_direction, kind, normal):
    def generate(context, builder, signature, arguments):
        kinds = [*[_BYTE_POINTER] * 5, _INT, _BYTE_POINTER]
        return _foreign(builder, arguments, kinds, _DOUBLE)

    return types.float64(*[_ADDRESS] * 8), generate


@intrinsic
def _call_controller(typing_context, function, registers, memory, n_memory, genes, n_genes, speeds):
    def generate(context, builder, signature, arguments):
        address = ir.IntType(64)
        _foreign(builder, arguments, [address] * 6, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 7), generate

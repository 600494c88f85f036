"""`casting` for compiled code: the same questions to the scene, asked of MuJoCo by address.

Only imported where numba is installed.
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

from khep_twin.rollout.addresses import data_address, function_address, model_address
from khep_twin.sensing import raycast
from khep_twin.sensing.raycast import FEW, LENGTH_AND_NORMAL, MANY, Floats
from khep_twin.units import Sensor

__all__ = ["FEW", "LENGTH_AND_NORMAL", "MANY"]


_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class Scene(NamedTuple):
    """A compiled scene as one robot's sensors see it; live arrays lie in MuJoCo's own memory.

    Attributes:
        calls: addresses of mj_step, the model, its state and mju_rayGeom.
        body: of the robot, whose own rays go out of it.
        frame: of that body, live (9,).
        cameras: of the sensors (8,).
        positions: of all cameras, live (n_cameras, 3) [m].
        frames: of all cameras, live (n_cameras, 9).
        solid: geoms that rays can hit, in MuJoCo's order (n_solid,).
        kinds: their types (n_solid,).
        extents: what each takes of the floor (n_solid, 8): centre x, y, cosine and sine of its angle, half
            length and width, or radius and -1 [m], bottom and top [m]; the length is below 0 for one that is
            not upright or may move.
        bounds: radius of a ball around each (n_solid,) [m].
        places: of all geoms, live (n_geoms, 3) [m].
        turns: of all geoms, live (n_geoms, 9).
        sizes: of all geoms (n_geoms, 3) [m].
        reflectances: of all geoms (n_geoms,).
        geoms: room for what rays hit (n_rays,).
        ways: room for where one goes (3,).
        normal: room for a surface's (3,).
        few: points of a bulb (9, 2).
        many: points of a bulb (64, 2).
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
    ways: Floats
    normal: Floats
    few: Floats
    many: Floats


def scene_of(model: mujoco.MjModel, data: mujoco.MjData, prefix: str) -> Scene:
    """What the sensors of the robot with this prefix see; model and state must outlive it."""
    body = model.body(prefix + "base").id
    cameras = [model.camera(prefix + sensor.name.lower()).id for sensor in Sensor]
    slices = raycast.ray_slices(model, prefix)
    addresses = [function_address("mj_step"), model_address(model), data_address(data)]
    # What is shown, but for the robot's own body.
    solid = np.flatnonzero((model.geom_rgba[:, 3] > 0) & (model.geom_bodyid != body))
    return Scene(
        np.array([*addresses, function_address("mju_rayGeom")], np.int64),
        body,
        data.xmat[body],
        np.array(cameras, np.int64),
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
        np.zeros(slices[0].stop - slices[0].start, np.int32),
        np.zeros(3),
        np.zeros(3),
        raycast.points_of_a_bulb(FEW),
        raycast.points_of_a_bulb(MANY),
    )


def _extent(model: mujoco.MjModel, geom: int) -> list[float]:
    """A row of `Scene.extents`."""
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
    """One step of the physics."""
    _call_step(scene.calls[0], scene.calls[1], scene.calls[2])


@njit
def body_frame(scene):
    """As `raycast.body_frame`."""
    return scene.frame


@njit
def position(scene, channel):
    """As `raycast.position`."""
    return scene.positions[scene.cameras[channel]]


@njit
def sensor_frame(scene, channel):
    """As `raycast.sensor_frame`."""
    return scene.frames[scene.cameras[channel]]


@njit
def direction(scene, frame, channel, ray, aside):
    """As `raycast.direction`."""
    return _through(frame, aside)


@njit
def _through(frame, aside):
    """As `raycast.through`."""
    x, y, z = frame[0] * aside - frame[2], frame[3] * aside - frame[5], frame[6] * aside - frame[8]
    scale = 1 / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@njit
def rays(scene, near, channel, level, found):
    """As `raycast.rays`, but none where nothing can be near enough to count."""
    reach = np.inf
    if level < 0:
        # What is this far off just fails to pass the threshold; a little more, for rounding.
        reach = np.sqrt(near.gain[channel] * near.brightest / -level) - near.offset[channel]
        reach = reach * (1 + 1e-9) + 1e-9
    camera = scene.cameras[channel]
    frame, place = scene.frames[camera], scene.positions[camera]
    if not _anything_within(scene, frame, place, reach):
        return 0
    aside = near.aside[channel]
    for ray in range(len(aside)):
        x, y, z = _through(frame, aside[ray])
        scene.ways[0], scene.ways[1], scene.ways[2] = x, y, z
        _cast_one(scene, place, x, y, z, ray, found)
    return len(found)


@njit
def _anything_within(scene, frame, place, reach):
    """Whether anything solid may be within reach [m] before a sensor; sure if it says no."""
    if reach <= 0:
        return False
    if reach == np.inf:
        return True
    x, y, z = place[0], place[1], place[2]
    ahead_x, ahead_y = -frame[2], -frame[5]
    # Rays lean no more than the sensor's own axes do together.
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
            # How far its farthest corner lies ahead.
            most = half * abs(cosine * ahead_x + sine * ahead_y)
            most += other * abs(cosine * ahead_y - sine * ahead_x)
            if dx * ahead_x + dy * ahead_y + most >= 0:
                return True
    return False


@njit
def _cast_one(scene, place, x, y, z, ray, found):
    """Finds the first thing that a ray hits: each is asked in MuJoCo's order, and by MuJoCo."""
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
            ahead, aside = dx * x + dy * y, dx * y - dy * x
            if ahead < -bound or aside * aside > bound * bound * flat:
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
    """As `raycast.surfaces`: what `rays` has hit with the same rays."""
    for ray in range(len(found)):
        geom = scene.geoms[ray]
        found[ray] = scene.reflectances[geom] if geom >= 0 else 0.0


@njit
def stopped(scene, channel, x, y, z, glass):
    """As `raycast.stopped`."""
    scene.ways[0], scene.ways[1], scene.ways[2] = x, y, z
    return _stops(scene, scene.positions[scene.cameras[channel]], x, y, glass)


@njit
def blocked(scene, channel, disc, left, up, way, cutoff, glass):
    """As `raycast.blocked`."""
    points = scene.few if disc == FEW else scene.many
    place = scene.positions[scene.cameras[channel]]
    n = len(points)
    hits = 0
    for point in range(n):
        across, upward = points[point, 0], points[point, 1]
        x = across * left[0] + upward * up[0] + way[0]
        y = across * left[1] + upward * up[1] + way[1]
        scene.ways[0], scene.ways[1] = x, y
        scene.ways[2] = across * left[2] + upward * up[2] + way[2]
        if _stops(scene, place, x, y, glass):
            hits += 1
    return hits / n


@njit
def _stops(scene, place, x, y, glass):
    """Whether light on a way is stopped before the bulb's glass: by anything, whichever is first."""
    flat = x * x + y * y
    length = np.sqrt(flat)
    for i in range(len(scene.solid)):
        here = scene.solid[i]
        if scene.kinds[i] != _PLANE:
            dx, dy = scene.places[here, 0] - place[0], scene.places[here, 1] - place[1]
            bound = (scene.bounds[i] + 1e-9) * length
            ahead, aside = dx * x + dy * y, dx * y - dy * x
            if ahead < -bound or ahead - bound > flat or abs(aside) > bound:
                continue
        hit = _length(scene, i, place, np.int64(0))
        if 0 <= hit < glass:
            return True
    return False


heading = njit(raycast.heading)


@njit
def _length(scene, i, place, normal):
    """How far a ray along `scene.ways` goes to a solid thing, by MuJoCo; the normal's address may be 0."""
    here = scene.solid[i]
    return _call_ray_geom(
        scene.calls[3],
        scene.places[here].ctypes.data,
        scene.turns[here].ctypes.data,
        scene.sizes[here].ctypes.data,
        place.ctypes.data,
        scene.ways.ctypes.data,
        scene.kinds[i],
        normal,
    )


@njit
def decide(function, registers, memory, genes, speeds):
    """Calls a compiled controller by its address (`compiled.address_of`)."""
    _call_controller(
        function,
        registers.ctypes.data,
        memory.ctypes.data,
        len(memory),
        genes.ctypes.data,
        len(genes),
        speeds.ctypes.data,
    )


_ADDRESS, _BYTE_POINTER, _INT, _DOUBLE = (
    types.intp,
    ir.IntType(8).as_pointer(),
    ir.IntType(32),
    ir.DoubleType(),
)


def _foreign(builder, arguments, kinds, result):
    """Calls the function at the address of the first argument; the others' kinds are C's."""
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
def _call_ray_geom(typing_context, function, place, turn, size, point, way, kind, normal):
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

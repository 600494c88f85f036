"""`casting` for compiled code: the same questions to the scene, asked of MuJoCo by address.

Only imported where numba is installed.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false

from typing import NamedTuple

import mujoco
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from khep_twin import casting
from khep_twin.casting import FEW, LENGTH_AND_NORMAL, MANY, WITHOUT_WHEELS, Floats
from khep_twin.kernel import N_REGISTERS
from khep_twin.scale.addresses import data_address, function_address, model_address
from khep_twin.units import Sensor

__all__ = ["FEW", "LENGTH_AND_NORMAL", "MANY"]


class Scene(NamedTuple):
    """A compiled scene as one robot's sensors see it; live arrays lie in MuJoCo's own memory.

    Attributes:
        calls: addresses of mj_step, mj_ray, mj_multiRay, the model, its state and the groups that stop light.
        body: of the robot, whose own rays go out of it.
        frame: of that body, live (9,).
        cameras: of the sensors (8,).
        positions: of all cameras, live (n_cameras, 3) [m].
        frames: of all cameras, live (n_cameras, 9).
        first: where each sensor's rays begin in `rays` (8,).
        n_rays: of a sensor.
        rays: the scene's sensor data, live.
        reflectances: of all geoms (n_geoms,).
        geoms: room for what rays hit (64,).
        lengths: room for how long they are (64,).
        ways: room for where they go (192,).
        few: points of a bulb (9, 2).
        many: points of a bulb (64, 2).
    """

    calls: NDArray[np.int64]
    body: int
    frame: Floats
    cameras: NDArray[np.int64]
    positions: Floats
    frames: Floats
    first: NDArray[np.int64]
    n_rays: int
    rays: Floats
    reflectances: Floats
    geoms: NDArray[np.int32]
    lengths: Floats
    ways: Floats
    few: Floats
    many: Floats


def scene_of(model: mujoco.MjModel, data: mujoco.MjData, prefix: str) -> Scene:
    """What the sensors of the robot with this prefix see; model and state must outlive it."""
    body = model.body(prefix + "base").id
    slices = casting.ray_slices(model, prefix)
    many = casting.points_of_a_bulb(MANY)
    calls = [function_address(name) for name in ("mj_step", "mj_ray", "mj_multiRay")]
    return Scene(
        np.array([*calls, model_address(model), data_address(data), WITHOUT_WHEELS.ctypes.data], np.int64),
        body,
        data.xmat[body],
        np.array([model.camera(prefix + sensor.name.lower()).id for sensor in Sensor], np.int64),
        data.cam_xpos,
        data.cam_xmat,
        np.array([part.start for part in slices], np.int64),
        (slices[0].stop - slices[0].start) // LENGTH_AND_NORMAL,
        data.sensordata,
        model.geom_user[:, 0].copy(),
        np.zeros(len(many), np.int32),
        np.zeros(len(many)),
        np.zeros(3 * len(many)),
        casting.points_of_a_bulb(FEW),
        many,
    )


@njit
def step(scene):
    """One step of the physics."""
    _call_step(scene.calls[0], scene.calls[3], scene.calls[4])


@njit
def body_frame(scene):
    """As `casting.body_frame`."""
    return scene.frame


@njit
def position(scene, channel):
    """As `casting.position`."""
    return scene.positions[scene.cameras[channel]]


@njit
def sensor_frame(scene, channel):
    """As `casting.sensor_frame`."""
    return scene.frames[scene.cameras[channel]]


@njit
def rays(scene, channel):
    """As `casting.rays`."""
    first = scene.first[channel]
    return scene.rays[first : first + LENGTH_AND_NORMAL * scene.n_rays]


@njit
def surfaces(scene, channel, directions, cutoff, found):
    """As `casting.surfaces`."""
    _cast(scene, channel, directions.ctypes.data, np.int64(0), scene.n_rays, cutoff)
    for ray in range(scene.n_rays):
        geom = scene.geoms[ray]
        found[ray] = scene.reflectances[geom] if geom >= 0 else 0.0


@njit
def way_clear(scene, channel, x, y, z):
    """As `casting.way_clear`."""
    scene.ways[0], scene.ways[1], scene.ways[2] = x, y, z
    calls = scene.calls
    at = scene.positions[scene.cameras[channel]].ctypes.data
    return _call_ray(calls[1], calls[3], calls[4], at, scene.ways.ctypes.data, calls[5], 1, scene.body)


@njit
def blocked(scene, channel, disc, left, up, way, cutoff, glass):
    """As `casting.blocked`."""
    points = scene.few if disc == FEW else scene.many
    n = len(points)
    for point in range(n):
        across, upward = points[point, 0], points[point, 1]
        scene.ways[3 * point] = across * left[0] + upward * up[0] + way[0]
        scene.ways[3 * point + 1] = across * left[1] + upward * up[1] + way[1]
        scene.ways[3 * point + 2] = across * left[2] + upward * up[2] + way[2]
    _cast(scene, channel, scene.ways.ctypes.data, scene.calls[5], n, cutoff)
    stopped = 0
    for point in range(n):
        if 0 <= scene.lengths[point] < glass:
            stopped += 1
    return stopped / n


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


@njit
def _cast(scene, channel, ways, groups, n, cutoff):
    calls = scene.calls
    at = scene.positions[scene.cameras[channel]].ctypes.data
    geoms, lengths = scene.geoms.ctypes.data, scene.lengths.ctypes.data
    _call_multi_ray(
        calls[2], calls[3], calls[4], at, ways, groups, 1, scene.body, geoms, lengths, np.int64(0), n, cutoff
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
def _call_ray(typing_context, function, model, data, point, way, groups, static, body):
    def generate(context, builder, signature, arguments):
        # No geom and no normal are asked for.
        nothing = ir.Constant(arguments[0].type, 0)
        kinds = [_BYTE_POINTER] * 5 + [_INT] * 2 + [_BYTE_POINTER] * 2
        return _foreign(builder, [*arguments, nothing, nothing], kinds, _DOUBLE)

    return types.float64(*[_ADDRESS] * 8), generate


@intrinsic
def _call_multi_ray(
    typing_context,
    function,
    model,
    data,
    point,
    ways,
    groups,
    static,
    body,
    geoms,
    lengths,
    normals,
    n,
    cutoff,
):
    def generate(context, builder, signature, arguments):
        kinds = [*[_BYTE_POINTER] * 5, _INT, _INT, *[_BYTE_POINTER] * 3, _INT, _DOUBLE]
        _foreign(builder, arguments, kinds, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 12, types.float64), generate


@intrinsic
def _call_controller(typing_context, function, registers, memory, n_memory, genes, n_genes, speeds):
    def generate(context, builder, signature, arguments):
        address = ir.IntType(64)
        _foreign(builder, arguments, [address] * 6, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 7), generate


REGISTERS = N_REGISTERS
"""How many numbers lie behind a controller's first address."""

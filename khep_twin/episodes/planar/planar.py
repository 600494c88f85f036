"""Plane of a playpen: the robot's constants and the obstacles around it, taken from MuJoCo's scene.

    setup = EpisodeSetup(Playpen.load("looping-maze"), planar=True)

Nothing here is fitted: masses, inertias, friction, motors, positions and heights are those of that scene.
"""

# numba is not typed.
# pyright: reportMissingTypeStubs=false

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.planar import plane as flat
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen_to_mjcf import SHELL_FRICTION
from khep_twin.sensing.mujoco_scene import visible
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.fitted_robots import pairs_of
from khep_twin.simulation.mujoco_forms import movable_names

LEAST_WIDTH_MM, MOST_SLENDER = 16.0, 3.0
"""Least width of a movable object [mm], and largest height over it: what is pushed at up to 320 mm/s in
MuJoCo tips over below these (measured: 10 mm wide and 30 mm high, 16 and 80, 20 and 80; not 16 and 50)."""

_PREFIX = "khepera0/"

Floats = NDArray[np.float64]


class PlanarScene:
    """Constants of a plane, from a scene; threads may share it.

    `JOINTS` are the indices of `step.RobotState` in it.

    Args:
        playpen: Playpen with one robot.
        model: Model of its scene.
        at: Indices of the robot.
        step_ns: Step of the plane [ns].

    Raises:
        PlaypenError: The playpen has a feature that a plane does not support.
    """

    JOINTS = flat.LEFT_ANGLE, flat.RIGHT_ANGLE, flat.LEFT_ANGLE, flat.RIGHT_ANGLE, 0, 1, flat.X

    def __init__(self, playpen: Playpen, model: mujoco.MjModel, at: RobotIndices, step_ns: int) -> None:
        _refuse_what_tips(playpen)
        robot = playpen.robots[0]
        self.position = robot.x_mm, robot.y_mm, robot.heading_deg
        self._step_ns = step_ns
        shell = model.geom(f"{_PREFIX}shell")
        low, high = _span(model, shell.id)
        self.height = float(model.cam_pos[at.cameras[0], 2])
        fixed = [geom for geom in visible(model) if model.geom_bodyid[geom] == 0]
        movable = [model.geom(name).id for name in movable_names(playpen)]
        upright = [*fixed, *movable]
        self.things = np.zeros((len(upright), flat.N_COLUMNS))
        for row, geom in zip(self.things, upright, strict=True):
            row[: flat.TOP + 1] = _thing(model, geom)
        self.things[:, flat.BODY] = -1
        self.things[len(fixed) :, flat.BODY] = range(len(movable))
        self.bodies = np.zeros((len(movable), flat.N_BODY))
        for row, thing in zip(self.bodies, range(len(fixed), len(upright)), strict=True):
            row[flat.THING] = thing
            row[flat.INVERSE_MASS : flat.FRICTION + 1] = _body(model, upright[thing], self.things[thing])
        bottoms, tops = self.things[:, flat.BOTTOM], self.things[:, flat.TOP]
        self.things[:, flat.TOUCHED] = (tops > low) & (bottoms < high)
        self.things[:, flat.REFLECTANCE] = model.geom_user[upright, 0]
        self.fit(model, at, mujoco.MjData(model))

    def fit(self, model: mujoco.MjModel, at: RobotIndices, data: mujoco.MjData) -> None:
        """Take the robot's constants from a model; its state is lost."""
        self.chassis = _chassis(model, at, self._step_ns, data)
        self.mounts = np.array([_mount(model, camera) for camera in at.cameras])


def _chassis(
    model: mujoco.MjModel, at: RobotIndices, step_ns: int, data: mujoco.MjData
) -> dict[str, float | int]:
    """Return the robot's constants, from the scene."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    masses = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, masses)
    turning, axle = at.velocity + 5, at.wheel_speeds[0]
    mass = float(model.body_subtreemass[at.base])
    inertia, spin = float(masses[turning, turning]), float(masses[axle, axle])
    left_wheel, right_wheel = model.geom_size[list(at.tyres), 0].tolist()
    wheel = (left_wheel + right_wheel) / 2
    grip = float(model.pair_friction[pairs_of(model, at.tyres)[0], 0])
    left, right = (float(model.body_pos[wheel, 1]) for wheel in at.wheels)
    track, h = left - right, units.STEP_NS * 1e-9
    resistance, constant = model.actuator_gainprm[at.motors[0], :2].tolist()
    stall, damping = constant / resistance, constant * constant / resistance
    # Inertia at each wheel, with the body's mass or inertia as if at the rims.
    going = mass / 2 * wheel * wheel + spin
    swinging = 2 * inertia / (track * track) * wheel * wheel + spin
    gear = float(model.dof_frictionloss[axle])
    _, _, high = centre = data.subtree_com[at.base]
    ahead = float((centre - data.xpos[at.base]) @ data.xmat[at.base].reshape(3, 3)[:, 0])
    arm = abs(float(model.geom(f"{_PREFIX}front_support").pos[0]))
    weight = mass * abs(float(model.opt.gravity[2]))
    return dict(
        substep=h,
        n_substeps=step_ns // units.STEP_NS,
        radius=float(model.geom(f"{_PREFIX}shell").size[0]),
        track=track,
        wheel=wheel,
        left_wheel=left_wheel,
        right_wheel=right_wheel,
        mass=mass,
        inertia=inertia,
        spin=spin,
        stall=stall,
        damping=damping,
        left_free_speed=left_wheel / constant,
        right_free_speed=right_wheel / constant,
        going=going / (going + h * damping),
        turning=swinging / (swinging + h * damping),
        gear=gear / wheel,
        dead_voltage=gear / stall,
        grip=grip * weight / 2,
        left_hold=1.0,
        right_hold=1.0,
        relief=grip / 2 / arm,
        shift=grip / track,
        lean=-weight * ahead,
        high=float(high) + 2 * (spin - float(model.dof_armature[axle])) / (wheel * mass),
        low=_span(model, model.geom(f"{_PREFIX}shell").id)[0],
        friction=SHELL_FRICTION,
    )


def _refuse_what_tips(playpen: Playpen) -> None:
    """Raise a `PlaypenError` if a movable object would tip over when it is pushed."""
    for kind, items in playpen.objects.items():
        for number, item in enumerate(items, 1):
            shape = item.footprint
            sides = (shape.radius_mm * 2,) if isinstance(shape, Circle) else (shape.length_mm, shape.width_mm)
            if item.movable and min(sides) < max(LEAST_WIDTH_MM, item.height_mm / MOST_SLENDER):
                found = f"{min(sides):g} mm wide and {item.height_mm:g} mm high"
                raise PlaypenError(
                    f"{playpen.name}: {kind} {number} is movable, {found}; expected a width of at least "
                    f"{LEAST_WIDTH_MM:g} mm and a third of the height in the plane, where nothing tips over"
                )


def _span(model: mujoco.MjModel, geom: int) -> tuple[float, float]:
    """Return the lowest and highest height of an upright geom [m]."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    half = size[2] if kind == mujoco.mjtGeom.mjGEOM_BOX else size[1]
    at = float(model.geom_pos[geom, 2])
    if _is_movable(model, geom):
        at = float(model.body_pos[model.geom_bodyid[geom], 2])
    return at - float(half), at + float(half)


def _is_movable(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom is a body of its own, at the body's own place."""
    return bool(model.body_jntnum[model.geom_bodyid[geom]] and not model.geom_pos[geom].any())


def _body(model: mujoco.MjModel, geom: int, thing: Floats) -> list[float]:
    """Return a movable obstacle's columns of `Plane.bodies`, from its inverse mass on."""
    mass = float(model.body_mass[model.geom_bodyid[geom]])
    length, width = float(thing[flat.LENGTH]), float(thing[flat.WIDTH])
    inertia, rim = mass * length * length / 2, length
    if width >= 0:
        inertia, rim = mass * (length * length + width * width) / 3, math.hypot(length, width)
    friction = float(model.geom_friction[geom, 0])
    grip = friction * mass * abs(float(model.opt.gravity[2]))
    return [1 / mass, 1 / inertia, grip, grip * rim, friction]


def _thing(model: mujoco.MjModel, geom: int) -> list[float]:
    """Return a row of `Plane.things`."""
    x, y, _ = model.geom_pos[geom].tolist()
    w, _, _, z = model.geom_quat[geom].tolist()
    if _is_movable(model, geom):
        body = model.geom_bodyid[geom]
        x, y, _ = model.body_pos[body].tolist()
        w, _, _, z = model.body_quat[body].tolist()
    angle, size = 2 * math.atan2(z, w), model.geom_size[geom].tolist()
    sides = size[:2] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX else [size[0], -1.0]
    return [x, y, math.cos(angle), math.sin(angle), *sides, *_span(model, geom)]


def _mount(model: mujoco.MjModel, camera: int) -> list[float]:
    """Return a row of `PlanarRobot.mounts`."""
    x, y, _ = model.cam_pos[camera].tolist()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.cam_quat[camera])
    # A camera looks along its -z.
    return [x, y, -float(turn[2]), -float(turn[5]), math.hypot(x, y)]

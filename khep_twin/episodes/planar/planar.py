"""Plane of a playpen: the robot's constants and the obstacles around it, from MuJoCo's scene.

    setup = EpisodeSetup(Playpen.load("looping-maze"), planar=True)

No constant is fitted: masses, inertias, friction, motors, positions and heights are those of the scene.
"""

# numba is not typed.
# pyright: reportMissingTypeStubs=false

import math
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.planar import plane as planar
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen.footprint import Circle
from khep_twin.playpen_to_mjcf import SHELL_FRICTION
from khep_twin.robots.model import robot_name
from khep_twin.sensing.mujoco_scene import is_floor, visible_geoms
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.fitted_robots import contact_pairs_of
from khep_twin.simulation.mujoco_forms import movable_names

MIN_WIDTH_MM, MAX_SLENDERNESS = 16.0, 3.0
"""Smallest width of a movable object [mm], and largest ratio of height to width. In MuJoCo, objects outside
these limits tip over when pushed at up to 320 mm/s (measured: 10 mm wide and 30 mm high, 16 and 80, 20 and
80; not 16 and 50)."""

_PREFIX = f"{robot_name(0)}/"

Floats = NDArray[np.float64]


class PlanarScene:
    """Constants of a plane, from a scene. It is thread-safe.

    Args:
        playpen: Playpen with one robot.
        model: Model of its scene.
        indices: Indices of the robot.
        step_ns: Step of the plane [ns].

    Raises:
        PlaypenError: The playpen has a feature that a plane does not support.
    """

    def __init__(self, playpen: Playpen, model: mujoco.MjModel, indices: RobotIndices, step_ns: int) -> None:
        _check_stability(playpen)
        robot = playpen.robots[0]
        self.start = robot.x_mm, robot.y_mm, robot.heading_deg
        self._step_ns = step_ns
        shell = model.geom(f"{_PREFIX}shell")
        low, high = _height_range(model, shell.id)
        wheels = planar.LEFT_ANGLE, planar.RIGHT_ANGLE
        self.indices = replace(
            indices,
            pose=planar.FREE_JOINT,
            velocity=planar.FREE_JOINT,
            wheel_qpos=wheels,
            wheel_dofs=wheels,
            motors=(0, 1),
        )
        floor = [geom for geom in np.flatnonzero(is_floor(model)).tolist() if model.geom_rgba[geom, 3] > 0]
        self.paint = np.array([_paint_row(model, geom) for geom in floor]).reshape(-1, planar.N_COLUMNS)
        fixed = [geom for geom in visible_geoms(model) if model.geom_bodyid[geom] == 0]
        movable = [model.geom(name).id for name in movable_names(playpen)]
        upright = [*fixed, *movable]
        self.obstacles = np.zeros((len(upright), planar.N_COLUMNS))
        for row, geom in zip(self.obstacles, upright, strict=True):
            row[: planar.TOP + 1] = _obstacle_row(model, geom)
        self.obstacles[:, planar.BODY] = -1
        self.obstacles[len(fixed) :, planar.BODY] = range(len(movable))
        self.bodies = np.zeros((len(movable), planar.N_BODY))
        for row, obstacle in zip(self.bodies, range(len(fixed), len(upright)), strict=True):
            row[planar.OBSTACLE] = obstacle
            columns = _body_columns(model, upright[obstacle], self.obstacles[obstacle])
            row[planar.INVERSE_MASS : planar.FRICTION + 1] = columns
        bottoms, tops = self.obstacles[:, planar.BOTTOM], self.obstacles[:, planar.TOP]
        self.obstacles[:, planar.TOUCHABLE] = (tops > low) & (bottoms < high)
        self.obstacles[:, planar.REFLECTANCE] = model.geom_user[upright, 0]
        self.set_robot(model, indices, mujoco.MjData(model))

    def set_robot(self, model: mujoco.MjModel, indices: RobotIndices, data: mujoco.MjData) -> None:
        """Read the robot's constants from a model, for example with a varied robot; `data` is overwritten."""
        self.robot_constants = _robot_constants(model, indices, self._step_ns, data)
        self.mounts = np.array([_mount_row(model, camera) for camera in indices.cameras])


def _robot_constants(
    model: mujoco.MjModel, indices: RobotIndices, step_ns: int, data: mujoco.MjData
) -> dict[str, float | int]:
    """Return the robot's constants from the scene."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    masses = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, masses)
    yaw, axle = indices.velocity + 5, indices.wheel_dofs[0]
    mass = float(model.body_subtreemass[indices.base])
    inertia, wheel_inertia = float(masses[yaw, yaw]), float(masses[axle, axle])
    left_wheel, right_wheel = model.geom_size[list(indices.tyres), 0].tolist()
    radius = (left_wheel + right_wheel) / 2
    tyre_friction = float(model.pair_friction[contact_pairs_of(model, indices.tyres)[0], 0])
    left_y, right_y = (float(model.body_pos[wheel, 1]) for wheel in indices.wheels)
    track, h = left_y - right_y, units.STEP_NS * 1e-9
    resistance, constant = model.actuator_gainprm[indices.motors[0], :2].tolist()
    stall_torque, damping = constant / resistance, constant * constant / resistance
    # Inertia at each wheel, including the body's mass or inertia reduced to the rims.
    linear_inertia = mass / 2 * radius * radius + wheel_inertia
    angular_inertia = 2 * inertia / (track * track) * radius * radius + wheel_inertia
    gear_torque = float(model.dof_frictionloss[axle])
    _, _, mass_height = centre = data.subtree_com[indices.base]
    forward = float((centre - data.xpos[indices.base]) @ data.xmat[indices.base].reshape(3, 3)[:, 0])
    support_distance = abs(float(model.geom(f"{_PREFIX}front_support").pos[0]))
    weight = mass * abs(float(model.opt.gravity[2]))
    shell = model.geom(f"{_PREFIX}shell")
    return dict(
        substep=h,
        n_substeps=step_ns // units.STEP_NS,
        # A disc around the axle's middle that reaches as far forwards as the shell.
        radius=float(shell.size[0] + abs(shell.pos[0])),
        track=track,
        wheel_radius=radius,
        left_wheel=left_wheel,
        right_wheel=right_wheel,
        mass=mass,
        inertia=inertia,
        wheel_inertia=wheel_inertia,
        stall_torque=stall_torque,
        damping=damping,
        left_free_speed=left_wheel / constant,
        right_free_speed=right_wheel / constant,
        linear_decay=linear_inertia / (linear_inertia + h * damping),
        angular_decay=angular_inertia / (angular_inertia + h * damping),
        gear_friction=gear_torque / radius,
        max_voltage=float(model.actuator_ctrlrange[indices.motors[0], 1]),
        dead_voltage=gear_torque / stall_torque,
        tyre_force=tyre_friction * weight / 2,
        left_grip=1.0,
        right_grip=1.0,
        pitch_relief=tyre_friction / 2 / support_distance,
        roll_shift=tyre_friction / track,
        weight_moment=-weight * forward,
        pitch_arm=float(mass_height)
        + 2 * (wheel_inertia - float(model.dof_armature[axle])) / (radius * mass),
        push_height=_height_range(model, shell.id)[0],
        friction=SHELL_FRICTION,
    )


def _check_stability(playpen: Playpen) -> None:
    """Raise a `PlaypenError` for a movable object that tips over when it is pushed."""
    for kind, items in playpen.objects.items():
        for number, item in enumerate(items, 1):
            shape = item.footprint
            sides = (shape.radius_mm * 2,) if isinstance(shape, Circle) else (shape.length_mm, shape.width_mm)
            if item.movable and min(sides) < max(MIN_WIDTH_MM, item.height_mm / MAX_SLENDERNESS):
                size_text = f"{min(sides):g} mm wide and {item.height_mm:g} mm high"
                raise PlaypenError(
                    f"{playpen.name}: {kind} {number} is movable, {size_text}; expected a width of at least "
                    f"{MIN_WIDTH_MM:g} mm and a third of the height in the plane, where nothing tips over"
                )


def _height_range(model: mujoco.MjModel, geom: int) -> tuple[float, float]:
    """Return the heights of the bottom and top of an upright geom [m]."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    half_height = size[2] if kind == mujoco.mjtGeom.mjGEOM_BOX else size[1]
    centre = float(model.geom_pos[geom, 2])
    if _is_movable(model, geom):
        centre = float(model.body_pos[model.geom_bodyid[geom], 2])
    return centre - float(half_height), centre + float(half_height)


def _is_movable(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom is a movable body, at the body's origin."""
    return bool(model.body_jntnum[model.geom_bodyid[geom]] and not model.geom_pos[geom].any())


def _body_columns(model: mujoco.MjModel, geom: int, obstacle: Floats) -> list[float]:
    """Return the columns of a movable obstacle in `Plane.bodies`, from INVERSE_MASS on."""
    mass = float(model.body_mass[model.geom_bodyid[geom]])
    half_x, half_y = float(obstacle[planar.HALF_LENGTH]), float(obstacle[planar.HALF_WIDTH])
    inertia, rim = mass * half_x * half_x / 2, half_x
    if half_y >= 0:
        inertia, rim = (mass * (half_x * half_x + half_y * half_y) / 3, math.hypot(half_x, half_y))
    friction = float(model.geom_friction[geom, 0])
    max_force = friction * mass * abs(float(model.opt.gravity[2]))
    return [1 / mass, 1 / inertia, max_force, max_force * rim, friction]


def _obstacle_row(model: mujoco.MjModel, geom: int) -> list[float]:
    """Return a row of `Plane.obstacles`."""
    x, y, _ = model.geom_pos[geom].tolist()
    w, _, _, z = model.geom_quat[geom].tolist()
    if _is_movable(model, geom):
        body = model.geom_bodyid[geom]
        x, y, _ = model.body_pos[body].tolist()
        w, _, _, z = model.body_quat[body].tolist()
    angle, sizes = 2 * math.atan2(z, w), model.geom_size[geom].tolist()
    half_sides = sizes[:2] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX else [sizes[0], -1.0]
    return [x, y, math.cos(angle), math.sin(angle), *half_sides, *_height_range(model, geom)]


def _paint_row(model: mujoco.MjModel, geom: int) -> Floats:
    """Return a row of `Plane.paint`; the floor is endless."""
    row = np.zeros(planar.N_COLUMNS)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        row[[planar.HALF_LENGTH, planar.HALF_WIDTH]] = math.inf, -1.0
    else:
        row[: planar.TOP + 1] = _obstacle_row(model, geom)
    row[planar.REFLECTANCE] = model.geom_user[geom, 0]
    return row


def _mount_row(model: mujoco.MjModel, camera: int) -> list[float]:
    """Return a row of `PlanarRobot.mounts`."""
    x, y, z = model.cam_pos[camera].tolist()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.cam_quat[camera])
    # A camera looks along its -z.
    return [x, y, -float(turn[2]), -float(turn[5]), math.hypot(x, y), z]

"""Other calibrations for the robots of a compiled scene, without another compilation.

The result is the model that `playpen_to_mjcf` would compile from these calibrations, to the last bit (static
deflection of tyres: to rounding), in a fiftieth of the time: wheels, motors, tyres and headings are set, and
MuJoCo computes all derived values. Not updated are the damping of a turret's servos, which depends slightly
on the robot's inertia, and the visualisation scale.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.robots.to_mjcf import wheel_inertia
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices

FIELDS = (
    "actuator_acc0",
    "actuator_gainprm",
    "body_inertia",
    "body_invweight0",
    "body_pos",
    "cam_mat0",
    "cam_poscom0",
    "cam_quat",
    "dof_M0",
    "dof_frictionloss",
    "dof_invweight0",
    "dof_length",
    "geom_aabb",
    "geom_pos",
    "geom_rbound",
    "geom_size",
    "light_poscom0",
    "pair_friction",
    "pair_margin",
)
"""Arrays of a model that depend on a calibration, directly or by MuJoCo's computation."""


class CalibratedRobots:
    """Robots of a compiled model, which no other world may use."""

    def __init__(self, model: mujoco.MjModel, robots: Sequence[RobotIndices]) -> None:
        self._model = model
        self._robots = robots
        self._compiled_fields: dict[str, NDArray[np.float64]] = {
            name: getattr(model, name).copy() for name in FIELDS
        }
        self._mean_inertia = model.stat.meaninertia
        self._tyre_pairs = [contact_pairs_of(model, robot.tyres) for robot in robots]

    def set_calibrations(self, calibrations: Sequence[Calibration] | None, data: mujoco.MjData) -> None:
        """Set the robots' calibrations; None restores the compiled model, to the last bit.

        Args:
            calibrations: Calibration of each robot.
            data: State of the scene, which is overwritten.
        """
        model = self._model
        for name, array in self._compiled_fields.items():
            getattr(model, name)[:] = array
        model.stat.meaninertia = self._mean_inertia
        if calibrations is None:
            return
        for robot, tyre_pairs, calibration in zip(self._robots, self._tyre_pairs, calibrations, strict=True):
            _set_calibration(model, robot, calibration)
            model.pair_friction[tyre_pairs, :2] = calibration.wheels.friction
        mujoco.mj_setConst(model, data)
        invweight, compiled_invweight = model.body_invweight0, self._compiled_fields["body_invweight0"]
        for robot, tyre_pairs in zip(self._robots, self._tyre_pairs, strict=True):
            # The contact margin is the tyres' static deflection, proportional to the wheel's inverse weight.
            wheel = robot.wheels[0]
            model.pair_margin[tyre_pairs] *= invweight[wheel, 0] / compiled_invweight[wheel, 0]
        # The solver's scale, summed sequentially as in MuJoCo.
        model.stat.meaninertia = float(np.cumsum(model.dof_M0)[-1]) / model.nv


def _set_calibration(model: mujoco.MjModel, robot: RobotIndices, calibration: Calibration) -> None:
    """Set the values that `robots.to_mjcf` derives from a robot's calibration, except contacts."""
    half_base = units.metres(calibration.wheels.base_mm) / 2
    for side, (y, radius) in enumerate(zip((half_base, -half_base), calibration.wheels.radii, strict=True)):
        wheel, tyre, rim = robot.wheels[side], robot.tyres[side], robot.rims[side]
        model.body_pos[wheel] = model.geom_pos[rim] = 0, y, radius
        model.geom_size[[tyre, rim], 0] = radius
        half_width = float(model.geom_size[rim, 1])
        model.body_inertia[wheel] = wheel_inertia(float(model.body_mass[wheel]), radius, 2 * half_width)
        model.geom_rbound[tyre], model.geom_rbound[rim] = radius, np.hypot(radius, half_width)
        model.geom_aabb[tyre, 3:], model.geom_aabb[rim, 3:5] = radius, radius
        motors = calibration.motors
        model.dof_frictionloss[robot.wheel_dofs[side]] = motors.friction_torque_n_m
        model.actuator_gainprm[robot.motors[side], :2] = motors.resistance, motors.constant
    for camera, heading_deg in zip(robot.cameras, calibration.heading_deg, strict=False):
        # A camera looks along its -z, with x to its right and y up.
        heading = units.radians(heading_deg)
        c, s = np.cos(heading), np.sin(heading)
        mujoco.mju_mat2Quat(model.cam_quat[camera], np.array([s, 0, -c, -c, 0, -s, 0, 1, 0]))


def contact_pairs_of(model: mujoco.MjModel, geoms: Sequence[int]) -> NDArray[np.intp]:
    """Return the contact pairs with one of these geoms."""
    return np.flatnonzero(np.isin(model.pair_geom1, geoms) | np.isin(model.pair_geom2, geoms))

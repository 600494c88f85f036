"""Indices of one robot in a compiled scene; no other module looks them up by name."""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false, reportUnknownParameterType=false
# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

_SIDES = ("left", "right")
_PARTS = ("tyre", "rim")


@dataclass(frozen=True, slots=True)
class RobotIndices:
    """Indices of a robot's parts in the arrays of its model; pairs are left and right.

    Attributes:
        base: Body of the chassis.
        wheels: Bodies of the wheels.
        tyres: Geoms that touch the floor.
        rims: Geoms that show the wheels.
        pose: First of the 7 numbers of the pose in qpos.
        velocity: First of the 6 numbers of the velocity in qvel.
        wheel_qpos: Angles of the wheels in qpos.
        wheel_dofs: Degrees of freedom of the wheels, indices in qvel.
        motors: Actuators of the wheels.
        cameras: Cameras of the infrared sensors, in the order of the robot's registers.
        leds: Sites of the LEDs.
        led_lights: Bodies of the LEDs' lights.
    """

    base: int
    wheels: tuple[int, int]
    tyres: tuple[int, int]
    rims: tuple[int, int]
    pose: int
    velocity: int
    wheel_qpos: tuple[int, int]
    wheel_dofs: tuple[int, int]
    motors: tuple[int, int]
    cameras: tuple[int, ...]
    leds: tuple[int, ...]
    led_lights: tuple[int, ...]

    @classmethod
    def of(cls, model: mujoco.MjModel, robot: str) -> Self:
        """Return the indices of a robot by its name in the scene, e.g. "khepera0".

        Raises:
            KeyError: The model has no robot of this name.
        """
        pose = model.joint(f"{robot}/pose")
        left, right = (model.joint(f"{robot}/{side}_axle") for side in _SIDES)
        left_wheel, right_wheel = (model.body(f"{robot}/{side}_wheel").id for side in _SIDES)
        tyres, rims = ([model.geom(f"{robot}/{side}_{part}").id for side in _SIDES] for part in _PARTS)
        # Parts of the robot, without those of its turrets.
        part_pattern = re.compile(rf"{robot}/[^/]+")
        cameras = [name for name in _names(model, mujoco.mjtObj.mjOBJ_CAMERA) if part_pattern.fullmatch(name)]
        bodies = [name for name in _names(model, mujoco.mjtObj.mjOBJ_BODY) if part_pattern.fullmatch(name)]
        leds = [name.removesuffix("_light") for name in bodies if name.endswith("_light")]
        left_motor, right_motor = (model.actuator(f"{robot}/{side}_motor").id for side in _SIDES)
        return cls(
            base=model.body(f"{robot}/base").id,
            wheels=(left_wheel, right_wheel),
            tyres=(tyres[0], tyres[1]),
            rims=(rims[0], rims[1]),
            pose=int(pose.qposadr[0]),
            velocity=int(pose.dofadr[0]),
            wheel_qpos=(int(left.qposadr[0]), int(right.qposadr[0])),
            wheel_dofs=(int(left.dofadr[0]), int(right.dofadr[0])),
            motors=(left_motor, right_motor),
            cameras=tuple(model.camera(name).id for name in cameras),
            leds=tuple(model.site(led).id for led in leds),
            led_lights=tuple(model.body(f"{led}_light").id for led in leds),
        )

    def pose_in(self, qpos: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return the robot's x, y [m] and heading [rad]."""
        x, y, _, qw, qx, qy, qz = qpos[self.pose : self.pose + 7].tolist()
        return x, y, math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj) -> Iterator[str]:
    """Yield the names of all objects of a kind."""
    index = 0
    while (name := mujoco.mj_id2name(model, kind, index)) is not None:
        yield name
        index += 1

"""Robot of a playpen as a part of its scene: its model's file fitted to its calibration, with its turrets.

Contacts of robots are explicit pairs, as stiff as the step allows; those of the tyres are springs.
"""

# MuJoCo's types are partly unknown.
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

import math
from collections.abc import Sequence
from importlib.resources import files
from itertools import product
from pathlib import Path

import mujoco

from khep_twin import units
from khep_twin.board.turrets import find_turrets, mount_heights
from khep_twin.playpen import RobotEntry
from khep_twin.robots.body import Body
from khep_twin.sensing import calibration

ASSETS = Path(str(files("khep_twin"))) / "assets"

SOLREF = [2.5 * units.STEP_NS * 1e-9, 1.0]
"""Stiffest contact that is stable at this step: time constant 2.5 steps, critically damped (measured)."""

SOLIMP = [0.95, 0.99, 0.0005, 0.5, 2]
"""Impedance above MuJoCo's default, so that weights press contacts in by micrometres only."""

_TYRE_SOLIMP = [0.002, 0.002, 0.0005, 0.5, 2]
"""Impedance of the tyres, which makes them springs with dampers. MuJoCo's friction lifts a contact that slips
at a speed by impedance x friction x speed x time constant: a stiff one leaves the floor, again and again."""

_SPRING_SOLIMP = [0.5, 0.5, 0.001, 0.5, 2]
"""Impedance of supports on springs, at which MuJoCo's stiffness is that of the spring over the moved mass."""


def add_robot(
    spec: mujoco.MjSpec, prefix: str, robot: RobotEntry, grounds: Sequence[str] = ("floor",)
) -> tuple[list[str], list[float]]:
    """Add a robot with its turrets to the scene.

    Args:
        spec: Scene.
        prefix: Prefix of the names of its parts.
        robot: Entry of the playpen.
        grounds: Names of the geoms that it may drive on.

    Returns:
        Names of the turrets' colliding geoms, and the initial controls of all its motors.
    """
    child = mujoco.MjSpec.from_file(str(ASSETS / robot.body.scene))
    _add_parts(child, robot.body)
    controls = _remove_keyframes(child)
    measured = calibration.read_for(robot.calibration, robot.robot_model)
    _fit_body(child, robot.body)
    _fit_wheels(child, measured.wheels)
    _fit_motors(child, measured.motors)
    # Further sensors look at the floor.
    for name, heading_deg in zip(robot.body.cameras, measured.heading_deg, strict=False):
        heading, camera = units.radians(heading_deg), child.camera(name)
        camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
        camera.alt.xyaxes = [math.sin(heading), -math.cos(heading), 0, 0, 0, 1]
    turret_geoms: list[str] = []
    kinds = find_turrets(robot.turrets)
    for kind, height in zip(kinds, mount_heights(kinds), strict=True):
        if kind.scene is not None:
            turret = mujoco.MjSpec.from_file(str(kind.scene))
            turret_geoms += [f"{prefix}{kind.name}/{geom.name}" for geom in turret.geoms if geom.contype]
            controls += _remove_keyframes(turret)
            frame = child.body("base").add_frame(pos=[0, 0, height])
            child.attach(turret, prefix=f"{kind.name}/", frame=frame)
    deflection = _static_deflection(child)
    heading = units.radians(robot.heading_deg)
    frame = spec.worldbody.add_frame(
        pos=[units.metres(robot.x_mm), units.metres(robot.y_mm), 0],
        quat=[math.cos(heading / 2), 0, 0, math.sin(heading / 2)],
    )
    spec.attach(child, prefix=prefix, frame=frame)
    for tyre, ground in product(("left_tyre", "right_tyre"), grounds):
        pair = add_contact(spec, prefix + tyre, ground, measured.wheels.friction)
        pair.solimp = _TYRE_SOLIMP
        # MuJoCo divides it by the impedance: friction acts as fast as that of a stiff contact.
        pair.solreffriction = [SOLREF[0] / _TYRE_SOLIMP[0], 1]
        # The spring acts from above the floor on, so that the loaded tyre just touches it.
        pair.margin = deflection
    for support, ground in product(("front_support", "back_support"), grounds):
        # Polished balls: without friction, which also keeps odometry clean.
        pair = add_contact(spec, prefix + support, ground, 0.0)
        if robot.body.support_solref is not None:
            pair.solref, pair.solimp = robot.body.support_solref, _SPRING_SOLIMP
    return turret_geoms, controls


def add_contact(spec: mujoco.MjSpec, geom: str, other: str, friction: float) -> mujoco.MjsPair:
    """Add a contact between two geoms, as stiff as the step allows; without friction for 0."""
    return spec.add_pair(
        geomname1=geom,
        geomname2=other,
        condim=3 if friction else 1,
        friction=[friction, friction, 0.005, 0.0001, 0.0001],
        solref=SOLREF,
        solimp=SOLIMP,
    )


def _remove_keyframes(part: mujoco.MjSpec) -> list[float]:
    """Remove a part's keyframes, which the scene's keyframe replaces; return the controls of its "home"."""
    controls = [0.0] * len(part.actuators)
    for key in list(part.keys):
        if key.name == "home" and len(key.ctrl):
            controls = list(key.ctrl)
        part.delete(key)
    return controls


def _add_parts(robot: mujoco.MjSpec, body: Body) -> None:
    """Add the infrared sensors, wheels and motors that a model's file lacks; calibrations set their sizes."""
    base = robot.body("base")
    for name, position in zip(body.cameras, body.sensor_places, strict=True):
        if not robot.camera(name):
            base.add_camera(name=name, pos=position, resolution=[9, 1], fovy=12.680383)
    for side in ("left", "right") if not robot.body("left_wheel") else ():
        wheel = base.add_body(name=f"{side}_wheel", mass=body.wheel_mass, explicitinertial=True)
        wheel.ipos, wheel.iquat = [0, 0, 0], [0.7071067812, 0.7071067812, 0, 0]
        wheel.add_joint(
            name=f"{side}_axle",
            axis=[0, 1, 0],
            armature=body.rotor_inertia,
            # Stiff, so that a wheel that friction holds creeps by micrometres a second only.
            solref_friction=[0.00625, 1],
            solimp_friction=[0.999, 0.999, 0.001, 0.5, 2],
        )
        tyre = wheel.add_geom(name=f"{side}_tyre", size=[body.wheel_radius, 0, 0], group=3, mass=0)
        tyre.contype, tyre.conaffinity, tyre.rgba = 0, 0, [0.5, 0.5, 0.5, 0]
        robot.add_actuator(
            name=f"{side}_motor",
            target=f"{side}_axle",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrlrange=[-body.voltage_limit, body.voltage_limit],
        )


def _fit_body(robot: mujoco.MjSpec, body: Body) -> None:
    """Set the body of a model whose file has that of another one."""
    if not body.fits_scene:
        return
    scale = body.height / units.BODY_HEIGHT
    insets = {"base": 0.0, "board": 0.001, "shell": 0.0}
    for geom in robot.geoms:
        if geom.name in insets:
            geom.size = [body.radius - insets[geom.name], scale * geom.size[1], geom.size[2]]
            geom.pos = [*geom.pos[:2], scale * geom.pos[2]]
    for name, side in (("front_support", 1), ("back_support", -1)):
        support = robot.geom(name)
        support.pos = [side * body.support_position, 0, support.pos[2]]
    base = robot.body("base")
    for name, position in zip(body.cameras, body.sensor_places, strict=True):
        robot.camera(name).pos = position
    base.mass = mass = body.mass - 2 * robot.body("left_wheel").mass
    base.ipos = [*base.ipos[:2], scale * base.ipos[2]]
    across = mass * (3 * body.radius**2 + body.height**2) / 12
    base.inertia = [across, across, mass * body.radius**2 / 2]


def _fit_wheels(robot: mujoco.MjSpec, wheels: calibration.WheelCalibration) -> None:
    """Set the size and position of the robot's wheels."""
    half_base = units.metres(wheels.base_mm) / 2
    for side, y, radius in zip(("left", "right"), (half_base, -half_base), wheels.radii, strict=True):
        wheel, tyre, rim = robot.body(f"{side}_wheel"), robot.geom(f"{side}_tyre"), robot.geom(f"{side}_rim")
        wheel.inertia = wheel_inertia(wheel.mass, radius, 2 * rim.size[1])
        tyre.size = [radius, *tyre.size[1:]]
        rim.size = [radius, *rim.size[1:]]
        wheel.pos = rim.pos = [0, y, radius]


def wheel_inertia(mass: float, radius: float, width: float) -> list[float]:
    """Return the principal inertias of a wheel, a cylinder [kg m^2], about its axle last."""
    across = mass * (3 * radius**2 + width**2) / 12
    return [across, across, mass * radius**2 / 2]


def _fit_motors(robot: mujoco.MjSpec, motors: calibration.MotorCalibration) -> None:
    """Set the constants of the robot's motors and gears."""
    for side in ("left", "right"):
        robot.joint(f"{side}_axle").frictionloss = motors.friction_torque_n_m
        robot.actuator(f"{side}_motor").set_to_dcmotor(
            motorconst=[motors.constant, motors.constant], resistance=motors.resistance
        )


def _static_deflection(robot: mujoco.MjSpec) -> float:
    """Return the static deflection of the tyres' springs under the robot's weight [m].

    MuJoCo's contact in equilibrium: (1 - impedance) (time constant)^2 x load x inverse mass of the wheel.
    """
    model = robot.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    base, wheel, support = model.body("base"), model.body("left_wheel"), model.geom("front_support")
    wheel_share = 1 - abs(data.subtree_com[base.id, 0] / support.pos[0])
    load = base.subtreemass[0] * units.GRAVITY / 2 * wheel_share
    return float((1 - _TYRE_SOLIMP[0]) * SOLREF[0] ** 2 * load * wheel.invweight0[0])

"""Conversion of a playpen to a scene: Playpen -> MjSpec -> MJCF that opens in plain MuJoCo.

Names in the scene: "floor"; "wall_left", "wall_right", "wall_bottom", "wall_top", or "wall_1" … along an
outline; "block0", "cylinder0", "patch0", "lamp0" … and pieces of walls "wall0_0" … in the file's order,
where nameless adjoining blocks are merged under the first one's number; stripes as sites
"stripe_block0_0" …; the robots as bodies "khepera0/base" … with the same prefix for all their parts, their
turrets as "khepera0/gripper/arm" ….
The keyframe "home" is the start, with the motors' targets; MuJoCo alone starts with all controls at 0.
The MJCF holds the sensors' inputs: a geom's `user` values are its infrared reflectance and its
electrical conductance [S], a lamp is a site whose `user` value is its power [W].

Contacts of robots are explicit pairs (tyres and supports with the floor, shell with the objects on
it), which is faster and keeps the ball-shaped tyres from touching walls; movable objects collide
with everything by MuJoCo's filter.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from typing import Any

import mujoco

from khep_twin import units
from khep_twin.playpen import Arena, Block, Cylinder, Patch, Playpen, Wall
from khep_twin.playpen.footprint import Circle, Footprint, Rectangle, overlap
from khep_twin.playpen.merge import merge_blocks
from khep_twin.playpen.parts import Obstacle
from khep_twin.playpen.polygon import walls_around
from khep_twin.playpen.stripes import Panel, panels, panels_within
from khep_twin.playpen.surfaces import Surface
from khep_twin.robots.model import robot_name
from khep_twin.robots.to_mjcf import SOLIMP, SOLREF, add_contact, add_robot
from khep_twin.sensing.line_faces import STRIPE
from khep_twin.sensing.mujoco_scene import GROUND_GROUP

STEPS_NS = (units.STEP_NS, 2 * units.STEP_NS, 4 * units.STEP_NS)
"""Valid steps of a scene [ns]: the robot's step, one conversion long, and coarser ones for many runs."""

SHELL_FRICTION = 0.3
"""Friction of the plastic body on walls and objects (assumed)."""

_FRICTION_RATIO = 5e4
"""Ratio of frictional to normal impedance: under the tyres' soft springs, friction stays hard (creep below
1 mm/s before a tyre slips)."""

_PATCH_HEIGHT = 0.0002
"""Height of patches on the floor [m]: as thin as paint."""

_PATCH_RISE = 2e-6
"""Height of a patch above another that it lies on [m]."""

_PANEL_GAP = 5e-5
"""Distance of stripes in front of their side, and their thickness [m]."""

_TABLE_TOP, _TABLE_HEIGHT = 0.02, 0.1
"""Thickness of a table's top, and its height above the ground [m]."""

_SLAB = 0.01
"""Thickness of a ramp [m]."""

_GROUND_COLOUR = [0.45, 0.43, 0.40, 1]
_FLOOR_COLOUR = [0.93, 0.92, 0.88, 1]


def to_mjcf(playpen: Playpen) -> str:
    """Return the playpen as MJCF text."""
    return to_spec(playpen).to_xml()


def to_spec(playpen: Playpen) -> mujoco.MjSpec:
    """Return the playpen as a MuJoCo specification, ready to compile.

    Raises:
        CalibrationError: A robot's calibration cannot be found or used.
    """
    spec = mujoco.MjSpec()
    spec.modelname = playpen.name
    spec.nuser_geom = 2
    spec.nuser_site = 1
    _set_options(
        spec,
        any(item.movable for item in chain(*playpen.obstacles.values())),
        n_robots=len(playpen.robots),
    )
    obstacles, grounds = _add_arena(spec, playpen), ["floor"]
    if playpen.arena.table:
        grounds.append(_add_lower_ground(spec))
    for kind, items in playpen.obstacles.items():
        for index, item in merge_blocks(items):
            name = f"{kind}{index}"
            if isinstance(item, Wall):
                obstacles += _add_wall(spec, playpen, name, item)
            else:
                _add_object(spec, playpen, name, item)
                (grounds if isinstance(item, Block) and item.ramp else obstacles).append(name)
    for index, patch in enumerate(playpen.patches):
        _add_patch(spec, playpen, index, patch)
    for index, lamp in enumerate(playpen.lamps):
        position = [units.metres(lamp.x_mm), units.metres(lamp.y_mm), units.metres(lamp.z_mm)]
        spec.worldbody.add_site(
            name=f"lamp{index}",
            pos=position,
            size=[units.BULB_RADIUS, 0, 0],
            rgba=[*(part / 255 for part in lamp.rgb), 1],
            userdata=[lamp.power_w],
        )
    shells: list[str] = []
    turret_geoms: list[list[str]] = []
    controls: list[float] = []
    for index, robot in enumerate(playpen.robots):
        prefix = f"{robot_name(index)}/"
        names, robot_controls = add_robot(spec, prefix, robot, grounds)
        turret_geoms.append(names)
        controls += robot_controls
        shell = prefix + "shell"
        for obstacle in [*obstacles, *(grounds if len(grounds) > 1 else ()), *shells]:
            add_contact(spec, shell, obstacle, SHELL_FRICTION)
        shells.append(shell)
    if any(turret_geoms):
        # A gripped object must not slip: 0.01 mm lost in a minute, instead of 31 mm (measured).
        spec.option.noslip_iterations = 5
    for owner, names in enumerate(turret_geoms):
        for name in names:
            for shell in [*shells[:owner], *shells[owner + 1 :]]:
                add_contact(spec, name, shell, SHELL_FRICTION)
    if controls:
        spec.add_key(name="home", ctrl=controls)
    return spec


def set_step(spec: mujoco.MjSpec, step_ns: int) -> None:
    """Set the step [ns] of a specification from `to_spec`: contacts as stable, sensors in the same order.

    Raises:
        ValueError: The control tick or the scan is not a whole number of these steps.
    """
    if step_ns not in STEPS_NS:
        steps_text = ", ".join(f"{step / 1e6:g}" for step in STEPS_NS)
        raise ValueError(
            f"a step of {step_ns / 1e6:g} ms does not divide the control tick of {units.TICK_NS / 1e6:g} ms "
            f"into whole conversions; expected one of {steps_text} ms"
        )
    step = step_ns * 1e-9
    step_ratio = step / spec.option.timestep
    spec.option.timestep = step
    for contact in (*spec.geoms, *spec.pairs):
        if contact.solref[0] == SOLREF[0]:
            contact.solref = [2.5 * step, 1.0]
    for pair in spec.pairs:
        pair.solreffriction = [pair.solreffriction[0] * step_ratio, pair.solreffriction[1]]
        pair.margin *= step_ratio**2
    conversions, scan = step_ns // units.STEP_NS, units.SCAN_NS * 1e-9
    for sensor in spec.sensors:
        for channel, infrared_sensor in enumerate(units.Sensor):
            if sensor.name.endswith(f"/{infrared_sensor.key}_rays"):
                # As in assets/khepera.xml half a step early, so that rounding cannot move it.
                sensor.interval = [scan, (channel // conversions + 0.5) * step - scan]


def _set_options(spec: mujoco.MjSpec, movable: bool, n_robots: int) -> None:
    spec.option.timestep = units.STEP_NS * 1e-9
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The same friction in all directions; a pyramid's depends on the heading by 10 to 15 %.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = _FRICTION_RATIO
    # A diverged simulation must stop the run, not restart silently.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # With it, contacts are wrong by up to 7.6 mm in 17 to 29 of 100 positions around a box's edges (measured,
    # MuJoCo 3.17.0): a robot sinks into the edge and is flung out of it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if movable:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    elif n_robots < 2:
        # With several robots the solver treats each group in contact (island) apart: 13 times as fast for
        # twenty robots of which some push (measured).
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    # Viewers need these to show a scene of half a metre.
    spec.visual.map.znear = 0.005
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.25] * 3, [0.1] * 3
    # Viewers draw every ray of every rangefinder; without a colour they hide nothing.
    spec.visual.rgba.rangefinder = [1, 1, 0.1, 0]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960


def _add_arena(spec: mujoco.MjSpec, playpen: Playpen) -> list[str]:
    """Add floor, light and walls of the arena; return the walls' names."""
    arena = playpen.arena
    wall_panels = panels_within(arena.corners, arena.stripes)
    _add_stripes(spec.worldbody, playpen, "wall", wall_panels, units.metres(arena.wall_height_mm))
    width, depth = units.metres(arena.width_mm), units.metres(arena.height_mm)
    thickness, height = units.metres(arena.wall_thickness_mm), units.metres(arena.wall_height_mm)
    spec.worldbody.add_light(
        pos=[width / 2, depth / 2, 1.5], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    margin = 0.05 + thickness
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[width / 2, depth / 2, 0],
        size=[width / 2 + margin, depth / 2 + margin, 0.01],
        rgba=_FLOOR_COLOUR,
        contype=0,
        conaffinity=1,
        solref=SOLREF,
        solimp=SOLIMP,
        userdata=[playpen.surface("white").reflectance, 0],
    )
    if arena.table:
        floor = spec.geom("floor")
        floor.type, floor.group = mujoco.mjtGeom.mjGEOM_BOX, GROUND_GROUP
        floor.pos = [width / 2, depth / 2, -_TABLE_TOP / 2]
        floor.size = [width / 2, depth / 2, _TABLE_TOP / 2]
        return []
    if arena.outline_mm:
        names: list[str] = []
        for number, shape in enumerate(walls_around(arena.outline_mm, arena.wall_thickness_mm), 1):
            geom = _add_upright(spec, f"wall_{number}", shape, height)
            _paint(geom, playpen, arena, movable=False)
            names.append(f"wall_{number}")
        return names
    # The walls stand outside the arena's inner edge; left and right ones fill the corners.
    walls = {
        "wall_left": ([-thickness / 2, depth / 2], [thickness / 2, depth / 2 + thickness]),
        "wall_right": ([width + thickness / 2, depth / 2], [thickness / 2, depth / 2 + thickness]),
        "wall_bottom": ([width / 2, -thickness / 2], [width / 2, thickness / 2]),
        "wall_top": ([width / 2, depth + thickness / 2], [width / 2, thickness / 2]),
    }
    for name, (centre, half_size) in walls.items():
        geom = spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*centre, height / 2],
            size=[*half_size, height / 2],
        )
        _paint(geom, playpen, arena, movable=False)
    return list(walls)


def _add_lower_ground(spec: mujoco.MjSpec) -> str:
    """Add the ground below a table; return its name."""
    floor = spec.geom("floor")
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[floor.pos[0], floor.pos[1], -_TABLE_HEIGHT],
        size=[floor.size[0] + 0.5, floor.size[1] + 0.5, 0.01],
        rgba=_GROUND_COLOUR,
        contype=0,
        conaffinity=1,
        solref=SOLREF,
        solimp=SOLIMP,
        userdata=[0, 0],
    )
    return "ground"


def _add_object(spec: mujoco.MjSpec, playpen: Playpen, name: str, item: Block | Cylinder) -> None:
    shape, height = item.footprint, units.metres(item.height_mm)
    if item.movable:
        body = spec.worldbody.add_body(name=name, **_pose(shape, height))
        body.add_freejoint()
        geom = body.add_geom(name=name, mass=units.kilograms(item.mass_g), **_type_and_size(shape, height))
        at_origin = replace(shape, x_mm=0.0, y_mm=0.0)
        if isinstance(at_origin, Rectangle):
            at_origin = replace(at_origin, angle_deg=0.0)
        _add_stripes(body, playpen, name, panels(at_origin, item.stripes), height, -height / 2)
    else:
        geom = _add_upright(spec, name, shape, height)
        _add_stripes(spec.worldbody, playpen, name, panels(shape, item.stripes), height)
    _paint(geom, playpen, item, item.movable)
    if isinstance(item, Block) and item.ramp:
        _make_ramp(geom, item)


def _make_ramp(geom: mujoco.MjsGeom, block: Block) -> None:
    """Tilt a block so that its top rises along its length, as a slab that starts below the floor."""
    length, height = units.metres(block.length_mm), units.metres(block.height_mm)
    heading, slope, half_slab = units.radians(block.angle_deg) / 2, math.atan2(height, length) / 2, _SLAB / 2
    # By the heading, and then by the slope about its own left.
    c, s, up, down = math.cos(heading), math.sin(heading), math.cos(slope), -math.sin(slope)
    geom.quat = [c * up, -s * down, c * down, s * up]
    setback = half_slab * math.sin(2 * slope)
    x, y = units.metres(block.x_mm), units.metres(block.y_mm)
    geom.pos = [
        x + setback * math.cos(2 * heading),
        y + setback * math.sin(2 * heading),
        height / 2 - half_slab * math.cos(2 * slope),
    ]
    geom.size = [math.hypot(length, height) / 2, units.metres(block.width_mm) / 2, half_slab]
    geom.group = GROUND_GROUP


def _add_wall(spec: mujoco.MjSpec, playpen: Playpen, name: str, wall: Wall) -> list[str]:
    names: list[str] = []
    for piece, shape in enumerate(wall.footprints):
        height = units.metres(wall.height_mm)
        geom = _add_upright(spec, f"{name}_{piece}", shape, height)
        _paint(geom, playpen, wall, movable=False)
        _add_stripes(spec.worldbody, playpen, f"{name}_{piece}", panels(shape, wall.stripes), height)
        names.append(f"{name}_{piece}")
    return names


def _add_patch(spec: mujoco.MjSpec, playpen: Playpen, index: int, patch: Patch) -> None:
    # A patch on others lies above them, by less than paint is thick.
    n_below = sum(overlap(patch.footprint, other.footprint) for other in playpen.patches[:index])
    geom = _add_upright(spec, f"patch{index}", patch.footprint, _PATCH_HEIGHT + n_below * _PATCH_RISE)
    _paint(geom, playpen, patch, movable=False)
    geom.conaffinity = 0  # visual only


def _add_upright(spec: mujoco.MjSpec, name: str, shape: Footprint, height: float) -> mujoco.MjsGeom:
    """Add a fixed geom with a footprint."""
    return spec.worldbody.add_geom(name=name, **_type_and_size(shape, height), **_pose(shape, height))


def _type_and_size(shape: Footprint, height: float) -> dict[str, Any]:
    """Return type and size of a geom with a footprint."""
    if isinstance(shape, Circle):
        size = [units.metres(shape.radius_mm), height / 2, 0]
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": size}
    size = [units.metres(shape.length_mm) / 2, units.metres(shape.width_mm) / 2, height / 2]
    return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": size}


def _pose(shape: Footprint, height: float) -> dict[str, Any]:
    """Return position and orientation of a geom or a body with a footprint on the floor."""
    half = 0.0 if isinstance(shape, Circle) else units.radians(shape.angle_deg) / 2
    position = [units.metres(shape.x_mm), units.metres(shape.y_mm), height / 2]
    return {"pos": position, "quat": [math.cos(half), 0, 0, math.sin(half)]}


def _paint(geom: mujoco.MjsGeom, playpen: Playpen, part: Arena | Obstacle | Patch, movable: bool) -> None:
    """Set colour, reflectance, conductance and contacts of a geom, by the surface of its part."""
    surface = playpen.surface(part.surface)
    reflectance = surface.reflectance if isinstance(part, Patch) else playpen.reflectance(part)
    geom.rgba = _colour(surface)
    geom.userdata = [reflectance, surface.conductance]
    geom.contype = 1 if movable else 0
    geom.conaffinity = 1
    geom.solref = SOLREF
    geom.solimp = SOLIMP


def _colour(surface: Surface) -> list[float]:
    return [*(part / 255 for part in surface.rgb), 1]


def _add_stripes(
    body: mujoco.MjsBody,
    playpen: Playpen,
    name: str,
    stripes: Iterable[Panel],
    height: float,
    bottom: float = 0.0,
) -> None:
    """Add the panels of stripes just in front of a side, as sites, which have no contacts and stop no ray.

    Args:
        body: Body of the striped object.
        playpen: Playpen with the surfaces.
        name: Name of the striped object or wall.
        stripes: Panels in the frame of the body.
        height: Height of the object or wall [m].
        bottom: Height of its lower end in the frame of the body [m].
    """
    for number, panel in enumerate(stripes):
        angle = units.radians(panel.angle_deg)
        x, y = units.metres(panel.x_mm), units.metres(panel.y_mm)
        body.add_site(
            name=f"{STRIPE}_{name}_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[x + _PANEL_GAP * math.sin(angle), y - _PANEL_GAP * math.cos(angle), bottom + height / 2],
            quat=[math.cos(angle / 2), 0, 0, math.sin(angle / 2)],
            size=[units.metres(panel.width_mm) / 2, _PANEL_GAP / 2, height / 2],
            rgba=_colour(playpen.surface(panel.surface)),
        )

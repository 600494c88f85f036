"""A playpen's scene in MuJoCo for a simulation: forms for plain and compiled code, robots, light, bounds."""

import copy
import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.clock import n_steps
from khep_twin.playpen import Lighting, Playpen
from khep_twin.playpen.model import MANY_ROBOTS
from khep_twin.playpen.starts import Start
from khep_twin.playpen_to_mjcf import set_step, to_spec
from khep_twin.process.status_line import announced
from khep_twin.robots.core import core_of, make_state
from khep_twin.robots.model import robot_name
from khep_twin.sensing import calibration
from khep_twin.sensing.ambient import LightSource
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Light
from khep_twin.sensing.mujoco_scene import MujocoScene
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.simulated import Timing
from khep_twin.simulation.fitted_robots import CalibratedRobots
from khep_twin.simulation.moments import Moments
from khep_twin.simulation.physics_state import FIELDS_CHANGED_BY_RUNS, fingerprint
from khep_twin.simulation.simulation import NO_LIGHT
from khep_twin.step import Reason

Floats = NDArray[np.float64]


class SceneModel(NamedTuple):
    """Compiled model of a playpen, which worlds may share.

    Attributes:
        playpen: Playpen.
        spec: Scene.
        model: Compiled scene.
        timing: Divisions of time.
    """

    playpen: Playpen
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    timing: Timing

    @classmethod
    def of(cls, playpen: Playpen, motion_ns: int = units.STEP_NS, step_ns: int | None = None) -> Self:
        """Return the model of a playpen.

        Args:
            playpen: Playpen.
            motion_ns: Step of the physics, which divides a control tick [ns].
            step_ns: Step of the simulation, which divides that of the physics [ns]; by default the same.
        """
        with _announced(len(playpen.robots)):
            spec = to_spec(playpen)
            if motion_ns != units.STEP_NS:
                set_step(spec, motion_ns)
            model = spec.compile()
        # The twin computes the robots' readings itself; only turrets need MuJoCo's sensors.
        if all(sensor.name.count("/") < 2 for sensor in spec.sensors):
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        return cls(playpen, spec, model, timing(playpen, motion_ns, step_ns or motion_ns))


class MujocoForms:
    """Scene of a playpen in MuJoCo.

    Args:
        scene_model: Compiled scene.
        data: State of the scene.
        shared: Whether other worlds use the model.

    Attributes:
        model: Compiled scene: that of `scene_model`, or a copy once robots of a shared model have varied.
        indices: Indices of each robot.
        cores: Core of each robot.
        moments: Recorded moments.
    """

    def __init__(self, scene_model: SceneModel, data: mujoco.MjData, shared: bool = False) -> None:
        self._playpen, _, self.model, self._timing = scene_model
        self._data = data
        self._shared = shared
        self._calibrations = [calibration.read(entry.calibration)[0] for entry in self._playpen.robots]
        self._run_calibrations = self._calibrations
        self._calibrated: CalibratedRobots | None = None
        self._fingerprint = ""
        self._initial_fields: dict[str, Floats] = {
            name: getattr(self.model, name).copy() for name in FIELDS_CHANGED_BY_RUNS
        }
        count = len(self._playpen.robots)
        self.cores = [core_of(entry.robot_model) for entry in self._playpen.robots]
        self.moments = Moments(self.model, sum(core.n_moments for core in self.cores))
        self.indices = [RobotIndices.of(self.model, robot_name(index)) for index in range(count)]
        bodies = [self.model.body(name).id for name in movable_names(self._playpen)]
        self._free_joints: list[int] = self.model.jnt_qposadr[self.model.body_jntadr[bodies]].tolist()
        self.refresh()

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects (n, 3)."""
        rows: list[tuple[float, float, float]] = []
        for start in self._free_joints:
            px, py, _, w, x, y, z = self._data.qpos[start : start + 7].tolist()
            rows.append((px, py, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
        return np.array(rows).reshape(-1, 3)

    def refresh(self) -> None:
        """Update the forms after fixed geoms were moved in the model."""
        self.moments.use(self.model)
        self._plain: MujocoScene | None = None
        self._arrays: tuple[Any, ...] | None = None
        # With several robots no line of sight is precomputed, so those of one robot serve all.
        self._lights = [LightSource(self.model, robot) for robot in self.indices[:1]]

    @property
    def fingerprint(self) -> str:
        """Hash of the scene with its current robots, in hexadecimal digits."""
        if not self._fingerprint:
            self._fingerprint = fingerprint(self.model, self._timing, self._run_calibrations)
        return self._fingerprint

    def plain(self) -> MujocoScene:
        """Return the scene for plain code."""
        if self._plain is None:
            self._plain = MujocoScene(self.model, self._data, self.moments.rows)
        return self._plain

    def compiled(self) -> tuple[Any, ...]:
        """Return the scene for compiled code, as arrays."""
        from khep_twin.simulation.mujoco_calls import make_calls

        if self._arrays is None:
            self._arrays = make_calls(self.model, self._data, self.moments.rows)
        solids = self._arrays[1]
        # The rims of varied robots may have another size.
        solids["bound"] = self.model.geom_rbound[solids["geom"]]
        return self._arrays

    def vary_robots(self, make_rng: Callable[[int], np.random.Generator] | None) -> None:
        """Draw each robot's calibration around the playpen's, by its stream; None restores the playpen's."""
        if self._calibrated is None:
            if self._shared:
                self.model = copy.copy(self.model)
                self.moments.use(self.model)
                self._plain = None
                self._arrays = None
            self._calibrated = CalibratedRobots(self.model, self.indices)
        self._run_calibrations = self._calibrations
        if make_rng is not None:
            self._run_calibrations = [
                calibration.vary(measured, make_rng(number))
                for number, measured in enumerate(self._calibrations)
            ]
        self._calibrated.set_calibrations(None if make_rng is None else self._run_calibrations, self._data)

    def robot_states(self) -> list[Any]:
        """Return the state of each robot before a start."""
        states: list[Any] = []
        first_moment = 0
        robots = zip(self.cores, self.indices, self._run_calibrations, self._playpen.robots, strict=True)
        for core, indices, measured, entry in robots:
            arguments = self.model, indices, measured, entry, first_moment
            states.append(make_state(entry.robot_model, *arguments))
            first_moment += core.n_moments
        return states

    def reserve_lamps(self, n_lamps: int) -> bool:
        """Make space for lamps in recorded moments; return whether the forms have been replaced."""
        if not self.moments.reserve(n_lamps):
            return False
        self._plain = None
        self._arrays = None
        return True

    def describe_error(self, reason: int) -> str:
        """Return why the physics cannot continue."""
        if reason == Reason.WARNED:
            kind = mujoco.mjtWarning(int(np.flatnonzero(self._data.warning.number)[0])).name
            return f"MuJoCo warns of {kind}"
        positions, speeds = np.abs(self._data.xpos).max(), np.abs(self._data.qvel).max()
        return f"something is {positions:g} m off, at {speeds:g} m/s or rad/s"

    def light(self, lamps: Lamps, lighting: Lighting) -> Light:
        """Return the lamps with the precomputed lines of sight to them."""
        return self._lights[0].light(lamps.positions, lighting) if self._lights else NO_LIGHT

    def with_starts(self, starts: Sequence[Start]) -> Playpen:
        """Return the playpen with its robots at these starts."""
        robots = tuple(
            entry.model_copy(update={"x_mm": x_mm, "y_mm": y_mm, "heading_deg": heading_deg})
            for entry, (x_mm, y_mm, heading_deg) in zip(self._playpen.robots, starts, strict=True)
        )
        return self._playpen.model_copy(update={"robots": robots})

    def restore_model(self) -> None:
        """Undo changes of the model by LEDs and faults of a run, if it is not shared."""
        self._fingerprint = ""
        if not self._shared:
            for name, array in self._initial_fields.items():
                getattr(self.model, name)[:] = array

    def reset(self, playpen: Playpen) -> None:
        """Reset the state, with the robots at their starts in a playpen that is otherwise equal."""
        mujoco.mj_resetData(self.model, self._data)
        for indices, entry, original in zip(self.indices, playpen.robots, self._playpen.robots, strict=True):
            start = entry.x_mm, entry.y_mm, entry.heading_deg
            if start != (original.x_mm, original.y_mm, original.heading_deg):
                self._data.qpos[indices.pose : indices.pose + 7] = _free_joint(start)


def movable_names(playpen: Playpen) -> list[str]:
    """Return the names of the movable objects' bodies and geoms, in the order of `Playpen.objects`."""
    return [
        f"{kind}{index}"
        for kind, items in playpen.objects.items()
        for index, item in enumerate(items)
        if item.movable
    ]


def _free_joint(start: Start) -> Floats:
    """Return the qpos of a robot's free joint at a start (7,), as MuJoCo computes it."""
    x_mm, y_mm, heading_deg = start
    heading = units.radians(heading_deg)
    spec = mujoco.MjSpec()
    frame = spec.worldbody.add_frame(
        pos=[units.metres(x_mm), units.metres(y_mm), 0],
        quat=[math.cos(heading / 2), 0, 0, math.sin(heading / 2)],
    )
    child = mujoco.MjSpec()
    body = child.worldbody.add_body(name="base", mass=1, inertia=[1, 1, 1])
    body.add_freejoint()
    spec.attach(child, prefix="robot/", frame=frame)
    return spec.compile().qpos0


def timing(playpen: Playpen, motion_ns: int, step_ns: int) -> Timing:
    """Return the divisions of time, by the steps of physics and simulation [ns], and an arena's bounds."""
    width, height = playpen.arena.width_mm, playpen.arena.height_mm
    steps_per_motion = n_steps(motion_ns, step_ns)
    return Timing(
        step_ns=step_ns,
        steps_per_motion=steps_per_motion,
        conversions=step_ns // units.STEP_NS,
        steps_per_tick=n_steps(units.TICK_NS, motion_ns) * steps_per_motion,
        steps_per_supply=n_steps(units.SCAN_NS, step_ns),
        limit=1.0 + max(units.metres(width), units.metres(height)),
    )


def _announced(n_robots: int) -> AbstractContextManager[None]:
    """Announce the compilation of a scene with many robots, which takes long."""
    if n_robots <= MANY_ROBOTS:
        return nullcontext()
    start_s, title = time.monotonic(), f"khep_twin: making the scene of {n_robots} robots"

    def elapsed() -> str:
        return f"{title}: {time.monotonic() - start_s:.0f} s"

    return announced(f"{title}, which takes long", elapsed, elapsed)

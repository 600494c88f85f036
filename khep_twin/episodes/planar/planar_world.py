"""One robot in a plane for episodes: the counterpart of `World`."""

import copy
from collections.abc import Callable, Sequence
from functools import cache, partial
from threading import RLock
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.casting import PlaneScene
from khep_twin.episodes.planar.planar import PlanarScene
from khep_twin.episodes.planar.plane import PlanarRobot, Plane
from khep_twin.playpen import Lamp, Lighting
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.process.one_thread import one_thread
from khep_twin.randomness import stream
from khep_twin.robots.core import make_state
from khep_twin.robots.model import robot_name
from khep_twin.sensing import calibration
from khep_twin.sensing.ambient import LightSource
from khep_twin.sensing.buffers import as_records, view
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Light
from khep_twin.sensing.mujoco_scene import bulb_points
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import COARSE, FINE
from khep_twin.simulation.fitted_robots import CalibratedRobots
from khep_twin.simulation.mujoco_forms import SceneModel
from khep_twin.simulation.simulation import Simulation
from khep_twin.step import Reason

N_ROBOT_CONTACTS = 8
"""Largest number of contacts of the robot; fewer obstacles fit around it."""

N_OBSTACLE_CONTACTS = 64
"""Largest number of simultaneous contacts between movable obstacles and others."""

STATE_FIELDS = ("joints", "speeds", "ctrl", "force", "impulses", "last_step", "contacts")
"""Fields of `PlanarRobot` that are reset at the start of each episode."""

Floats = NDArray[np.float64]


class PlanarForms:
    """State of a plane, for plain and for compiled code, which share its memory.

    Args:
        scene_model: Compiled model of a playpen with one robot, at the step of the plane.
        planar_scene: Constants of the plane.
    """

    def __init__(self, scene_model: SceneModel, planar_scene: PlanarScene) -> None:
        self._planar_scene = planar_scene
        self._entry = scene_model.playpen.robots[0]
        self._model = scene_model.model
        self._calibration = self._drawn_calibration = calibration.read(self._entry.calibration)[0]
        self._varied: tuple[PlanarScene, CalibratedRobots, mujoco.MjModel, mujoco.MjData] | None = None
        self._indices = RobotIndices.of(self._model, robot_name(0))
        self._light_source = LightSource(self._model, self._indices)
        points = [bulb_points(disc) for disc in (COARSE, FINE)]
        fields: dict[str, Any] = {
            **planar_scene.robot_constants,
            "mounts": planar_scene.mounts,
            "sensor_range": 0.0,
            "n_coarse_points": len(points[0]),
            "points": np.concatenate(points),
            "hidden": np.zeros(sum(map(len, points)), np.int64),
            "contacts": np.zeros((N_ROBOT_CONTACTS, 6)),
            "joints": np.zeros(planar.N_JOINTS),
            "speeds": np.zeros(planar.N_JOINTS),
            "ctrl": np.zeros(2),
            "force": np.zeros(2),
            "impulses": np.zeros(planar.N_IMPULSES),
            "last_step": np.zeros(planar.N_LAST),
        }
        self._obstacles, self._near = planar_scene.obstacles.copy(), np.zeros_like(planar_scene.obstacles)
        self._bodies = planar_scene.bodies.copy()
        self._obstacle_contacts = np.zeros((N_OBSTACLE_CONTACTS, planar.N_CONTACT_COLUMNS))
        self._fixed_by_distance = np.zeros(len(self._obstacles) - len(self._bodies), np.int64)
        robot = PlanarRobot(**fields)
        self._records = as_records([robot], robot)
        record: Any = self._records[0]
        self.state = {name: record[name] for name in STATE_FIELDS}
        # Plain Python accesses memoryviews faster than arrays.
        views = {
            name: record[name].data if isinstance(value, np.ndarray) else value
            for name, value in fields.items()
        }
        near, bodies, obstacle_contacts = view(self._near), view(self._bodies), view(self._obstacle_contacts)
        obstacles, order = view(self._obstacles), self._fixed_by_distance.data
        paint = view(planar_scene.paint)
        robot = PlanarRobot(**views)
        self.plane = Plane(obstacles, order, near, bodies, obstacle_contacts, paint, robot)
        self._set_constants(planar_scene)

    def plain(self) -> PlaneScene:
        """Return the scene for plain code."""
        return PlaneScene(self.plane)

    def compiled(self) -> tuple[Any, ...]:
        """Return the scene for compiled code: the fields of `Plane`."""
        moving = self._near, self._bodies, self._obstacle_contacts
        return self._obstacles, self._fixed_by_distance, *moving, self._planar_scene.paint, self._records

    def place_robot(self, start: Start | None) -> None:
        """Reset the state, with the robot at rest at `start` [mm, deg], or at its pose in the playpen."""
        x_mm, y_mm, heading_deg = start or self._planar_scene.start
        x, y, heading = units.metres(x_mm), units.metres(y_mm), units.radians(heading_deg)
        for array in self.state.values():
            array[:] = 0
        self.state["joints"][:3] = x, y, heading
        # Infinity makes the first step measure all distances and compute the cosine of the heading.
        self.state["last_step"][[planar.ANCHOR_X, planar.END_HEADING]] = np.inf
        self._obstacles[:], self._bodies[:] = self._planar_scene.obstacles, self._planar_scene.bodies
        # An approximate order, which speeds up the first measurement.
        fixed = self._obstacles[: len(self._fixed_by_distance)]
        distances = np.hypot(fixed[:, planar.CENTRE_X] - x, fixed[:, planar.CENTRE_Y] - y)
        self._fixed_by_distance[:] = np.argsort(distances - fixed[:, planar.HALF_LENGTH], kind="stable")

    def vary_robots(self, make_rng: Callable[[int], np.random.Generator] | None) -> None:
        """Draw the robot's calibration around the playpen's, by `make_rng(0)`; None for the playpen's."""
        if self._varied is None:
            model = copy.copy(self._model)
            self._varied = (
                copy.copy(self._planar_scene),
                CalibratedRobots(model, [self._indices]),
                model,
                mujoco.MjData(model),
            )
        scene, calibrated_robots, model, data = self._varied
        self._drawn_calibration = self._calibration
        if make_rng is None:
            scene = self._planar_scene
        else:
            self._drawn_calibration = calibration.vary(self._calibration, make_rng(0))
            calibrated_robots.set_calibrations([self._drawn_calibration], data)
            scene.set_robot(model, self._indices, data)
        self._set_constants(scene)

    def robot_states(self) -> list[Any]:
        """Return the state of the robot."""
        return [self._robot_state]

    def light(self, lamps: Lamps, lighting: Lighting) -> Light:
        """Return the lamps with their precomputed lines of sight."""
        return self._light_source.light(lamps.positions, lighting)

    def describe_error(self, reason: int) -> str:
        """Return why the motion cannot continue."""
        return "the motion left its bounds"

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad]."""
        return planar.true_pose(self.state["joints"].tolist())

    @property
    def joints(self) -> Floats:
        """Copy of the joint positions."""
        return self.state["joints"].copy()

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable obstacles (n, 3)."""
        rows = self._obstacles[len(self._fixed_by_distance) :]
        headings = np.arctan2(rows[:, planar.SINE], rows[:, planar.COSINE])
        return np.column_stack([rows[:, planar.CENTRE_X], rows[:, planar.CENTRE_Y], headings])

    def _set_constants(self, scene: PlanarScene) -> None:
        """Set the constants of a plane, and the robot's sensors from the last drawn calibration."""
        arguments = self._model, scene.indices, self._drawn_calibration, self._entry, 0
        self._robot_state = make_state(self._entry.robot_model, *arguments)
        proximity = self._robot_state.sensors.proximity
        ranges = np.array(proximity.offset) + proximity.reach + scene.mounts[: len(proximity.reach), 4]
        record: Any = self._records[0]
        reach = max(float(ranges.max()), 2 * record["radius"])
        fields = {**scene.robot_constants, "mounts": scene.mounts, "sensor_range": reach}
        for name, value in fields.items():
            record[name] = value
        scalars = {name: value for name, value in fields.items() if not isinstance(value, np.ndarray)}
        self.plane = self.plane._replace(robot=self.plane.robot._replace(**scalars))


class PlanarWorld:
    """One robot in a plane; `reset` starts a run.

    Args:
        scene_model: Compiled model of a playpen with one robot, at the step of the plane.
        planar_scene: Constants of the plane.

    Attributes:
        timing: Durations in steps.
        simulation: State of the stepping core.
        forms: State of the plane.
        guard: Lock of its methods.
    """

    def __init__(self, scene_model: SceneModel, planar_scene: PlanarScene) -> None:
        self.guard = RLock()
        self.playpen = scene_model.playpen
        self.timing = scene_model.timing
        self.forms = PlanarForms(scene_model, planar_scene)
        self.simulation = Simulation(self.forms, self.timing)

    @one_thread
    def reset(
        self,
        seed: int = 0,
        *,
        noise: float = True,
        vary: bool = False,
        starts: Sequence[Start] | None = None,
        lamps: Sequence[Lamp] | None = None,
    ) -> None:
        """Start a new run at time 0, as `World.reset` does."""
        simulation = self.simulation
        if starts is None:
            robot = at_spots(self.playpen, seed).robots[0]
            starts = [(robot.x_mm, robot.y_mm, robot.heading_deg)]
        simulation.reset(seed, noise=noise, vary=vary)
        self.forms.place_robot(starts[0])
        playpen = self.playpen
        if lamps is not None:
            playpen = playpen.model_copy(update={"lamps": tuple(lamps)})
        all_lamps = Lamps(playpen, cache(partial(stream, seed, "lamps")))
        simulation.set_lamps(all_lamps, playpen.lighting)
        simulation.switch_on()

    @one_thread
    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], in whole steps.

        Raises:
            DivergedError: The motion left its bounds, or a controller returned a speed that is not finite.
        """
        while self.simulation.advance(time_ns // self.timing.step_ns) != Reason.DONE:
            pass

    @one_thread
    def finish_steps(self, reason: int, end_step: int) -> None:
        """Handle a return of the stepping core, and run up to a step, as `World.finish_steps` does."""
        self.simulation.check_reason(reason)
        self.advance_to(end_step * self.timing.step_ns)

    @property
    def is_self_contained(self) -> bool:
        """True, as no code outside the stepping core acts within a run."""
        return True

    @property
    def poses(self) -> list[tuple[float, float, float]]:
        """True x, y [m] and heading [rad] of the robot."""
        return [self.forms.pose]

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects (n, 3)."""
        return self.forms.objects

    @property
    def is_pushed(self) -> bool:
        """True if an obstacle pushed the robot in the last substep."""
        impulses = self.forms.state["impulses"]
        return bool(impulses[planar.PUSHED] or impulses[planar.PUSHED_ASIDE])

    @property
    def joints(self) -> Floats:
        """Copy of the joint positions (planar.N_JOINTS,)."""
        return self.forms.joints

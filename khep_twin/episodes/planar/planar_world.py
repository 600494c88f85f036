"""One robot in a plane, as episodes use it: the counterpart of `World`."""

import copy
from collections.abc import Callable, Sequence
from functools import cache, partial
from threading import RLock
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.board.rom import DEMO, ROMS
from khep_twin.episodes.planar import plane as flat
from khep_twin.episodes.planar.casting import PlaneScene
from khep_twin.episodes.planar.planar import PlanarScene
from khep_twin.episodes.planar.plane import PlanarRobot, Plane
from khep_twin.one_thread import one_thread
from khep_twin.playpen import Lamp, Lighting
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.randomness import stream
from khep_twin.sensing import calibration
from khep_twin.sensing.ambient import LightSource
from khep_twin.sensing.buffers import as_records, view
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Light
from khep_twin.sensing.mujoco_scene import points_of_a_bulb
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import FEW, MANY
from khep_twin.simulation.fitted_robots import FittedRobots
from khep_twin.simulation.mujoco_forms import SceneModel, robot_state
from khep_twin.simulation.simulation import Simulation
from khep_twin.step import DONE, RobotState

N_CONTACTS = 8
"""Most obstacles that push the robot at once: more than fit around it."""

N_TOUCHES = 64
"""Most contacts between movable obstacles and others that are solved at once."""

LIVE = ("joints", "speeds", "ctrl", "force", "grips", "last", "contacts")
"""Fields of `PlanarRobot` that are reset at the start of each episode."""

Floats = NDArray[np.float64]


class PlanarForms:
    """State of a plane in its two forms, which share it.

    Args:
        scene_model: Compiled model of a playpen with one robot, at the step of the plane.
        planar_scene: Constants of the plane.
    """

    def __init__(self, scene_model: SceneModel, planar_scene: PlanarScene) -> None:
        self._planar_scene = planar_scene
        self._entry, self._model = scene_model.playpen.robots[0], scene_model.model
        self._calibration = self._drawn = calibration.read(self._entry.calibration)[0]
        self._fitted: tuple[PlanarScene, FittedRobots, mujoco.MjModel, mujoco.MjData] | None = None
        self._indices = RobotIndices.of(self._model, "khepera0")
        self._lights = LightSource(self._model, self._indices)
        points = [points_of_a_bulb(number) for number in (FEW, MANY)]
        numbers: dict[str, Any] = {
            **_constants(planar_scene),
            "height": planar_scene.height,
            "sight": 0.0,
            "n_few": len(points[0]),
            "points": np.concatenate(points),
            "hidden": np.zeros(sum(map(len, points)), np.int64),
            "contacts": np.zeros((N_CONTACTS, 6)),
            "joints": np.zeros(flat.N_JOINTS),
            "speeds": np.zeros(flat.N_JOINTS),
            "ctrl": np.zeros(2),
            "force": np.zeros(2),
            "grips": np.zeros(flat.N_GRIPS),
            "last": np.zeros(flat.N_LAST),
        }
        self._things, self._near = planar_scene.things.copy(), np.zeros_like(planar_scene.things)
        self._bodies, self._touches = planar_scene.bodies.copy(), np.zeros((N_TOUCHES, flat.N_TOUCH))
        self._order = np.zeros(len(self._things) - len(self._bodies), np.int64)
        robot = PlanarRobot(**numbers)
        self._records = as_records([robot], robot)
        record: Any = self._records[0]
        self.state = {name: record[name] for name in LIVE}
        # Memoryviews of the same memory are faster in plain Python.
        views = {
            name: record[name].data if isinstance(value, np.ndarray) else value
            for name, value in numbers.items()
        }
        near, bodies, touches = view(self._near), view(self._bodies), view(self._touches)
        things, order = view(self._things), self._order.data
        self.plane = Plane(things, order, near, bodies, touches, PlanarRobot(**views))
        self._sense(planar_scene)

    def plain(self) -> PlaneScene:
        """Return the scene for plain code."""
        return PlaneScene(self.plane)

    def compiled(self) -> tuple[Any, ...]:
        """Return the scene for compiled code, as arrays."""
        return self._things, self._order, self._near, self._bodies, self._touches, self._records

    def put(self, start: Start | None) -> None:
        """Reset the state, with the robot at rest at its own pose or at the start [mm, deg]."""
        x_mm, y_mm, heading_deg = start or self._planar_scene.position
        x, y, heading = units.metres(x_mm), units.metres(y_mm), units.radians(heading_deg)
        for array in self.state.values():
            array[:] = 0
        self.state["joints"][:3] = x, y, heading
        # An infinite distance makes the first step measure all distances, and another heading its cosine.
        self.state["last"][[flat.ANCHOR_X, flat.END]] = np.inf
        self._things[:], self._bodies[:] = self._planar_scene.things, self._planar_scene.bodies
        # Nearly sorted, which speeds up the first measurement.
        things = self._things[: len(self._order)]
        away = np.hypot(things[:, flat.CENTRE_X] - x, things[:, flat.CENTRE_Y] - y)
        self._order[:] = np.argsort(away - things[:, flat.LENGTH], kind="stable")

    def vary(self, spread: Callable[[int], np.random.Generator] | None) -> None:
        """Make the robot another of the same make, drawn from its stream; None for that of the playpen."""
        if self._fitted is None:
            model = copy.copy(self._model)
            self._fitted = (
                copy.copy(self._planar_scene),
                FittedRobots(model, [self._indices]),
                model,
                mujoco.MjData(model),
            )
        scene, fitted, model, data = self._fitted
        self._drawn = self._calibration
        if spread is None:
            scene = self._planar_scene
        else:
            self._drawn = calibration.varied(self._calibration, spread(0))
            fitted.fit([self._drawn], data)
            scene.fit(model, self._indices, data)
        self._sense(scene)

    @property
    def n_robots(self) -> int:
        """Number of robots, 1."""
        return 1

    @property
    def numbers(self) -> Sequence[int]:
        """Number of the robot."""
        return (0,)

    def robot_states(self) -> list[RobotState]:
        """Return the state of the robot."""
        return [self._robot_state]

    def light(self, lamps: Lamps, lighting: Lighting) -> Light:
        """Return the lamps with the known sight lines to them."""
        return self._lights.light(lamps.positions, lighting)

    def trouble(self, reason: int) -> str:
        """Return a sentence on why the motion cannot go on."""
        return "the motion left its bounds"

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad]."""
        return flat.true_pose(self.state["joints"].tolist())

    @property
    def joints(self) -> Floats:
        """Copy of the joint positions."""
        return self.state["joints"].copy()

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable obstacles (n, 3)."""
        rows = self._things[len(self._order) :]
        headings = np.arctan2(rows[:, flat.SINE], rows[:, flat.COSINE])
        return np.column_stack([rows[:, flat.CENTRE_X], rows[:, flat.CENTRE_Y], headings])

    def _sense(self, scene: PlanarScene) -> None:
        """Take over the constants of a plane, and the sensors of the robot as drawn last."""
        drawn = robot_state(self._model, self._indices, PlanarScene.JOINTS, self._drawn, self._entry)
        self._robot_state, proximity = drawn, drawn.sensors.proximity
        reaches = np.array(proximity.offset) + proximity.reach + scene.mounts[:, 4]
        record: Any = self._records[0]
        numbers = {**_constants(scene), "sight": max(float(reaches.max()), 2 * record["radius"])}
        for name, value in numbers.items():
            record[name] = value
        single = {name: value for name, value in numbers.items() if not isinstance(value, np.ndarray)}
        self.plane = self.plane._replace(robot=self.plane.robot._replace(**single))


def _constants(scene: PlanarScene) -> dict[str, Any]:
    """Return the fields of `PlanarRobot` that a calibration changes."""
    return {
        **scene.chassis,
        "mounts": scene.mounts,
    }


class PlanarWorld:
    """One robot in a plane; runs begin with `reset`.

    Args:
        scene_model: Compiled model of a playpen with one robot, at the step of the plane.
        planar_scene: Constants of the plane.

    Attributes:
        timing: Divisions of time.
        simulation: State that the stepping core works on.
        forms: State of the plane.
        guard: Guard of its methods.
    """

    def __init__(self, scene_model: SceneModel, planar_scene: PlanarScene) -> None:
        self.guard = RLock()
        self.playpen, self.timing = scene_model.playpen, scene_model.timing
        self.forms = PlanarForms(scene_model, planar_scene)
        self.simulation = Simulation(self.forms, self.timing)

    @one_thread
    def reset(
        self,
        seed: int = 0,
        *,
        noise: bool = True,
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
        self.forms.put(starts[0])
        self._switch_on_board()
        playpen = self.playpen
        if lamps is not None:
            playpen = playpen.model_copy(update={"lamps": tuple(lamps)})
        lit = Lamps(playpen, cache(partial(stream, seed, "lamps")))
        simulation.set_lamps(lit, playpen.lighting)
        simulation.switch_on()

    @one_thread
    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], in whole steps.

        Raises:
            DivergedError: The motion left its bounds, or a controller gave a speed that is no number.
        """
        while self.simulation.advance(time_ns // self.timing.step_ns) != DONE:
            pass

    @one_thread
    def finish_steps(self, reason: int, until: int) -> None:
        """Act for a return of the stepping core, and run on to a step, as `World.finish_steps` does."""
        self.simulation.checked(reason)
        self.advance_to(until * self.timing.step_ns)

    @property
    def is_self_contained(self) -> bool:
        """True, as nothing acts amid a run."""
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
        """True if an obstacle has pushed the robot in the last substep."""
        grips = self.forms.state["grips"]
        return bool(grips[flat.PUSHED] or grips[flat.PUSHED_ASIDE])

    @property
    def joints(self) -> Floats:
        """Copy of the joint positions (flat.N_JOINTS,)."""
        return self.forms.joints

    def _switch_on_board(self) -> None:
        entry, record = self.playpen.robots[0], self.simulation.records[0]
        kernel.reset(record["registers"].data)
        mode = ROMS[entry.rom].modes[entry.mode]
        record["processor"][:] = 1, mode.function == DEMO

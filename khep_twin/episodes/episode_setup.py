"""A playpen prepared for episodes without a serial line: its compiled scene, step and control period."""

import math
from collections.abc import Iterable
from functools import partial
from operator import index

from khep_twin import units
from khep_twin.board.fault_injection import Fault
from khep_twin.clock import n_steps, to_ns
from khep_twin.episodes.planar.planar import PlanarScene
from khep_twin.errors import PlaypenError, RobotModelError
from khep_twin.playpen import Playpen, PlaypenLike
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.robots.core import core_of
from khep_twin.robots.model import robot_name
from khep_twin.sensing import calibration
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.mujoco_forms import SceneModel

PLANAR_STEP_NS = 4 * units.STEP_NS
"""Step in a plane, one tick [ns]; its only effect is that four sensors are converted at the same pose."""


class EpisodeSetup:
    """A playpen prepared for any number of episodes. It is thread-safe.

    Args:
        playpen: Playpen with a robot, or its name or path.
        step_ns: Step of the physics [ns]: 2.5 ms as on the robot, or coarser, 5 or 10 ms; by default 2.5 ms,
            and 10 ms in a plane.
        period_ns: Control period [ns], whole ticks of 10 ms.
        planar: Whether the robot moves in a plane instead of MuJoCo.
        at_line: Whether episodes have a line. The sensors are then converted one by one with any step of the
            physics, as the age of a reading is that of its conversion.
        faults: Faults of the robots.

    Attributes:
        scene_model: Compiled model.
        step_ns: Step of the episodes [ns].
        steps_per_period: Steps per control period.
        core: Core of the robots.
        interface: Registers of the robots.
        entry: First robot.
        calibration: Calibration of the first robot.
        indices: Indices of the first robot.
        planar_scene: Constants of the plane; None in MuJoCo.

    Raises:
        PlaypenError: The playpen has no robot, or a feature that a plane does not support.
        ValueError: The step or the period is not a whole number of ticks, or there are faults in the plane.
        TypeError: The step or the period is not an integer.
    """

    def __init__(
        self,
        playpen: PlaypenLike,
        *,
        step_ns: int | None = None,
        period_ns: int = units.SCAN_NS,
        planar: bool = False,
        at_line: bool = False,
        faults: Iterable[Fault] = (),
    ) -> None:
        playpen = Playpen.load(playpen)
        name, robots = playpen.name, playpen.robots
        if len(robots) == 0:
            raise PlaypenError(f"{name}: 0 robots; expected one for an episode")
        families = sorted({robot.robot_model.family for robot in robots})
        if len(families) > 1:
            raise PlaypenError(f"{name}: robots of {len(families)} models; expected one model in an episode")
        self.core = core_of(robots[0].robot_model)
        try:
            self.interface = robots[0].robot_model.episode_interface
        except RobotModelError as error:
            raise PlaypenError(f"{name}: robot 1: {error}") from error
        if planar and (playpen.arena.table or any(block.ramp for block in playpen.blocks)):
            raise PlaypenError(f"{name}: a table or a ramp; expected level floor and walls in the plane")
        if planar and len(robots) > 1:
            raise PlaypenError(f"{name}: {len(robots)} robots; expected one in the plane")
        if planar and robots[0].turrets:
            turrets = list(robots[0].turrets)
            raise PlaypenError(f"{name}: robot 1: turrets = {turrets}; expected none in the plane")
        self.faults = tuple(faults)
        if planar and self.faults:
            raise ValueError(f"{len(self.faults)} faults in the plane; expected none")
        # `index` rejects floats such as 5e6.
        period_ns, step_ns = index(period_ns), None if step_ns is None else index(step_ns)
        if period_ns <= 0 or period_ns % units.TICK_NS:
            raise ValueError(
                f"control period of {period_ns / 1e6:g} ms; expected whole ticks of "
                f"{units.TICK_NS / 1e6:g} ms"
            )
        if step_ns is None:
            step_ns = PLANAR_STEP_NS if planar else units.STEP_NS
        self._motion_ns = step_ns
        self._at_line = at_line
        self.step_ns = units.STEP_NS if at_line else step_ns
        self.playpen = playpen
        self.period_ns = period_ns
        self.scene_model = SceneModel.of(playpen, step_ns, self.step_ns)
        self.model = self.scene_model.model
        self.steps_per_period = n_steps(period_ns, self.step_ns)
        self.entry = robots[0]
        self.calibration = calibration.read(self.entry.calibration)[0]
        if self.calibration.ambient.rises_with_light:
            problem = f"robot 1: calibration = {self.entry.calibration!r}: rises_with_light = true"
            raise PlaypenError(f"{name}: {problem}; expected false in an episode")
        self.indices = RobotIndices.of(self.model, robot_name(0))
        self.planar_scene = PlanarScene(playpen, self.model, self.indices, step_ns) if planar else None

    def __reduce__(self) -> tuple[object, ...]:
        """Return a function and its arguments for a copy, as MuJoCo's scene cannot be copied."""
        make = partial(
            EpisodeSetup,
            step_ns=self._motion_ns,
            period_ns=self.period_ns,
            planar=self.planar_scene is not None,
            at_line=self._at_line,
            faults=self.faults,
        )
        return make, (self.playpen,)

    def periods(self, seconds: float) -> int:
        """Return the number of control periods in a time [s].

        Raises:
            ValueError: The number is not whole, or is below 0.
        """
        if not 0 <= seconds < math.inf:
            raise ValueError(f"{seconds} s; expected a time from 0, of whole control periods")
        duration_ns = to_ns(seconds)
        if duration_ns % self.period_ns:
            raise ValueError(
                f"{seconds:g} s; expected a whole number of control periods of {self.period_ns / 1e6:g} ms"
            )
        return duration_ns // self.period_ns

    def start(self, seed: int) -> Start:
        """Return the start of the first robot: its pose in the playpen, or the spot drawn by the seed."""
        robot = self.entry
        if robot.spots:
            robot = at_spots(self.playpen, seed).robots[0]
        return robot.x_mm, robot.y_mm, robot.heading_deg

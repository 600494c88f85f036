"""A playpen prepared for episodes without a serial line: its scene, its robot and its lamps."""

import copy
import math
from collections.abc import Sequence
from operator import index
from threading import Lock

import mujoco

from khep_twin import units
from khep_twin.clock import n_steps, to_ns
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Lamp, Playpen
from khep_twin.playpen.starts import Start, at_spots
from khep_twin.playpen_to_mjcf import set_step, to_spec
from khep_twin.randomness import stream
from khep_twin.rollout import stepping
from khep_twin.rollout.planar.planar import PlanarScene
from khep_twin.sensing import calibration
from khep_twin.sensing.ambient import bulbs
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.optics import Bulbs
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.world import keep_quiet

PLANAR_STEP_NS = 4 * units.STEP_NS
"""Step in a plane, one tick [ns]; its only effect is that sensors are converted four at a time."""


class EpisodeSetup:
    """A playpen prepared for any number of episodes; threads may share it.

    Args:
        playpen: Playpen with one robot.
        step_ns: Physics step [ns]: 2.5 ms as on the robot, or coarser, 5 or 10 ms; by default 2.5 ms, and
            10 ms in a plane.
        period_ns: Control period [ns], whole ticks of 10 ms.
        planar: Whether the robot moves in a plane instead of MuJoCo.

    Raises:
        PlaypenError: The playpen has a feature that episodes without a serial line do not support.
        ValueError: The step or the period does not fit into whole ticks.
        TypeError: The step or the period is not an integer.
    """

    def __init__(
        self,
        playpen: Playpen,
        *,
        step_ns: int | None = None,
        period_ns: int = units.SCAN_NS,
        planar: bool = False,
    ) -> None:
        _refuse(playpen)
        # `index` rejects floats such as 5e6.
        period_ns, step_ns = index(period_ns), None if step_ns is None else index(step_ns)
        if period_ns <= 0 or period_ns % units.TICK_NS:
            raise ValueError(
                f"control period of {period_ns / 1e6:g} ms; expected whole ticks of "
                f"{units.TICK_NS / 1e6:g} ms"
            )
        mujoco.set_mju_user_warning(keep_quiet)
        if step_ns is None:
            step_ns = PLANAR_STEP_NS if planar else units.STEP_NS
        self.playpen, self.step_ns, self.period_ns = playpen, step_ns, period_ns
        spec = to_spec(playpen)
        if step_ns != units.STEP_NS:
            set_step(spec, step_ns)
        self.model = spec.compile()
        # Compiled episodes cast rays themselves, only where something is near enough to be seen.
        self.without_sensors = copy.copy(self.model)
        self.without_sensors.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self.entry = playpen.robots[0]
        self.calibration = calibration.read(self.entry.calibration)[0]
        self.indices = at = RobotIndices.of(self.model, "khepera0")
        self.light = self.lit(playpen.lamps)
        self.planar_scene = PlanarScene(playpen, self.model, at, step_ns) if planar else None
        width, height = playpen.arena.width_mm, playpen.arena.height_mm
        self.sim_indices = stepping.SimIndices(
            *(
                (*at.wheel_angles, *at.motors, at.pose)
                if self.planar_scene is None
                else PlanarScene.JOINT_ADDRESSES
            ),
            self.calibration.motors.constant,
            1.0 + max(units.metres(width), units.metres(height)),
            step_ns // units.STEP_NS,
            n_steps(units.TICK_NS, step_ns),
            n_steps(units.SCAN_NS, step_ns),
            n_steps(period_ns, step_ns),
        )

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

    def lit(self, lamps: Sequence[Lamp]) -> "EpisodeLamps":
        """Return the light of other lamps on this ground."""
        lamp_playpen = self.playpen.model_copy(update={"lamps": tuple(lamps)})
        return EpisodeLamps(lamp_playpen, self.model, self.indices, self.step_ns)

    def start(self, seed: int) -> Start:
        """Return the robot's start: its own pose, or the spot that the seed draws."""
        robot = self.entry
        if robot.spots:
            robot = at_spots(self.playpen, seed).robots[0]
        return robot.x_mm, robot.y_mm, robot.heading_deg

    def another(self, seed: int) -> Calibration:
        """Return the calibration of another robot of the same make, drawn by the seed."""
        return calibration.varied(self.calibration, stream(seed, "robot", 0, "spread"))


class EpisodeLamps:
    """Lamps of an episode: positions, occlusion, and power at each step.

    Args:
        playpen: Playpen with these lamps.
        model: Model of the scene.
        robot: Indices of the robot.
        step_ns: Physics step of the scene [ns].
    """

    def __init__(self, playpen: Playpen, model: mujoco.MjModel, robot: RobotIndices, step_ns: int) -> None:
        # Lamps that are all on draw no random numbers.
        self._lamps = Lamps(playpen, stream(0, "lamps"))
        self._step_ns = step_ns
        self.bulbs: Bulbs = bulbs(SightLines(model, robot, self._lamps.positions), playpen.lighting)
        self._first = list(self._lamps.powers)
        self._rows: list[list[float]] = []
        self._turn = Lock()

    def at_start(self) -> list[list[float]]:
        """Return the powers before the first step (1, n_lamps) [W]."""
        return [self._first]

    def during(self, first: int, count: int) -> list[list[float]]:
        """Return the powers after each of some steps, or one row if they are constant (n, n_lamps) [W]."""
        if self._lamps.steady:
            return [self._first]
        # Environments in threads share the setup, and so its light.
        with self._turn:
            while len(self._rows) < first + count:
                self._lamps.update((len(self._rows) + 1) * self._step_ns, ())
                self._rows.append(list(self._lamps.powers))
        return self._rows[first : first + count]


def _refuse(playpen: Playpen) -> None:
    """Raise a `PlaypenError` if the playpen has a feature that episodes without a serial line lack."""
    name, robots = playpen.name, playpen.robots
    if len(robots) != 1:
        raise PlaypenError(f"{name}: {len(robots)} robots; expected one for an episode without a serial line")
    if robots[0].turrets:
        raise PlaypenError(
            f"{name}: robot 1: turrets = {list(robots[0].turrets)}; expected none for an episode without a "
            "serial line"
        )
    if playpen.lighting.mode != "all":
        raise PlaypenError(
            f"{name}: lighting: mode = {playpen.lighting.mode!r}; expected 'all' for an episode without a "
            "serial line"
        )

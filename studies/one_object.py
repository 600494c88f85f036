"""One robot and one object, in the twin or in another world: the same controllers run in each.

The object is at the origin: a wall that fills the half-plane x > 0, an upright cylinder, or a lamp.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Arena, Cylinder, Lamp, Playpen, RobotEntry
from khep_twin.units import BODY_RADIUS, BULB_RADIUS

Floats = NDArray[np.float64]

Readings = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Function of distances [m] and bearings [rad] (n,): proximity and ambient counts, each (n, 8)."""

Decide = Callable[[Floats, Floats, Floats], Floats]
"""Function of n robots' proximity and ambient counts, each (n, 8), and a memory (n, n_memory), which it may
change; returns speeds (n, 2) [pulses/10 ms]."""

PERIOD_S = units.SCAN_NS * 1e-9
"""Control period [s]: a scan of all sensors."""

LAMP_POWER_W = 2.0
"""Power of the lamp [W], as of the sampled one."""

_MIDDLE_MM = 1500.0
_SPEED_LIMIT = 127


@dataclass(frozen=True, slots=True)
class Target:
    """The object of a world.

    Attributes:
        name: Name in results.
        radius: Radius of a cylinder or of a lamp's bulb [m]; 0 for a wall.
        solid: Whether the robot is stopped by it.
    """

    name: str
    radius: float
    solid: bool = True

    def place(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return distances from the robot's edge [m] and bearings, ccw [rad], at poses (n, 3)."""
        x, y, heading = poses.T
        if not self.radius:
            return -x - BODY_RADIUS, -heading
        return np.hypot(x, y) - self.radius - BODY_RADIUS, np.arctan2(-y, -x) - heading


WALL = Target("wall", 0.0)
CYLINDER = Target("cylinder", 0.027)
LAMP = Target("lamp", BULB_RADIUS, solid=False)


class World(Protocol):
    """World of n robots that move at the same time, each alone with the object."""

    poses: Floats

    def begin(self, starts: Floats) -> None:
        """Place the robots at poses x, y [m] and heading [rad] from the object (n, 3), at rest."""
        ...

    def read(self) -> tuple[Floats, Floats]:
        """Return proximity and ambient counts, each (n, 8)."""
        ...

    def drive(self, speeds: Floats) -> None:
        """Drive with speeds (n, 2) [pulses/10 ms] for a period."""
        ...


@dataclass(frozen=True, slots=True)
class Controller:
    """Controller of n robots together.

    Attributes:
        name: Name in results.
        decide: Function that returns the speeds.
        n_memory: Length of its memory, all 0 at first.
    """

    name: str
    decide: Decide
    n_memory: int = 0


@dataclass(frozen=True, slots=True)
class Track:
    """Motion of n robots, at the start and after each period.

    Attributes:
        poses: Poses x, y [m] and heading [rad], whole turns counted (n_periods + 1, n, 3).
        gaps: Distances from the robots' edge to the object (n_periods + 1, n) [m].
    """

    poses: Floats
    gaps: Floats


def run(world: World, target: Target, controller: Controller, starts: Floats, seconds: float) -> Track:
    """Run a controller from start poses (n, 3); speeds are rounded and clipped as by command D."""
    world.begin(starts)
    memory = np.zeros((len(starts), controller.n_memory))
    poses = [starts]
    for _ in range(round(seconds / PERIOD_S)):
        speeds = controller.decide(*world.read(), memory)
        world.drive(np.clip(np.round(speeds), -_SPEED_LIMIT, _SPEED_LIMIT))
        poses.append(world.poses.copy())
    track = np.array(poses)
    return Track(track, np.array([target.place(period_poses)[0] for period_poses in track]))


class TwinWorld:
    """World of the twin in MuJoCo, one episode for each robot.

    Args:
        target: Object near the robots.
        noise: Whether sensors are noisy.
        seed: Seed of the first robot; the others have the next ones.
        readings: Readings that replace those of the twin's sensors, by distance and bearing.
    """

    def __init__(
        self, target: Target, *, noise: bool = False, seed: int = 0, readings: Readings | None = None
    ) -> None:
        self._target, self._readings = target, readings
        self._setup = EpisodeSetup(scene(target))
        self._noise, self._seed = noise, seed
        self._origin = np.array([2 * _MIDDLE_MM if target is WALL else _MIDDLE_MM, _MIDDLE_MM]) / 1e3
        self._lanes: list[Episode] = []

    def begin(self, starts: Floats) -> None:
        """Place the robots at poses."""
        while len(self._lanes) < len(starts):
            self._lanes.append(Episode(self._setup))
        self._live = self._lanes[: len(starts)]
        for number, (episode, (x, y, heading)) in enumerate(zip(self._live, starts, strict=True)):
            position_mm = (np.array([x, y]) + self._origin) * 1e3
            start = float(position_mm[0]), float(position_mm[1]), math.degrees(heading)
            episode.begin(self._seed + number, EpisodeOptions(start=start, noise=self._noise))
        self.poses = starts.copy()

    def read(self) -> tuple[Floats, Floats]:
        """Return the counts of the last scan."""
        if self._readings is not None:
            proximity, ambient = self._readings(*self._target.place(self.poses))
            return np.round(proximity), np.round(ambient)
        counts = np.array([episode.readings() for episode in self._live], np.float64)
        return counts[:, 0], counts[:, 1]

    def drive(self, speeds: Floats) -> None:
        """Drive for a period; headings count whole turns."""
        for number, (episode, (left, right)) in enumerate(zip(self._live, speeds.tolist(), strict=True)):
            episode.drive(left, right)
            episode.run(PERIOD_S)
            x, y, heading = episode.pose
            turned = heading - self.poses[number, 2]
            self.poses[number, :2] = x - self._origin[0], y - self._origin[1]
            self.poses[number, 2] += math.atan2(math.sin(turned), math.cos(turned))


def scene(target: Target) -> Playpen:
    """Return the object as a playpen: the wall at its right side, others in its middle."""
    middle_mm = _MIDDLE_MM
    cylinders: tuple[Cylinder, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    if target is CYLINDER:
        cylinders = (Cylinder(x_mm=middle_mm, y_mm=middle_mm, radius_mm=target.radius * 1e3, height_mm=50),)
    elif target is LAMP:
        lamps = (Lamp(x_mm=middle_mm, y_mm=middle_mm, power_w=LAMP_POWER_W),)
    return Playpen(
        version=1,
        name=target.name,
        arena=Arena(width_mm=2 * _MIDDLE_MM, height_mm=2 * _MIDDLE_MM),
        robot=(RobotEntry(x_mm=500, y_mm=500, heading_deg=0),),
        cylinder=cylinders,
        lamp=lamps,
        surfaces={},
    )

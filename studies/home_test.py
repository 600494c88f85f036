"""Homing by odometry alone: `python -m studies home-test [PICTURE]`.

A host drives a robot over an open floor for 30 s: legs of 100 to 400 mm straight on at speed 10 (80 mm/s,
as the toolbox's vehicles drive), and between them turns on the spot of 30 to 150 degrees to either side,
the wheels at speed 5. Then it returns to its start by odometry and stops within 5 mm.
It knows the encoders (command H, as often as 9600 baud allow) and the nominal wheels. The result is the true
distance from the start, for 100 robots of the same model (seeds 1 to 100, a path each), for the nominal
robot, and for three robots on ten paths each.
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from khep_twin.host import Khepera
from khep_twin.randomness import stream
from khep_twin.units import PULSE_LENGTH, WHEEL_BASE
from tools.command_table import command_line

ROBOTS = range(1, 101)
HOME_MM = 100.0
"""Distance within which published robots count as at home [mm]."""

_DRIVEN_S = 30.0
_FAST, _SLOW = 10, 5
_NEAR = 0.005
"""Distance from home at which the host stops [m]."""

_ARENA = """
version = 1
name = "open"
[arena]
width_mm = 6000
height_mm = 6000
[[robot]]
x_mm = 3000
y_mm = 3000
heading_deg = 0
"""


class Odometry:
    """Pose relative to the start, from the encoders and the nominal wheels.

    Attributes:
        x: Position ahead of the start [m].
        y: Position to the left of the start [m].
        heading: Heading counter-clockwise from that of the start [rad].
    """

    def __init__(self, robot: Khepera) -> None:
        self._robot, self._last = robot, robot.position()
        self.x = self.y = self.heading = 0.0

    def update(self) -> None:
        """Read the encoders."""
        now = self._robot.position()
        left, right = ((new - old) * PULSE_LENGTH for new, old in zip(now, self._last, strict=True))
        middle = self.heading + (right - left) / 2 / WHEEL_BASE
        self.x += (left + right) / 2 * math.cos(middle)
        self.y += (left + right) / 2 * math.sin(middle)
        self.heading += (right - left) / WHEEL_BASE
        self._last = now

    @property
    def away(self) -> float:
        """Distance from the start [m]."""
        return math.hypot(self.x, self.y)

    @property
    def bearing(self) -> float:
        """Direction of the start, counter-clockwise from ahead [rad]."""
        return math.remainder(math.atan2(-self.y, -self.x) - self.heading, math.tau)


def open_arena(folder: str | Path) -> Path:
    """Write a playpen with one robot in an open arena; return its path."""
    path = Path(folder) / "open.toml"
    path.write_text(_ARENA)
    return path


def twin(arena: Path, seed: int) -> Khepera:
    """Return a robot of the same model, or the nominal one for seed 0."""
    return Khepera(f"khep://{arena}?seed={seed}&vary={'on' if seed else 'off'}")


def true_pose(robot: Khepera) -> tuple[float, float, float]:
    """Return a twin's x, y [m] and heading [rad]."""
    return robot.port.twin.world.poses[0]  # type: ignore[attr-defined]


def miss_distance(arena: Path, seed: int, path: int) -> float:
    """Return the true distance from the start after homing by odometry [m]."""
    with twin(arena, seed) as robot:
        start_x, start_y, _ = true_pose(robot)
        odometry = Odometry(robot)
        _wander(robot, odometry, stream(path, "home test"))
        _go_home(robot, odometry)
        robot.set_speed(0, 0)
        robot.sleep(0.5)
        x, y, _ = true_pose(robot)
        return math.hypot(x - start_x, y - start_y)


def _wander(robot: Khepera, odometry: Odometry, rng: np.random.Generator) -> None:
    """Drive legs and turns on the spot until the time is over."""
    end = robot.time + _DRIVEN_S
    while robot.time < end:
        length, turn = rng.uniform(0.1, 0.4), math.radians(rng.uniform(30, 150)) * rng.choice((-1, 1))
        x, y = odometry.x, odometry.y
        robot.set_speed(_FAST, _FAST)
        while math.hypot(odometry.x - x, odometry.y - y) < length and robot.time < end:
            odometry.update()
        aim = odometry.heading + turn
        while (aim - odometry.heading) * turn > 0 and robot.time < end:
            side = round(math.copysign(_SLOW, turn))
            robot.set_speed(-side, side)
            odometry.update()


def _go_home(robot: Khepera, odometry: Odometry) -> None:
    """Drive to the start according to the odometry."""
    while odometry.away > _NEAR:
        bearing = odometry.bearing
        if abs(bearing) > 0.3:
            side = round(math.copysign(_SLOW if abs(bearing) > 0.6 else 1, bearing))
            robot.set_speed(-side, side)
        else:
            speed = _FAST if odometry.away > 0.05 else 2
            side = round(speed * bearing)
            robot.set_speed(speed - side, speed + side)
        odometry.update()


def misses(seeds: range, paths: range) -> NDArray[np.float64]:
    """Return the distances from home on paths [mm], pair by pair; one seed drives all paths."""
    with TemporaryDirectory() as folder:
        arena = open_arena(folder)
        pairs = [(seeds[0], path) for path in paths] if len(seeds) == 1 else zip(seeds, paths, strict=True)
        return np.array([miss_distance(arena, seed, path) * 1e3 for seed, path in pairs])


def summary_line(name: str, missed: NDArray[np.float64]) -> str:
    """Return one line about a series of tests."""
    low, middle, high = np.percentile(missed, (10, 50, 90))
    at_home = float((missed <= HOME_MM).mean())
    return (
        f"{name:<34} median {middle:5.1f} mm, 10 to 90 %: {low:5.1f} to {high:5.1f} mm, "
        f"within {HOME_MM:.0f} mm: {at_home:.0%}"
    )


def draw(missed: NDArray[np.float64], target: Path) -> None:
    """Draw a histogram of the misses of robots of the same model."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    panel = figure.subplots()
    panel.hist(missed, bins=np.arange(0, max(missed.max(), 200) + 10, 10).tolist(), color="#1b4965")
    panel.axvspan(50, 100, color="#fae0da", zorder=0, label="published: 50 to 100 mm off")
    panel.axvline(
        float(np.median(missed)), color="#e4572e", lw=1.6, label=f"median {np.median(missed):.0f} mm"
    )
    panel.set_xlabel("distance from home after 30 s of driving and the way back by odometry [mm]")
    panel.set_ylabel(f"robots of {len(missed)}")
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(frameon=False)
    figure.savefig(target, dpi=110)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("picture", type=Path, nargs="?", help="file for a picture")
    options = parser.parse_args()
    nominal = misses(range(1), range(1, 11))
    print(summary_line("the nominal robot, 10 paths", nominal), flush=True)
    for seed in (1, 2, 3):
        print(
            summary_line(f"robot {seed}, 10 paths", misses(range(seed, seed + 1), range(1, 11))), flush=True
        )
    missed = misses(ROBOTS, ROBOTS)
    print(summary_line(f"{len(ROBOTS)} robots, a path each", missed))
    if options.picture is not None:
        draw(missed, options.picture)

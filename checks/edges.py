"""Random playpens at the limits of the check, driven through at random and at full speed.

    python -m checks edges 2000

A quarter of the playpens have Kheperas IV. Each playpen depends on its number alone, so that findings are
reproducible: `--first NUMBER` starts there.
Findings are a simulation that diverges, a robot that leaves the arena, exceeds 1.1 m/s (full speed is 1.02; a
Khepera IV 1.3, full speed 1.22),
rises 15 mm above the floor or tilts by 30 degrees, and a movable object that leaves the arena through a wall.
A robot with a gripper is top-heavy and has an arm that pushes: its fall ends the drive without a finding. The
same holds in playpens with movable objects, as a robot may climb on a loose board.
"""

import math
import random
from collections.abc import Iterator

from khep_twin import playpen, units
from khep_twin.clock import NS_PER_S
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen.polygon import contains, distance
from khep_twin.robots.model import Feature
from khep_twin.world import World
from tools.command_table import command_line

FASTEST, FASTEST4 = 1.1, 1.3
"""Highest speed of a Khepera and of a Khepera IV [m/s]."""

SUNK_MM = 3.0
"""Depth to which a thin object hit by a robot sinks into a wall, and comes out again [mm]."""

HIGHEST, STEEPEST_DEG = 0.015, 30.0
"""Limits of a robot's height above the floor [m], and of its tilt."""

FULL_PWM = 2940
"""Full PWM of a Khepera IV."""

TOPPLED = "toppled"

COMMANDS = [
    (127, 127),
    (-127, -127),
    (127, -127),
    (127, 60),
    (60, 127),
    (-127, -60),
    (-60, -127),
    (-127, 127),
]
"""Speeds of left and right wheel [8 mm/s]."""


def text_of(number: int) -> str:
    """Return the playpen of a number, which the check may refuse."""
    rng = random.Random(number)
    scale, robot = (2.5, 'model = "khepera4"') if number % 4 == 3 else (1, "")
    width, height = scale * rng.uniform(250, 500), scale * rng.uniform(200, 400)
    lines = ['version = 1\nname = "edge"\n[arena]', f"width_mm = {width:.0f}", f"height_mm = {height:.0f}"]
    lines += [
        f"wall_thickness_mm = {rng.choice((1, 2, 3, 5, 8, *[10] * 5))}",
        f"wall_height_mm = {rng.choice((15, 20, 30, 50, 100))}",
    ]
    if rng.random() < 0.3:
        tip = rng.uniform(0.05, 0.95) * height
        right, top = width // 1, height // 1
        corners = [[0, 0], [right, 0], [width * 0.6 // 1, tip // 1], [right, top], [0, top]]
        lines.append(f"outline_mm = {corners}")
    for _ in range(rng.choice((0, 1, 2))):
        points = [
            [rng.uniform(0, width) // 1, rng.uniform(0, height) // 1] for _ in range(rng.choice((2, 3)))
        ]
        lines += [
            "[[wall]]",
            f"points_mm = {points}",
            f"thickness_mm = {_thin(rng)}",
            f"height_mm = {_low(rng)}",
        ]
    for _ in range(rng.choice((0, 1, 2, 3, 4))):
        round_one = rng.random() < 0.4
        lines += ["[[cylinder]]" if round_one else "[[block]]", *_place(rng, width, height)]
        if round_one:
            lines.append(f"radius_mm = {_side(rng)}")
        else:
            lines += [f"length_mm = {_side(rng)}", f"width_mm = {_side(rng)}"]
            lines.append(f"angle_deg = {rng.choice((0, 0, 45, rng.uniform(0, 90)))}")
        lines.append(f"height_mm = {_low(rng)}")
        if rng.random() < 0.6:
            lines += ["movable = true", f"mass_g = {rng.choice((5, 5, 20, 100, 1000, 10_000))}"]
    for _ in range(rng.choice((1, 1, 2))):
        lines += ["[[robot]]", *_place(rng, width, height), f"heading_deg = {rng.uniform(0, 360)}", robot]
        if rng.random() < 0.2 and not robot:
            lines.append('turrets = ["gripper"]')
    return "\n".join(lines) + "\n"


def playpens(first: int, count: int) -> Iterator[tuple[int, Playpen]]:
    """Yield so many playpens that pass the check, with their numbers."""
    number = first
    while count:
        try:
            candidate = playpen.parse(text_of(number), "edge.toml")
        except PlaypenError:
            pass
        else:
            yield number, candidate
            count -= 1
        number += 1


def find_fault(number: int, candidate: Playpen, seconds: float = 10.0) -> str | None:
    """Drive around in a playpen; return the finding, None without one."""
    rng = random.Random(-1 - number)
    world = World(candidate, noise=False, unpaced=True)
    due_ns = [0] * len(world.robots)
    ejected: set[str] = set()
    try:
        while world.time_ns < seconds * NS_PER_S:
            for index, robot in enumerate(world.robots):
                if world.time_ns >= due_ns[index]:
                    speeds = rng.choice(COMMANDS)
                    arm, hand = rng.randrange(256), rng.randrange(2)
                    if Feature.LINE in candidate.robots[index].robot_model.features:
                        robot.send(b"D,%d,%d\nT,1,E,%d\nT,1,D,%d\n" % (*speeds, arm, hand))
                    else:
                        robot.send(b"L,%d,%d\r\n" % tuple(speed * FULL_PWM // 127 for speed in speeds))
                    due_ns[index] = world.time_ns + rng.randrange(5, 150) * units.TICK_NS
            world.advance_to(world.time_ns + units.TICK_NS)
            if finding := next(_find_faults(world, ejected), None):
                return f"{finding} at {world.time_ns / NS_PER_S:g} s" if finding != TOPPLED else None
    except DivergedError as error:
        return str(error)
    return None


def _find_faults(world: World, ejected: set[str]) -> Iterator[str]:
    """Yield current findings; `ejected` holds objects that hopped over a lower wall, which are none."""
    arena, data = world.playpen.arena, world.data
    for index in range(1, world.model.nbody):
        name = str(world.model.body(index).name)
        robot, _, part = name.partition("/")
        if part not in ("", "base") or name in ejected:
            continue
        x, y, z = data.xpos[index].tolist()
        if not contains(arena.corners, x * 1000, y * 1000):
            if distance(arena.corners, x * 1000, y * 1000) < SUNK_MM and not part:
                continue
            if part or z * 1000 < arena.wall_height_mm:
                yield f"{name} is outside the arena, at ({x:.3f}, {y:.3f}, {z:.3f}),"
            ejected.add(name)
        elif part:
            yield from _off_its_wheels(world, index, int(robot.removeprefix("khepera")))
        elif not -0.01 < z < 1.5:
            yield f"{name} is {z:.3f} m high"


def _off_its_wheels(world: World, body: int, number: int) -> Iterator[str]:
    upright = max(-1.0, min(1.0, float(world.data.xmat[body][8])))
    tilt_deg, height = math.degrees(math.acos(upright)), abs(float(world.data.xpos[body][2]))
    start = int(world.model.body(body).dofadr[0])
    things = (*world.playpen.blocks, *world.playpen.cylinders)
    if world.playpen.robots[number].turrets or any(thing.movable for thing in things):
        if tilt_deg > STEEPEST_DEG:
            yield TOPPLED
    elif tilt_deg > STEEPEST_DEG:
        yield f"robot {number + 1} tilts by {tilt_deg:.0f} degrees"
    elif height > HIGHEST:
        yield f"robot {number + 1} is {height * 1000:.1f} mm off the floor"
    fastest = FASTEST if Feature.LINE in world.playpen.robots[number].robot_model.features else FASTEST4
    if (speed := math.hypot(*world.data.qvel[start : start + 2].tolist())) > fastest:
        yield f"robot {number + 1} goes {speed:.2f} m/s"


def _thin(rng: random.Random) -> int:
    return rng.choice((1, 2, 3, 5, 8))


def _low(rng: random.Random) -> int:
    return rng.choice((1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50, 100))


def _side(rng: random.Random) -> float:
    return rng.choice((1, 2, 3, 5, 8, 12, 20, 40, 80))


def _place(rng: random.Random, width: float, height: float) -> list[str]:
    return [f"x_mm = {rng.uniform(0, width):.0f}", f"y_mm = {rng.uniform(0, height):.0f}"]


def main() -> int:
    """Search the requested number of playpens; return 1 if there are findings."""
    parser = command_line(__doc__)
    parser.add_argument("count", type=int, nargs="?", default=2000, help="playpens that pass the check")
    parser.add_argument("--first", type=int, default=0, help="number to begin at")
    options = parser.parse_args()
    finds = 0
    for number, candidate in playpens(options.first, options.count):
        if finding := find_fault(number, candidate):
            finds += 1
            print(f"playpen {number}: {finding}", flush=True)
    print(f"{options.count} playpens from {options.first} on: {finds} broke")
    return 1 if finds else 0

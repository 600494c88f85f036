"""Cost of an image of the K213, in pure Python and compiled: `python -m benchmarks.line_images`.

Each scene is that of a playpen with a K213 on its first robot, at its start. The best of several rounds
counts, as other load only adds time.
"""

import time
from collections.abc import Callable

from khep_twin.board.k213 import PIXELS
from khep_twin.playpen import Playpen
from khep_twin.sensing.line_faces import fixed_faces, moving_faces, read_poses
from khep_twin.simulation.ready import function_of
from khep_twin.vision.camera import Lamp, LineCamera, eye_of
from khep_twin.world import World

PLAYPENS = ("default", "stripes", "obstacles", "two-lamps", "workshop", "deceptive-maze")

ROUNDS = 7


def with_a_k213(playpen: Playpen) -> Playpen:
    """Return a playpen whose first robot carries a K213 alone, under walls that allow it."""
    first, *other_robots = playpen.robots
    robots = (first.model_copy(update={"turrets": ("k213",)}), *other_robots)
    arena = playpen.arena.model_copy(update={"wall_height_mm": max(playpen.arena.wall_height_mm, 50.0)})
    return playpen.model_copy(update={"robots": robots, "arena": arena})


def cost_us(take: Callable[[], object], count: int) -> float:
    """Return the time of an image [us]: the best round's mean."""
    best = float("inf")
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(count):
            take()
        best = min(best, (time.perf_counter() - start) / count)
    return best * 1e6


def row(name: str) -> str:
    """Measure one playpen."""
    world = World(with_a_k213(Playpen.load(name)), compiled=False)
    turret = next(iter(world.robots[0].firmware.turrets.values()))
    eye = world.model.camera("khepera0/k213/eye").id
    fixed, moving = fixed_faces(world.model), moving_faces(world.model, world.robots[0].indices.base)
    camera = LineCamera(fixed, moving, read_poses(world.data), function_of("vision"))
    powers = world.simulation.powers
    lamps: list[Lamp] = [(*at, power) for at, power in zip(world.lamps.positions, powers, strict=True)]

    def take(compiled: bool) -> Callable[[], int]:
        eye_pose, pixels = eye_of(world.data, eye), turret.registers[PIXELS]
        return lambda: camera.take(eye_pose, pixels, lamps, 300.0, 0, (1, 2), 0, compiled=compiled)

    take(True)()
    compiled_us, plain_us = cost_us(take(True), 200), cost_us(take(False), 5)
    counts = f"{len(fixed)} | {len(moving.geoms)} | {len(lamps)}"
    return f"| `{name}` | {counts} | {compiled_us:.0f} | {plain_us / 1e3:.1f} |"


if __name__ == "__main__":
    print("| playpen | fixed faces | moving geoms | lamps | compiled [us] | plain [ms] |")
    print("|---|---|---|---|---|---|")
    for name in PLAYPENS:
        print(row(name), flush=True)

"""Kheperax 0.2.0 as a peer, in a separate process and environment, without khep_twin.

The first line of the input is the scene in JSON, from `peers.scene`; the answer is versions. Each further
line, "ROBOTS STEPS", is one measurement: ROBOTS robots together take STEPS steps of 20 ms, as
`jax.lax.scan` over steps under `jax.vmap` over robots, compiled before the clock starts. The answer in JSON:
`wall` and `cpu` [s], the latter of all threads, the mean `way_mm` of a robot's centre, and the number of
robots `stuck` at the end, as a robot that has touched a wall never moves again in Kheperax.

The same as in khep_twin: the arena's size, walls and blocks, the body's radius, eight sensors at the
calibration's headings, the control period, speeds in pulses per 10 ms, and the ROM's rule, speed = counts x
weights / 400 + 10. Not the same: Kheperax has no physics, motors, firmware, noise or lamps; a wheel's path of
20 ms is one arc, with a wheel base as wide as the body; walls have no thickness, a cylinder
has twelve sides, nothing has a height; a sensor is one laser from the robot's centre to its reach, and the
counts for the rule fall linearly with its length, from 1023 at the body's edge to 0 at the reach;
numbers have 32 bits. It draws random numbers and checks its bumpers for walls in each step, though neither
is used here.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Any


def main() -> None:
    scene = json.loads(sys.stdin.readline())
    run = make_measure(scene)
    print(json.dumps({name: version(name) for name in ("kheperax", "jax")}), flush=True)
    for line in sys.stdin:
        robots, steps = (int(word) for word in line.split())
        print(json.dumps(run(robots, steps)), flush=True)


def make_measure(scene: dict[str, Any]) -> Callable[[int, int], dict[str, float]]:
    """Return a function of the numbers of robots and steps that measures them."""
    import jax
    import jax.numpy as jnp

    jax.tree_leaves = jax.tree_util.tree_leaves  # Kheperax calls it, and jax has removed it
    from kheperax.simu.geoms import Pos, Segment
    from kheperax.simu.maze import Maze
    from kheperax.simu.posture import Posture
    from kheperax.simu.robot import Robot
    from kheperax.tasks.config import KheperaxConfig
    from kheperax.tasks.main import KheperaxTask

    unit_mm = max(scene["width_mm"], scene["height_mm"])
    radius, reach = scene["radius_mm"] / unit_mm, scene["reach_mm"] / unit_mm
    x, y, heading = scene["start"]
    ends = jnp.asarray(scene["walls_mm"], jnp.float32).reshape(-1, 4).T / unit_mm
    limits = ((0.0, 0.0), (scene["width_mm"] / unit_mm, scene["height_mm"] / unit_mm))
    maze = Maze(Segment(Pos(ends[0], ends[1]), Pos(ends[2], ends[3])), Maze.make_border_walls(limits))
    robot = Robot(
        posture=Posture(x / unit_mm, y / unit_mm, heading),
        radius=radius,
        laser_ranges=radius + reach,
        laser_angles=jnp.asarray(scene["headings"]),
    )
    step_of_a_pulse = scene["pulse_mm"] * 2 / unit_mm  # in 20 ms, at a pulse per 10 ms
    config = KheperaxConfig.get_default()
    config.maze, config.robot, config.limits = maze, robot, limits
    config.action_scale = scene["top_speed"] * step_of_a_pulse
    task = KheperaxTask(config)
    weights = jnp.asarray(scene["weights"])

    def rule(lengths: Any) -> Any:
        counts = 1023 * jnp.clip(1 - (lengths - radius) / reach, 0, 1)
        return (counts @ weights / scene["divisor"] + scene["speed"]) / scene["top_speed"]

    def one_step(state: Any, _: Any) -> tuple[Any, Any]:
        next_state = task.step(state, rule(state.obs[:-2]))
        moved = next_state.robot.posture.dist_to(state.robot.posture)
        return next_state, moved

    def episode(state: Any, steps: int) -> tuple[Any, Any, Any]:
        next_state, moved = jax.lax.scan(one_step, state, None, steps)
        return next_state, moved.sum(), next_state.robot.collides(maze)

    @cache
    def compile_run(robots: int, steps: int) -> tuple[Any, Any]:
        keys = jax.random.split(jax.random.PRNGKey(1), robots)

        def first_state(key: Any) -> Any:
            # After one step all numbers have their final types.
            return one_step(task.reset(key), None)[0]

        if robots == 1:
            run = jax.jit(lambda state: episode(state, steps))
            states = jax.jit(first_state)(keys[0])
        else:
            run = jax.jit(jax.vmap(lambda state: episode(state, steps)))
            states = jax.jit(jax.vmap(first_state))(keys)
            turn = jnp.linspace(0, 2 * jnp.pi, robots, endpoint=False)
            posture = states.robot.posture
            states = states.replace(robot=states.robot.replace(posture=posture.replace(angle=turn)))
        jax.block_until_ready(run(states))
        return run, states

    def measure(robots: int, steps: int) -> dict[str, float]:
        run, states = compile_run(robots, steps)
        cpu, wall = cpu_s(), time.perf_counter()
        _, way, stuck = jax.block_until_ready(run(states))
        times = {"wall": time.perf_counter() - wall, "cpu": cpu_s() - cpu}
        return {**times, "way_mm": float(way.mean() * unit_mm), "stuck": int(stuck.sum())}

    return measure


def cpu_s() -> float:
    """Return the processor time of all threads of this process [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())

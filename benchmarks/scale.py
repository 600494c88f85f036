"""How fast lives without a serial line are: `python -m benchmarks.scale`.

All rows drive the ROM's Braitenberg vehicle along the same way for the same time, interleaved, in one
process; times are of the processor, but for the rows with threads, which are by the clock. The floor is a
loop around mj_step alone, called from Python, in the same scene with its rangefinders, driven by the motor
voltages that the vehicle had. A second floor has no sensors at all. What comes out depends on the machine and
on what else it does; ratios do so least.
"""

import platform
import statistics
import sys
import time
from collections.abc import Callable

import mujoco
import numba

from khep_twin import kernel, playpen, units
from khep_twin.clock import to_ns
from khep_twin.scale.batch import rollout
from khep_twin.scale.life import Ground, Life
from khep_twin.scale.minds import Policy, Wander
from khep_twin.world import World

PLAYPENS = ("default", "obstacles", "looping-maze")
SECONDS = 20
ROUNDS = 5
LIVES = 32
LIFE_S = 4.0
WHOLE = 1024 * 60
"""Simulated seconds of a generation: 1024 lives of a minute."""


def voltages(ground: Ground) -> list[tuple[float, float]]:
    """What the vehicle's motors get, tick by tick."""
    life = Life(ground, Wander())
    life.begin(1)
    found: list[tuple[float, float]] = []
    for _ in range(SECONDS * 1_000_000_000 // units.TICK_NS):
        left, right = life._data.ctrl.tolist()
        found.append((left, right))
        life.go_on(ground.wiring.steps_per_tick)
    return found


def bare_loop(ground: Ground, driven: list[tuple[float, float]], model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    for both in driven:
        data.ctrl[:] = both
        for _ in range(ground.wiring.steps_per_tick):
            mujoco.mj_step(model, data)


def life(ground: Ground, compiled: bool) -> None:
    one = Life(ground, Wander(), compiled=compiled)
    one.begin(1)
    one.live(SECONDS)


def world(name: str) -> None:
    found = World(playpen.load(name), seed=1)
    cells = found.robots[0].registers.data
    for scan in range(SECONDS * 50):
        kernel.wander(cells)
        found.advance_to((scan + 1) * units.SCAN_NS)


def single(name: str, step_ns: int) -> None:
    """One life beside its floors."""
    ground = Ground(playpen.load(name), step_ns=step_ns)
    driven = voltages(ground)
    rows: dict[str, Callable[[], None]] = {
        "bare mj_step, rangefinders (floor)": lambda: bare_loop(ground, driven, ground.model),
        "bare mj_step, no sensors": lambda: bare_loop(ground, driven, ground.without_sensors),
        "life, compiled": lambda: life(ground, True),
        "life, plain": lambda: life(ground, False),
    }
    if step_ns == units.STEP_NS:
        rows["world"] = lambda: world(name)
    table(f"{name}, {step_ns / 1e6:g} ms, one life", rows, SECONDS, time.process_time)


def batch(name: str, step_ns: int) -> None:
    """Many lives, on one thread and on two."""
    ground = Ground(playpen.load(name), step_ns=step_ns)
    asked = Policy(lambda proximity, ambient, which: 10 - proximity[:, [3, 2]] / 100)

    def run(driver: Wander | Policy, threads: int) -> None:
        rollout(ground, driver, range(LIVES), LIFE_S, threads=threads)

    rows: dict[str, Callable[[], None]] = {
        "batch, 1 thread": lambda: run(Wander(), 1),
        "batch, 2 threads": lambda: run(Wander(), 2),
        "Python policy, 1 thread": lambda: run(asked, 1),
        "Python policy, 2 threads": lambda: run(asked, 2),
    }
    simulated = LIVES * round(to_ns(LIFE_S) / 1e9)
    title = f"{name}, {step_ns / 1e6:g} ms, {LIVES} lives of {LIFE_S:g} s"
    table(title, rows, simulated, time.perf_counter)


def table(
    title: str, rows: dict[str, Callable[[], None]], simulated: float, clock: Callable[[], float]
) -> None:
    """Measures and prints; ratios are to the first row."""
    taken: dict[str, list[float]] = {row: [] for row in rows}
    for _ in range(ROUNDS):
        for row, run in rows.items():
            start = clock()
            run()
            taken[row].append(clock() - start)
    first = statistics.median(next(iter(taken.values())))
    print(f"{title:44}{'median':>8}{'best':>8}{'ratio':>8}   [simulated s per s]")
    for row, times in taken.items():
        median = statistics.median(times)
        whole = f"   1024 x 60 s in {WHOLE / simulated * median:.0f} s" if "batch" in row else ""
        print(f"  {row:42}{simulated / median:8.0f}{simulated / min(times):8.0f}{first / median:8.2f}{whole}")


def main() -> None:
    print(f"mujoco {mujoco.__version__}, numba {numba.__version__}, Python {platform.python_version()}")
    Life(Ground(playpen.load("default")), compiled=True).begin()  # compiles, once
    for name in PLAYPENS:
        for step_ns in (units.STEP_NS, 2 * units.STEP_NS):
            single(name, step_ns)
    for name in PLAYPENS[:2]:
        for step_ns in (units.STEP_NS, 2 * units.STEP_NS):
            batch(name, step_ns)


if __name__ == "__main__":
    sys.exit(main())

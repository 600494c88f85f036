"""`make bench`: the main job beside the bare physics of the same scene, interleaved, one process, one core.

Each row is simulated seconds per second of wall time, as the median of the rounds (and the best), and its
ratio to the floor: a loop around mj_step alone, called from Python, on the compiled scene with its
rangefinders, driven by constant motor voltages.
"""

import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco

from khep_twin import playpen, units
from khep_twin.host import Khepera
from khep_twin.lab.controllers import braitenberg
from khep_twin.lab.experiment import run
from khep_twin.playpen_to_mjcf import to_spec

PLAYPEN = "obstacles"
SECONDS = 60
ROUNDS = 7


def bare_loop() -> float:
    """The floor: nothing but mj_step."""
    model = to_spec(playpen.load(PLAYPEN)).compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = (0.35, 0.30)
    start = time.perf_counter()
    for _ in range(SECONDS * 1_000_000_000 // units.STEP_NS):
        mujoco.mj_step(model, data)
    return time.perf_counter() - start


def braitenberg_run(options: str) -> float:
    """The main job, with opening and closing."""
    start = time.perf_counter()
    with Khepera(f"khep://{PLAYPEN}?seed=1{options}") as robot:
        run(braitenberg, robot, seconds=SECONDS)
    return time.perf_counter() - start


def idle_run() -> float:
    """A twin without a host: firmware, sensors and physics only."""
    start = time.perf_counter()
    with Khepera(f"khep://{PLAYPEN}?seed=1") as robot:
        robot.set_speed(5, 4)
        robot.sleep(SECONDS)
    return time.perf_counter() - start


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        rows: dict[str, Callable[[], float]] = {
            "bare mj_step loop (floor)": bare_loop,
            "twin, no host": idle_run,
            "Braitenberg over khep://, no log": lambda: braitenberg_run(""),
            "Braitenberg over khep://, logged": lambda: braitenberg_run(f"&log={log}"),
        }
        times: dict[str, list[float]] = {name: [] for name in rows}
        for _ in range(ROUNDS):
            for name, measure in rows.items():
                times[name].append(measure())
    floor = statistics.median(times["bare mj_step loop (floor)"])
    versions = f"mujoco {mujoco.__version__}, Python {platform.python_version()}"
    print(f"{PLAYPEN}, {SECONDS} s, {ROUNDS} rounds; {versions}")
    print(f"{'':36}{'median':>10}{'best':>10}{'ratio':>8}   [simulated s per s]")
    for name, taken in times.items():
        median = statistics.median(taken)
        print(f"{name:36}{SECONDS / median:10.0f}{SECONDS / min(taken):10.0f}{floor / median:8.2f}")


if __name__ == "__main__":
    sys.exit(main())

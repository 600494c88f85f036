"""`python -m benchmarks.run_page`: pages that play runs: size, writing, opening, and frames in Chromium.

The runs are a minute of one robot that drives among obstacles, and `--minutes` of the twenty robots of
`swarm`. The pages are opened from the disk, and played at normal speed in plan and in 3-D, which a processor
draws (SwiftShader).
"""

import argparse
import os
import random
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.page import chromium
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.web.run_page import RunPage

SECONDS = 6.0
"""Wall time of a measurement of frames [s]."""

STEP_NS = 100_000_000
"""Time between two commands to a robot [ns]."""

SOFTWARE = ("--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader")
"""Options of Chromium: the processor draws WebGL, and the rest of the page as on a machine without a GPU."""

FRAMES = """async (seconds) => {
  const end = performance.now() + 1000 * seconds;
  let frames = 0;
  for (; performance.now() < end; frames++) await new Promise(requestAnimationFrame);
  return frames / seconds;
}"""


def record(path: Path, playpen: str, seconds: float) -> None:
    """Write the log of robots that drive at random speeds and ask for their readings."""
    rng = random.Random(1)
    with open_twin(playpen, TwinOptions(seed=1, log=str(path), robot=None)) as twin:
        while twin.world.time_ns < seconds * 1e9:
            for robot in twin.robots:
                robot.send(f"D,{rng.randint(-3, 12)},{rng.randint(-3, 12)}\nN\n".encode())
            twin.advance_to(twin.world.time_ns + STEP_NS)


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options.add_argument("--minutes", type=float, default=10.0, help="length of the run of twenty robots")
    seconds = 60 * options.parse_args().minutes
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{'':24}{'MB':>7}{'s to write':>12}{'x real time':>13}{'s to open':>11}{'plan':>7}{'3-D':>7}")
    with tempfile.TemporaryDirectory() as folder, chromium(*SOFTWARE) as page:
        for playpen, length in (("obstacles", 60.0), ("swarm", seconds)):
            log, target = Path(folder, f"{playpen}.mcap"), Path(folder, f"{playpen}.html")
            record(log, playpen, length)
            RunPage([log])  # once before, to load and compile
            start = time.perf_counter()
            RunPage([log]).save(target)
            written_s = time.perf_counter() - start
            shown = "" if page is None else show(page, target)
            size = target.stat().st_size / 1e6
            print(f"{playpen:24}{size:7.2f}{written_s:12.2f}{length / written_s:13.0f}{shown}")


def show(page: Any, target: Path) -> str:
    """Return the time until a page plays [s], and its frames per second in plan and in 3-D."""
    start = time.perf_counter()
    page.goto(target.as_uri())
    page.wait_for_selector("html[data-ready]")
    opened_s = time.perf_counter() - start
    plan = page.evaluate(FRAMES, SECONDS)
    page.click("#solids")
    page.wait_for_selector(".solid[data-shapes]")
    return f"{opened_s:11.2f}{plan:7.1f}{page.evaluate(FRAMES, SECONDS):7.1f}"


if __name__ == "__main__":
    main()

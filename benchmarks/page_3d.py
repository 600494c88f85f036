"""`python -m benchmarks.page_3d`: the designer's 3-D view rendered by the CPU, and its memory.

A twin drives in `looping-maze` with twenty blocks more; Chromium, whose WebGL is SwiftShader's, shows it at
800 x 600 while the view is orbited. It prints the frames per second, those of a canvas of that size that is
only cleared (the limit of this machine), and the processor time of a frame. Then the twin runs ten times as
fast for `--minutes`, and the page's memory after garbage collections is printed.
"""

import argparse
import json
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.page import Twin, chromium
from khep_twin import playpen
from khep_twin.playpen import Playpen
from khep_twin.web import drafts

SECONDS = 6.0
"""Wall time of a measurement [s]."""

BLOCKS = 20

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")

FRAMES = """async ([seconds, bare]) => {
  const canvas = bare ? Object.assign(document.createElement("canvas"), { width: 800, height: 600 }) : null;
  const pen = canvas?.getContext("webgl2", { alpha: false, antialias: false });
  if (canvas) document.body.replaceChildren(canvas);
  const end = performance.now() + 1000 * seconds;
  let frames = 0;
  while (performance.now() < end) {
    await new Promise(requestAnimationFrame);
    frames++;
    pen?.clearColor(Math.random(), 0, 0, 1);
    pen?.clear(pen.COLOR_BUFFER_BIT);
    if (!bare) document.activeElement.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft", bubbles: true }));
  }
  return frames / seconds;
}"""  # noqa: E501


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options.add_argument("--minutes", type=float, default=10.0, help="length of the measurement of memory")
    minutes = options.parse_args().minutes
    # The window whose arena is 800 x 600.
    with tempfile.TemporaryDirectory() as folder, chromium(*SOFTWARE, width=1304, height=677) as page:
        if page is None:
            sys.exit("no Chromium, or no Playwright")
        twin = Twin(folder)
        try:
            page.goto("about:blank")
            bare = page.evaluate(FRAMES, [SECONDS, True])
            show(page, twin, Path(folder))
            size = page.evaluate("[solid.width, solid.height]")
            before = _processor()
            orbited = page.evaluate(FRAMES, [SECONDS, False])
            processor = (_processor() - before) / (orbited * SECONDS)
            print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {size[0]} x {size[1]} pixels")
            print(
                f"orbited with a running twin: {orbited:.1f} frames/s, {processor * 1e3:.1f} ms of CPU each"
            )
            print(f"a bare canvas that is cleared: {bare:.1f} frames/s")
            remember(page, twin, minutes)
        finally:
            twin.process.terminate()
            twin.process.wait()


def draft() -> dict[str, Any]:
    """Return the maze with blocks where there is room for them."""
    rng, maze = random.Random(1), Playpen.load("looping-maze")
    content: dict[str, Any] = json.loads(json.dumps(drafts.draft_of(maze)))
    blocks = content["block"] = list(content.get("block", []))
    while len(blocks) < BLOCKS:
        x_mm, y_mm = rng.uniform(20, maze.arena.width_mm - 20), rng.uniform(20, maze.arena.height_mm - 20)
        blocks.append({"x_mm": x_mm, "y_mm": y_mm, "angle_deg": rng.uniform(0, 90), "length_mm": 14.0})
        blocks[-1] |= {"width_mm": 10.0, "height_mm": 40.0, "surface": "lego"}
        if drafts.problems_of(content):
            blocks.pop()
    return content


def show(page: Any, twin: Twin, folder: Path) -> None:
    """Start a twin in the maze, and show it in 3-D."""
    (folder / "maze.toml").write_text(playpen.dump(drafts.playpen_of(draft())), encoding="utf-8")
    twin.post("end")
    twin.post("start", draft=draft(), file="maze.toml", speed=1)
    twin.look()
    twin.post("run", controllers=["braitenberg"], cycles=10**9)
    page.goto(twin.url)
    page.wait_for_selector("html[data-ready]")
    page.click("#three-d")
    page.wait_for_selector("#solid[data-shapes]")
    page.wait_for_selector("#follow:not([hidden])")
    page.focus("#solid")


def remember(page: Any, twin: Twin, minutes: float) -> None:
    """Print the page's memory while the twin runs ten times as fast."""
    twin.post("pace", speed=10)
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.enable")
    began = time.monotonic()
    while True:
        for _ in range(2):
            session.send("HeapProfiler.collectGarbage")
        used = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
        nodes = session.send("Memory.getDOMCounters")["nodes"]
        elapsed_s = time.monotonic() - began
        simulated = page.inner_text("#clock").split(" ")[0]
        print(
            f"{elapsed_s / 60:5.1f} min, {simulated} s simulated: heap {used:.2f} MB, {nodes} nodes",
            flush=True,
        )
        if elapsed_s >= 60 * minutes:
            return
        page.wait_for_timeout(1000 * min(60.0, max(60 * minutes - elapsed_s, 1)))


def _processor() -> float:
    """Return the processor time of Chromium's processes so far [s]."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, fields = path.read_text().split("(", 1)[1].rsplit(")", 1)
            if name.startswith("chrom"):
                ticks += sum(map(int, fields.split()[11:13]))
        except OSError:  # which has ended meanwhile
            continue
    return ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

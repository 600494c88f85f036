"""`python -m benchmarks.page`: cost of the designer's live view for the twin.

A twin runs a Braitenberg vehicle as fast as possible, in turns unwatched, watched by a client that reads each
picture, and by the page in Chromium where that and Playwright are installed. Each row is simulated seconds
per second of wall time and the server's processor time per simulated second, as medians over the rounds, and
the cost: the loss against the unwatched turns right before and after it, in both. Last are the frames per
second that Chromium draws while an object is dragged among 200.
"""

import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from websockets.sync.client import connect

from benchmarks.line import processor_s

PLAYPEN = "obstacles"
ROUNDS = 7
SECONDS = 2.0
"""Wall time of a turn [s]."""

OBJECTS = 200
"""Objects in the playpen in which one of them is dragged."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Speed of a twin.

    Attributes:
        speed: Simulated seconds per second.
        processor: Processor time of the server per simulated second [s].
    """

    speed: float
    processor: float


class Twin:
    """A designer in a separate process, whose twin runs as fast as possible."""

    def __init__(self, folder: str) -> None:
        command = [sys.executable, "-m", "khep_twin", "design", "--no-browser"]
        self.process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        self.origin = self.url[: self.url.index("/", 8)]
        draft = self.post("library", name=PLAYPEN)["draft"]
        self.post("start", draft=draft, speed=0)
        self.look()
        self.post("run", controllers=["braitenberg"], cycles=10**9)

    def post(self, action: str, **arguments: Any) -> Any:
        """Send the designer a request, as its page does."""
        headers = {"Content-Type": "application/json", "Origin": self.origin}
        with urlopen(Request(f"{self.url}do/{action}", json.dumps(arguments).encode(), headers)) as answer:
            return json.load(answer)

    @contextmanager
    def live(self) -> Iterator[Any]:
        """Yield the events that the page receives."""
        url = self.url.replace("http", "ws", 1) + "live"
        with connect(url, origin=self.origin) as socket:  # pyright: ignore[reportArgumentType]
            yield socket

    def look(self) -> tuple[float, float, float]:
        """Return simulated time, wall time and processor time at the next picture [s]."""
        with self.live() as socket:
            while True:
                message = json.loads(socket.recv())
                if message["kind"] == "picture":
                    return message["time"], time.perf_counter(), processor_s(self.process.pid)

    def turn(self, watch: Callable[[], AbstractContextManager[Any]]) -> Turn:
        """Run the twin for a turn, watched."""
        with watch() as socket:
            start = self.look()
            end = time.perf_counter() + SECONDS
            while (left := end - time.perf_counter()) > 0:
                if socket is None:
                    time.sleep(left)
                else:
                    socket.recv()
            stop = self.look()
        simulated, wall, processor = (later - earlier for later, earlier in zip(stop, start, strict=True))
        return Turn(simulated / wall, processor / simulated)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, chromium() as page:
        drags: list[float] = []
        twin = Twin(folder)
        watchers: dict[str, Callable[[], AbstractContextManager[Any]]] = {"watched by a client": twin.live}
        if page is not None:
            watchers["watched in Chromium"] = lambda: _open_run_tab(page, twin.url)
        turns: dict[str, list[Turn]] = {"unwatched": [], **{name: [] for name in watchers}}
        costs: dict[str, list[float]] = {name: [] for name in watchers}
        try:
            twin.turn(nullcontext)
            alone = [twin.turn(nullcontext)]
            for _ in range(ROUNDS):
                for name, watch in watchers.items():
                    turns[name].append(twin.turn(watch))
                    alone.append(twin.turn(nullcontext))
                    unwatched_speed = (alone[-2].speed + alone[-1].speed) / 2
                    costs[name].append(1 - turns[name][-1].speed / unwatched_speed)
            if page is not None:
                twin.post("end")
                Path(folder, "crowd.toml").write_text(crowd(), encoding="utf-8")
                drags = drag(page, twin.url)
        finally:
            twin.process.terminate()
            twin.process.wait()
    turns["unwatched"] = alone
    print(f"{PLAYPEN}, {ROUNDS} rounds of {SECONDS:g} s, {os.cpu_count()} cores")
    print(f"{'':24}{'s per s':>9}{'CPU ms per s':>15}{'cost':>8}")
    for name, series in turns.items():
        speed = statistics.median(turn.speed for turn in series)
        processor = statistics.median(turn.processor for turn in series) * 1e3
        cost = f"{statistics.median(costs[name]):8.1%}" if name in costs else ""
        print(f"{name:24}{speed:9.1f}{processor:15.2f}{cost}")
    if drags:
        slow = statistics.quantiles(drags, n=100)[94]
        rate = 1 / statistics.mean(drags)
        print(f"drag among {OBJECTS} objects: {rate:.0f} frames/s; 95 % took less than {slow * 1e3:.0f} ms")
    else:
        print("no Chromium, or no Playwright: the page itself was not measured")


@contextmanager
def chromium(*options: str, width: int = 1280, height: int = 720) -> Iterator[Any]:
    """Open a page of headless Chromium with further options; None if it is not installed."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        program = None
    if program is None:
        yield None
        return
    with sync_playwright() as playwright:  # pyright: ignore[reportPossiblyUnboundVariable]
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *options])
        yield browser.new_page(viewport={"width": width, "height": height})
        browser.close()


@contextmanager
def _open_run_tab(page: Any, url: str) -> Iterator[None]:
    page.goto(url)
    page.wait_for_selector("html[data-ready]")
    page.click('[data-tab="run"]')
    yield
    page.goto("about:blank")


def crowd() -> str:
    """Return a playpen of many objects, with room to drag the robot among them."""
    head = 'version = 1\nname = "crowd"\n\n[arena]\nwidth_mm = 2000\nheight_mm = 1000\n'
    robot = "\n[[robot]]\nx_mm = 1000\ny_mm = 500\nheading_deg = 90\n"
    places = [
        (100 + 90 * column, row) for row in [60 + 80 * index for index in range(12)] for column in range(20)
    ]
    places = [place for place in places if abs(place[1] - 500) > 70][: OBJECTS - 1]
    return (
        head
        + robot
        + "".join(
            f"\n[[cylinder]]\nx_mm = {x}\ny_mm = {y}\nradius_mm = 12.5\nheight_mm = 50\n" for x, y in places
        )
    )


def drag(page: Any, url: str) -> list[float]:
    """Drag the robot to and fro; return the times between the browser's frames during the drag [s]."""
    page.goto(url)
    page.wait_for_selector("html[data-ready]")
    page.click("#open")
    page.select_option("#dialog select", "crowd.toml")
    page.click("#dialog .main")
    page.wait_for_selector(".kind-robot.drawn")
    box = page.locator(".kind-robot.drawn .body").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.evaluate(
        "(() => { window.frames = []; const see = (now) => { frames.push(now); requestAnimationFrame(see); };"
        " requestAnimationFrame(see); })()"
    )
    end = time.perf_counter() + 2 * SECONDS
    while time.perf_counter() < end:
        for step in [*range(-20, 20), *range(20, -20, -1)]:
            page.mouse.move(x + 10 * step, y + step / 2)
    frames = page.evaluate("frames")
    page.mouse.up()
    return [(after - before) / 1e3 for before, after in itertools.pairwise(frames)]


if __name__ == "__main__":
    sys.exit(main())

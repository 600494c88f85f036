"""What a person does in a browser with a page of the designer: Chromium by Playwright (`make browser`).

Pictures of each step are left in the folder KHEP_SCREENSHOTS, out/browser by default.
"""

import base64
import os
import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PICTURES = Path(os.environ.get("KHEP_SCREENSHOTS", "out/browser"))
BROWSED = [
    # Playwright's own loop leaves a socket to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
"""The marks of tests in a browser."""


def need_a_browser() -> None:
    """Skip a file of tests without one, and beside other tests: Playwright's loop would disturb them."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        pytest.skip("a browser needs its own process: make browser", allow_module_level=True)
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed; see make browser")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here", allow_module_level=True)


class Visit:
    """A page of the designer, and what a person does with it.

    Attributes:
        page: Playwright's.
        trouble: what its console has told.
    """

    def __init__(self, page: Any, url: str) -> None:
        self.page, self.url = page, url
        self.trouble: list[str] = []
        self._session: Any = None
        self._touched = 0
        page.on("console", lambda told: told.type in ("error", "warning") and self.trouble.append(told.text))
        page.on("pageerror", lambda error: self.trouble.append(str(error)))
        page.set_default_timeout(60_000)
        self.open()

    def open(self) -> None:
        self.page.goto(self.url)
        self.page.wait_for_selector("html[data-ready]")

    def picture(self, name: str) -> None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=PICTURES / f"{name}.png")

    def at(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Where in the window a place of the arena is."""
        spot = self.page.evaluate(
            """([x, y]) => {
                const matrix = document.querySelector("#view > g").getScreenCTM();
                const at = new DOMPoint(x, y).matrixTransform(matrix);
                return [at.x, at.y];
            }""",
            [x_mm, y_mm],
        )
        return spot[0], spot[1]

    def click(self, x_mm: float, y_mm: float, **options: Any) -> None:
        self.page.mouse.click(*self.at(x_mm, y_mm), **options)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.page.mouse.move(*self.at(*start))
        self.page.mouse.down()
        self.page.mouse.move(*self.at(*end), steps=5)
        self.page.mouse.up()

    def add(self, tool: str, *places: tuple[float, float]) -> None:
        for place in places:
            self.page.click(f'[data-tool="{tool}"]')
            self.click(*place)

    def save_as(self, name: str) -> None:
        self.page.click("#save-as")
        self.page.fill("#dialog input", name)
        self.page.click("#dialog .main")
        self.wait_file(name)

    def open_file(self, name: str) -> None:
        """Opens a file of the folder, and waits until it is checked."""
        self.page.click("#open")
        self.page.select_option("#dialog select", name)
        self.page.click("#dialog .main")
        self.wait_file(name)
        self.page.wait_for_selector("#problems.none")

    def wait_file(self, name: str) -> None:
        """Waits until this file is open, without changes."""
        self.wait(f"document.querySelector('#file').textContent === '{name}'")

    def new(self) -> None:
        """Opens the chosen playpen of the library, and waits for it."""
        self.page.click("#dialog .main")
        self.wait_file("new playpen")

    def show_3d(self) -> None:
        self.page.click("#three-d")
        self.page.wait_for_selector("#solid[data-shapes]")

    def start(self, log: str = "") -> None:
        """Starts a twin of what is drawn, with a log of this name, and waits until it is shown."""
        self.page.click('[data-tab="run"]')
        self.page.fill("#log", log)
        self.page.click("#start")
        self.page.wait_for_selector(".live")

    def drive(self) -> None:
        """Starts a program that does not end by itself, and waits until it drives."""
        self.page.click('[data-tab="run"]')
        self.page.fill("#cycles", "100000")
        self.page.click("#run")
        self.wait_driven()

    def choose_program(self, name: str) -> None:
        """Chooses a controller's file, as soon as it is offered."""
        offered = "[...document.querySelector('#controller').options]"
        self.wait(f"{offered}.some(({{ value }}) => value === '{name}')")
        self.page.select_option("#controller", name)

    def wait_driven(self) -> None:
        """Waits until a program drives."""
        self.wait("document.querySelector('#clock').textContent.includes('driven')")

    def wait_seconds(self, seconds: float) -> None:
        """Waits until the clock shows more."""
        self.wait(f"parseFloat(document.querySelector('#clock').textContent) > {seconds}")

    def stop(self) -> None:
        """Stops the program that drives, and waits for it."""
        self.page.click("#stop")
        self.wait("!document.querySelector('#run').disabled")

    def end(self) -> None:
        """Ends the twin, and waits for it."""
        self.page.click("#end")
        self.wait("document.querySelector('#clock').textContent === 'not running'")

    def count(self, selector: str) -> int:
        return self.page.locator(selector).count()

    def drop(self, file: Path) -> None:
        """Drops a file on the arena, as a file manager does."""
        carried = self.page.evaluate_handle(
            """([name, data]) => {
                const carried = new DataTransfer();
                carried.items.add(new File([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))], name));
                return carried;
            }""",
            [file.name, base64.b64encode(file.read_bytes()).decode()],
        )
        for kind in ("dragover", "drop"):
            self.page.dispatch_event("#arena", kind, {"dataTransfer": carried})

    def lift(self, x_mm: float, y_mm: float) -> None:
        """Takes the robot that runs, wherever it is by now, and puts it down elsewhere."""
        while not self.count(".held"):
            self.page.mouse.up()
            self.page.mouse.move(*self.at(*self.robot()))
            self.page.mouse.down()
        self.page.mouse.move(*self.at(x_mm, y_mm), steps=5)
        self.page.mouse.up()

    def robot(self) -> tuple[float, float]:
        """Where the robot that runs is shown."""
        place = self.page.get_attribute(".live", "transform")
        x_mm, y_mm, _ = map(float, re.findall(r"[-\d.]+", place))
        return x_mm, y_mm

    def clock(self) -> float:
        found = re.match(r"[\d.]+", self.page.inner_text("#clock"))
        return float(found[0]) if found else 0.0

    def wait(self, expression: str) -> None:
        """Asks again and again: the page's own rules let nothing be evaluated in it by itself."""
        end = time.monotonic() + 120
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, expression
            self.page.wait_for_timeout(50)

    def touch(self, *fingers: tuple[float, float]) -> None:
        """Has fingers at these places of the window from now on, and nowhere else; none lifts them all."""
        self._session = self._session or self.page.context.new_cdp_session(self.page)
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        kind = "touchEnd" if not points else "touchStart" if len(points) > self._touched else "touchMove"
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self._touched = len(points)

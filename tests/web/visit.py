"""Actions of a person on a page of the designer, in Chromium by Playwright (`make browser`).

Screenshots of each step are saved in the folder KHEP_SCREENSHOTS, out/browser by default.
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
FIREFOX = shutil.which("firefox") or shutil.which("firefox-esr")
PICTURES = Path(os.environ.get("KHEP_SCREENSHOTS", "out/browser"))
BROWSED = [
    # Playwright's loop leaves a socket to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
"""Marks of tests in a browser."""


def need_a_browser() -> None:
    """Skip a file of tests without a browser, and in pytest-xdist: Playwright's loop disturbs other tests."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        pytest.skip("a browser needs its own process: make browser", allow_module_level=True)
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed; see make browser")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here", allow_module_level=True)


class Visit:
    """A page of the designer, and a person's actions on it.

    Attributes:
        page: Page of Playwright.
        errors: Errors and warnings in its console.
    """

    def __init__(self, page: Any, url: str) -> None:
        self.page, self.url = page, url
        self.errors: list[str] = []
        self._session: Any = None
        self._touched = 0
        page.on(
            "console", lambda entry: entry.type in ("error", "warning") and self.errors.append(entry.text)
        )
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.set_default_timeout(60_000)
        self.open()

    def open(self) -> None:
        self.page.goto(self.url)
        self.page.wait_for_selector("html[data-ready]")

    def picture(self, name: str) -> None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=PICTURES / f"{name}.png")

    def at(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Return the position in the window of a point of the arena."""
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

    def add(self, tool: str, *points: tuple[float, float]) -> None:
        for point in points:
            self.page.click(f'[data-tool="{tool}"]')
            self.click(*point)

    def save_as(self, name: str) -> None:
        self.page.click("#save-as")
        self.page.fill("#dialog input", name)
        self.page.click("#dialog .main")
        self.wait_file(name)

    def open_file(self, name: str) -> None:
        """Open a file of the folder, and wait until it is checked."""
        self.page.click("#open")
        self.page.select_option("#dialog select", name)
        self.page.click("#dialog .main")
        self.wait_file(name)
        self.page.wait_for_selector("#problems.none")

    def wait_file(self, name: str) -> None:
        """Wait until a file is open, without changes."""
        self.wait(f"document.querySelector('#file').textContent === '{name}'")

    def new(self) -> None:
        """Open the selected playpen of the library, and wait for it."""
        self.page.click("#dialog .main")
        self.wait_file("new playpen")

    def show_3d(self) -> None:
        self.page.click("#three-d")
        self.page.wait_for_selector("#solid[data-shapes]")

    def start(self, log: str = "") -> None:
        """Start a twin of the drawing, with a log of this name, and wait until it is shown."""
        self.page.click('[data-tab="run"]')
        self.page.fill("#log", log)
        self.page.click("#start")
        self.page.wait_for_selector(".live")

    def drive(self) -> None:
        """Start a program of 100000 cycles, and wait until it drives."""
        self.page.click('[data-tab="run"]')
        self.page.fill("#cycles", "100000")
        self.page.click("#run")
        self.wait_driven()

    def choose_program(self, name: str) -> None:
        """Select a controller's file as soon as it is listed."""
        options = "[...document.querySelector('#controller').options]"
        self.wait(f"{options}.some(({{ value }}) => value === '{name}')")
        self.page.select_option("#controller", name)

    def wait_driven(self) -> None:
        """Wait until a program drives."""
        self.wait("document.querySelector('#clock').textContent.includes('driven')")

    def wait_seconds(self, seconds: float) -> None:
        """Wait until the clock shows a later time."""
        self.wait(f"parseFloat(document.querySelector('#clock').textContent) > {seconds}")

    def stop(self) -> None:
        """Stop the running program, and wait for its end."""
        self.page.click("#stop")
        self.wait("!document.querySelector('#run').disabled")

    def end(self) -> None:
        """End the twin, and wait for its end."""
        self.page.click("#end")
        self.wait("document.querySelector('#clock').textContent === 'not running'")

    def count(self, selector: str) -> int:
        return self.page.locator(selector).count()

    def drop(self, file: Path) -> None:
        """Drop a file on the arena, as a file manager does."""
        transfer = self.page.evaluate_handle(
            """([name, data]) => {
                const transfer = new DataTransfer();
                transfer.items.add(new File([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))], name));
                return transfer;
            }""",
            [file.name, base64.b64encode(file.read_bytes()).decode()],
        )
        for kind in ("dragover", "drop"):
            self.page.dispatch_event("#arena", kind, {"dataTransfer": transfer})

    def lift(self, x_mm: float, y_mm: float) -> None:
        """Lift the moving robot and put it down at a position."""
        while not self.count(".held"):
            self.page.mouse.up()
            self.page.mouse.move(*self.at(*self.robot()))
            self.page.mouse.down()
        self.page.mouse.move(*self.at(x_mm, y_mm), steps=5)
        self.page.mouse.up()

    def robot(self) -> tuple[float, float]:
        """Return the position of the running robot on the page."""
        transform = self.page.get_attribute(".live", "transform")
        x_mm, y_mm, _ = map(float, re.findall(r"[-\d.]+", transform))
        return x_mm, y_mm

    def clock(self) -> float:
        match = re.match(r"[\d.]+", self.page.inner_text("#clock"))
        return float(match[0]) if match else 0.0

    def wait(self, expression: str) -> None:
        """Poll an expression: the page's content security policy forbids `wait_for_function`."""
        end = time.monotonic() + 120
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, expression
            self.page.wait_for_timeout(50)

    def touch(self, *fingers: tuple[float, float]) -> None:
        """Set the positions of all fingers in the window; without any, lift them."""
        self._session = self._session or self.page.context.new_cdp_session(self.page)
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        kind = "touchEnd" if not points else "touchStart" if len(points) > self._touched else "touchMove"
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self._touched = len(points)

"""The page in a real browser: Chromium by Playwright, where both are installed (`make browser`).

Pictures of each step are left in the folder KHEP_SCREENSHOTS, out/browser by default.
"""

import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from khep_twin import playpen as playpens
from khep_twin.host import Khepera
from khep_twin.lab.repeat import read_recorded, repeat
from tests.drawn_bitmap import drawn
from tests.web.conftest import Asker

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; see make browser")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here"),
    # Playwright's own loop leaves a socket to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
PICTURES = Path(os.environ.get("KHEP_SCREENSHOTS", "out/browser"))


class Visit:
    """A page of the designer, and what a person does with it.

    Attributes:
        page: Playwright's.
        trouble: what its console has told.
    """

    def __init__(self, page: Any, url: str) -> None:
        self.page, self.url = page, url
        self.trouble: list[str] = []
        page.on("console", lambda told: told.type in ("error", "warning") and self.trouble.append(told.text))
        page.on("pageerror", lambda error: self.trouble.append(str(error)))
        page.set_default_timeout(20_000)
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
        self.wait(f"document.querySelector('#file').textContent === '{name}'")

    def count(self, selector: str) -> int:
        return self.page.locator(selector).count()

    def clock(self) -> float:
        found = re.match(r"[\d.]+", self.page.inner_text("#clock"))
        return float(found[0]) if found else 0.0

    def wait(self, expression: str) -> None:
        """Asks again and again: the page's own rules let nothing be evaluated in it by itself."""
        end = time.monotonic() + 60
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, expression
            self.page.wait_for_timeout(50)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def visit(browser: Any, asker: Asker) -> Iterator[Visit]:
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    visit = Visit(context.new_page(), asker.server.url)
    yield visit
    context.close()
    assert visit.trouble == []


def draw_ten(visit: Visit) -> None:
    visit.add("block", (120, 380), (480, 380))
    visit.add("cylinder", (300, 400), (480, 120))
    visit.add("lamp", (60, 440), (540, 440))
    visit.add("robot", (300, 220))
    visit.page.click('[data-tool="wall"]')
    visit.click(100, 60)
    visit.click(100, 200)
    visit.page.keyboard.press("Enter")
    visit.add("patch", (400, 80))
    visit.add("spot", (200, 120))


def test_ten_objects_are_drawn_saved_run_lifted_and_stopped(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    draw_ten(visit)
    assert visit.count(".drawn") == 10
    # One block is dragged, turned and sized by hand, the other by its fields.
    visit.drag((120, 380), (140, 330))
    visit.drag((140 + 30 + 21, 330), (140, 400))
    visit.click(480, 380)
    page.fill("#field-block-angle_deg", "45")
    page.keyboard.press("Tab")
    page.select_option("#field-block-surface", "black")
    page.wait_for_selector("#problems.none")
    visit.picture("1-drawn")
    visit.save_as("ten.toml")
    saved = playpens.load(tmp_path / "ten.toml")
    assert (len(saved.blocks), len(saved.cylinders), len(saved.lamps), len(saved.walls)) == (2, 2, 2, 1)
    assert (len(saved.robots), len(saved.patches), len(saved.spots)) == (1, 1, 1)
    assert (saved.blocks[0].x_mm, saved.blocks[0].y_mm, saved.blocks[0].angle_deg) == (140, 330, 90)
    assert (saved.blocks[1].surface, saved.blocks[1].angle_deg) == ("black", 45)
    assert saved.walls[0].points_mm == ((100, 60), (100, 200))

    # Reopened, it is the same.
    visit.open()
    page.click("#open")
    page.select_option("#dialog select", "ten.toml")
    page.click("#dialog .main")
    visit.wait("document.querySelectorAll('.drawn').length === 10")

    # A minute of Braitenberg, ten times as fast.
    page.click('[data-tab="run"]')
    page.select_option("#speed", "10")
    page.fill("#log", "run.mcap")
    page.fill("#cycles", "")
    page.fill("#seconds", "60")
    page.click("#run")
    visit.wait("document.querySelector('#clock').textContent.includes('driven')")
    bars = "[...document.querySelectorAll('#panel rect.proximity')].map((bar) => +bar.getAttribute('height'))"
    visit.wait(f"Math.max(...{bars}) > 1")
    motors = "[...document.querySelectorAll('#panel rect.speed')].map((bar) => +bar.getAttribute('height'))"
    assert max(page.evaluate(motors)) > 1
    visit.picture("2-running")
    visit.wait("document.querySelectorAll('#runs-done tbody tr').length === 1")
    assert visit.clock() >= 60

    # Lifted and put down while it runs.
    page.select_option("#speed", "1")
    page.fill("#seconds", "600")
    page.click("#run")
    visit.wait("document.querySelector('#clock').textContent.includes('driven')")
    place = "(document.querySelector('.live').getAttribute('transform').match(/[-\\d.]+/g)).map(Number)"
    x_mm, y_mm, _ = page.evaluate(place)
    visit.drag((x_mm, y_mm), (300, 130))
    visit.wait(f"(([x, y]) => Math.hypot(x - 300, y - 130) < 80)({place})")
    visit.click(60, 440)
    visit.wait("document.querySelector('.kind-lamp.off')")
    visit.picture("3-lifted")
    page.click("#stop")
    visit.wait("!document.querySelector('#run').disabled")
    page.click("#end")
    visit.wait("document.querySelector('#clock').textContent === 'not running'")
    recorded = read_recorded(tmp_path / "run.mcap")
    assert repeat(recorded) is None


def test_what_is_wrong_is_told_at_the_object_while_it_is_dragged(visit: Visit) -> None:
    visit.add("block", (200, 200))
    visit.add("robot", (400, 200))
    page = visit.page
    page.mouse.move(*visit.at(400, 200))
    page.mouse.down()
    page.mouse.move(*visit.at(210, 200), steps=6)
    page.wait_for_selector(".kind-robot.bad")
    assert "overlaps" in page.text_content(".why")
    visit.picture("4-wrong")
    page.mouse.move(*visit.at(400, 300), steps=6)
    page.wait_for_selector(".kind-robot:not(.bad)")
    page.mouse.up()
    page.keyboard.press("Control+z")
    page.keyboard.press("Control+z")
    assert visit.count(".kind-robot.drawn") == 0
    page.keyboard.press("Control+y")
    assert visit.count(".kind-robot.drawn") == 1


def test_a_playpen_is_built_by_keys_alone(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    page.focus("#view")
    for key in ("b", "Enter", "ArrowLeft", "Shift+ArrowLeft", "[", "r", "Enter", "Shift+ArrowDown"):
        page.keyboard.press(key)
    page.wait_for_selector("#problems.none")
    page.keyboard.press("Control+s")
    page.fill("#dialog input", "keys")
    page.keyboard.press("Enter")
    visit.wait("document.querySelector('#file').textContent === 'keys.toml'")
    made = playpens.load(tmp_path / "keys.toml")
    assert (made.blocks[0].x_mm, made.blocks[0].angle_deg) == (245, 15)
    assert made.robots[0].y_mm == 200


def test_what_was_not_saved_is_offered_again(visit: Visit) -> None:
    visit.add("block", (200, 200))
    visit.open()
    visit.page.click("text=Go on with it")
    assert visit.count(".kind-block.drawn") == 1


def test_two_pages_on_one_file_ask_before_one_replaces_the_other(visit: Visit, browser: Any) -> None:
    visit.add("block", (200, 200))
    visit.save_as("both.toml")
    second = Visit(visit.page.context.new_page(), visit.url)
    second.page.click("#open")
    second.page.click("#dialog .main")
    second.page.wait_for_selector("text=Another page has both.toml open")
    second.add("cylinder", (400, 200))
    second.page.click("#save")
    visit.page.wait_for_selector("text=was saved by another page")
    visit.add("lamp", (100, 100))
    visit.page.click("#save")
    visit.page.wait_for_selector("text=Replace it")
    visit.trouble = [text for text in visit.trouble if "409" not in text]


def test_a_picture_becomes_a_playpen(visit: Visit, tmp_path: Path) -> None:
    Image.fromarray(~drawn()).save(tmp_path / "scan.png")
    page = visit.page
    page.set_input_files("#import", tmp_path / "scan.png")
    page.click("#dialog .main")
    visit.wait("document.querySelectorAll('.kind-block').length > 4")
    page.wait_for_selector("#problems.none")
    assert page.text_content("#file") == "new playpen *"


def test_a_controller_of_ones_own_is_run_from_its_file(visit: Visit, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(3, 3)\n")
    page = visit.page
    visit.add("robot", (300, 120))
    page.click('[data-tab="run"]')
    visit.wait("[...document.querySelector('#controller').options].some((each) => each.value === 'mine.py')")
    page.select_option("#controller", "mine.py")
    page.fill("#cycles", "20")
    page.fill("#runs", "2")
    page.fill("#keep", "series")
    page.click("#run")
    visit.wait("document.querySelectorAll('#runs-done tbody tr').length === 2")
    assert (tmp_path / "series").is_dir()
    page.click("#end")


def test_a_sensor_test_is_driven_and_shown(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    visit.add("robot", (300, 120))
    page.click('[data-tab="run"]')
    page.select_option("#speed", "0")
    page.click('[data-tab="sense"]')
    page.fill("#amount", "20")
    page.click("#gather")
    page.wait_for_selector("#figure:not([hidden])", timeout=60_000)
    visit.wait("document.querySelector('#figure').naturalWidth > 100")
    visit.picture("5-sensed")
    page.click("#save-sensed")
    page.wait_for_selector("text=Saved as test.mat")
    assert (tmp_path / "test.mat").stat().st_size > 500


def test_an_outside_host_shares_the_line_of_the_robot_that_runs(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    page.click('[data-tab="run"]')
    page.fill("#cycles", "100000")
    page.click("#run")
    visit.wait("document.querySelector('#clock').textContent.includes('driven')")
    host = Khepera(page.text_content("#port"))
    try:
        for _ in range(5):
            assert len(host.proximity()) == 8
            assert host.versions() == ("5.02", "5.01")
        visit.wait("document.querySelector('#host').textContent.includes('commands')")
        visit.picture("6-shared")
    finally:
        host.port.close()
    page.click("#stop")
    page.click("#end")


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1024, 768), (768, 1024)])
def test_nothing_sticks_out_of_the_window(browser: Any, asker: Asker, width: int, height: int) -> None:
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=width < 1280)
    visit = Visit(context.new_page(), asker.server.url)
    wide, high = visit.page.evaluate(
        "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
    )
    assert wide <= width
    assert high <= height
    visit.picture(f"7-{width}x{height}")
    context.close()
    assert visit.trouble == []


def test_a_drag_among_two_hundred_objects_is_smooth(visit: Visit) -> None:
    """Tells the frames per second; machines differ, so that only a standstill fails."""
    page = visit.page
    page.evaluate("window.frames_seen = 0")
    for _ in range(4):
        visit.add("block", (100 + 100 * _, 100))
    page.focus("#view")
    for _ in range(6):
        page.keyboard.press("Control+a")
        page.keyboard.press("Control+d")
        page.keyboard.press("ArrowUp")
    assert visit.count(".drawn") >= 200
    box = page.locator(".kind-block.drawn").last.get_attribute("transform")
    x_mm, y_mm = map(float, re.findall(r"[-\d.]+", box or "")[:2])
    page.keyboard.press("Escape")
    page.mouse.move(*visit.at(x_mm, y_mm))
    page.mouse.down()
    page.evaluate("(() => { const see = () => { frames_seen++; requestAnimationFrame(see); }; see(); })()")
    start = time.monotonic()
    for step in range(100):
        page.mouse.move(*visit.at(x_mm + step % 50, y_mm - step % 30))
    took = time.monotonic() - start
    page.mouse.up()
    rate = page.evaluate("frames_seen") / took
    print(f"{rate:.0f} frames/s while dragging among {visit.count('.drawn')} objects")
    assert rate > 5

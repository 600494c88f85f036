"""A run as one HTML file, opened from the disk in a real browser."""

import math
import random
import time
from base64 import b64encode
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pytest
from command_line import good
from relay_logs import in_turn, relayed

from khep_twin.web import run_content
from khep_twin.web.run_page import RunPage
from tests.web.run_pages import headers, record, with_hostile_texts
from tests.web.visit import BROWSED, FIREFOX, PICTURES, need_a_browser

need_a_browser()
pytestmark = BROWSED

SIZES = {"desk": (1280, 720), "tablet": (820, 1180), "phone": (390, 844)}


SCREENSHOT_STYLE = b64encode(sha256(b"body {}").digest()).decode()
"""Hash of the style that Playwright adds in Firefox for a screenshot; the page's policy blocks it."""


class Player:
    """A page that plays runs.

    Attributes:
        page: Page of Playwright.
        errors: Errors and warnings in its console.
        requests: Addresses that it has requested.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on(
            "console", lambda entry: entry.type in ("error", "warning") and self.errors.append(entry.text)
        )
        page.on(
            "pageerror",
            lambda error: SCREENSHOT_STYLE not in str(error) and self.errors.append(str(error)),
        )
        page.on("dialog", lambda dialog: self.errors.append(dialog.message) or dialog.dismiss())
        page.on("request", lambda request: self.requests.append(request.url))

    def open(self, file: Path, moment: str = "") -> None:
        self.page.goto(f"{file.as_uri()}{moment}")
        self.page.wait_for_selector("html[data-ready]")

    def wait(self, expression: str) -> None:
        """Poll an expression: the page's content security policy forbids `wait_for_function`."""
        end = time.monotonic() + 60
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, expression
            self.page.wait_for_timeout(50)

    def clock(self) -> float:
        return float(self.page.inner_text("#clock").split(" ")[0])

    def readings(self) -> dict[str, list[float]]:
        """Return the displayed numbers of a robot as `export` orders and scales them."""
        rows = [row.split("\t") for row in self.page.locator(".readings tr").all_inner_texts()[1:]]
        speed = next(index for index, (name, *_) in enumerate(rows) if name.startswith("speed"))
        (pose,) = (cells[1].split(", ") for cells in rows if cells[0].startswith("x, y"))
        return {
            "proximity": [int(cells[1]) for cells in rows[:speed]],
            "ambient": [int(cells[2]) for cells in rows[:speed]],
            "speed": [int(text) for text in rows[speed][1:3]],
            "pose": [float(text) for text in pose],
        }

    def picture(self, name: str) -> None:
        PICTURES.mkdir(parents=True, exist_ok=True)
        engine = self.page.context.browser.browser_type.name
        self.page.screenshot(path=PICTURES / f"{name}-{engine}.png", caret="initial")


@pytest.fixture(scope="module", params=["chromium", "firefox"])
def engine(request: pytest.FixtureRequest, playwright: Any, browser: Any) -> Iterator[Any]:
    """Chromium, and Firefox if it is installed in a version that Playwright controls."""
    if request.param == "chromium":
        yield browser
        return
    from playwright.sync_api import Error

    is_own = FIREFOX is None or Path(playwright.firefox.executable_path).exists()
    system = {} if is_own else {"channel": "moz-firefox", "executable_path": FIREFOX}
    try:
        opened = playwright.firefox.launch(**system)
        opened.new_context().close()
    except Error as error:
        pytest.skip(f"there is no Firefox here that Playwright controls: {error.message.splitlines()[0]}")
    yield opened
    opened.close()


@pytest.fixture
def player(engine: Any) -> Iterator[Player]:
    context = engine.new_context(viewport={"width": 1280, "height": 720})
    player = Player(context.new_page())
    yield player
    context.close()
    assert player.errors == []
    assert all(url.startswith(("file:", "blob:")) for url in player.requests)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    commands = (b"N\n", b"O\n", b"E\n", b"L,0,1\n")
    return record(tmp_path_factory.mktemp("player") / "run.mcap", 5.0, commands=commands)


@pytest.fixture(scope="module")
def file(log: Path) -> Path:
    target = log.with_suffix(".html")
    RunPage([log], with_log=True).save(target)
    return target


def test_a_page_plays_by_itself_and_stops_at_the_end(player: Player, file: Path) -> None:
    player.open(file)
    player.page.select_option("#speed", "10")
    player.wait("document.querySelector('#clock').textContent === '5.00 s'")
    assert player.page.inner_text("#play") == "Play"
    player.page.click("#loop")
    player.page.click("#play")
    player.wait("parseFloat(document.querySelector('#clock').textContent) < 3")
    assert player.page.inner_text("#play") == "Pause"
    assert player.page.get_attribute(".trail", "d")


@pytest.mark.parametrize("playpen", ["obstacles", "arena4"])
@pytest.mark.parametrize("is_thinned", [False, True])
def test_dragging_shows_the_numbers_of_export(
    player: Player, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, playpen: str, is_thinned: bool
) -> None:
    """Thinned samples are exact at contacts and events."""
    commands = (b"D,900,905\n",) if playpen == "arena4" else (b"N\n", b"O\n")
    log = record(tmp_path / "run.mcap", 5.0, playpen, commands)
    if is_thinned:
        monkeypatch.setattr(run_content, "_MAX_SAMPLES", 25)
    RunPage([log]).save(tmp_path / "run.html")
    good("export", log, "-o", tmp_path / "run.csv", "--channels", "pose,proximity,ambient,speed")
    table = {
        name: np.array(column)
        for name, column in pyarrow.csv.read_csv(tmp_path / "run.csv").to_pydict().items()
    }
    columns = [name for name in table if name.startswith(("proximity", "ambient", "speed"))]
    player.open(tmp_path / "run.html", "#t=0")
    box = player.page.locator("#slider").bounding_box()
    (run,) = headers((tmp_path / "run.html").read_text())
    assert (run["interval"] > 0) == is_thinned
    player.page.mouse.move(box["x"] + 8, box["y"] + box["height"] / 2)
    player.page.mouse.down()
    rng = random.Random(4)
    contacts = [start for _, start, _ in run["contacts"]]
    moments = [] if is_thinned else [rng.uniform(0, run["end"]) for _ in range(10)]
    for moment in [*moments, *contacts]:
        x = box["x"] + 8 + moment / run["end"] * (box["width"] - 16)
        player.page.mouse.move(x, box["y"] + box["height"] / 2)
        time_s = player.page.evaluate("player.time")
        row = int(np.searchsorted(table["time_s"], time_s + 1e-9)) - 1
        shown = player.readings()
        counts = [*shown["proximity"], *shown["ambient"], *shown["speed"]]
        assert counts == [table[name][row] for name in columns if "setpoint" not in name]
        pose = [1e3 * table["x_m"][row], 1e3 * table["y_m"][row], math.degrees(table["heading_rad"][row])]
        assert shown["pose"] == pytest.approx(pose, abs=0.11)
    if contacts:
        assert contacts[-1] == pytest.approx(time_s)
    player.page.mouse.up()
    player.wait(f"location.hash === '#t={+round(time_s, 3):g}&robot=khepera0'")


def test_keys_step_and_jump_and_a_link_opens_its_moment(player: Player, file: Path) -> None:
    player.open(file, "#t=2.5&robot=khepera0")
    assert player.clock() == 2.5
    keys = player.page.keyboard
    for key, moment in (
        (".", 2.52),
        (",", 2.5),
        ("ArrowRight", 3.5),
        ("ArrowLeft", 2.5),
        ("End", 5.0),
        ("Home", 0.0),
    ):
        keys.press(key)
        assert player.clock() == pytest.approx(moment), key
    keys.press("]")
    first = player.clock()
    assert first > 0
    assert player.page.get_attribute(".events [aria-current]", "class") in ("event", "contact")
    keys.press("[")
    assert player.clock() < first
    assert "khepera0, at 1" in player.page.inner_text("#status")
    keys.press("?")
    assert "one sample back or ahead" in player.page.inner_text("#dialog")
    keys.press("Escape")
    player.page.focus("#slider")
    keys.press("PageUp")
    assert player.page.get_attribute("#slider", "aria-valuetext") == "5.00 of 5.00 s"
    player.page.evaluate("location.hash = '#t=1'")
    player.wait("document.querySelector('#clock').textContent === '1.00 s'")


@pytest.mark.parametrize("size", SIZES)
def test_plan_and_3d_are_shown_at_each_size(player: Player, file: Path, size: str) -> None:
    width, height = SIZES[size]
    player.page.set_viewport_size({"width": width, "height": height})
    player.open(file, "#t=3")
    assert player.page.evaluate("document.documentElement.scrollWidth") <= width
    player.picture(f"player-{size}")
    player.page.keyboard.press("3")
    if "no WebGL" in player.page.inner_text("#status"):
        assert player.page.is_visible(".plan .live")
        pytest.skip("this browser has no WebGL here")
    player.page.wait_for_selector(".solid[data-shapes]")
    player.page.keyboard.press("f")
    assert player.page.get_attribute("#follow-button", "aria-pressed") == "true"
    player.page.wait_for_timeout(300)
    player.picture(f"player-{size}-3d")


def test_the_origin_and_the_log_are_kept(player: Player, file: Path, log: Path) -> None:
    player.open(file, "#t=0")
    player.page.click(".about")
    assert "khep-twin repeat run.mcap" in player.page.inner_text("#dialog")
    player.picture("player-about")
    assert player.page.get_attribute("#dialog a", "download") == "run.mcap"
    if player.page.context.browser.browser_type.name == "firefox":
        return  # Playwright reports no downloads of an unmodified Firefox.
    with player.page.expect_download() as download:
        player.page.click("#dialog a")
    assert Path(download.value.path()).read_bytes() == log.read_bytes()


def test_logs_side_by_side_and_a_real_robots_log_play_together(
    player: Player, log: Path, tmp_path: Path
) -> None:
    lines = in_turn(*[b"N\n", b"n,0,0,500,0,0,0,0,7\r\n"] * 20)
    RunPage([log, relayed(tmp_path / "real.mcap", lines)]).save(tmp_path / "pair.html")
    player.open(tmp_path / "pair.html", "#t=3")
    assert player.page.locator(".run").count() == 2
    assert player.page.locator(".arena:visible").count() == 1
    assert "n,0,0,500,0,0,0,0,7" in player.page.locator(".transcript").nth(1).inner_text()
    player.picture("player-pair")


def test_hostile_texts_are_shown_and_run_no_script(player: Player, log: Path, tmp_path: Path) -> None:
    hostile = with_hostile_texts(log, tmp_path / "<img src=x onerror=alert(3)>.mcap")
    RunPage([hostile], with_log=True).save(tmp_path / "hostile.html")
    player.open(tmp_path / "hostile.html", "#t=4")
    player.page.click(".about")
    assert "onerror=alert(1)" in player.page.inner_text("#dialog")
    assert "onerror=alert(1)" in player.page.inner_text(".transcript")
    assert "onerror=alert(3)" in player.page.inner_text(".run h2")
    assert player.page.locator("img").count() == 0
    player.page.evaluate(
        "document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.ran = 1\">')"
    )
    player.page.wait_for_timeout(200)
    assert player.page.evaluate("window.ran") is None
    assert any("Content Security Policy" in text or "settings blocked" in text for text in player.errors)
    player.errors.clear()

"""Playpens are drawn in a real browser, saved, lost and found."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin import playpen as playpens
from khep_twin.playpen_parts import Block
from tests.drawn_bitmap import drawn
from tests.web.conftest import Asker
from tests.web.visit import BROWSED, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


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
    page.keyboard.press("Escape")
    before = view(visit)
    for key in ("+", "ArrowRight"):
        page.keyboard.press(key)
    after = view(visit)
    assert after[2] == pytest.approx(0.8 * before[2])
    assert after[0] == pytest.approx(before[0] + 0.1 * before[2] + 0.08 * before[2])
    page.keyboard.press("Control+s")
    page.fill("#dialog input", "keys")
    page.keyboard.press("Enter")
    visit.wait("document.querySelector('#file').textContent === 'keys.toml'")
    made = playpens.load(tmp_path / "keys.toml")
    assert (made.blocks[0].x_mm, made.blocks[0].angle_deg) == (245, 15)
    assert made.robots[0].y_mm == 200


def test_what_was_not_saved_is_offered_again(visit: Visit, tmp_path: Path) -> None:
    visit.add("block", (200, 200))
    # As when the tab is closed: at once, before the page has kept its draft by itself.
    visit.page.goto("about:blank")
    wait_for(lambda: (tmp_path / ".unnamed.toml.draft").exists())
    visit.open()
    visit.page.click("text=Go on with it")
    assert visit.count(".kind-block.drawn") == 1


def test_what_is_drawn_outlives_a_designer_that_was_ended(visit: Visit, asker: Asker) -> None:
    visit.add("block", (200, 200))
    asker.end()
    visit.page.wait_for_selector("text=The designer does not answer")
    visit.add("cylinder", (400, 200))
    visit.page.click("#save-as")
    visit.page.click("#dialog .main")
    visit.page.wait_for_selector("text=This did not reach the designer")
    assert visit.count(".drawn") == 2
    visit.picture("8-ended")
    visit.trouble = [text for text in visit.trouble if "ERR_CONNECTION" not in text]


def test_two_pages_on_one_file_ask_before_one_replaces_the_other(visit: Visit, browser: Any) -> None:
    visit.add("block", (200, 200))
    visit.save_as("both.toml")
    second = Visit(visit.page.context.new_page(), visit.url)
    second.page.click("#open")
    second.page.click("#dialog .main")
    second.page.wait_for_selector("text=Another page has both.toml open")
    second.page.wait_for_timeout(1000)  # it had this file before, and nothing tells that it is there anew
    second.add("cylinder", (400, 200))
    second.page.click("#save")
    visit.page.wait_for_selector("text=was saved by another page")
    visit.add("lamp", (100, 100))
    visit.page.click("#save")
    visit.page.wait_for_selector("text=Replace it")
    visit.trouble = [text for text in visit.trouble if "409" not in text]


@pytest.mark.parametrize("dropped", [False, True])
@pytest.mark.parametrize("kind", ["png", "mat"])
def test_a_picture_or_a_scan_becomes_a_playpen(
    visit: Visit, tmp_path: Path, kind: str, dropped: bool
) -> None:
    file = tmp_path / f"maze.{kind}"
    if kind == "png":
        Image.fromarray(~drawn()).save(file)
    else:
        savemat(file, {"btmap1": np.where(drawn()[::-1], 44, 1)})
    page = visit.page
    if dropped:
        visit.drop(file)
    else:
        page.set_input_files("#import", file)
    page.click("#dialog .main")
    visit.wait("document.querySelectorAll('.kind-block').length > 3")
    page.wait_for_selector("#problems.none")
    assert page.text_content("#file") == "new playpen *"
    assert page.input_value("#field-playpen-name") == "maze"
    visit.save_as("maze.toml")
    # The first block stands upper left, as it is drawn; the scan has its first row at the bottom.
    assert any(abs(block.x_mm - 110) < 5 and abs(block.y_mm - 390) < 5 for block in saved_blocks(tmp_path))


def test_what_is_no_picture_is_told_and_changes_nothing(visit: Visit, tmp_path: Path) -> None:
    visit.add("block", (200, 200))
    visit.save_as("mine.toml")
    (tmp_path / "notes.png").write_text("no picture")
    visit.drop(tmp_path / "notes.png")
    visit.page.click("#dialog .main")
    visit.page.wait_for_selector(".banner.error")
    assert visit.count(".drawn") == 1
    visit.trouble = [text for text in visit.trouble if "400" not in text]


def test_two_fingers_zoom_and_move_the_view(tablet: Visit) -> None:
    tablet.add("block", (300, 250))
    before = view(tablet)
    left, right = tablet.at(200, 250), tablet.at(400, 250)
    wider_left, wider_right = tablet.at(100, 250), tablet.at(500, 250)
    tablet.touch(left)
    tablet.touch(left, right)
    tablet.touch(wider_left, wider_right)
    assert view(tablet)[2] == pytest.approx(before[2] / 2)
    tablet.touch()
    # What the fingers took is where they left it, and nothing was drawn or selected by them.
    assert tablet.at(200, 250) == pytest.approx(wider_left)
    assert tablet.at(400, 250) == pytest.approx(wider_right)
    assert tablet.count(".drawn") == 1
    tablet.picture("9-pinched")
    start, end = tablet.at(300, 250), tablet.at(320, 300)
    tablet.touch(start)
    tablet.touch(end)
    tablet.touch()
    assert tablet.page.input_value("#field-block-y_mm") == "300"


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1024, 768), (820, 1180)])
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


def test_a_drag_among_two_hundred_objects_ends_where_the_mouse_does(visit: Visit) -> None:
    """How smooth it is tells python -m benchmarks.page."""
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
    print(f"{page.evaluate('frames_seen') / took:.0f} frames/s among {visit.count('.drawn')} objects")
    moved = page.locator(".kind-block.drawn").last.get_attribute("transform")
    assert moved.startswith(f"translate({x_mm + 50:g} {y_mm - 10:g})")


def wait_for(happens: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.02)


def saved_blocks(folder: Path) -> tuple[Block, ...]:
    return playpens.load(folder / "maze.toml").blocks


def view(visit: Visit) -> list[float]:
    """What of the arena is in view: x, y, width, height [mm]."""
    return [float(number) for number in visit.page.get_attribute("#view", "viewBox").split()]


def test_what_is_typed_wrongly_is_told_drawn_somehow_and_left_by_tab(visit: Visit) -> None:
    page = visit.page
    visit.add("block", (300, 250))
    for text in ("", "1e99", "-5", "60"):
        page.fill("#field-block-length_mm", text)
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "field-block-width_mm"
        page.wait_for_selector("#problems.none" if text == "60" else "#problems:not(.none)")
    page.fill("#field-block-x_mm", "")
    page.keyboard.press("Tab")
    page.wait_for_selector("#problems:not(.none)")
    page.click("#undo")
    page.click('[data-tab="playpen"]')
    for text in ("1e99", "1e7", "", "600"):
        page.fill("#field-arena-width_mm", text)
        page.keyboard.press("Tab")
    page.fill("#field-arena-outline_mm", "1, 2")
    page.keyboard.press("Tab")
    assert not page.evaluate("document.querySelector('#field-arena-outline_mm').checkValidity()")
    page.wait_for_selector("#problems.none")
    assert visit.count(".drawn") == 1


def test_a_file_that_cannot_be_opened_leaves_the_draft_of_the_last(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    visit.save_as("mine.toml")
    visit.add("block", (300, 250))
    (tmp_path / "broken.toml").write_text("x = [1")
    draft = tmp_path / ".mine.toml.draft"
    while not draft.exists():
        page.wait_for_timeout(50)
    page.click("#open")
    page.select_option("#dialog select", "broken.toml")
    page.click("#dialog .main")
    page.wait_for_selector("text=There are changes that are not saved")
    page.click("#dialog .main")
    page.wait_for_selector("text=not TOML")
    assert draft.exists()
    visit.trouble.clear()  # the answer 400

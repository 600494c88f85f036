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

from khep_twin.playpen import Playpen
from khep_twin.playpen.parts import Block
from tests.drawn_bitmap import drawn
from tests.web.conftest import Client, run_server
from tests.web.visit import BROWSED, PICTURES, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


def test_what_is_wrong_is_reported_at_the_object_while_it_is_dragged(visit: Visit) -> None:
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


def test_what_is_deleted_while_it_is_dragged_takes_no_other_object_with_it(visit: Visit) -> None:
    visit.add("block", (200, 200), (400, 300))
    page = visit.page
    page.mouse.move(*visit.at(200, 200))
    page.mouse.down()
    page.mouse.move(*visit.at(250, 100), steps=3)
    page.keyboard.press("Delete")
    page.mouse.move(*visit.at(100, 100), steps=3)
    page.mouse.up()
    left = page.locator(".kind-block.drawn")
    assert left.count() == 1
    assert left.get_attribute("transform").startswith("translate(400 300)")
    page.keyboard.press("Control+z")
    assert left.count() == 2
    assert left.first.get_attribute("transform").startswith("translate(200 200)")


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
    visit.wait_file("keys.toml")
    playpen = Playpen.load(tmp_path / "keys.toml")
    for default in ("mass_g", "movable", "[lighting]", "surface", "calibration", "mode"):
        assert default not in (tmp_path / "keys.toml").read_text()
    assert (playpen.blocks[0].x_mm, playpen.blocks[0].angle_deg) == (245, 15)
    assert playpen.robots[0].y_mm == 200


def test_a_tool_is_kept_for_several_objects(visit: Visit) -> None:
    page = visit.page
    page.dblclick('[data-tool="cylinder"]')
    for place in ((100, 100), (200, 100), (300, 100)):
        visit.click(*place)
    assert visit.count(".kind-cylinder.drawn") == 3
    visit.picture("14-kept")
    page.click('[data-tool="lamp"]')
    page.wait_for_timeout(600)
    page.dblclick('[data-tool="lamp"]')
    assert visit.count(".locked") == 1
    page.wait_for_timeout(600)
    page.click('[data-tool="lamp"]')
    visit.click(100, 300)
    visit.click(200, 300)  # this tool was left after the first
    assert visit.count(".kind-lamp.drawn") == 1
    for key in ("p", "p"):
        page.keyboard.press(key)
    visit.click(300, 300)
    page.keyboard.press("Enter")
    page.keyboard.press("Escape")
    visit.click(400, 400)
    assert visit.count(".kind-patch.drawn") == 2
    page.keyboard.press("w")
    page.keyboard.press("w")
    for x_mm in (50, 550):
        visit.click(x_mm, 200)
        visit.click(x_mm, 400)
        page.keyboard.press("Enter")
    assert visit.count(".kind-wall.drawn") == 2
    assert "· 2 patches, 2 walls, 3 cylinders, 1 lamp, " in page.inner_text("#legend")


def test_the_handles_for_turning_and_sizing_differ(visit: Visit) -> None:
    page = visit.page
    visit.add("block", (300, 250))
    assert (visit.count(".handle.turn circle"), visit.count(".handle.size rect")) == (1, 1)
    visit.picture("15-handles")
    box = page.locator(".handle.size").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(*visit.at(350, 280), steps=4)
    page.mouse.up()
    assert (page.input_value("#field-block-length_mm"), page.input_value("#field-block-width_mm")) == (
        "100",
        "60",
    )


def test_turrets_are_boxes_and_the_gripper_is_drawn(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    visit.add("robot", (150, 120), (300, 220))
    box = "#field-robot-turrets input[value=gripper]"
    page.check(box)
    assert visit.count(".kind-robot .turret") > 5
    page.wait_for_selector("#problems.none")
    page.click("#view")
    page.keyboard.press("Control+a")
    assert page.evaluate(f"document.querySelector('{box}').indeterminate")
    page.check(box)
    parts = visit.count(".kind-robot .turret")
    page.uncheck(box)
    assert visit.count(".kind-robot .turret") == 0
    page.click("#undo")
    assert visit.count(".kind-robot .turret") == parts
    assert page.is_checked(box)
    visit.picture("16-turrets")
    visit.save_as("grippers.toml")
    saved = Playpen.load(tmp_path / "grippers.toml")
    assert [robot.turrets for robot in saved.robots] == [("gripper",), ("gripper",)]


def test_a_turret_that_is_checked_later_goes_below_those_that_stand_on_it(
    visit: Visit, tmp_path: Path
) -> None:
    visit.add("robot", (150, 120))
    for turret in ("k213", "gripper"):
        visit.page.check(f"#field-robot-turrets input[value={turret}]")
    visit.page.wait_for_selector("#problems.none")
    visit.save_as("stack.toml")
    assert Playpen.load(tmp_path / "stack.toml").robots[-1].turrets == ("gripper", "k213")


def test_what_was_not_saved_is_offered_again(visit: Visit, tmp_path: Path) -> None:
    visit.add("block", (200, 200))
    # For example if the tab is closed before the page saves its draft automatically.
    visit.page.goto("about:blank")
    wait_for(lambda: drafts(tmp_path) == ["unnamed"])
    visit.open()
    visit.page.click("text=Continue it")
    visit.page.wait_for_selector(".kind-block.drawn")
    assert visit.count(".kind-block.drawn") == 1


def test_a_draft_is_offered_for_its_own_playpen_only_and_outlives_another(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("robot", (300, 100))
    visit.save_as("mine.toml")
    content = (tmp_path / "mine.toml").read_bytes()
    page.click("#new")
    page.check("#dialog input[value=default]")
    visit.new()
    visit.add("block", (200, 200))
    page.goto("about:blank")
    wait_for(lambda: drafts(tmp_path) == ["unnamed"])
    visit.open()
    page.wait_for_selector("text=A draft of a new playpen was never saved")
    visit.open_file("mine.toml")
    assert visit.count("text=Continue it") == 0
    page.click("#save")
    page.wait_for_selector("text=Saved as mine.toml")
    assert (tmp_path / "mine.toml").read_bytes() == content
    visit.add("lamp", (100, 100))
    page.click("#undo")
    assert drafts(tmp_path) == ["unnamed"]
    # Nor does drawing something else delete or replace it.
    page.goto(f"{visit.url}#new")
    page.reload()
    page.wait_for_selector("html[data-ready]")
    visit.add("cylinder", (200, 200))
    wait_for(lambda: drafts(tmp_path) == ["unnamed", "unnamed"])
    page.click("text=Continue it")
    wait_for(lambda: drafts(tmp_path) == ["unnamed"])
    assert (visit.count(".kind-block.drawn"), visit.count(".kind-cylinder.drawn")) == (1, 0)
    page.click("#undo")  # what was drawn before is not lost either
    assert (visit.count(".kind-block.drawn"), visit.count(".kind-cylinder.drawn")) == (0, 1)
    page.click("#redo")
    visit.save_as("other.toml")
    assert drafts(tmp_path) == []
    assert len(Playpen.load(tmp_path / "other.toml").blocks) == 1


def test_a_draft_is_thrown_away_only_when_the_person_says_so(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    for _ in range(2):
        visit.add("block", (200, 200))
        page.goto("about:blank")
        visit.open()
    wait_for(lambda: drafts(tmp_path) == ["unnamed", "unnamed"])
    visit.open()
    page.click(".banner button[title=Close]")
    page.wait_for_timeout(1000)
    visit.open()
    assert drafts(tmp_path) == ["unnamed", "unnamed"]
    for left in (1, 0):
        page.click("text=Discard it")
        wait_for(lambda count=left: len(drafts(tmp_path)) == count)
    assert visit.count(".banner") == 0


def test_a_draft_of_a_file_that_has_changed_since_does_not_replace_it_unasked(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.save_as("mine.toml")
    visit.add("block", (200, 200))
    page.goto("about:blank")
    wait_for(lambda: drafts(tmp_path) == ["mine.toml"])
    file = tmp_path / "mine.toml"
    file.write_text(file.read_text() + "# by an editor\n")
    visit.open()
    page.click("text=Continue it")
    page.wait_for_selector(".kind-block.drawn")
    page.click("#save")
    page.wait_for_selector("text=was changed by another page or program")
    assert "by an editor" in file.read_text()


def test_a_new_file_of_any_name_is_drawn_and_saved(browser: Any, tmp_path: Path) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    with run_server(tmp_path, "my pen.toml") as client:
        visit = Visit(context.new_page(), client.server.url)
        assert visit.page.text_content("#file") == "my pen.toml"
        visit.add("block", (200, 200))
        visit.page.click("#save")
        visit.page.wait_for_selector("text=Saved as my pen.toml")
        visit.page.reload()
        visit.page.wait_for_selector("html[data-ready]")
        assert (visit.page.text_content("#file"), visit.count(".kind-block.drawn")) == ("my pen.toml", 1)
        visit.save_as("größe 2.toml")
        context.close()
    assert visit.errors == []
    assert Playpen.load(tmp_path / "my pen.toml").name == "my-pen"
    assert Playpen.load(tmp_path / "größe 2.toml").name == "gro-e-2"


def test_an_error_of_the_first_request_is_shown(browser: Any, client: Client) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    page = context.new_page()

    def refuse(route: Any) -> None:
        route.fulfill(status=500, body="no more room")

    page.route("**/do/hello", refuse)
    page.goto(client.server.url)
    page.wait_for_selector(".banner.error >> text=no more room")
    page.unroute("**/do/hello")
    page.click("text=Try again")
    page.wait_for_selector("html[data-ready]")
    context.close()


def test_a_designer_that_ends_during_a_run_says_so_once_and_what_needs_it_is_off(
    visit: Visit, client: Client
) -> None:
    page = visit.page
    visit.add("block", (200, 200))
    visit.add("robot", (400, 200))
    visit.drive()
    client.end()
    page.wait_for_selector("text=The designer has ended, and the twin with it")
    assert page.inner_text("#clock") == "not running"
    page.click('[data-tab="object"]')
    visit.add("cylinder", (400, 400))
    page.keyboard.press("Control+s")
    page.wait_for_timeout(2000)  # checks, drafts and reconnections fail meanwhile
    assert visit.count(".banner") == 1
    assert visit.count(".drawn") == 3
    for name in "new open save save-as import three-d run stop start end put connect gather".split():
        assert page.evaluate(f"document.querySelector('#{name}').closest('[inert]') !== null"), name
    assert page.evaluate("document.querySelector('#undo').closest('[inert]') === null")
    visit.picture("8-ended")
    visit.errors = [text for text in visit.errors if "ERR_CONNECTION" not in text]


def test_a_designer_that_is_reached_again_is_used_again(visit: Visit) -> None:
    page = visit.page

    def cut(route: Any) -> None:
        route.abort()

    page.route("**/do/check", cut)
    visit.add("block", (200, 200))
    page.wait_for_selector("text=The designer cannot be reached")
    page.unroute("**/do/check")
    visit.wait("!document.querySelector('.banner')")
    visit.save_as("mine.toml")
    visit.errors = [text for text in visit.errors if "ERR_FAILED" not in text]


def test_an_error_stays_until_its_cause_is_gone(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    page.click("#run")
    page.wait_for_selector(".banner.error >> text=there is no robot")
    (tmp_path / "broken.toml").write_text("x = [1")
    page.click("#open")
    page.click("#dialog .main")
    page.wait_for_selector(".banner.error >> text=not TOML")
    visit.add("robot", (300, 200))
    page.wait_for_selector("text=there is no robot", state="detached")
    assert visit.count(".banner.error") == 1
    visit.save_as("mine.toml")
    visit.wait("!document.querySelector('.banner.error')")


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (820, 1180), (390, 844), (390, 600)])
def test_banners_cover_neither_arena_nor_tools_nor_legend(
    browser: Any, empty: None, client: Client, tmp_path: Path, width: int, height: int
) -> None:
    (tmp_path / "notes.png").write_text("no picture")
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=width < 1280)
    visit = Visit(context.new_page(), client.server.url)
    page = visit.page
    before = page.evaluate("JSON.stringify(document.querySelector('#arena').getBoundingClientRect())")
    page.click('[data-tab="run"]')
    page.click("#start")
    visit.drop(tmp_path / "notes.png")
    page.click("#dialog .main")
    Visit(context.new_page(), client.server.url)
    visit.wait("document.querySelectorAll('.banner').length === 3")
    page.evaluate("document.querySelector('main').scrollTo(0, 0)")
    assert page.evaluate("JSON.stringify(document.querySelector('#arena').getBoundingClientRect())") == before
    page.screenshot(path=PICTURES / f"12-banners-{width}x{height}.png")
    covered = """() => ["header", "#tools", "#view", "#legend"].filter((name) => {
        const main = document.querySelector("main").getBoundingClientRect();
        const [is, over] = [name, "#banners"].map((selector) =>
            document.querySelector(selector).getBoundingClientRect());
        const bottom = Math.min(is.bottom, main.height ? main.bottom : Infinity);  // scrolled out of view
        return is.left < over.right && over.left < is.right && is.top < over.bottom && over.top < bottom;
    })"""
    assert page.evaluate(covered) == []
    for name in ("run", "sense"):
        page.click(f'[data-tab="{name}"]')
        panel = f"document.querySelector('#tab-{name}')"
        assert page.evaluate(f"{panel}.scrollWidth <= {panel}.clientWidth"), name
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    context.close()


def test_two_pages_on_one_file_ask_before_one_replaces_the_other(visit: Visit, tmp_path: Path) -> None:
    visit.add("block", (200, 200))
    visit.save_as("both.toml")
    second = Visit(visit.page.context.new_page(), visit.url)
    second.page.click("#open")
    second.page.click("#dialog .main")
    second.page.wait_for_selector("text=Another page has both.toml open")
    second.page.wait_for_timeout(1000)  # it had this file before, and no event shows that it was loaded again
    second.add("cylinder", (400, 200))
    second.page.click("#save")
    visit.page.wait_for_selector("text=was saved by another page")
    visit.add("lamp", (100, 100))
    visit.page.click("#save")
    visit.page.wait_for_selector("text=Replace it")
    # What was saved by one page leaves the draft of the other, which it no longer is to close first.
    second.page.goto("about:blank")
    assert drafts(tmp_path) == ["both.toml"]
    visit.page.goto("about:blank")
    visit.open()
    visit.page.click("text=Continue it")
    visit.page.wait_for_selector(".kind-lamp.drawn")


def test_saves_that_follow_each_other_at_once_do_not_disagree(visit: Visit, tmp_path: Path) -> None:
    visit.save_as("mine.toml")
    visit.add("block", (200, 200))
    visit.page.evaluate("for (let number = 0; number < 3; number++) document.querySelector('#save').click()")
    visit.wait_file("mine.toml")
    visit.add("lamp", (400, 200))
    visit.page.click("#save")
    visit.wait_file("mine.toml")
    assert "[[lamp]]" in (tmp_path / "mine.toml").read_text()
    assert visit.count(".banner.error") == 0


def test_a_file_that_is_loaded_anew_ends_the_twin_in_its_drawing(visit: Visit) -> None:
    visit.add("robot", (200, 200))
    visit.save_as("both.toml")
    second = Visit(visit.page.context.new_page(), visit.url)
    second.page.click("#open")
    second.page.click("#dialog .main")
    second.page.wait_for_selector(".kind-robot.drawn")
    second.add("cylinder", (400, 200))
    visit.start()
    second.page.click("#save")
    visit.page.click("text=Load it anew")
    visit.page.wait_for_selector(".kind-cylinder.drawn")
    visit.wait("document.querySelector('#clock').textContent === 'not running'")
    assert visit.count(".live") == 0


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


def test_what_is_no_picture_is_reported_and_changes_nothing(visit: Visit, tmp_path: Path) -> None:
    visit.add("block", (200, 200))
    visit.save_as("mine.toml")
    (tmp_path / "notes.png").write_text("no picture")
    visit.drop(tmp_path / "notes.png")
    visit.page.click("#dialog .main")
    visit.page.wait_for_selector(".banner.error")
    assert visit.count(".drawn") == 1


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


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1024, 768), (820, 1180), (390, 844)])
def test_nothing_sticks_out_of_the_window(browser: Any, client: Client, width: int, height: int) -> None:
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=width < 1280)
    visit = Visit(context.new_page(), client.server.url)
    wide, high = visit.page.evaluate(
        "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
    )
    assert wide <= width
    assert high <= height
    visit.picture(f"7-{width}x{height}")
    context.close()
    assert visit.errors == []


def test_a_long_name_covers_nothing_on_a_phone(browser: Any, tmp_path: Path) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    with run_server(tmp_path) as client:
        visit = Visit(context.new_page(), client.server.url)
        place = "JSON.stringify(document.querySelector('#arena').getBoundingClientRect())"
        before = visit.page.evaluate(place)
        for name in ("a name of many words " * 10, "long" * 50):
            visit.page.click("#save-as")
            visit.page.fill("#dialog input", f"{name}.toml")
            visit.page.click("#dialog .main")
            visit.wait_file(f"{name}.toml")
            assert visit.page.evaluate(place) == before
            assert visit.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        visit.picture("7-long-name")
        context.close()
    assert visit.errors == []


def test_a_drag_among_two_hundred_objects_ends_where_the_mouse_does(visit: Visit) -> None:
    """`python -m benchmarks.page` measures the frame rate."""
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


def drafts(folder: Path) -> list[str]:
    """Return the documents that have drafts, once for each draft."""
    return sorted(re.sub(r"\.[\d-]+\.draft$", "", path.name)[1:] for path in folder.glob(".*.draft"))


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def saved_blocks(folder: Path) -> tuple[Block, ...]:
    return Playpen.load(folder / "maze.toml").blocks


def view(visit: Visit) -> list[float]:
    """Return the visible part of the arena: x, y, width, height [mm]."""
    return [float(number) for number in visit.page.get_attribute("#view", "viewBox").split()]


def test_what_is_typed_wrongly_is_reported_drawn_somehow_and_left_by_tab(visit: Visit) -> None:
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
    wait_for(lambda: drafts(tmp_path) == ["mine.toml"])
    page.click("#open")
    page.select_option("#dialog select", "broken.toml")
    page.click("#dialog .main")
    page.wait_for_selector("text=There are changes that are not saved")
    page.click("#dialog .main")
    page.wait_for_selector("text=not TOML")
    assert drafts(tmp_path) == ["mine.toml"]


def test_a_playpen_of_the_library_is_chosen_by_its_picture(visit: Visit) -> None:
    page = visit.page
    page.click("#new")
    visit.wait(
        "[...document.querySelectorAll('.cards img')].slice(0, 4).every((image) => image.naturalWidth > 100)"
    )
    visit.picture("12-library")
    names = page.locator(".cards strong").all_inner_texts()
    position = names.index("garbage")
    assert "Five cylinders to be carried away" in page.locator(".cards label").nth(position).inner_text()
    for _ in range(position):
        page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    visit.wait("document.querySelectorAll('.kind-cylinder').length === 5")


def test_a_picture_of_the_library_that_is_still_drawn_has_another_in_its_place(visit: Visit) -> None:
    page = visit.page
    requests: list[Any] = []

    def hold(route: Any) -> None:
        if requests:
            route.continue_()
        requests.append(route)

    page.route("**/do/thumbnail", hold)
    page.click("#new")
    visit.wait("document.querySelectorAll('.cards img').length > 4")
    images = "[...document.querySelectorAll('.cards img')]"
    complete = f"{images}.every((image) => image.complete && image.naturalWidth)"
    visit.wait(complete)
    page.wait_for_timeout(100)
    assert len(requests) == 1
    requests[0].continue_()
    visit.wait("document.querySelector('.cards img').naturalWidth > 100")
    assert page.evaluate(complete)


def test_undo_in_a_field_takes_back_what_is_typed_and_then_the_drawings_last_change(visit: Visit) -> None:
    page = visit.page
    visit.add("block", (300, 250))
    x = "#field-block-x_mm"
    page.fill(x, "320")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "field-block-y_mm"
    page.keyboard.type("9")
    page.keyboard.press("Control+z")
    assert (page.input_value("#field-block-y_mm"), page.input_value(x)) == ("250", "320")
    page.keyboard.press("Control+z")
    assert (page.input_value(x), page.evaluate("document.activeElement.id")) == ("300", "field-block-y_mm")
    page.keyboard.press("Control+y")
    assert page.input_value(x) == "320"
    page.select_option("#field-block-surface", "black")
    page.focus("#field-block-surface")
    page.keyboard.press("Control+z")
    assert page.input_value("#field-block-surface") == "white"
    # Playpen, lighting and surfaces are covered, too.
    page.click('[data-tab="playpen"]')
    page.select_option("#field-lighting-mode", "random")
    page.fill("#field-arena-width_mm", "700")
    page.keyboard.press("Tab")
    page.click("text=New surface")
    page.locator('[aria-label="reflectance of surface1"]').fill("0.3")
    page.keyboard.press("Tab")
    for _ in range(4):
        page.click("#undo")
    assert page.input_value("#field-lighting-mode") == "all"
    assert page.input_value("#field-arena-width_mm") == "600"
    assert visit.count('[aria-label="reflectance of surface1"]') == 0


def test_undo_in_another_field_does_not_go_on_to_the_drawings(visit: Visit) -> None:
    page = visit.page
    visit.add("block", (300, 250))
    page.focus("#field-block-x_mm")
    page.keyboard.press("Control+a")
    page.keyboard.type("320")
    page.focus("#grid")
    page.keyboard.press("Control+z")
    assert page.evaluate("document.activeElement.id") == "grid"
    assert page.input_value("#field-block-x_mm") == "320"
    assert "320" in page.evaluate("document.querySelector('[data-id=\"block:0\"]').getAttribute('transform')")


def test_undo_brings_back_the_former_playpen_with_its_file_and_what_was_not_saved(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("block", (100, 100))
    visit.save_as("first.toml")
    visit.add("block", (300, 300))
    page.click("#new")
    page.click("#dialog .main")
    page.wait_for_selector("text=Undo brings them back")
    visit.new()
    picture = tmp_path / "drawn.png"
    Image.fromarray(~drawn()).save(picture)
    visit.drop(picture)
    page.wait_for_selector("#dialog input")
    page.click("#dialog .main")
    visit.wait_file("new playpen *")
    # Import and New are taken back, one after the other, and the file is the former one.
    page.click("#undo")
    assert page.text_content("#file") == "new playpen"
    page.click("#undo")
    assert (page.text_content("#file"), visit.count(".drawn")) == ("first.toml *", 2)
    assert page.evaluate("location.hash") == "#first.toml"
    page.wait_for_selector(".banner >> text=first.toml is open again")
    page.click("#redo")
    assert (page.text_content("#file"), page.evaluate("location.hash")) == ("new playpen", "#new")
    page.click("#undo")
    page.click("#save")
    visit.wait_file("first.toml")
    assert len(Playpen.load(tmp_path / "first.toml").blocks) == 2
    # The history goes on before it: the second block, then the first one.
    page.click("#undo")
    assert (page.text_content("#file"), visit.count(".drawn")) == ("first.toml *", 1)


def test_a_file_that_was_changed_since_it_was_left_is_not_replaced_unasked_after_undo(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("block", (100, 100))
    visit.save_as("first.toml")
    page.click("#new")
    visit.new()
    (tmp_path / "first.toml").write_text((tmp_path / "first.toml").read_text() + "# of an editor\n")
    page.click("#undo")
    page.click("#save")
    page.wait_for_selector(".banner.error >> text=first.toml")
    assert (tmp_path / "first.toml").read_text().endswith("# of an editor\n")


def test_tools_and_buttons_of_the_top_bar_have_icons_in_the_colour_of_the_text_and_names(
    visit: Visit,
) -> None:
    page = visit.page
    drawn_icons = """[
        ...document.querySelectorAll('header button:not([hidden]), header label, nav button'),
    ].every((button) => {
        const { width, height } = button.querySelector('use').getBBox();
        return button.textContent.trim() && Math.min(width, height) > 4;
    })"""
    for width in (1280, 420):
        page.set_viewport_size({"width": width, "height": 860})
        visit.wait(drawn_icons)
        for name in ("Run", "New…", "Undo", "Delete", "Zoom in", "3-D", "Keys", "Block", "Spot"):
            assert page.get_by_role("button", name=name, exact=True).count() == 1, name
        # The key of each tool is shown beside it, even without room for its name.
        keys = page.locator("nav kbd")
        assert keys.all_inner_texts() == list("VBCWLRPS")
        assert all(key.is_visible() for key in keys.all())
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        for selector in ("#open", "#undo", "[data-tool=wall]"):
            colours = "((e) => [getComputedStyle(e).color, getComputedStyle(e.querySelector('use')).stroke])"
            text, stroke = page.evaluate(f"{colours}(document.querySelector('{selector}'))")
            assert text == stroke


def test_a_large_draft_is_kept_when_the_page_is_hidden(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    table = "[[cylinder]]\nx_mm = {}\ny_mm = {}\nradius_mm = 5\nheight_mm = 50\n"
    rows = "".join(table.format(20 + 25 * (n % 40), 20 + 25 * (n // 40)) for n in range(600))
    arena = 'version = 1\nname = "many"\n[arena]\nwidth_mm = 1100\nheight_mm = 600\n'
    (tmp_path / "many.toml").write_text(arena + rows)
    page.click("#open")
    page.click("#dialog .main")
    visit.wait("document.querySelectorAll('.kind-cylinder').length === 600")
    visit.add("lamp", (1060, 560))
    visit.wait_file("many.toml *")
    # For example if another tab is shown.
    page.evaluate(
        "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    page.wait_for_timeout(400)
    assert not page.locator("text=The designer cannot be reached").count()
    end = 100
    while not (paths := list(tmp_path.glob(".many.toml.*.draft"))) and end:
        page.wait_for_timeout(100)
        end -= 1
    assert paths[0].stat().st_size > 64 * 1024

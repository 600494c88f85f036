"""The pictures of docs/designer.md.

KHEP_SCREENSHOTS=docs/pictures make browser BROWSER='-k pictures_of_the_guide'    # updates them
"""

import re
import shutil
from pathlib import Path

from PIL import Image

from khep_twin.web.routes import ASSETS
from tests.web.visit import BROWSED, PICTURES, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED

PAGE = Path(__file__).parents[2] / "docs" / "designer.md"

BENCH = """
version = 1
name = "bench"
arena = { width_mm = 600, height_mm = 500 }
robot = [{ x_mm = 300, y_mm = 330, heading_deg = 90 }]
"""


def test_the_pictures_of_the_guide_are_the_pages_own(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    shutil.copy(ASSETS.parent / "playpens" / "obstacles.toml", tmp_path / "mine.toml")
    visit.open_file("mine.toml")
    visit.click(590, 435)
    visit.picture("designer")

    page.mouse.move(*visit.at(120, 290))
    page.mouse.down()
    page.mouse.move(*visit.at(215, 405), steps=5)
    page.wait_for_selector(".kind-robot.bad")
    visit.picture("designer_wrong")
    page.mouse.up()
    page.click("#undo")
    page.wait_for_selector("#problems.none")

    page.click("#view")
    page.click('[data-tool="select"]')
    visit.click(120, 290)
    page.check("#field-robot-turrets input[value=gripper]")
    page.wait_for_selector("#problems.none")
    visit.show_3d()
    page.wait_for_timeout(500)
    visit.picture("designer_3d")
    page.click("#three-d")
    page.click("#undo")

    page.click('[data-tab="run"]')
    page.select_option("#speed", "10")
    page.fill("#cycles", "3000")
    page.click("#run")
    visit.wait_seconds(18)
    page.select_option("#speed", "0.25")
    page.focus("#view")
    page.wait_for_timeout(300)
    visit.picture("designer_run")
    page.check("#curves input[value=light]")
    page.click("#pause")
    visit.wait("document.querySelector('#clock').textContent.includes('paused')")
    page.evaluate("document.querySelector('#bars').scrollIntoView()")
    canvas = page.locator("#curves canvas").bounding_box()
    page.mouse.move(canvas["x"] + 0.6 * canvas["width"], canvas["y"] + 60)
    page.wait_for_selector("#curves output >> text=proximity")
    visit.picture("designer_curves")
    page.click("#pause")

    visit.stop()
    visit.end()

    (tmp_path / "bench.toml").write_text(BENCH)
    visit.open_file("bench.toml")
    page.click('[data-tab="run"]')
    page.select_option("#speed", "0")
    page.click('[data-tab="sense"]')
    page.fill("#amount", "13")
    page.click("#gather")
    page.wait_for_selector("#figure:not([hidden])")
    visit.wait("document.querySelector('#figure').naturalWidth > 100")
    visit.picture("designer_sense")

    page.click('[data-tab="run"]')
    visit.end()
    visit.open_file("mine.toml")
    visit.start()
    page.mouse.move(*visit.at(120, 290))
    page.mouse.down()
    page.mouse.move(*visit.at(410, 440), steps=5)
    page.wait_for_selector(".live.held.bad")
    visit.picture("designer_held")
    page.mouse.up()
    page.click("#end")

    visit.wait("document.querySelector('#clock').textContent === 'not running'")
    page.click('[data-tab="challenge"]')
    page.wait_for_selector("#challenge-picture:not([hidden])")
    page.select_option("#challenge", "stop")
    page.click("#challenge-playpen")
    page.click("#score")
    page.wait_for_selector("#score-status.passed >> text=reference solution: passed")
    page.locator("#challenge-text").evaluate("text => text.scrollIntoView()")
    visit.picture("designer_challenge")

    names = re.findall(r"\(pictures/(designer\w*\.png)\)", PAGE.read_text())
    assert len(names) >= 4
    for name in names:
        with Image.open(PAGE.parent / "pictures" / name) as old, Image.open(PICTURES / name) as new:
            assert (old.mode, old.size) == (new.mode, new.size), name

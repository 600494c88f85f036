"""The arena in 3-D, in a real browser: orbited, live, followed, and without WebGL."""

import io
import re

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.web.conftest import Client
from tests.web.visit import BROWSED, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


def screenshot(visit: Visit) -> NDArray[np.uint8]:
    picture = visit.page.locator("#solid").screenshot()
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))


def shapes(visit: Visit) -> int:
    return int(visit.page.get_attribute("#solid", "data-shapes") or 0)


def test_the_scene_is_shown_by_a_key_and_orbited(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    page.focus("#view")
    page.keyboard.press("3")
    page.wait_for_selector("#solid[data-shapes]")
    assert page.get_attribute("#three-d", "aria-pressed") == "true"
    page.wait_for_timeout(300)
    first = screenshot(visit)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20
    page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(300)
    turned = screenshot(visit)
    assert (turned != first).any()
    page.keyboard.press("0")
    page.wait_for_timeout(300)
    assert (screenshot(visit) == first).mean() > 0.99
    visit.picture("3d-drawing")
    # What is drawn meanwhile appears.
    before = shapes(visit)
    page.evaluate("document.querySelector('.kind-robot').focus()")
    page.keyboard.press("3")
    visit.add("block", (150, 120))
    page.focus("#view")
    page.keyboard.press("3")
    visit.wait(f"+document.querySelector('#solid').dataset.shapes === {before + 1}")


def test_a_running_twin_is_followed(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    page.click("#three-d")
    page.click('[data-tab="run"]')
    page.click("#run")
    page.wait_for_selector("#follow:not([hidden])")
    visit.wait_seconds(1)
    first = screenshot(visit)
    visit.wait_seconds(2.5)
    assert (screenshot(visit) != first).any()
    page.focus("#solid")
    page.keyboard.press("f")
    assert page.get_attribute("#follow", "aria-pressed") == "true"
    visit.wait_seconds(3.5)
    visit.picture("3d-followed")
    visit.stop()
    page.click("#end")
    page.wait_for_selector("#follow[hidden]", state="attached")


def test_a_lamp_lights_the_floor_but_not_behind_an_object_and_the_robot_has_a_shadow(visit: Visit) -> None:
    visit.add("robot", (450, 250))
    visit.page.wait_for_selector("#problems.none")
    visit.show_3d()
    visit.page.wait_for_timeout(500)
    pictures = [screenshot(visit).astype(int)]
    floor = np.median(pictures[0][-150:-100, 300:400], axis=(0, 1))
    near = pictures[0].sum(axis=2) - floor.sum()
    assert ((near < -20) & (near > -200)).sum() > 100  # a soft edge at the foot of walls and of the robot
    visit.page.click("#three-d")
    for tool, place in (("lamp", (200, 250)), ("cylinder", (260, 250))):
        visit.add(tool, place)
        visit.page.wait_for_selector("#problems.none")
        visit.show_3d()
        visit.page.wait_for_timeout(1000)
        pictures.append(screenshot(visit).astype(int))
        visit.picture(f"3d-{tool}")
        visit.page.click("#three-d")
    dark, bright, hidden = (picture.sum(axis=2) for picture in pictures)
    assert (bright > dark + 30).sum() > 2000
    assert (hidden < bright - 30).sum() > 500


def test_a_lamp_that_becomes_bright_later_lights_the_floor_from_then_on(visit: Visit, client: Client) -> None:
    visit.add("robot", (450, 250))
    visit.add("lamp", (200, 250))
    visit.page.wait_for_selector("#problems.none")
    other = Visit(visit.page.context.new_page(), client.server.url)
    visit.start()
    other.page.wait_for_selector(".live")
    assert other.count(".kind-lamp") == 0  # its drawing has no power
    other.show_3d()
    pictures: list[NDArray[np.int64]] = []
    for _ in range(2):
        other.page.wait_for_timeout(1000)
        pictures.append(screenshot(other).astype(int).sum(axis=2))
        visit.page.click("#switches input")
    other.picture("3d-later")
    bright, dark = pictures
    assert (bright > dark + 30).sum() > 2000
    visit.errors += other.errors


def test_a_dark_system_gets_a_dark_page(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    visit.show_3d()
    page.wait_for_timeout(500)
    fill = "getComputedStyle(document.querySelector('.floor')).fill"
    light, plan = screenshot(visit), page.evaluate(fill)
    assert brightness(page.evaluate("getComputedStyle(document.body).backgroundColor")) == 255
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(1000)
    assert brightness(page.evaluate("getComputedStyle(document.body).backgroundColor")) < 50
    assert brightness(page.evaluate(fill)) < 80 < brightness(plan)
    assert screenshot(visit).mean() < light.mean() / 2
    visit.picture("3d-dark")
    assert contrast_of_texts(visit) > 4.5


def brightness(colour: str) -> float:
    return float(np.mean([float(part) for part in re.findall(r"[\d.]+", colour)[:3]]))


def contrast_of_texts(visit: Visit) -> float:
    """Return the contrast of the page's text with its background by WCAG."""
    pair = visit.page.evaluate(
        "(({ color, backgroundColor }) => [color, backgroundColor])(getComputedStyle(document.body))"
    )

    def luminance(colour: str) -> float:
        parts = [float(part) / 255 for part in re.findall(r"[\d.]+", colour)[:3]]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))

    low, high = sorted(luminance(colour) for colour in pair)
    return (high + 0.05) / (low + 0.05)


def test_without_webgl_the_server_draws_the_scene(visit: Visit) -> None:
    page = visit.page
    page.add_init_script("OffscreenCanvas.prototype.getContext = () => null")
    visit.open()
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    page.click("#three-d")
    page.wait_for_selector("#dialog img")
    page.click("#dialog .main")
    assert page.get_attribute("#three-d", "aria-pressed") == "false"

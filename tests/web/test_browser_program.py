"""Controllers are written in the page, run by a key, and their failing line is marked, in a real browser."""

from pathlib import Path

from tests.web.visit import BROWSED, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


def test_a_program_is_written_run_by_a_key_and_its_failing_line_is_marked(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    page.click('[data-tab="run"]')
    page.click("#edit")
    visit.wait("document.querySelector('#code').value.includes('class Wander')")
    page.fill("#code", "def controller(robot):")
    page.press("#code", "Control+End")
    page.keyboard.press("Enter")
    page.keyboard.type("robot.set_speed(3, 3)")
    page.keyboard.press("Enter")
    page.keyboard.type("nonsense()")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#lines .failed")
    assert page.inner_text("#lines .failed") == "3"
    assert "NameError: name 'nonsense'" in page.inner_text("#program-status")
    visit.picture("13-program")
    text = "def controller(robot):\n    robot.set_speed(3, 3)\n    nonsense()"
    assert (tmp_path / "mine.py").read_text() == text
    page.focus("#code")
    page.keyboard.press("Control+End")
    for _ in "nonsense()":
        page.keyboard.press("Backspace")
    page.keyboard.type("print('driven')")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#printed >> text=driven", state="attached")
    assert visit.count("#lines .failed") == 0
    visit.stop()
    visit.end()


def test_a_program_that_another_has_changed_is_not_overwritten(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(1, 1)\n")
    page.click('[data-tab="run"]')
    page.click("#edit")
    visit.wait("document.querySelector('#code').value.includes('1, 1')")
    (tmp_path / "mine.py").write_text("# another's\n")
    page.fill("#code", "# mine\n")
    page.press("#code", "Control+s")
    page.wait_for_selector(".banner >> text=was changed by another page or program")
    assert (tmp_path / "mine.py").read_text() == "# another's\n"
    page.click(".banner >> text=Replace it")
    visit.wait("document.querySelector('#save-program').disabled")
    assert (tmp_path / "mine.py").read_text() == "# mine\n"


def test_each_program_keeps_a_history_of_its_own(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    for name in ("a", "b"):
        (tmp_path / f"{name}.py").write_text(f"# {name}\n")
    edit(visit, "a.py")
    page.press("#code", "Control+End")
    page.keyboard.type("one two")
    edit(visit, "b.py")
    assert page.input_value("#code") == "# b\n"
    page.press("#code", "Control+End")
    page.keyboard.type("three")
    # Back at the first one, with what was not saved, by the button of the open programs.
    page.click("#programs >> text=a.py *")
    assert page.input_value("#code") == "# a\none two"
    for text in ("# a\none ", "# a\n", "# a\n"):
        page.press("#code", "Control+z")
        assert page.input_value("#code") == text
    assert page.is_disabled("#save-program")
    for text in ("# a\none ", "# a\none two"):
        page.press("#code", "Control+y")
        assert page.input_value("#code") == text
    page.click("#programs >> text=b.py *")
    assert page.input_value("#code") == "# b\nthree"
    page.press("#code", "Control+z")
    assert page.input_value("#code") == "# b\n"
    # What is typed after an undo is a separate step, as are a deletion and an indentation.
    page.press("#code", "Control+End")
    page.keyboard.type("four")
    page.keyboard.press("Backspace")
    page.keyboard.press("Tab")
    for text in ("# b\nfou", "# b\nfour", "# b\n"):
        page.press("#code", "Control+z")
        assert page.input_value("#code") == text
    # A save keeps the history, also under another name.
    page.press("#code", "Control+y")
    page.fill("#program-file", "c.py")
    page.click("#save-program")
    visit.wait("document.querySelector('#save-program').disabled")
    assert ((tmp_path / "c.py").read_text(), (tmp_path / "b.py").read_text()) == ("# b\nfour", "# b\n")
    page.press("#code", "Control+z")
    assert page.input_value("#code") == "# b\n"


def test_what_another_has_written_to_an_open_program_can_be_undone(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    (tmp_path / "a.py").write_text("# mine\n")
    edit(visit, "a.py")
    (tmp_path / "a.py").write_text("# another's\n")
    edit(visit, "a.py")
    visit.wait("document.querySelector('#code').value === \"# another's\\n\"")
    page.press("#code", "Control+z")
    assert page.input_value("#code") == "# mine\n"


def edit(visit: Visit, name: str) -> None:
    visit.page.click('[data-tab="run"]')
    visit.wait(
        f"[...document.querySelector('#controller').options].some(({{ value }}) => value === '{name}')"
    )
    visit.page.select_option("#controller", name)
    visit.page.click("#edit")
    visit.wait(f"document.querySelector('#program-file').value === '{name}'")
    visit.page.wait_for_selector("#tab-program:not([hidden])")


def test_a_program_that_is_open_and_not_saved_is_not_replaced_by_another_saved_under_its_name(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    (tmp_path / "b.py").write_text("# b\n")
    page.click('[data-tab="run"]')
    page.click("#edit")  # a new one, mine.py
    visit.wait("document.querySelector('#code').value.includes('class Wander')")
    page.fill("#code", "# an hour's work\n")
    edit(visit, "b.py")
    page.press("#code", "Control+End")
    page.keyboard.type("more")
    page.fill("#program-file", "mine.py")
    page.click("#save-program")
    page.wait_for_selector(".banner.error >> text=mine.py is open here with changes that are not saved")
    page.click("#programs >> text=mine.py *")
    assert page.input_value("#code") == "# an hour's work\n"
    assert not (tmp_path / "mine.py").exists()


def test_the_line_of_the_program_that_failed_is_marked_and_not_that_of_one_whose_name_ends_so(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(1, 1)\n    nonsense()\n")
    (tmp_path / "notmine.py").write_text("# notes\n" * 9)
    visit.add("robot", (300, 250))
    edit(visit, "mine.py")
    edit(visit, "notmine.py")
    page.click('[data-tab="run"]')
    page.select_option("#controller", "mine.py")
    page.click("#run")
    page.wait_for_selector("#lines .failed")
    assert page.input_value("#program-file") == "mine.py"
    page.click('[data-tab="run"]')
    visit.end()


def test_a_program_without_an_end_is_left_after_a_stop_and_the_mended_one_runs(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    (tmp_path / "mine.py").write_text("def controller(robot):\n    while True: pass\n")
    visit.add("robot", (300, 250))
    page.wait_for_selector("#problems.none")
    edit(visit, "mine.py")
    page.dblclick("#run")
    visit.wait_driven()
    page.click('[data-tab="program"]')
    page.press("#code", "Control+Enter")
    page.wait_for_selector(".banner.error >> text=A program is running: Stop ends it")
    # A page that is opened now shows where the robot is, and can stop it.
    second = Visit(page.context.new_page(), visit.url)
    second.wait_driven()
    assert second.robot() == (300, 250)
    assert (second.page.is_disabled("#run"), second.count(".banner.error")) == (True, 0)
    second.page.click("#stop")
    for tab in (visit, second):
        tab.page.wait_for_selector(".banner.error >> text=the program does not end")
        tab.wait("document.querySelector('#clock').textContent === 'not running'")
        assert tab.page.is_enabled("#run")
        assert (tab.count(".live"), tab.count("#tools[inert]")) == (0, 0)
    second.page.close()
    page.fill("#code", "def controller(robot):\n    print('mended')\n    robot.set_speed(3, 3)\n")
    page.press("#code", "Control+Enter")
    page.wait_for_selector("#printed >> text=mended", state="attached")
    assert second.errors == []
    visit.stop()
    visit.end()


def test_a_khepera_and_a_khepera4_are_drawn_and_each_is_driven_by_a_program_of_its_own(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    page.click('[data-tab="playpen"]')
    for key in ("width_mm", "height_mm"):
        page.fill(f"#field-arena-{key}", "2000")
        page.press(f"#field-arena-{key}", "Enter")
    page.click("#zoom-fit")
    heights = page.locator(".axis").evaluate_all(
        "(texts) => texts.map((text) => text.getBoundingClientRect().height)"
    )
    assert min(heights) > 10
    visit.add("robot", (600, 1000), (1400, 1000))
    page.click('[data-tab="object"]')
    page.select_option("#field-robot-model", "khepera4")
    page.wait_for_selector("#problems.none")
    page.click('[data-tab="run"]')
    assert page.locator("#tab-run .wide > span").all_inner_texts() == ["1: Khepera", "2: Khepera IV"]
    for robot, file, text in ((0, "mine.py", "robot: Khepera)"), (1, "mine2.py", "robot: Khepera4)")):
        page.click('[data-tab="run"]')
        page.click(f'[data-edit="{robot}"]')
        visit.wait(f"document.querySelector('#program-file').value === '{file}'")
        visit.wait(f"document.querySelector('#code').value.includes('{text}')")
        page.press("#code", "Control+s")
        visit.wait("document.querySelector('#save-program').disabled")
    visit.show_3d()
    visit.drive()
    lists = page.locator("#tab-run .wide select")
    assert lists.evaluate_all("(lists) => lists.map(({ value }) => value)") == ["mine.py", "mine2.py"]
    visit.wait_seconds(3)
    visit.picture("33-both-3d")
    page.click("#three-d")
    rays = "[...document.querySelectorAll('[data-live=\"1\"] .ray')]"
    visit.wait(f"{rays}.filter((ray) => ray.getAttribute('d')).length > 8")  # the infrared ones are 8
    for robot in (0, 1):
        place = f"document.querySelectorAll('.live')[{robot}].getAttribute('transform').match(/[-.\\d]+/g)"
        visit.wait(f"{place}[1] > 1005")
    page.select_option("#which", "1")
    visit.wait("document.querySelector('#readings').textContent.includes('ultrasonic')")
    visit.picture("34-both-plan")
    visit.stop()
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(3, 3)\n    robot.nose\n")
    page.click('[data-tab="run"]')
    page.click("#run")
    page.wait_for_selector("#lines .failed")
    assert page.inner_text("#program-status").startswith("mine.py:3: AttributeError: 'Khepera' object")
    visit.wait_driven()
    visit.stop()
    page.click('[data-tab="run"]')
    visit.end()

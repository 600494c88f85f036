"""Twins and robots are run from a page in a real browser."""

import struct
from pathlib import Path

import pytest

from khep_twin.board.uart import HostEventKind
from khep_twin.host import Khepera, Khepera4
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.recorded import read_recorded_run
from khep_twin.playpen import Playpen
from tests.served_twin import served
from tests.web.conftest import Client
from tests.web.visit import BROWSED, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


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
    saved = Playpen.load(tmp_path / "ten.toml")
    assert (len(saved.blocks), len(saved.cylinders), len(saved.lamps), len(saved.walls)) == (2, 2, 2, 1)
    assert (len(saved.robots), len(saved.patches), len(saved.spots)) == (1, 1, 1)
    assert (saved.blocks[0].x_mm, saved.blocks[0].y_mm, saved.blocks[0].angle_deg) == (140, 330, 90)
    assert (saved.blocks[1].surface, saved.blocks[1].angle_deg) == ("black", 45)
    assert saved.walls[0].points_mm == ((100, 60), (100, 200))

    # Reopened, it is the same.
    visit.open()
    visit.open_file("ten.toml")
    visit.wait("document.querySelectorAll('.drawn').length === 10")

    # A minute of Braitenberg, ten times as fast.
    page.click('[data-tab="run"]')
    page.select_option("#speed", "10")
    page.fill("#log", "run.mcap")
    page.fill("#cycles", "")
    page.fill("#seconds", "60")
    page.click("#run")
    visit.wait_driven()
    bars = "[...document.querySelectorAll('#panel rect.proximity')].map((bar) => +bar.getAttribute('height'))"
    visit.wait(f"Math.max(...{bars}) > 1")
    lights = bars.replace("proximity", "light")
    visit.wait(f"Math.max(...{lights}) > 13")  # of 15: full in the dark
    assert "500 dark" in page.inner_text("#bars")
    motors = "[...document.querySelectorAll('#panel rect.speed')].map((bar) => +bar.getAttribute('height'))"
    assert max(page.evaluate(motors)) > 1
    visit.picture("2-running")
    visit.wait("document.querySelectorAll('#runs-done tbody tr').length === 1")
    assert visit.clock() >= 60

    # Lifted and put down while it runs.
    page.select_option("#speed", "1")
    page.fill("#seconds", "600")
    page.click("#run")
    visit.wait_driven()
    slow = []
    page.route("**/do/put", lambda route: slow.append(route))
    visit.lift(300, 130)
    visit.click(60, 440)
    page.wait_for_timeout(300)  # the later request would overtake the earlier one
    slow[0].continue_()
    visit.wait("document.querySelector('.kind-lamp.off')")
    visit.picture("3-lifted")
    visit.stop()
    visit.end()
    recorded = read_recorded_run(tmp_path / "run.mcap")
    assert [
        event.kind
        for _, _, event in recorded.events
        if event.kind in (HostEventKind.MOVE_ROBOT, HostEventKind.SWITCH_LAMP)
    ] == [
        HostEventKind.MOVE_ROBOT,
        HostEventKind.SWITCH_LAMP,
    ]
    assert repeat(recorded) is None


def test_a_controller_of_ones_own_is_run_from_its_file(visit: Visit, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(3, 3)\n")
    page = visit.page
    visit.add("robot", (300, 120))
    page.click('[data-tab="run"]')
    visit.choose_program("mine.py")
    page.fill("#cycles", "20")
    page.fill("#runs", "2")
    page.fill("#keep", "series")
    page.click("#run")
    visit.wait("document.querySelectorAll('#runs-done tbody tr').length === 2")
    assert (tmp_path / "series").is_dir()
    page.click("#end")


def test_a_new_program_appears_and_what_it_prints_and_its_stopped_run_are_shown(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("robot", (300, 120))
    visit.start()
    (tmp_path / "talks.py").write_text(
        "print('read')\ncycles = []\n\ndef controller(robot):\n    cycles.append(1)\n"
        "    print(f'cycle {len(cycles)}')\n    robot.set_speed(3, 3)\n"
    )
    # Nothing is clicked meanwhile.
    visit.choose_program("talks.py")
    page.fill("#cycles", "100000")
    page.click("#run")
    page.wait_for_selector("#printed >> text=cycle 5")
    assert page.inner_text("#printed").startswith("read\ncycle 1\ncycle 2\n")
    visit.stop()
    row = page.inner_text("#runs-done tbody tr").split("\t")
    assert row[0] == "1, stopped"
    assert int(row[1]) >= 5
    assert page.inner_text("#printed").endswith(f"cycle {row[1]}\n")
    visit.picture("13-printed")
    page.click("#end")


def test_a_sensor_test_warns_where_nothing_is_within_reach(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    page.click('[data-tab="run"]')
    page.select_option("#speed", "0")
    page.click('[data-tab="sense"]')
    page.select_option("#motion", "rotational")
    page.fill("#amount", "90")
    page.click("#gather")
    page.wait_for_selector("#sensed-warning >> text=Nothing was within reach")
    visit.wait("document.querySelector('#figure').naturalWidth > 100")
    visit.picture("14-nothing-sensed")


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
    visit.drive()
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


def test_a_robot_at_a_port_shows_its_readings_and_stops_at_a_click(visit: Visit) -> None:
    """The port is that of a served twin, which replies like a robot."""
    page = visit.page
    with served("obstacles") as (_, port):
        page.click('[data-tab="run"]')
        page.fill("#device", port)
        page.click("#connect")
        visit.wait("document.querySelector('#clock').textContent.includes(' s')")
        page.fill("#cycles", "100000")
        page.click("#run")
        speed = "document.querySelector('#readings tr:last-child').textContent"
        visit.wait(
            f"/[1-9]/.test({speed}) && document.querySelector('#clock').textContent.includes('driven')"
        )
        visit.picture("10-real")
        assert page.is_disabled("#pause")
        page.click("#stop")
        visit.wait(f"{speed} === 'speed left, right00'")
        visit.end()


def test_a_page_loaded_anew_shows_what_runs_and_what_was_drawn(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 120))
    visit.save_as("mine.toml")
    visit.add("block", (300, 400))
    page.click('[data-tab="run"]')
    page.select_option("#speed", "2")
    visit.drive()
    page.click("#pause")
    visit.wait("document.querySelector('#clock').textContent.includes('paused')")
    visit.open()
    visit.wait("document.querySelector('#clock').textContent.includes('paused')")
    assert (visit.count(".drawn"), page.text_content("#file")) == (2, "mine.toml *")
    visit.wait("document.querySelector('#pause').textContent === 'Resume'")
    assert page.is_disabled("#run")
    assert page.input_value("#speed") == "2"
    visit.end()


def test_fingers_lift_the_robot_that_runs_and_turn_it(tablet: Visit, tmp_path: Path) -> None:
    page = tablet.page
    tablet.add("robot", (300, 200))
    tablet.start("run.mcap")
    tablet.wait("/^[0-9.]+ s/.test(document.querySelector('#clock').textContent)")
    start, right, top = map(tablet.at, (300, 400, 300), (200, 200, 300))
    tablet.touch(start)
    page.wait_for_selector(".live.held")
    tablet.touch(start, right)
    tablet.touch(start, top)
    tablet.touch()
    tablet.wait("!document.querySelector('.held')")
    tablet.end()
    recorded = read_recorded_run(tmp_path / "run.mcap")
    (pose,) = [
        struct.unpack("<3d", event.data)
        for _, _, event in recorded.events
        if event.kind is HostEventKind.MOVE_ROBOT
    ]
    assert pose[:2] == pytest.approx((300, 200), abs=2)
    assert abs(pose[2]) == pytest.approx(180, abs=2)


def test_a_twin_is_run_by_keys_alone(visit: Visit) -> None:
    page = visit.page
    page.focus("#view")
    for key in ("r", "Enter"):
        page.keyboard.press(key)
    tab_to(visit, '[data-tab="run"]')
    page.keyboard.press("Enter")
    tab_to(visit, "#run")
    page.keyboard.press("Enter")
    visit.wait_driven()
    visit.picture("11-keys")
    page.focus("#cycles")  # stops from anywhere
    page.keyboard.press("Escape")
    visit.wait("!document.querySelector('#run').disabled")
    tab_to(visit, "#end")
    page.keyboard.press("Enter")
    visit.wait("document.querySelector('#clock').textContent === 'not running'")


def test_run_and_stop_are_in_the_top_bar_whatever_the_panel_shows(tablet: Visit) -> None:
    page = tablet.page
    tablet.add("robot", (300, 200))
    page.set_viewport_size({"width": 390, "height": 844})
    for tab in ("object", "playpen", "sense"):
        page.click(f'[data-tab="{tab}"]')
        for button in ("#run", "#stop"):
            assert page.locator(button).bounding_box()["y"] < 60
    page.click("#run")
    tablet.wait_driven()
    assert page.is_visible("#tab-run")
    page.locator("#tab-run #put").scroll_into_view_if_needed()
    tablet.picture("12-narrow")
    tablet.stop()
    page.click("#end")


def test_a_held_robot_gets_a_red_outline_where_it_has_no_room(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.add("block", (300, 400))
    visit.start()
    # Before the first picture the robot has no position to lift it from.
    visit.wait_seconds(0)
    page.mouse.move(*visit.at(300, 200))
    page.mouse.down()
    for place, bad in (((310, 390), True), ((400, 300), False), ((-20, 300), True), ((310, 380), True)):
        page.mouse.move(*visit.at(*place), steps=5)
        page.wait_for_selector(".live.held.bad" if bad else ".live.held:not(.bad)")
    page.wait_for_selector(".why >> text=overlaps block 1")
    body = "getComputedStyle(document.querySelector('.live .body')).stroke"
    assert page.evaluate(body) == "rgb(213, 94, 0)"
    visit.picture("13-held")
    page.mouse.up()
    page.wait_for_selector("text=overlaps block 1")
    visit.wait("!document.querySelector('.bad') && !document.querySelector('.why')")
    while visit.robot() != pytest.approx((300, 200), abs=1):  # with the next picture
        page.wait_for_timeout(50)
    page.click("#end")


def test_the_legend_does_not_cover_the_arena(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.start()
    legend = page.locator("#legend").bounding_box()
    assert legend["y"] + legend["height"] <= visit.at(300, 510)[1]
    page.click("#end")


def test_the_gripper_is_drawn_as_it_stands(visit: Visit, tmp_path: Path) -> None:
    (tmp_path / "lower.py").write_text(
        "from khep_twin.host import Gripper\n\n\ndef controller(robot):\n    Gripper(robot).lower()\n"
    )
    page = visit.page
    visit.add("robot", (300, 200))
    page.check("#field-robot-turrets input[value=gripper]")
    page.click('[data-tab="run"]')
    visit.choose_program("lower.py")
    page.fill("#cycles", "100000")
    page.click("#start")
    page.wait_for_selector(".live .turret")
    # Largest distance of the parts ahead of the robot's centre; above 65 mm when lowered.
    boxes = "[...document.querySelectorAll('.live .turret')].map((part) => part.getBBox())"
    front_mm = f"Math.max(...{boxes}.map((box) => box.x + box.width))"
    assert page.evaluate(front_mm) < 30
    page.click("#run")
    visit.wait(f"{front_mm} > 65")
    visit.picture("17-gripper")
    page.click("#stop")
    page.click("#end")


def tab_to(visit: Visit, selector: str) -> None:
    for _ in range(60):
        if visit.page.evaluate(f"document.activeElement.matches({selector!r})"):
            return
        visit.page.keyboard.press("Tab")
    raise AssertionError(f"{selector} is not reached")


def test_another_playpen_is_asked_for_before_the_twin_ends(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.start()
    page.click("#new")
    page.click("#dialog [value=cancel]")
    page.click("#open")
    page.wait_for_selector("text=There are no playpens")
    assert visit.count(".live") == 1
    page.click("#new")
    page.click("#dialog .main")
    page.wait_for_selector("text=There are changes that are not saved")
    page.click("#dialog .main")
    visit.wait("document.querySelector('#clock').textContent === 'not running'")


def test_a_twin_that_does_not_come_up_is_not_waited_for(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    page.click('[data-tab="run"]')
    page.fill("#log", "missing/run.mcap")
    page.click("#run")
    page.wait_for_selector(".banner.error >> text=missing")
    page.fill("#log", "")
    page.click("#run")
    visit.wait_driven()
    page.click("#end")


def test_line_images_are_a_strip_below_the_readings(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    page.check("#field-robot-turrets input[value=k213]")
    visit.start()
    pixels = "document.querySelector('#vision').getContext('2d').getImageData(0, {}, 64, 1).data"
    # Rows rise: the first one has come up from the bottom after a second.
    visit.wait(f"!document.querySelector('#vision').hidden && {pixels.format(90)}[3] === 255")
    white = page.evaluate(f"[...{pixels.format(99)}].filter((_, byte) => byte % 4 === 0)")
    assert min(white) > 100  # the walls
    visit.picture("18-line-image")
    page.click("#end")


def test_after_a_run_its_log_and_report_are_kept_and_the_command_that_views_it_is_shown(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.start("run.mcap")
    assert page.is_hidden("#logged")
    visit.wait_seconds(0.5)
    page.click("#end")
    page.wait_for_selector("#logged:not([hidden])")
    assert page.inner_text("#view-command").endswith("run.mcap")
    for button, name in (("#keep-log", "run.mcap"), ("#keep-report", "run.html")):
        with page.expect_download() as download:
            page.click(button)
        assert download.value.suggested_filename == name
        assert Path(download.value.path()).stat().st_size > 1000


def test_curves_show_the_readings_of_the_selected_robot_and_their_values_at_the_pointer(visit: Visit) -> None:
    page = visit.page
    visit.add("robot", (300, 200), (100, 250))
    page.click('[data-tab="run"]')
    page.select_option("#others select", "")
    assert page.is_hidden("#curves")
    page.click("#run")
    visit.wait_seconds(2)
    page.click("#pause")
    visit.wait("document.querySelector('#clock').textContent.includes('paused')")
    page.check("#curves input[value=light]")
    for robot in ("1", "0"):  # the second one stands still
        page.select_option("#which", robot)
        page.click("#step")
        visit.wait("/[0-9]$/.test(document.querySelector('#readings tr:last-child').textContent)")
        for plot, column in ((0, 2), (1, 3)):
            point(visit, plot, 1.0)
            table = f"[...document.querySelectorAll('#readings tr td:nth-child({column})')].slice(0, 8)"
            values = "[...document.querySelectorAll('#curves li b')].slice(0, 8)"
            texts = ".map((cell) => cell.textContent).join(' ')"
            visit.wait(f"{table}{texts} === {values}{texts}")
    point(visit, 2, 1.0)
    visit.wait("document.querySelector('#curves li:nth-child(10) b').textContent !== ''")
    driven = page.locator("#curves li b").all_inner_texts()
    assert driven[:8] == [""] * 8
    assert page.inner_text("#readings tr:last-child").split("\t")[1:] == driven[8:]
    assert page.inner_text("#curves output").endswith("speeds of the wheels [pulses/10 ms]")
    visit.picture("19-curves")
    for name in ("proximity", "light", "speed"):
        page.uncheck(f"#curves input[value={name}]")
    page.wait_for_selector("#curves canvas", state="hidden")
    page.click("#end")


def point(visit: Visit, plot: int, part: float) -> None:
    """Move the pointer over a plot of the curves, to a fraction of its width."""
    canvas = visit.page.locator("#curves canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    visit.page.mouse.move(box["x"] + 46 + part * (box["width"] - 55), box["y"] + 101 * plot + 40)


# Other curves on the same page, fed by the test: the count of a sensor is the whole second.
FED = """async () => {
    const { Curves } = await import("./static/curves.js");
    const root = document.querySelector("#curves").cloneNode(true);
    document.querySelector("#tab-run").prepend(root);
    root.id = "fed";
    const canvas = root.querySelector("canvas");
    const curves = new Curves(root);
    const names = [...Array(8).keys()];
    const sensors = Object.fromEntries(names.map((sensor) => [sensor, [255, 0, 255]]));
    const wheels = { left: [255, 0, 0], right: [0, 0, 255] };
    const bars = { proximity: { full: 1023 }, light: { full: 500 }, speed: { full: 20 } };
    curves.setColours({ sensors, wheels });
    curves.clear([{ names, bars }]);
    let time = 0;
    window.feed = (seconds) => {
        for (const end = time + seconds; time < end; time += 1 / 128) {
            const proximity = Array(8).fill(Math.floor(time));
            curves.add({ time, robots: [{ proximity, ambient: proximity, speed: [5, 15] }] });
        }
    };
    const copy = new OffscreenCanvas(400, 400).getContext("2d", { willReadFrequently: true });
    window.red = () => {
        copy.clearRect(0, 0, 400, 400);
        copy.drawImage(canvas, 0, 0);
        const { data } = copy.getImageData(0, 0, 400, 400);
        return data.filter((red, at) => at % 4 === 0 && red > 150 && data[at + 1] + data[at + 2] < 99).length;
    };
    const frame = () => new Promise((done) => requestAnimationFrame(done));
    window.idle = async () => {
        canvas.width = 300; // clears it
        feed(1);
        await frame();
        await frame();
        return red() === 0;
    };
    feed(100);
}"""


def test_curves_keep_the_last_twenty_seconds_and_are_drawn_in_view_only(visit: Visit) -> None:
    page = visit.page
    page.click('[data-tab="run"]')
    page.evaluate(FED)
    visit.wait("red() > 150")  # the left wheel's line, along the whole axis
    box = page.locator("#fed canvas").bounding_box()
    for part, second in ((1.0, "99"), (0.5, "89"), (0.0, "79")):
        page.mouse.move(box["x"] + 46 + part * (box["width"] - 55), box["y"] + 40)
        visit.wait(f"document.querySelector('#fed li b').textContent === '{second}'")
    page.locator("#connect").scroll_into_view_if_needed()
    visit.wait("idle()")
    page.locator("#fed canvas").scroll_into_view_if_needed()
    visit.wait("red() > 150")
    page.click('[data-tab="sense"]')
    visit.wait("idle()")
    page.click('[data-tab="run"]')
    visit.wait("red() > 150")


def test_undo_during_a_run_puts_a_lifted_robot_back_and_switches_a_lamp_again(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.add("lamp", (60, 440))
    visit.start("run.mcap")
    visit.wait_seconds(0)
    assert page.is_disabled("#undo")
    visit.lift(450, 350)
    stands_at(visit, 450, 350)
    visit.click(60, 440)
    page.wait_for_selector(".kind-lamp.off")
    page.focus("#view")
    page.keyboard.press("Control+z")
    page.wait_for_selector(".kind-lamp:not(.off)")
    page.click("#undo")
    stands_at(visit, 300, 200)
    assert page.is_disabled("#undo")
    page.click("#redo")
    stands_at(visit, 450, 350)
    # A move that is refused is no step of the history.
    visit.lift(-20, 300)
    page.wait_for_selector(".banner.error")
    visit.wait("!document.querySelector('.held')")
    page.keyboard.press("Control+z")
    stands_at(visit, 300, 200)
    page.click("#end")
    visit.wait("document.querySelector('#clock').textContent === 'not running'")
    # Again about the drawing, which the run has not changed.
    assert page.is_enabled("#undo")
    page.click("#undo")
    assert visit.count(".drawn") == 1
    recorded = read_recorded_run(tmp_path / "run.mcap")
    kinds = [event.kind for _, _, event in recorded.events]
    assert (kinds.count(HostEventKind.MOVE_ROBOT), kinds.count(HostEventKind.SWITCH_LAMP)) == (4, 2)
    assert repeat(recorded) is None


def test_a_move_that_another_page_is_refused_takes_no_step_of_undo(visit: Visit, client: Client) -> None:
    visit.add("robot", (300, 200))
    visit.start()
    visit.wait_seconds(0)
    visit.lift(450, 350)
    stands_at(visit, 450, 350)
    refused = {"robot": 0, "x_mm": -20, "y_mm": 300, "heading_deg": 0, "tab": "another-page"}
    client.do("put", **refused)
    client.do("put", **{**refused, "x_mm": 100})
    stands_at(visit, 100, 300)
    assert not visit.page.is_visible(".banner.error")
    visit.page.click("#undo")
    stands_at(visit, 300, 200)


def stands_at(visit: Visit, x_mm: float, y_mm: float) -> None:
    place = "document.querySelector('.live').getAttribute('transform').match(/[-.\\d]+/g)"
    visit.wait(f"Math.hypot({place}[0] - {x_mm}, {place}[1] - {y_mm}) < 3")


def test_a_file_that_has_changed_during_a_run_is_not_replaced_unasked_by_a_page_loaded_anew(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    visit.add("robot", (300, 200))
    visit.save_as("mine.toml")
    visit.start()
    file = tmp_path / "mine.toml"
    file.write_text(file.read_text().replace("width_mm = 600", "width_mm = 700"))
    visit.open()
    page.wait_for_selector(".live")
    visit.end()
    visit.add("block", (200, 400))
    page.click("#save")
    page.wait_for_selector("#banners >> text=/was changed by another page or program|Saved as/")
    assert "width_mm = 700" in file.read_text()


def test_a_khepera4_is_drawn_chosen_saved_run_and_watched(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    visit.add("robot", (300, 250))
    for value in ("k213", "gripper"):
        page.check(f"#field-robot-turrets input[value={value}]")
    page.select_option("#field-robot-mode", "3")
    page.select_option("#field-robot-model", "khepera4")
    page.wait_for_selector("#problems.none")
    assert page.locator("#field-robot-rom option").all_inner_texts() == ["kh4server"]
    assert page.locator("#field-robot-mode option").all_inner_texts() == ["1: 115200 baud"]
    assert page.inner_text("#field-robot-turrets") == "none for this model"
    assert page.locator("#calibrations option").all_text_contents() == ["khepera4"]
    visit.picture("30-khepera4-drawn")
    visit.save_as("four.toml")
    assert Playpen.load(tmp_path / "four.toml").robots[0].rom == "kh4server"
    visit.start()
    visit.wait_seconds(0)
    host = Khepera4(page.text_content("#port"))
    try:
        host.set_speed(0.05, 0.05)
        visit.wait("document.querySelector('.trail')?.getTotalLength() > 20")
        visit.picture("31-khepera4-run")
        page.click("#stop")
        visit.wait("document.querySelector('#readings').textContent.includes('speed left, right00')")
    finally:
        host.port.close()
    visit.open()
    visit.wait("document.querySelector('.trail')?.getTotalLength() > 20")
    visit.picture("32-khepera4-opened")
    visit.end()

"""Reports: well-formed, complete, self-contained, reproducible; with all data of a log."""

import re
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import good, refusal
from matplotlib.figure import Figure
from nine_sensors import SENSORS, nine_playpen
from relay_logs import in_turn, relayed
from shadow_updates import updates, written

from khep_twin.lab.report import shadow_section
from khep_twin.lab.report.pages import EVENT_LIMIT, html, limit_rows
from khep_twin.lab.report.pdf import pdf
from khep_twin.lab.report.report import make_report
from khep_twin.lab.report.rows import definitions
from khep_twin.log.reader import read_series
from khep_twin.log.shadow_channels import PoseState
from khep_twin.log.shadow_track import read_shadow
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.registry import find_model
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog

SECOND = 1_000_000_000
HEADINGS = ["Faults and events", "Versions and settings", "What the numbers mean"]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished log of three seconds of two robots: one hits a wall, one turns."""
    path = tmp_path_factory.mktemp("report") / "run.mcap"
    one = Playpen.load("two-lamps")
    other = one.robots[0].model_copy(update={"x_mm": 500.0, "y_mm": 450.0, "heading_deg": 0.0})
    pair = one.model_copy(update={"robots": (*one.robots, other), "name": "both"})
    options = TwinOptions(seed=3, robot=None, faults=("dead:left@1",), log=str(path))
    with open_twin(pair, options) as twin:
        twin.robots[0].send(b"N\nO\nD,4,-4\n")
        twin.robots[1].send(b"D,9,9\nX\n")
        twin.advance_to(3 * SECOND)
        twin.world.log_event(0, "<taken> & $away$")
    return path


@pytest.fixture(scope="module")
def page(log: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The log's report as a page."""
    return write(log, tmp_path_factory.mktemp("page") / "run.html").decode("utf-8")


class Page(HTMLParser):
    """Contents of a page; refuses tags that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.words: list[str] = []
        self.pictures: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            values = dict(attrs)
            assert (values["src"] or "").startswith("data:image/png;base64,iVBOR")
            self.pictures.append(values["alt"] or "")
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        if data.strip():
            self.words.append(data.strip())


def write(log: Path, output: Path) -> bytes:
    assert good("report", log, "-o", output) == f"report  {output}\n"
    return output.read_bytes()


def rows(log: Path, robot: int = 0) -> dict[str, str]:
    return dict(make_report(read_series(log), "log").robots[robot].rows)


def test_the_page_is_well_formed_and_whole(page: str) -> None:
    content = Page(page)
    assert content.headings == ["khepera0", "khepera1", *HEADINGS]
    assert content.words[2] == "Run in the playpen both"
    assert content.pictures == [
        "Paths in the playpen",
        *(
            f"{picture} of khepera{index} over time"
            for index in (0, 1)
            for picture in ("Sensors", "Wheel speeds")
        ),
    ]
    assert {"seed", "mujoco", "('dead:left@1',)"} < set(content.words)
    assert "<taken> & $away$" in content.words
    assert "fault dead:left@1 begins" in content.words
    assert {name for name, _ in definitions()} < set(content.words)


def test_the_page_needs_nothing_else(page: str) -> None:
    assert not re.search(r"https?:|//[a-z]|url\(|@import", re.sub(r"base64,[^\"]+", "", page))
    assert not Page(page).tags & {"script", "link", "iframe", "object", "embed"}


def test_the_same_log_gives_the_same_page_whatever_matplotlib_is_set_to(
    log: Path, page: str, tmp_path: Path
) -> None:
    import matplotlib

    changed: Any = {"lines.linewidth": 9, "font.size": 20, "axes.facecolor": "black"}
    with matplotlib.rc_context(changed):
        assert write(log, tmp_path / "again.html").decode("utf-8") == page


@pytest.mark.long
def test_the_same_log_gives_the_same_pdf(log: Path, tmp_path: Path) -> None:
    real = relayed(tmp_path / "real.mcap", in_turn(b"N\n", b"n,0,0,500,0,0,0,0,0\r\n"))
    for path in (log, real):
        assert write(path, tmp_path / "a.pdf") == write(path, tmp_path / "b.pdf")


def test_the_pdf_has_pages_and_no_date(log: Path, tmp_path: Path) -> None:
    data = write(log, tmp_path / "run.pdf")
    assert data.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", data)) >= 3
    assert b"/CreationDate" not in data


def test_the_numbers_have_units_and_fit_the_run(log: Path) -> None:
    turning, driving = rows(log), rows(log, 1)
    assert turning["Duration"] == "3.00 s"
    assert re.fullmatch(r"[0-9]+ mm", driving["Distance"])
    assert re.fullmatch(r"[1-3], [0-9.]+ s in touch; the first at [0-9.]+ s", driving["Collisions"])
    assert turning["Collisions"] == "none"
    assert turning["Commands"] == "3, 1.0 per second: D 1, N 1, O 1"
    assert turning["Unanswered"] == "0; refused 0"
    assert driving["Unanswered"] == "0; refused 1"
    assert re.fullmatch(r"[0-9.]+ ms in the mean, [0-9.]+ ms at most", turning["Reply time"])
    assert re.fullmatch(
        r"0.00 turns left, 0.[0-9]+ turns right; net \N{MINUS SIGN}[0-9]+°", turning["Turned"]
    )
    assert re.fullmatch(r"[0-9]+ counts, sensor [a-z]+ ?[0-9a-z]*, at [0-9.]+ s", turning["Brightest moment"])


def test_the_report_on_a_real_robots_log_lists_what_is_missing(tmp_path: Path) -> None:
    exchanges = in_turn(b"N\n", b"n,0,0,500,0,0,0,0,0\r\n", b"E\n", b"e,1,-2\r\n")
    real = relayed(tmp_path / "real.mcap", exchanges)
    (robot,) = make_report(read_series(real), "log").robots
    assert robot.missing == (
        "Not in this log: pose, ambient light, collisions, the wheels' counters and slip. "
        "A real robot's log has only replies to its host, at their times."
    )
    page = Page(write(real, tmp_path / "real.html").decode("utf-8"))
    assert page.words[2] == "Run of the robot at /dev/robot"
    assert robot.missing in page.words
    assert page.pictures == ["Sensors of khepera0 over time", "Wheel speeds of khepera0 over time"]
    assert dict(robot.rows)["Commands"] == "2, 5.0 per second: E 1, N 1"
    assert dict(robot.rows)["Reply time"] == "100.0 ms in the mean, 100.0 ms at most"


def test_without_a_calibration_the_dark_level_is_that_of_the_model(tmp_path: Path) -> None:
    exchanges = in_turn(b"O\n", f"o,{','.join(['4000'] * 12)}\n\r".encode())
    real = relayed(tmp_path / "real.mcap", exchanges, find_model("khepera3"))
    (robot,) = make_report(read_series(real), "log").robots
    assert robot.missing.endswith("There is no calibration: the dark level is taken as 4000 counts.")
    assert dict(robot.rows)["Light gained"] == "0.0 counts in the mean of all sensors"


@pytest.mark.parametrize("suffix", [".html", ".pdf"])
def test_a_log_without_samples_has_a_report(suffix: str, tmp_path: Path) -> None:
    log = relayed(tmp_path / "real.mcap")
    write(log, tmp_path / f"x{suffix}")
    assert rows(log) == {"Duration": "0.00 s", "Commands": "none"}


def test_a_run_of_no_time_has_a_report(tmp_path: Path) -> None:
    with open_twin("default", TwinOptions(log=str(tmp_path / "run.mcap"))):
        pass
    write(tmp_path / "run.mcap", tmp_path / "run.html")
    assert rows(tmp_path / "run.mcap")["Duration"] == "0.00 s"


def test_of_very_many_events_the_first_are_reported() -> None:
    events = [(f"{second} s", "something") for second in range(100)]
    assert limit_rows(events)[-1] == ("…", "and 60 more")
    assert limit_rows(events)[:-1] == tuple(events[:EVENT_LIMIT])
    assert limit_rows(events[:EVENT_LIMIT]) == tuple(events[:EVENT_LIMIT])


def test_what_cannot_be_reported_is_one_line(log: Path, tmp_path: Path) -> None:
    torn, foreign, refused = tmp_path / "torn.mcap", tmp_path / "foreign.mcap", partial(refusal, "report")
    torn.write_bytes(log.read_bytes()[:-500])
    foreign.write_bytes(b"\x89PNG\r\n\x1a\n")
    for path in (torn, foreign):
        assert "no whole log" in refused(path, "-o", tmp_path / "x.html")
    assert "expected a name that ends in .html or .pdf" in refused(log, "-o", tmp_path / "x.doc")
    assert "there is no directory" in refused(log, "-o", tmp_path / "none" / "x.html")
    html_log = tmp_path / "log.html"
    html_log.write_bytes(log.read_bytes())
    assert "this is the log" in refused(html_log, "-o", html_log)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.mcap", "log.html", "torn.mcap"]


@pytest.fixture
def shadow(tmp_path: Path) -> Path:
    """The log of a shadow with an alarm, of a host that does not ask for light."""
    path = tmp_path / "shadow.mcap"
    log = ShadowLog(path, Playpen.load("workshop"), ShadowSettings())
    for update in updates():
        log.write(update)
    log.close()
    return path


def test_a_report_on_a_shadow_has_its_residuals_and_alarms(shadow: Path, tmp_path: Path) -> None:
    text = write(shadow, tmp_path / "shadow.html").decode("utf-8")
    assert Page(text).headings == ["The robot as its shadow follows it", "Alarms", *HEADINGS]
    alarm = "since 0.80 s, reported at 1.00 s, 97.5 % sure, in proximity; ended at 2.00 s"
    assert f"<th>stuck sensor 2</th><td>{alarm}</td>" in text
    states = "followed 66.7 %, unsure 33.3 %, lost 0.0 % of the time; lost 0 times"
    assert f"<th>States</th><td>{states}</td>" in text
    assert "<th>Suspected</th><td>dead sensor 2 or stuck sensor 2 up to 60 %</td>" in text
    assert 'alt="States and suspected faults over time"' in text
    # 2 mm along x and 3 mm along y.
    assert "<th>Spread of the position</th><td>3.6 mm median, 3.6 mm at 95 %</td>" in text
    assert "<th>Dead reckoning</th><td>14 mm from the estimate in the end, 14 mm at most</td>" in text


def test_a_report_on_a_shadow_has_a_strip_for_each_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = read_shadow(written(tmp_path / "nine.mcap", playpen=nine_playpen(tmp_path, monkeypatch)))
    assert dict(shadow_section.rows(track))["Proximity, residual"] == "5 counts rms"
    draw, height, name = shadow_section.pictures(track)[1]
    figure = Figure((7.1, height))
    draw(figure, track, (0, 0))
    assert name == "Residuals of the sensors"
    labels = [axes.get_ylabel().replace("\n", " ") for axes in figure.axes]
    assert labels == [*SENSORS, *[""] * 9]


def test_a_map_has_the_poses_that_were_considered_while_the_robot_was_lost(shadow: Path) -> None:
    track = read_shadow(shadow)
    lost = replace(track, states=[(0, PoseState.FOLLOWED), (2 * SECOND, PoseState.LOST)])
    for variant, missing, dots in ((track, 0, 0), (lost, 21, 200)):
        axes = shadow_section.draw_map(Playpen.load("workshop"), variant).axes[0]
        _, estimate, considered = axes.lines[-3:]
        assert np.isnan(np.asarray(estimate.get_xdata(), float)).sum() == missing
        assert len(np.asarray(considered.get_xdata())) == dots


def test_a_report_on_an_older_log_of_a_shadow_has_no_states(shadow: Path) -> None:
    track = replace(read_shadow(shadow), states=[], suspected=[])
    assert "States" not in dict(shadow_section.rows(track))
    assert next(name for *_, name in shadow_section.pictures(track)) == "Residuals of the sensors"


@pytest.mark.long
def test_a_report_on_a_shadow_is_the_same_each_time_as_pdf(shadow: Path) -> None:
    report = make_report(read_series(shadow), "shadow", read_shadow(shadow))
    assert pdf(report) == pdf(report)


def test_a_report_on_a_shadow_without_updates_says_so(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    ShadowLog(path, Playpen.load("workshop"), ShadowSettings()).close()
    text = html(make_report(read_series(path), "empty", read_shadow(path))).decode()
    assert "none: no reply had values" in text

"""Logs of a Khepera IV beside a Khepera: read, exported, viewed, drawn, reported and repeated."""

# The annotations of matplotlib leave types unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import csv
from pathlib import Path

import numpy as np
import pytest
from log_contents import values_of
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle

import khep_twin
from khep_twin.drawing.map import draw
from khep_twin.errors import LogError
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.lab.experiment.run_statistics import clearance
from khep_twin.lab.report.export import choose_channels, write_table
from khep_twin.lab.report.pages import html, pictures
from khep_twin.lab.report.report import make_report
from khep_twin.log.reader import read_first_messages, read_series
from khep_twin.log.recorded import PROGRAM, read_recorded_run
from khep_twin.log.viewer.replay import view
from khep_twin.playpen import Playpen
from khep_twin.ports.resume import resume_run
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.khepera4.model import KHEPERA_4, SONAR

NS = 1_000_000_000
COMMANDS = (b"K,63,0,0,0,32,0,0,0,0\r\n", b"D,200,150\r\n", b"U,4\r\n", b"N\r\n", b"G\r\n")


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 1.5 s: two Khepera IVs, one of which is spoken to, and a Khepera."""
    path = tmp_path_factory.mktemp("mixed") / "run.mcap"
    with open_twin("arena4-two", TwinOptions(seed=2, log=str(path))) as twin:
        for tenth in range(15):
            twin.robot.send(COMMANDS[min(tenth, 4)])
            twin.advance_to((tenth + 1) * NS // 10)
    return path


def test_channels_of_a_khepera4_have_names_and_units() -> None:
    assert KHEPERA_4.channels["proximity"][0] == ("proximity_back_left", "counts")
    assert KHEPERA_4.channels["proximity"][-1] == ("proximity_ground_right", "counts")
    assert KHEPERA_4.channels["ultrasonic"][2] == ("ultrasonic_front", "cm")
    assert KHEPERA_4.channels["control"][-1] == ("control_status_led", "register")


def test_a_read_log_has_the_channels_of_both_models(mixed: Path) -> None:
    run = khep_twin.read_log(mixed)
    large, _, small = run.robots.values()
    assert (large.proximity.shape[1], small.proximity.shape[1]) == (12, 8)
    assert large.extra_channels["leds"][-1].tolist() == [63, 0, 0, 0, 32, 0, 0, 0, 0]
    assert not small.extra_channels
    table = run.table()
    is_first = table["robot"] == "khepera0"
    assert table["khepera4_proximity_ground_left"][is_first].tolist() == large.proximity[:, 8].tolist()
    assert np.isnan(table["proximity_left_90"][is_first].astype(float)).all()
    assert table["speed_left"].dtype == np.int64  # which both have


def test_an_export_has_the_columns_of_both_models(mixed: Path, tmp_path: Path) -> None:
    heads = read_first_messages(mixed)
    for robots, name in (
        (heads.label.robots, "khepera4_proximity_front"),
        (("khepera1",), "proximity_front"),
    ):
        with (tmp_path / "table.csv").open("w+b") as file:
            write_table(mixed, robots, choose_channels(heads, robots, None), ".csv", file)
        rows = [*csv.DictReader((tmp_path / "table.csv").read_text().splitlines())]
        large = [row for row in rows if row.get("robot", "khepera1") == "khepera1"]
        track = khep_twin.read_log(mixed).robots["khepera1"]
        assert [int(row[name]) for row in large] == track.proximity[:, 3].tolist()
        assert {row[name] for row in rows if row.get("robot") == "khepera2"} <= {""}


def test_a_view_has_beams_as_long_as_readings_and_leds_in_their_colours(mixed: Path, tmp_path: Path) -> None:
    view([mixed], save=tmp_path / "run.rrd")
    track = khep_twin.read_log(mixed).robots["khepera0"]
    rows = values_of(tmp_path / "run.rrd", "/obstacles/khepera0_ultrasonic", "LineStrips3D:strips")
    time_ns, strips = rows[-1]
    reading = int(track.extra_channels["ultrasonic"][track.times_ns.tolist().index(time_ns), 2])
    # Its axis is in the middle of the sector, and the sector of a disabled sensor has no size.
    middle = np.array(strips[2])[5]
    assert middle[0] == pytest.approx(SONAR.radius + reading / 100 * (reading < 1000), abs=1e-4)
    assert np.ptp(np.array(strips[0]), axis=0).max() == 0
    _, colours = values_of(tmp_path / "run.rrd", "/obstacles/khepera0_leds", "Ellipsoids3D:colors")[-1]
    assert [int(colour) >> 8 for colour in colours] == [0xFF0000, 0x00FF00, 0]
    rays = values_of(tmp_path / "run.rrd", "/obstacles/khepera0_sensors", "LineStrips3D:strips")
    assert len(rays[0][1]) == 12 * 5


def test_a_report_knows_the_wheels_and_the_further_sensors(mixed: Path) -> None:
    page = make_report(read_series(mixed), "run.mcap")
    large, _, small = page.robots
    assert dict(large.rows)["Distance by counters"].endswith(", 0.0 %")
    assert dict(large.rows)["Collisions"] == "none"
    assert [name for _, _, name in pictures(large)] == ["Sensors", "Wheel speeds", "Further sensors"]
    assert [name for _, _, name in pictures(small)] == ["Sensors", "Wheel speeds"]
    assert html(page).count(b"<img") == 9


def test_a_run_at_the_serial_line_is_repeated_and_taken_up(mixed: Path) -> None:
    assert repeat(read_recorded_run(mixed)) is None
    with resume_run(mixed, NS).twin as twin:
        assert twin.world.time_ns == NS


def test_a_run_that_a_program_drove_is_neither_repeated_nor_taken_up(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("arena4") as twin:
        twin.record(path, facts={PROGRAM: "prog"})
        twin.advance_to(NS // 10)
    for refused in (lambda: read_recorded_run(path), lambda: resume_run(path, 0)):
        with pytest.raises(LogError, match=r"a program drove it; expected a log of a serial line$"):
            refused()


def test_a_map_has_the_robots_wheels_arrows_up_ramps_and_no_walls_around_a_table() -> None:
    (axes,) = draw("arena4-ramps").axes
    (up, *_) = [patch for patch in axes.patches if isinstance(patch, FancyArrowPatch)]
    assert np.ptp(np.array(up.get_path().vertices)[:, 0]) > 0
    wheels = [patch.get_xy() for patch in axes.patches if isinstance(patch, Polygon)]
    assert any(np.isclose(np.ptp(corners, axis=0), (42, 6.5)).all() for corners in wheels)
    (axes,) = draw("arena4-table").axes
    assert not [patch for patch in axes.patches if isinstance(patch, Rectangle)]


def test_ramps_and_the_edge_of_a_table_are_no_obstacles() -> None:
    on_the_ramp, at_the_edge = np.array([[0.9, 1.0]]), np.array([[1.15, 0.4]])
    assert clearance(on_the_ramp, Playpen.load("arena4-ramps"))[0] > 0.5
    assert np.isinf(clearance(at_the_edge, Playpen.load("arena4-table"))).all()

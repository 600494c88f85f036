"""The command `khep-twin rollout`."""

import re
from pathlib import Path

import pytest
from command_line import complaint, good

from khep_twin import playpen
from khep_twin.log.reader import read_log
from khep_twin.playpen import Playpen

CONTROLLER = """
def controller(proximity, ambient):
    return 10 - proximity[3] / 100, 10 - proximity[2] / 100

def nothing(proximity, ambient):
    pass

def three(proximity, ambient, memory):
    return 1, 1
"""


def test_a_rollout_reports_how_it_went_and_the_same_again(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(CONTROLLER)
    options = ("own.py:controller", "--playpen", "looping-maze", "--seed", "1", "--seconds", "2")
    first, second = (good("rollout", *options, folder=tmp_path) for _ in range(2))
    assert first == second
    assert first.startswith("100 cycles in 2.0 s\nobstacle avoidance ")
    assert "\ndistance m " in first
    assert "homing" not in first


def test_a_rollout_in_a_plane_takes_about_the_same_path(tmp_path: Path) -> None:
    words = ("rollout", "--playpen", "looping-maze", "--noise", "off", "--seconds", "2")
    ways = [float(good(*words, *options, folder=tmp_path).split()[-1]) for options in ((), ("--planar",))]
    assert ways[1] == pytest.approx(ways[0], abs=2e-3)


def test_the_path_of_a_rollout_is_drawn_and_changes_nothing(tmp_path: Path) -> None:
    words = ("rollout", "--planar", "--playpen", "looping-maze", "--seconds", "4.5", "--period", "50")
    output = good(*words, "--picture", "way.png", folder=tmp_path)
    # Without a picture many periods pass at once.
    assert output == good(*words, folder=tmp_path) + "picture  way.png\n"
    assert (tmp_path / "way.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--planar", "--log", "x.mcap"), "the 2-D model has no scene to replay; expected one of them"),
        (("--picture", "way.bmp"), "expected a name that ends in .png, .svg or .pdf"),
        (("--seconds", "0.03"), "0.03 s; expected a whole number of control periods of 20 ms"),
        (("--seconds", "0"), "--seconds and --cycles are above 0 and finite"),
        (("--seconds", "1e300"), "1e+300 s; expected less than"),
        (("--period", "inf"), "--period inf: expected a time in ms, above 0 and at most 1e9"),
        (("own.py:three",), "model khepera1: term 'memory': unknown; (choices: gripper_barrier, "),
        (("own.py:nothing",), "nothing: returned None; expected two speeds, such as (10, 10)"),
    ],
)
def test_a_mistake_gets_one_line(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(CONTROLLER)
    assert message in complaint("rollout", *arguments, folder=tmp_path)
    assert not list(tmp_path.glob("*.mcap*"))


TWO = """
[[robot]]
x_mm = 330
y_mm = 300
heading_deg = 90
"""


def test_an_episode_with_robots_and_faults_is_logged_and_its_log_is_read(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(playpen.dump(Playpen.load("obstacles")) + TWO)
    options = ("--playpen", "two.toml", "--seconds", "1", "--fault", "dead:left@0.5", "--log", "run.mcap")
    output = good("rollout", *options, "--picture", "run.png", folder=tmp_path)
    assert re.search(r"^ +khepera0 +khepera1\n(.*\n)*distance m +0\.\d+ +0\.\d+$", output, re.MULTILINE)
    run = read_log(tmp_path / "run.mcap")
    assert [len(robot.registers) for robot in run.robots.values()] == [51, 51]
    assert [event.text for event in run.events] == ["fault dead:left@0.5 begins"] * 2
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "run.mcap" in complaint("rollout", *options, folder=tmp_path, codes=[2])
    line = complaint("repeat", "run.mcap", folder=tmp_path, codes=[1])
    assert line.startswith("run.mcap: cannot be repeated: its controller ran without a line")


def test_a_plane_has_no_log(tmp_path: Path) -> None:
    words = ("rollout", "--planar", "--seconds", "1", "--log", "run.mcap")
    assert "the 2-D model has no scene to replay" in complaint(*words, folder=tmp_path, codes=[2])
    assert not list(tmp_path.iterdir())

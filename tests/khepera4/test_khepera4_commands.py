"""The command line with a Khepera IV: runs repeat; commands for other models refuse it in one line."""

from pathlib import Path

import pytest
from command_line import good, khep_twin

from khep_twin.errors import PlaypenError
from khep_twin.host import Khepera4
from khep_twin.playpen import Playpen
from khep_twin.playpen.model import parse

ENTRY = '[[robot]]\nmodel = "khepera4"\nx_mm = 500\ny_mm = 500\nheading_deg = 0\n'
PEN = 'version = 1\nname = "pen"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\nwall_height_mm = 150\n'


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a Khepera IV that a host has driven."""
    path = tmp_path_factory.mktemp("khepera4") / "run.mcap"
    with Khepera4(f"khep://arena4?seed=3&log={path}") as robot:
        robot.set_speed(0.1, 0.05)
        robot.sleep(0.5)
        robot.proximity()
        robot.wander()
        robot.sleep(0.5)
        robot.ultrasonic()
        robot.accelerations()
    return path


def test_a_run_repeats_from_its_log_resumes_and_answers_the_same_at_another_port(log: Path) -> None:
    assert good("repeat", log).startswith("identical: 1.")
    assert "0 missing, 0 more" in good("repeat", log, "--port", "khep://arena4?seed=3")
    with Khepera4(f"khep://{log}?at=0.4") as robot:
        assert robot.time == pytest.approx(0.4, abs=0.01)
        assert robot.speed().left > robot.speed().right > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("calibrate khep://arena4 -o c.toml", "khep://arena4: the robot is a Khepera IV; expected"),
        ("conform khep://arena4", "khep://arena4: the robot is a Khepera IV; expected --model khepera4\n"),
        (
            "conform --model khepera4 khep://default",
            "khep://default: the robot is a Khepera; expected --model khepera\n",
        ),
        (
            "conform LOG",
            "run.mcap: robot 1: model = 'khepera4'; expected a Khepera or Khepera II for the checks",
        ),
        ("shadow default LOG", "run.mcap: khepera0 is a Khepera IV; expected a Khepera\n"),
        ("fit -o f.toml LOG=5turns", "run.mcap: of a khepera4; expected a khepera, or --model khepera4\n"),
        ("serve arena4 --rom 5.02", "rom = '5.02' with model = 'khepera4'; expected kh4server"),
        (
            "serve default --rom kh4server",
            "rom = 'kh4server' with model = 'khepera1'; expected 5.02 or 4.06",
        ),
        ("serve arena4 --mode 3", "mode = 3 with rom = 'kh4server': there is no such mode; expected"),
        ("serve gripper --model khepera4", "turrets = ['gripper'] with model = 'khepera4'; expected none"),
        (
            "serve arena4 --fault dead:17",
            "fault 'dead:17': robot 0 is a Khepera IV; expected left, right, a number below 17, or a name; (",
        ),
        ("exec --fault stuck:nose -- true", "fault 'stuck:nose': robot 0 is a Khepera IV; expected a number"),
    ],
)
def test_a_command_for_other_models_is_a_one_line_error(
    words: str, message: str, log: Path, tmp_path: Path
) -> None:
    result = khep_twin(*words.replace("LOG", str(log)).split(), folder=tmp_path)
    assert result.returncode in (1, 2)
    assert len(result.stderr.splitlines()) == 1
    assert message in result.stderr


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ('turrets = ["gripper"]', r"robot 1: turrets = \['gripper'\] with model = 'khepera4'; expected none"),
        ('rom = "5.02"', r"robot 1: rom = '5.02' with model = 'khepera4'; expected kh4server"),
    ],
)
def test_a_playpen_gives_a_khepera4_neither_turrets_nor_another_rom(key: str, message: str) -> None:
    assert Playpen.load("arena4").robots[0].rom == "kh4server"
    with pytest.raises(PlaypenError, match=message):
        parse(f"{PEN}{ENTRY}{key}\n", "pen.toml")

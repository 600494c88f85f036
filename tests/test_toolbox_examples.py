"""The Khepera Toolbox's own example programs, typed over: on a twin, and on a served one by its terminal."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from khep_twin.host import Khepera, toolbox
from khep_twin.lab import toolbox_khepbase, toolbox_simulator
from khep_twin.log.reader import read

sys.path.append(str(Path(__file__).parent / "ports"))
from test_serve import served  # isort: skip

EXAMPLES = Path(__file__).parents[1] / "examples" / "toolbox"


class Interrupted(Khepera):
    """A robot whose user presses Ctrl-C after so many speeds."""

    def __init__(self, url: str, cycles: int) -> None:
        super().__init__(url)
        self.left = cycles

    def set_speed(self, left: int, right: int) -> None:
        """Drives on, or not."""
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt
        super().set_speed(left, right)


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Interrupted:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return Interrupted("khep://obstacles?seed=1", 300)


@pytest.mark.parametrize("name", ["brait", "brait_khepbase"])
def test_the_braitenberg_vehicle_wanders_until_it_is_interrupted(name: str, robot: Interrupted) -> None:
    toolbox.ports({2: robot})
    if name == "brait_khepbase":
        robot.left = 20
    start = robot.port.twin.robot.pose
    try:
        with pytest.raises(KeyboardInterrupt):
            runpy.run_path(str(EXAMPLES / f"{name}.py"))
    finally:
        toolbox.ports({})
        toolbox_khepbase._views.clear()
    x, y, heading = robot.port.twin.robot.pose
    assert robot.left == 0
    assert abs(x - start[0]) + abs(y - start[1]) > 0.05
    if name == "brait":
        assert abs(heading - start[2]) > 0.1
        assert not Path("khepbase.png").exists()
    else:
        assert Path("khepbase.png").exists()


def test_the_simulators_example_goes_ahead_and_turns_at_the_wall() -> None:
    names = runpy.run_path(str(EXAMPLES / "simsamp1.py"))
    btmap1 = names["btmap1"]
    _, y, heading = btmap1.twin.robot.pose
    toolbox_simulator.close_playpen()
    assert btmap1.time == 50
    # 1000 cycles of 50 ms at 8 mm/s from the middle: it came to the upper wall and turned there.
    assert y > 0.40
    assert abs(heading - 1.5708) > 0.2


def converted(text: str) -> str:
    """A program for the simulator made one for the robot, as the toolbox's manual says."""
    return "".join(
        line for line in text.replace("sim_", "").splitlines(keepends=True) if "btmap1" not in line
    )


def test_without_sim_and_kheprom_it_drives_a_robot_behind_a_terminal(tmp_path: Path) -> None:
    program = converted((EXAMPLES / "simsamp1.py").read_text())
    assert "sms(2, 1, 1)" in program
    assert "kheprom" not in program
    (tmp_path / "samp1.py").write_text(program)
    log = tmp_path / "run.mcap"
    with served("default", "--clock", "wire", "--seed", "1", "--log", str(log)) as (_, path):
        environment = {**os.environ, "KHEP_PORT_2": path}
        command = [sys.executable, "samp1.py"]
        subprocess.run(command, check=True, timeout=120, cwd=tmp_path, env=environment)
    track = read(log).robots["khepera0"]
    spoken = [line.text for line in track.serial]
    assert spoken[:3] == ["D,1,1", "d", "N"]
    # A thousand cycles, a stop of its own, and the one with which the host closes the port.
    assert spoken.count("N") == 1000
    assert spoken[-4:] == ["D,0,0", "d", "D,0,0", "d"]
    assert "D,-1,1" in spoken
    assert track.pose[-1, 1] > 0.40


def test_two_runs_of_the_simulators_example_are_the_same() -> None:
    poses = set()
    for _ in range(2):
        names = runpy.run_path(str(EXAMPLES / "simsamp1.py"))
        poses.add(names["btmap1"].twin.robot.pose)
        toolbox_simulator.close_playpen()
    assert len(poses) == 1

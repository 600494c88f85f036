"""The toolbox's example for its simulator, converted for the robot by its manual's rule, on a terminal."""

import os
import sys
from pathlib import Path

import pytest
from forked import run_python
from served_twin import served

from khep_twin.log.reader import read_log

EXAMPLE = Path(__file__).parents[2] / "examples" / "toolbox" / "simsamp1.py"


def convert(text: str) -> str:
    """Convert a program for the simulator to one for the robot by the rule of the toolbox's manual."""
    return "".join(
        line for line in text.replace("sim_", "").splitlines(keepends=True) if "btmap1" not in line
    )


@pytest.mark.share(2)
@pytest.mark.parametrize("cycles", [50, 500])
def test_without_sim_and_kheprom_it_drives_a_robot_behind_a_terminal(cycles: int, tmp_path: Path) -> None:
    program = convert(EXAMPLE.read_text()).replace("500, 2, 0", f"{cycles}, 2, 0")
    assert "sms(2, 1, 1)" in program
    assert "kheprom" not in program
    (tmp_path / "samp1.py").write_text(program)
    log = tmp_path / "run.mcap"
    with served("default", "--clock", "wire", "--seed", "1", "--log", str(log)) as (_, path):
        environment = {**os.environ, "KHEP_PORT_2": path}
        command = [sys.executable, "samp1.py"]
        assert run_python(command, timeout=120, cwd=tmp_path, env=environment).returncode == 0
    track = read_log(log).robots["khepera0"]
    messages = [line.text for line in track.serial]
    assert messages[:3] == ["D,1,1", "d", "N"]
    # The cycles, the stop of the program, and that of the host when it closes the port.
    assert messages.count("N") == 2 * cycles
    assert messages[-4:] == ["D,0,0", "d", "D,0,0", "d"]
    if cycles == 500:  # it has reached a wall
        assert "D,-1,1" in messages
        assert track.pose[-1, 1] > 0.40

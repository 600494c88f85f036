"""`khep-twin calibrate`: one command from an unknown robot to its calibration."""

import math
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import complaint, good
from forked import Forked, run_python
from served_twin import served

from khep_twin.files.toml_files import dump
from khep_twin.sensing import calibration

BENCH = (
    'version = 1\nname = "bench"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    '[[robot]]\nx_mm = 500\ny_mm = 500\nheading_deg = 0\ncalibration = "hidden.toml"\n'
)
KHEPERA1 = calibration.read("khepera1")[0]


def hidden(folder: Path) -> calibration.Calibration:
    near = KHEPERA1.proximity
    update = {
        "wheels": calibration.WheelCalibration(radius_mm=7.8, base_mm=52.9),
        "proximity": near.model_copy(
            update={"gain_counts_mm2": tuple(1.15 * gain for gain in near.gain_counts_mm2)}
        ),
    }
    calibrated = KHEPERA1.model_copy(update=update)
    (folder / "hidden.toml").write_text(dump(calibrated))
    (folder / "bench.toml").write_text(BENCH.replace("hidden.toml", str(folder / "hidden.toml")))
    return calibrated


@pytest.mark.share(2)
@pytest.mark.parametrize(("walls_mm", "duty_s"), [((12, 26), 0.4), ((12, 20, 26), 0.75)])
def test_a_twin_that_nobody_knows_is_calibrated_by_one_command(
    walls_mm: tuple[int, ...], duty_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.lab.fit.session_steps._DUTY_S", duty_s)
    robot = hidden(tmp_path)
    walls = ",".join(map(str, walls_mm))
    words = ["calibrate", "khep://bench.toml?seed=3", "-o", "mine.toml", "--walls", walls]
    lines = good(*words, "--picture", "fit.png", folder=tmp_path).splitlines()
    assert f"step 1 of {3 + len(walls_mm)}: straight" in lines
    near = "Put the robot with its front 26 mm from a flat white wall, 50 mm high or more"
    assert f"{near}, looking straight at it." in lines
    calibrated = calibration.read(str(tmp_path / "mine.toml"))[0]
    assert calibrated.wheels.radius_mm == pytest.approx(robot.wheels.radius_mm, rel=0.004)
    assert calibrated.wheels.base_mm == pytest.approx(robot.wheels.base_mm, rel=0.005)
    assert calibrated.motors.no_load_speed_rad_s == pytest.approx(robot.motors.no_load_speed_rad_s, rel=0.02)
    assert calibrated.motors.stall_torque_n_m == pytest.approx(robot.motors.stall_torque_n_m, rel=0.1)
    gains = zip(calibrated.proximity.gain_counts_mm2, robot.proximity.gain_counts_mm2, strict=True)
    assert all(math.isclose(one, other, rel_tol=0.15) for one, other in gains)
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    recordings = {path.name for path in (tmp_path / "mine-session").iterdir()}
    wall_files = {f"wall-{distance_mm}.csv" for distance_mm in walls_mm}
    assert recordings == {"straight.mcap", "turns.mcap", "duty.mcap", "tests.txt"} | wall_files
    assert "mine.toml: is there already" in complaint(*words, folder=tmp_path, codes=[2])


@pytest.mark.long
def test_a_person_at_a_served_twin_reads_answers_and_interrupts(tmp_path: Path) -> None:
    """Two steps are skipped, the third is driven, and Ctrl-C comes before the wall."""
    hidden(tmp_path)
    command = [sys.executable, "-m", "khep_twin", "calibrate", "", "-o", "mine.toml", "--walls", "12"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with served(str(tmp_path / "bench.toml")) as (_, command[4]):
        with Forked(command, **pipes, cwd=tmp_path, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write("s\ns\n\n")
            process.stdin.flush()
            lines = [*iter(process.stdout.readline, "step 4 of 4: wall\n")]
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
            assert process.stderr is not None
            assert "the same command resumes from mine-session" in process.stderr.read()
        ended = run_python(command, input="s\ns\n", cwd=tmp_path)
    assert "step 2 of 4: skipped\n" in lines
    assert "step 3 of 4: duty.mcap=duty\n" in lines
    assert (tmp_path / "mine-session" / "tests.txt").read_text() == "duty.mcap=duty\n"
    assert ended.returncode == 1
    assert "step 3 of 4: done before: duty.mcap=duty" in ended.stdout
    (line,) = ended.stderr.splitlines()
    assert "the input ended at the question" in line
    assert not (tmp_path / "mine.toml").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--walls", "12,x"], "expected distances in mm"),
        (["--walls", "500"], "wall = 500; expected 1 to 300"),
        (["--lamp", "-1"], "lamp = -1; expected"),
        (["--ruler-mm", "-1"], "ruler = -1; expected"),
        (["--picture", "mine.toml"], "expected a separate file"),
    ],
)
def test_wrong_options_are_refused_before_the_robot_moves(
    tmp_path: Path, words: list[str], message: str
) -> None:
    words = ["calibrate", "khep://default", "-o", "mine.toml", *words]
    assert message in complaint(*words, folder=tmp_path, codes=[1])
    assert list(tmp_path.iterdir()) == []

"""Running controllers."""

from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from shares import share

from khep_twin.board.kernel import SETPOINTS
from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.experiment import run
from khep_twin.log.reader import read_log


def test_a_run_ends_after_its_cycles_or_its_time() -> None:
    with Khepera("khep://default") as robot:
        assert run(braitenberg, robot, cycles=10).cycles == 10
        start = robot.time
        outcome = run(braitenberg, robot, seconds=1)
        assert 1 <= outcome.duration < 1.1
        assert robot.time - start < 1.2
        assert robot.port.twin.robot.registers[SETPOINTS].tolist() == [0, 0]
        with pytest.raises(ValueError, match="no cycles and no seconds; expected one of them"):
            run(braitenberg, robot)


def test_progress_rises_to_one() -> None:
    parts: list[float] = []
    with Khepera("khep://default") as robot:
        run(braitenberg, robot, cycles=5, progress=parts.append)
    assert parts == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_the_motors_stop_when_a_controller_fails() -> None:
    def fails(robot: Khepera) -> None:
        robot.set_speed(20, 20)
        raise RuntimeError("of its own")

    with Khepera("khep://default") as robot:
        with pytest.raises(ControllerError, match=r"test_experiment.py:\d+: RuntimeError: of its own"):
            run(fails, robot, cycles=5)
        assert robot.port.twin.robot.registers[SETPOINTS].tolist() == [0, 0]


@pytest.mark.parametrize(("seed", "seconds"), share([(1, 30), (1, 120), (2, 120)], 3))
def test_the_vehicle_wanders_and_never_stands_for_five_seconds(
    seed: int, seconds: int, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    with Khepera(f"khep://obstacles?seed={seed}&log={log}") as robot:
        run(braitenberg, robot, seconds=seconds)
    track = read_log(log).robots["khepera0"]
    five_seconds = 250
    extents = np.hypot(
        *(np.ptp(sliding_window_view(track.pose[:, axis], five_seconds), axis=1) for axis in (0, 1))
    )
    assert extents.min() > 0.05
    assert np.ptp(track.pose[:, 0]) > 0.3


def test_a_controller_is_found_by_name_or_in_a_file(tmp_path: Path) -> None:
    assert find_controller("braitenberg") is braitenberg
    file = tmp_path / "mine.py"
    file.write_text("import beside\ndef controller(robot): beside.go(robot)\ndef other(robot): ...\n")
    (tmp_path / "beside.py").write_text("def go(robot): robot.set_speed(1, 1)\n")
    assert find_controller(str(file)).__name__ == "controller"
    assert find_controller(f"{file}:other").__name__ == "other"
    file.write_text("def only(robot): ...\n")
    assert find_controller(str(file)).__name__ == "only"


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("", "braitenburg", r"braitenburg: no such controller; .*did you mean 'braitenberg'\?"),
        ("", "{folder}/none.py", "none.py: no such file"),
        ("x = (", "{file}", r"mine.py:1: SyntaxError"),
        (
            "import nothing_like_it",
            "{file}",
            r"mine.py:1: ModuleNotFoundError: No module named 'nothing_like_it'",
        ),
        ("\n1 / 0", "{file}", r"mine.py:2: ZeroDivisionError"),
        ("def f(robot): ...", "{file}:g", r"no function 'g' that takes a robot.*choices: f"),
        ("def f(r): ...\ndef g(r): ...", "{file}", r"no function 'controller' .*choices: f, g"),
    ],
)
def test_a_controller_that_cannot_be_used_says_where_and_why(
    text: str, name: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(ControllerError, match=message) as caught:
        find_controller(name.format(file=file, folder=tmp_path))
    assert "\n" not in str(caught.value)

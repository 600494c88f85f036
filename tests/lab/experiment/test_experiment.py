"""Running controllers."""

from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from khep_twin.board.kernel import SETPOINTS
from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controller_files import find_controller, find_driver
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


@pytest.mark.share(3)
@pytest.mark.parametrize(("seed", "seconds"), [(1, 30), (1, 120), (2, 120)])
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
        ("def f(r): ...\ndef g(r): ...", "{file}", r"no function 'controller' .*mine.py:f \(choices: f, g"),
        ("a, b, *_ = 'proximity'.splt()", "{file}", r"attribute 'splt'. Did you mean: 'split'\?$"),
        ("speed = 1\nspeeed", "{file}", r"'speeed' is not defined. Did you mean: 'speed'\?$"),
        ("def f(a, b): ...", "{file}", r"'f' takes \(a, b\); expected one robot; .* rollout .*mine.py:f$"),
        ("", "obstacles", r"obstacles: no such controller; .* for a playpen --playpen obstacles$"),
        ("", "{folder}/none.py", r"none.py: no such file; to make one: .* new controller .*none.py$"),
        ("", "{folder}/folder.py", r"folder.py: cannot be read: Is a directory; expected the name of"),
    ],
)
def test_a_controller_that_cannot_be_used_says_where_and_why(
    text: str, name: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    (tmp_path / "folder.py").mkdir()
    with pytest.raises(ControllerError, match=message) as caught:
        find_controller(name.format(file=file, folder=tmp_path))
    assert "\n" not in str(caught.value)


def test_a_file_without_a_controller_says_what_is_in_it_and_what_two_lines_it_needs(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("import math\nspeed = 5\nclass Avoider:\n    def cycle(self, robot): ...\n")
    with pytest.raises(ControllerError) as caught:
        find_controller(str(file))
    message, *lines = str(caught.value).splitlines()
    expected = "expected a class of khep_twin.Controller, or two lines such as"
    assert message.endswith(f"in it: speed, class Avoider; {expected}")
    file.write_text("\n".join(lines))
    assert find_controller(str(file))
    with pytest.raises(ControllerError, match=r"takes \(robot\); .*for one of a robot: .* run "):
        find_driver(str(file))


def test_an_error_in_a_module_that_a_controller_imports_has_both_places(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("\nimport beside_it\n")
    for text, message in (
        ("x = 1\n\ndef go(robot:\n    pass\n", r"SyntaxError: .*\(beside_it.py, line 3\)$"),
        ("x = 1\ny = x.real.imagg\n", r"AttributeError: .*'imag'\? \(beside_it.py, line 2\)$"),
    ):
        (tmp_path / "beside_it.py").write_text(text)
        with pytest.raises(ControllerError, match=rf"mine\.py:2: {message}"):
            find_controller(str(tmp_path / "mine.py"))


def test_a_controller_in_utf_16_is_named_as_such(tmp_path: Path) -> None:
    for encoding in ("utf-16", "utf-16-le", "utf-16-be"):
        (tmp_path / "mine.py").write_bytes("def f(robot): ...\n".encode(encoding))
        with pytest.raises(ControllerError, match=r"mine.py: cannot be read: .* UTF-16; expected UTF-8"):
            find_controller(str(tmp_path / "mine.py"))

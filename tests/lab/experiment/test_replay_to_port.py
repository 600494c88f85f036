"""Replay of a log's bytes to another port: the same twin replies equally, another twin differs."""

from pathlib import Path

import pytest
from relay_logs import relayed
from served_twin import served

from khep_twin.errors import LogError, PortError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.replay_to_port import replay_to_port
from khep_twin.log.recorded import read_recorded_run
from khep_twin.ports.twin import TwinOptions, open_twin

URL = "khep://obstacles?seed=5"


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of three seconds of a host that sends several commands."""
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    with Khepera(f"{URL}&log={path}") as robot:
        robot.set_speed(5, 3)
        while robot.time < 3:
            robot.proximity()
            robot.speed()
            robot.position()
            robot.sleep(0.05)
    return path


def test_the_same_twin_answers_the_same(driven: Path) -> None:
    comparison = replay_to_port(read_recorded_run(driven), URL)
    assert comparison.is_identical
    assert {letter for letter, replies in comparison.letters.items() if replies.compared > 10} == {
        "n",
        "e",
        "h",
    }


def test_another_twin_differs_in_numbers(driven: Path) -> None:
    comparison = replay_to_port(read_recorded_run(driven), "khep://default?seed=5&noise=off")
    assert not comparison.is_identical
    assert comparison.letters["d"].different == 0
    near = comparison.letters["n"]
    assert near.differences.shape == (near.compared, 8)
    lines = comparison.text().splitlines()
    assert lines[0].startswith("khepera0: ")
    assert lines[-1].startswith("first difference at 0.0")


def test_lost_bytes_do_not_bring_the_rest_out_of_step(driven: Path) -> None:
    comparison = replay_to_port(read_recorded_run(driven), f"{URL}&fault=drop:0.003")
    assert 0 < comparison.letters["h"].different < comparison.letters["h"].compared
    assert comparison.missing + comparison.additional < 20


def test_a_line_that_is_silent_leaves_all_missing(driven: Path) -> None:
    recorded = read_recorded_run(driven)
    comparison = replay_to_port(recorded, f"{URL}&fault=drop:1")
    assert comparison.missing == sum(line.name == "robot" for line in recorded.lines[0])
    assert not comparison.is_identical


def test_what_was_sent_to_a_real_robot_can_be_sent_to_a_twin(tmp_path: Path) -> None:
    driven = (0, True, b"D,5,5\n"), (20, False, b"d\r\n")
    read = (500, True, b"H\n"), (520, False, b"h,10,20\r\n")
    log = relayed(tmp_path / "robot.mcap", [*driven, *read], baud=9600)
    comparison = replay_to_port(read_recorded_run(log), "khep://default")
    assert comparison.letters["d"].different == 0
    assert comparison.letters["h"].differences.shape == (1, 2)


def test_a_served_twin_answers_over_its_terminal(driven: Path) -> None:
    with served("obstacles", "--seed", "5") as (_, port):
        comparison = replay_to_port(read_recorded_run(driven), port)
    assert (comparison.missing, comparison.additional) == (0, 0)
    # Of 1500 pulses on the left; on a busy machine the first command may be half a second late.
    assert abs(comparison.letters["h"].differences).max() < 250


def test_what_cannot_be_sent_is_one_line(tmp_path: Path, driven: Path) -> None:
    with open_twin("default", TwinOptions(log=str(tmp_path / "run.mcap"))) as twin:
        twin.advance_to(100_000_000)
    with pytest.raises(LogError, match="no host has sent anything"):
        replay_to_port(read_recorded_run(tmp_path / "run.mcap"), URL)
    with pytest.raises(PortError, match="nowhere"):
        replay_to_port(read_recorded_run(driven), "khep://nowhere")

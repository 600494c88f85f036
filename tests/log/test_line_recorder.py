"""Channels of a recorded line, by the replies of robots of several models."""

from pathlib import Path

import pytest
from relay_logs import in_turn, relayed

from khep_twin.errors import LogError
from khep_twin.lab.conformance.recording.recorded_line import recorded_lines
from khep_twin.log.reader import read_log, read_series
from khep_twin.robots.registry import find_model


def numbers(count: int, first: int = 0) -> str:
    return ",".join(map(str, range(first, first + count)))


def exchanges(*pairs: str, end: str = "\r\n") -> list[tuple[int, bool, bytes]]:
    """Return requests and replies in turn."""
    return in_turn(*(f"{text}{end if number % 2 else chr(10)}".encode() for number, text in enumerate(pairs)))


@pytest.mark.parametrize(
    ("model", "lines", "end", "channels"),
    [
        (
            "khepera3-firmware2",
            *(
                ["N", f"n,{numbers(12)}", "D,l100,l-90", "d", "E", "e,98,-91", "R", "r,5,-6", "G,1", "g,1"],
                "\n\r",
                {"proximity": [*range(11)], "speed": [98, -91, 100, -90], "position": [5, -6, 0, 0]},
            ),
        ),
        (
            "khepera4",
            *(
                [
                    "O",
                    f"o,{numbers(12)}",
                    "G",
                    "g,1,2,3,4,5",
                    "T",
                    f"t,{numbers(30)}",
                    "D,7,8",
                    "d",
                    "E",
                    "e,6,9",
                ],
                "\r\n",
                {
                    "ambient": [*range(12)],
                    "ultrasonic": [1, 2, 3, 4, 5],
                    "accelerometer": [0, 10, 20],
                    "speed": [6, 9, 7, 8],
                },
            ),
        ),
        (
            "khepera1",
            *(
                ["N", f"n,{numbers(8)}", "D, 5, -5", "d", "E", "e,4,-4", "H", "h,1,2"],
                "\r\n",
                {"proximity": [*range(8)], "speed": [4, -4, 5, -5]},
            ),
        ),
    ],
)
def test_a_relayed_line_gives_the_channels_of_its_model(
    tmp_path: Path, model: str, lines: list[str], end: str, channels: dict[str, list[int]]
) -> None:
    chunks = exchanges(*lines, end=end)
    path = relayed(tmp_path / "real.mcap", chunks, find_model(model))
    series = read_series(path).series
    assert {name.removeprefix("/khepera0/"): item.values.tolist() for name, item in series.items()} == {
        name: [values] for name, values in channels.items()
    }
    run = read_log(path)
    assert run.robots["khepera0"].model.name == model
    assert [line.text for line in run.robots["khepera0"].serial] == lines


def test_replies_of_another_model_or_with_noise_are_in_the_transcript_alone(tmp_path: Path) -> None:
    lines = ("N", f"n,{numbers(12)}", "N", "n,1,2,x,4,5,6,7,8", "D,5", "z")
    path = relayed(tmp_path / "real.mcap", exchanges(*lines))
    assert read_series(path).series == {}
    assert [line.text for line in read_log(path).robots["khepera0"].serial] == [*lines]


def test_a_log_that_names_no_installed_model_is_read_by_its_channels(tmp_path: Path) -> None:
    path = relayed(tmp_path / "real.mcap", exchanges("N", f"n,{numbers(8)}"), model=None)
    assert read_log(path).robots["khepera0"].model.name == "khepera1"
    assert "model" not in read_log(path).metadata


def test_the_checks_of_a_recording_refuse_a_relayed_khepera_iii_by_its_model(tmp_path: Path) -> None:
    path = relayed(tmp_path / "real.mcap", exchanges("B", "b,3,0"), find_model("khepera3"))
    message = "robot 1: model = 'khepera3'; expected a Khepera or Khepera II for the checks of a recording"
    with pytest.raises(LogError, match=message):
        recorded_lines(path)
